"""
The wrappers that perturb observations or actions: one for a Gymnasium environment, one for an SB3 ``VecEnv``.

Dimension key: N environments side by side.
"""

import functools
from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import RecordConstructorArgs
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_tdpg.problem import attribute_of, horizon_of
from sb3_tdpg.robustness.core import Perturber, each_part
from sb3_tdpg.robustness.registry import Perturbation, find_applicable
from sb3_tdpg.robustness.scale import default_scale

Scale = float | np.ndarray | Mapping[str, Any] | None


class PerturbedObservation(gym.ObservationWrapper, RecordConstructorArgs):
    """
    Perturb the observations of one environment, or its actions.

    A perturbation of observations does not change state, reward, info and the environment's random numbers.
    ``reset(seed=...)`` also seeds the perturbation.

    :param env: Any environment with a suitable observation space. Its attribute ``observation_groups`` may name the
        components that fail together: ``{"imu": [0, 1, 2]}``, or ``{"imu": ["gyroscope"]}`` in a ``Dict``.
    :param perturbation: A name in :data:`~sb3_tdpg.robustness.PERTURBATIONS`.
    :param severity: 1 (mild) to 5 (strong).
    :param seed: Seed of the perturbation, combined with the seed of ``reset``. Without both it is random.
    :param scale: Scale of the components of a vector (in a ``Dict`` also by key); default: from the bounds of the
        space, and where they are infinite, measured in a short rollout
        (:func:`~sb3_tdpg.robustness.observation_scale`).
    :raises ValueError: if name or severity are unknown, or the perturbation does not apply.
    """

    def __init__(
        self, env: gym.Env, perturbation: str, severity: int = 3, *, seed: int | None = None, scale: Scale = None
    ) -> None:
        if isinstance(env, VecEnv):
            raise ValueError(f"{type(env).__name__} holds several environments: use PerturbedVecEnv")
        RecordConstructorArgs.__init__(self, perturbation=perturbation, severity=severity, seed=seed, scale=scale)
        gym.ObservationWrapper.__init__(self, env)
        self._perturber = make_perturber(perturbation, severity, env, 1, seed, scale)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and perturb its first observation."""
        observation, info = self.env.reset(seed=seed, options=options)
        if seed is not None:
            self._perturber.reseed(seed)
        self._perturber.begin(np.arange(1))
        return self.observation(observation), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step, with a perturbed action or observation."""
        if self._perturber.perturbation.kind == "action":
            (action,) = self._perturber(np.asarray(action)[None])
        return super().step(action)

    def observation(self, observation: Any) -> Any:
        """Perturb the next observation of the episode."""
        if self._perturber.perturbation.kind == "action":
            return observation
        batch = each_part(lambda part: np.asarray(part)[None], observation)
        return each_part(lambda part: part[0], self._perturber(batch))


class PerturbedVecEnv(VecEnvWrapper):
    """
    Perturb the observations of N environments in one call, or their actions.

    Every episode has its own draw, also after an automatic reset; ``info["terminal_observation"]`` is perturbed as the
    last observation of the episode that has ended. A perturbation of observations does not change state, reward, the
    rest of info and the environments' random numbers. ``env.seed(...)`` also seeds the perturbation. Put this wrapper
    inside a ``VecNormalize`` or a ``VecFrameStack``. The parameters are those of :class:`PerturbedObservation`; the
    perturbation need not be registered.
    """

    def __init__(
        self,
        venv: VecEnv,
        perturbation: str | Perturbation,
        severity: int = 3,
        *,
        seed: int | None = None,
        scale: Scale = None,
    ) -> None:
        if not isinstance(venv, VecEnv):
            name = type(venv).__name__
            raise ValueError(f"{name} is not a VecEnv of Stable-Baselines3: use make_vec_env, or PerturbedObservation")
        if isinstance(venv, VecNormalize) and venv.norm_obs:
            raise ValueError("perturb observations before they are normalised: VecNormalize(PerturbedVecEnv(env, ...))")
        super().__init__(venv)
        self._perturber = make_perturber(perturbation, severity, venv, venv.num_envs, seed, scale)

    def reset(self) -> Any:
        """Start N episodes, and perturb their first observations."""
        (env_seed, *_) = self.unwrapped._seeds  # the reset takes it
        observations = self.venv.reset()
        if env_seed is not None:
            self._perturber.reseed(env_seed)
        self._perturber.begin(np.arange(self.num_envs))
        self.reset_infos = self.unwrapped.reset_infos
        return observations if self._is_plant else self._perturber(observations)

    @property
    def _is_plant(self) -> bool:
        return self._perturber.perturbation.kind == "action"

    def step_async(self, actions: np.ndarray) -> None:
        """Begin a step, with perturbed actions if they are what is perturbed."""
        self.venv.step_async(self._perturber(actions) if self._is_plant else actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Step, and perturb the observations."""
        observations, rewards, dones, infos = self.venv.step_wait()
        ended = np.flatnonzero(dones)
        if self._is_plant:
            self._perturber.begin(ended)
            self.reset_infos = self.unwrapped.reset_infos
            return observations, rewards, dones, infos
        if not len(ended):
            return self._perturber(observations), rewards, dones, infos
        # First the observations of the running episodes up to their end, then the first ones of the next episodes.
        last = each_part(np.copy, observations)
        reported = [i for i in ended if "terminal_observation" in infos[i]]
        for i in reported:
            each_part(functools.partial(_put, i), last, infos[i]["terminal_observation"])
        perturbed, infos = self._perturber(last), list(infos)
        for i in reported:
            infos[i] = {**infos[i], "terminal_observation": each_part(lambda part, i=i: part[i].copy(), perturbed)}
        self._perturber.begin(ended)
        first = self._perturber(each_part(lambda part: part[ended], observations), ended)
        each_part(functools.partial(_put, ended), perturbed, first)
        self.reset_infos = self.unwrapped.reset_infos
        return perturbed, rewards, dones, infos


def _put(where: Any, target: np.ndarray, values: np.ndarray) -> None:
    target[where] = values


def make_perturber(
    perturbation: str | Perturbation,
    severity: int,
    env: gym.Env | VecEnv,
    n_envs: int,
    seed: int | None,
    scale: Scale,
) -> Perturber:
    """Make the perturber of an environment from a perturbation or its name; see :class:`PerturbedObservation`."""
    space, horizon = env.observation_space, horizon_of(env)
    perturbation = find_applicable(perturbation, space, horizon, env.action_space)
    perturbation.value(severity)  # checked before the calibration, which takes time
    if seed is not None and (isinstance(seed, bool) or seed < 0):
        raise ValueError(f"seed={seed} must be None or an integer of at least 0")
    how: dict[str, Any] = dict(seed=seed, horizon=horizon, groups=attribute_of(env, "observation_groups"))
    if perturbation.kind == "action":
        space, how["scale"] = env.action_space, np.ones(env.action_space.shape or ())
    elif not perturbation.timing:
        how["scale"] = default_scale(space, env, scale)
    return Perturber(perturbation, severity, space, n_envs, **how)
