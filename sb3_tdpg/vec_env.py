"""
Vectorised environments: many episodes of one :class:`~sb3_tdpg.envs.base.POMDPEnv` as a single batch.

Dimension key: N environments side by side, X state, U action.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import time
from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, cast

import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import EnvSpec, load_env_creator
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

from sb3_tdpg.checks import check_action_space
from sb3_tdpg.common.threads import usable_cores
from sb3_tdpg.envs.base import POMDPEnv
from sb3_tdpg.envs.checks import count as check_count
from sb3_tdpg.presets import DEFAULTS, preset_of
from sb3_tdpg.problem import horizon_of


class BatchedVecEnv(VecEnv):
    """
    An SB3 ``VecEnv`` that steps N episodes of one environment in a single NumPy call.

    It calls the same methods as the environment from ``gymnasium.make``, so the dynamics cannot differ. Only the
    leading dimension is N instead of 1. All episodes run in lockstep. As in every SB3 ``VecEnv``, a new episode begins
    at once when an episode has finished. As with ``Monitor``, ``info["episode"]`` reports the return and the length of
    an episode.

    :param env: The environment, without wrappers.
    :param n_envs: Number of episodes N.
    """

    def __init__(self, env: POMDPEnv, n_envs: int) -> None:
        self.env = env
        super().__init__(n_envs, env.observation_space, env.action_space)
        self._state = np.empty((0, 0))
        self._start_time = time.time()

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the generator that all episodes share; takes effect at the next ``reset``."""
        self._seeds = [seed] * self.num_envs
        return self._seeds

    def reset(self) -> np.ndarray:
        """Start N episodes and return y_0, ``(N, *obs)``; the true states x_0 are in ``reset_infos``."""
        if any(self._options):
            raise ValueError(
                f"{type(self.env).__name__} takes no reset options: pass variations to its constructor (env_kwargs)"
            )
        if self._seeds[0] is not None:
            gym.Env.reset(self.env, seed=self._seeds[0])
        self._reset_seeds()
        return self._start_episodes()

    def _start_episodes(self) -> np.ndarray:
        self._time = 0
        self._returns = np.zeros(self.num_envs)
        self._state, observation = self.env.reset_batch(self.num_envs)
        self.reset_infos = [{"state": state} for state in self._state.copy()]
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Store the actions, ``(N, U)``."""
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Apply the stored actions; see :class:`stable_baselines3.common.vec_env.VecEnv`."""
        if not len(self._state):
            raise gym.error.ResetNeeded("the episodes have not begun: call reset() first")
        is_last = self._time + 1 == self.env.horizon
        self._state, observation, cost, details = self.env.step_batch(self._state, self._actions, is_last=is_last)
        self._time += 1
        self._returns -= cost
        infos: list[dict[str, Any]] = [
            {"state": state, "cost": c} for state, c in zip(self._state.copy(), cost.tolist(), strict=True)
        ]
        for info, more in zip(infos, details, strict=False):
            info.update(more)
        if is_last:
            elapsed = round(time.time() - self._start_time, 6)
            for i, info in enumerate(infos):
                info.update({"TimeLimit.truncated": False, "terminal_observation": observation[i]})
                info["episode"] = {"r": float(self._returns[i]), "l": self._time, "t": elapsed}
            observation = self._start_episodes()
        return observation, (-cost).astype(np.float32), np.full(self.num_envs, is_last), infos

    def close(self) -> None:
        """Close the environment."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return the attribute of the environment, once per index."""
        value = getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of the environment that all episodes share."""
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the environment; return its result once per index."""
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Return True for ``Monitor``, whose work this class does, and False for all other wrappers."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Render the current state of every episode."""
        before = self.env._state
        images: list[Any] = []
        for state in self._state:
            self.env._state = state[None]
            images.append(self.env.render())
        self.env._state = before
        return images


def _spec(env_id: str) -> EnvSpec:
    """Return the registered specification; unlike ``gym.spec``, this also takes the ``module:id`` form."""
    module, _, bare_id = env_id.rpartition(":")
    if module:
        import_module(module)
    return gym.spec(bare_id)


def _creator(spec: EnvSpec) -> Any:
    return spec.entry_point if callable(spec.entry_point) else load_env_creator(str(spec.entry_point))


def batched_class(env_id: str) -> type[POMDPEnv] | None:
    """Return the class behind a registered id whose episodes can be stepped as one batch; ``None`` for other ids."""
    spec = _spec(env_id)
    creator = _creator(spec)
    is_ours = isinstance(creator, type) and issubclass(creator, POMDPEnv)
    is_wrapped = spec.additional_wrappers or spec.max_episode_steps is not None
    return cast(type[POMDPEnv], creator) if is_ours and not is_wrapped else None


def _default_n_envs(env: gym.Env, n_episodes: int | None, epoch_steps: int | None, *, batched: bool) -> int:
    """Return the default number of environments for an epoch of the given length or of TDPG's default length."""
    horizon = horizon_of(env)
    if not n_episodes and not epoch_steps:
        defaults = DEFAULTS[preset_of(env.observation_space, horizon)]
        n_episodes, epoch_steps = defaults.n_episodes, defaults.epoch_steps
    if n_episodes is None:  # so that an epoch of full episodes has at most epoch_steps steps
        assert epoch_steps is not None
        return max(1, min(epoch_steps // (horizon or 1), epoch_steps if batched else 10))
    # Each environment runs the same number of episodes.
    return n_episodes if batched else largest_divisor(n_episodes)


def largest_divisor(n_episodes: int, limit: int = 50) -> int:
    """Return the largest number of environments, up to a limit, that divides ``n_episodes``."""
    return max(n for n in range(1, min(n_episodes, limit) + 1) if n_episodes % n == 0)


def made_env(env: GymEnv | str | None, n_envs: int | None, **sizes: Any) -> GymEnv | None:
    """Return the environment that a model was given, or make it from its id; ``sizes`` is the length of an epoch."""
    if isinstance(env, str):
        env = make_episodes_env(env, n_envs, **sizes)
    elif n_envs is not None and (given := getattr(env, "num_envs", 1)) != n_envs:
        raise ValueError(
            f"n_envs={n_envs} applies to an environment given by its id, but the environment given has {given}: leave "
            "n_envs out"
        )
    if env is not None:
        check_action_space(env.action_space)
    return env


def make_episodes_env(
    env_id: str,
    n_envs: int | None = None,
    *,
    n_episodes: int | None = None,
    epoch_steps: int | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    seed: int | None = None,
    use_processes: bool = True,
) -> VecEnv:
    """
    Make a vectorised environment from a registered id, in the fastest way available.

    :param env_id: A registered Gymnasium id, also in the ``module:id`` form.
    :param n_envs: Number of environments. Default: ``n_episodes`` for a :class:`BatchedVecEnv`, else the largest
        divisor of ``n_episodes`` up to 50. With ``epoch_steps`` the default is the number of whole episodes that fit
        into an epoch. For any other environment than a :class:`BatchedVecEnv`, this number is at most 10.
    :param n_episodes: Number of episodes per epoch; default: TDPG's default.
    :param epoch_steps: Number of steps per epoch, instead of ``n_episodes``.
    :param env_kwargs: Keywords for the environment's constructor.
    :param seed: Seed for the first reset.
    :param use_processes: Whether the Panda environments, and BallCatch-v0 with PyBullet, use one process per core; the
        numbers are the same either way.
    :return: a :class:`BatchedVecEnv` for an environment of this package or another subclass of
        :class:`~sb3_tdpg.envs.base.POMDPEnv`, else SB3's ``DummyVecEnv``
    :raises ValueError: if a number is not an integer of at least 1.
    :raises gymnasium.error.Error: if the id is not registered.
    """
    for name, value in dict(n_envs=n_envs, n_episodes=n_episodes, epoch_steps=epoch_steps).items():
        if value is not None:
            check_count(name, value)
    env_kwargs = dict(env_kwargs or {})
    env_class, spec = batched_class(env_id), _spec(env_id)
    if env_class is not None:
        if use_processes and env_class.shares_work:
            env_kwargs.setdefault("n_processes", usable_cores())
        own = {**spec.kwargs, **env_kwargs}
        env = env_class(**own)
        env.spec = dataclasses.replace(spec, kwargs=own)  # as gym.make does
        if n_envs is None:
            n_envs = _default_n_envs(env, n_episodes, epoch_steps, batched=True)
        vec_env: VecEnv = BatchedVecEnv(env, n_envs)
        vec_env.seed(seed)
        return vec_env
    if n_envs is None:
        with contextlib.closing(gym.make(env_id, **env_kwargs)) as probe:
            n_envs = _default_n_envs(probe, n_episodes, epoch_steps, batched=False)
    # Given an id, make_vec_env requests rendering, and an environment without rendering then warns. Given a function,
    # make_vec_env does not request rendering.
    modes = getattr(_creator(spec), "metadata", {"render_modes": ["rgb_array"]}).get("render_modes", ())
    make = env_id if "rgb_array" in modes else functools.partial(gym.make, env_id)
    return make_vec_env(make, n_envs=n_envs, seed=seed, env_kwargs=env_kwargs)
