"""
Perturb the observations or the actions of an SB3 ``VecEnv``.

Dimension key: N environments side by side.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, unwrap_vec_normalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_tdpg.buffers import each_part
from sb3_tdpg.robustness.core import put, take
from sb3_tdpg.robustness.families import Family

Scale = float | np.ndarray | Mapping[str, Any] | None


class PerturbedVecEnv(VecEnvWrapper):
    """
    Perturb the observations or the actions of N environments, for evaluation or training.

    Every episode draws its own random values, also after an automatic reset. ``info["terminal_observation"]`` is
    perturbed as the last observation of the episode that has ended. A perturbation of observations does not change the
    state, the reward, the rest of ``info`` or the environments' random numbers. ``env.seed(...)`` also seeds the
    perturbation. Without ``env.seed`` and without ``seed``, every reset takes a seed from PyTorch's generator. So the
    seed of a training or a checkpoint also determines the perturbations. Put this wrapper inside a ``VecNormalize`` or
    a ``VecFrameStack``. A perturbation of actions can also be outside a ``VecNormalize``.

    :param venv: The environments.
    :param perturbation: A name in :data:`~sb3_tdpg.robustness.PERTURBATIONS`, or another declaration, such as a
        function or a dict; see :class:`~sb3_tdpg.robustness.families.Family`. With a dict or a list, each
        episode draws one of the entries.
    :param severity: Severity for a name, from 1 (mild) to 5 (strong). With ``None``, each episode has a random
        severity.
    :param seed: Seed of the perturbation.
    :param scale: Scale of a vector's components; for a ``Dict``, it can also be a dict of scales. The default scale
        comes from the bounds of the space. Where these are infinite, the scale is measured in a short rollout
        (:func:`~sb3_tdpg.robustness.observation_scale`).
    :raises ValueError: if the name or the severity is unknown, the perturbation does not apply, or it perturbs
        observations that a ``VecNormalize`` has normalised.
    """

    def __init__(
        self, venv: VecEnv, perturbation: Any, severity: int | None = 3, *, seed: int | None = None, scale: Scale = None
    ) -> None:
        if not isinstance(venv, VecEnv):
            name = type(venv).__name__
            raise ValueError(f"{name} is not a VecEnv of Stable-Baselines3: use make_vec_env, or DummyVecEnv")
        super().__init__(venv)
        family, self._seed = Family(perturbation, venv, severity, scale), seed
        normalize = unwrap_vec_normalize(venv)
        if normalize is not None and normalize.norm_obs and not family.is_plant:
            raise ValueError("perturb observations before they are normalised: VecNormalize(PerturbedVecEnv(env, ...))")
        self._is_plant, self._perturber = family.is_plant, family.members(venv.num_envs, seed)
        self._depth, inner = 0, venv
        while isinstance(inner, VecEnvWrapper):
            self._depth += isinstance(inner, PerturbedVecEnv)
            inner = inner.venv
        self.unperturbed: Any = None
        """The observations of the last reset or step, before the perturbation."""

    def reset(self) -> Any:
        """Start N episodes, and perturb their first observations."""
        (env_seed, *_) = self.unwrapped._seeds  # read here, since the reset clears it
        self.unperturbed = observations = self.venv.reset()
        if env_seed is None and self._seed is None:
            env_seed = int(th.randint(2**31, ()))
        if env_seed is not None:
            # A perturbation around another one must not draw the same numbers.
            self._perturber.reseed(env_seed + (self._depth << 32))
        self._perturber.begin(np.arange(self.num_envs))
        self.reset_infos = self.unwrapped.reset_infos
        return observations if self._is_plant else self._perturber(observations)

    def step_async(self, actions: np.ndarray) -> None:
        """Begin a step; perturb the actions if the perturbation is one of actions."""
        self.venv.step_async(self._perturber(actions) if self._is_plant else actions)

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step; perturb the observations unless the perturbation is one of actions."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self.reset_infos = self.unwrapped.reset_infos
        self.unperturbed, ended = observations, np.flatnonzero(dones)
        if self._is_plant:
            self._perturber.begin(ended)
            return observations, rewards, dones, infos
        if not len(ended):
            return self._perturber(observations), rewards, dones, infos
        # First perturb the last observations of the running and ended episodes, then the first ones of new episodes.
        last = each_part(np.copy, observations)
        reported = [i for i in ended if "terminal_observation" in infos[i]]
        for i in reported:
            put(last, i, infos[i]["terminal_observation"])
        perturbed, infos = self._perturber(last), list(infos)
        for i in reported:
            infos[i] = {**infos[i], "terminal_observation": each_part(np.copy, take(perturbed, i))}
        self._perturber.begin(ended)
        put(perturbed, ended, self._perturber(take(observations, ended), ended))
        return perturbed, rewards, dones, infos
