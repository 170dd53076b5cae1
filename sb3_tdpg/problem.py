"""
The properties of an environment that TDPG needs in addition to its spaces: the horizon and the true state.

Dimension key: E environments, X state.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecCheckNan, VecEnv, VecEnvWrapper, VecMonitor

from sb3_tdpg.checks import LARGEST, check_start
from sb3_tdpg.features import observation_kind

BRING_THE_STATE = (
    "give the environment an attribute `state_space` (a Box) and put a copy of the true state into "
    'info["state"] in both reset() and step()'
)


@dataclass(frozen=True)
class Problem:
    """
    A finite-horizon problem as the algorithm sees it.

    :param horizon: Number of actions T in an episode.
    :param state_dim: Dimension X of the state.
    :param state_is_observation: Whether the observation stands in for the state, because the environment does not
        report its state.
    :param state_names: Names of the X components: the environment's ``state_names``, or ``x0``, ``x1``, ...
    """

    horizon: int
    state_dim: int
    state_is_observation: bool
    state_names: tuple[str, ...]

    def initial_states(self, env: VecEnv, obs: np.ndarray) -> np.ndarray:
        """Return x_0 after a reset or an automatic reset of all environments: ``(E, X)``."""
        # The reset_infos of SB3's wrappers stay empty.
        return self._states(env, env.unwrapped.reset_infos, obs)

    def next_states(self, env: VecEnv, obs: np.ndarray, dones: np.ndarray, infos: list[dict[str, Any]]) -> np.ndarray:
        """Return x_{t+1} after a step, or x_0 of the next episode if the episode has ended: ``(E, X)``."""
        if dones.any():
            reset_infos = env.unwrapped.reset_infos
            infos = [reset_infos[i] if done else info for i, (done, info) in enumerate(zip(dones, infos, strict=True))]
        return self._states(env, infos, obs)

    def _states(self, env: VecEnv, infos: list[dict[str, Any]], obs: np.ndarray) -> np.ndarray:
        if self.state_is_observation:
            obs = unperturbed(env, obs)
            parts = list(obs.values()) if isinstance(obs, dict) else [obs]
            return np.concatenate([x.reshape(len(x), -1) for x in parts], axis=1, dtype=np.float32)
        try:
            states = [info["state"] for info in infos]
        except KeyError as e:
            raise ValueError(f'the environment has a `state_space` but no info["state"]: {BRING_THE_STATE}') from e
        for i, state in enumerate(states):
            if np.size(state) != self.state_dim:
                raise ValueError(
                    f'info["state"] of environment {i} has shape {np.shape(state)}, but `state_space` has '
                    f"{self.state_dim} components: mend reset() and step(), or the space"
                )
        return np.stack([np.ravel(state) for state in states])


def unperturbed(env: VecEnv, obs: Any) -> Any:
    """Return the observations from before all perturbations, also if several ``PerturbedVecEnv`` are nested."""
    while isinstance(env, VecEnvWrapper) and ("unperturbed" in vars(env) or type(env) in (VecMonitor, VecCheckNan)):
        obs, env = vars(env).get("unperturbed", obs), env.venv
    return obs


def read_problem(env: VecEnv, **keywords: bool) -> Problem:
    """
    Read the horizon and the state's dimension of an environment without stepping it, or raise a ``ValueError``.

    :param keywords: See :func:`~sb3_tdpg.features.observation_kind`.
    """
    check_start("observation", env.observation_space)
    if isinstance(env.observation_space, spaces.Tuple):
        raise ValueError(
            f"the observation space {env.observation_space} is not supported: use gymnasium.wrappers.FlattenObservation"
        )
    horizon = horizon_of(env)
    if not isinstance(horizon, (int, np.integer)) or horizon < 1:
        raise ValueError(
            f"TDPG needs a finite horizon, and the environment has none (horizon={horizon!r}): give it an integer "
            "attribute `horizon`, or wrap it in gymnasium.wrappers.TimeLimit and register it with max_episode_steps"
        )
    state_space = attribute_of(env, "state_space")
    # POPGym's environments (with observability_level) declare the space of their state but do not report the state.
    is_observation = state_space is None or env.has_attr("observability_level")
    if is_observation and observation_kind(env.observation_space, **keywords) != "vector":
        raise ValueError(
            f"the mutual information needs the true state, and an image ({env.observation_space}) cannot stand in for "
            f"it: {BRING_THE_STATE}"
        )
    space = env.observation_space if is_observation else state_space
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    state_dim = sum(math.prod(part.shape or ()) for part in parts)
    return Problem(int(horizon), state_dim, is_observation, _state_names(env, state_dim))


def horizon_of(env: VecEnv | gym.Env) -> Any:
    """Return the horizon that an environment declares, or its time limit; ``None`` if it has neither."""
    horizon = attribute_of(env, "horizon")
    if horizon is None:
        spec = attribute_of(env, "spec")
        horizon = None if spec is None else spec.max_episode_steps
    # The spec does not contain a TimeLimit that was added by the user or by the function behind the id.
    return attribute_of(env, "_max_episode_steps") if horizon is None else horizon


def _state_names(env: VecEnv, state_dim: int) -> tuple[str, ...]:
    names = attribute_of(env, "state_names")
    if names is None:
        return tuple(f"x{k}" for k in range(state_dim))
    if isinstance(names, str) or len(names) != state_dim or len(set(names)) != state_dim:
        raise ValueError(
            f"the environment's state_names={names!r} must be {state_dim} different names, one for each component of "
            'the state, with its unit: ("d (m)", "v (m/s)") for two. Leave the attribute out to have x0, x1, ...'
        )
    return tuple(str(name) for name in names)


def attribute_of(env: VecEnv | gym.Env, name: str) -> Any:
    """Return an attribute of the first environment, or ``None`` if there is none."""
    if isinstance(env, gym.Env):
        return env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None
    return env.get_attr(name, indices=[0])[0] if env.has_attr(name) else None


def check_numbers(what: str, values: np.ndarray, shape: tuple[int, ...] | None, t: np.ndarray) -> None:
    """
    Raise a ``ValueError`` if values of the environments, ``(E, *shape)``, cannot be given to a network.

    They must have the shape of their space, and no number may be NaN, infinite or larger than 1e18 in absolute value.
    ``t`` is the time step of each environment, ``(E,)``.
    """
    if values.shape[1:] != shape:
        raise ValueError(
            f"the environments returned {what}s of shape {values.shape[1:]} at step {t.max()} of an episode, but their "
            f"space has the shape {shape}: mend reset() and step(), or the space"
        )
    if np.issubdtype(values.dtype, np.floating) and not (good := np.abs(values) <= LARGEST).all():
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        env, component = index[0], f" in component {list(index[1:])}" if shape else ""
        raise ValueError(
            f"environment {env} returned the {what} {values[index]:g}{component} at step "
            f"{t[env]} of its episode: it must be a finite number of at most {LARGEST:g}"
        )


def check_observations(space: spaces.Space, observations: Any, t: np.ndarray) -> None:
    """Check the observations of all environments, see :func:`check_numbers`."""
    if isinstance(space, spaces.Dict):
        for key, part in space.items():
            check_numbers(f"observation[{key!r}]", observations[key], part.shape, t)
    else:
        check_numbers("observation", observations, space.shape, t)


@contextmanager
def named_shapes(env: VecEnv) -> Iterator[None]:
    """Replace NumPy's error for a wrongly shaped observation in an SB3 ``VecEnv`` by an error that names the shape."""
    try:
        yield
    except ValueError as e:
        frames = {frame.f_code.co_name: frame for frame, _ in traceback.walk_tb(e.__traceback__)}
        frame = frames.get("_save_obs") or frames.get("_stack_obs")
        if frame is None:
            raise
        index = frame.f_locals.get("env_idx")  # known in the DummyVecEnv only
        who = "an environment" if index is None else f"environment {index}"
        found = "" if index is None else f" {np.shape(frame.f_locals['obs'])}"
        raise ValueError(
            f"{who} returned an observation of a wrong shape{found} in reset() or step(): its observation_space "
            f"has the shape {env.observation_space.shape}"
        ) from e
