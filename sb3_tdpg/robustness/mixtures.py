"""
Perturbations in training: noise whose strength is drawn for each episode, and a mixture of the registry's.

They make rivals of the bottleneck that know what is coming. Dimension key: N environments, D components of a vector.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg.robustness.core import Perturber, each_part
from sb3_tdpg.robustness.registry import PERTURBATIONS, Perturbation
from sb3_tdpg.robustness.wrappers import PerturbedVecEnv, Scale, make_perturber


class Mixture:
    """
    Perturb each episode by one of several perturbations, drawn with equal probabilities, or not at all.

    It has the interface of a :class:`~sb3_tdpg.robustness.core.Perturber`.

    :param perturbers: The perturbations, of the observations.
    :param n_envs: Number of environments N.
    :param seed: Of the choice; ``None``: random.
    """

    def __init__(self, perturbers: Sequence[Perturber], n_envs: int, seed: int | None = None) -> None:
        self.perturbers = list(perturbers)
        self.perturbation: Perturbation = perturbers[0].perturbation  # its kind stands for all
        self._seed = seed
        self._rng = np.random.default_rng(seed)
        self.choice = np.zeros(n_envs, dtype=np.int64)
        self.begin(np.arange(n_envs))

    def reseed(self, env_seed: int) -> None:
        """Restart the random generators."""
        self._rng = np.random.default_rng([env_seed, *([] if self._seed is None else [self._seed])])
        for perturber in self.perturbers:
            perturber.reseed(env_seed)

    def begin(self, which: np.ndarray) -> None:
        """Draw the perturbations of the episodes that begin in the environments ``which``, ``(n,)``."""
        self.choice[which] = self._rng.integers(-1, len(self.perturbers), len(which))  # -1: none
        for perturber in self.perturbers:
            perturber.begin(which)

    def __call__(self, observations: Any, which: np.ndarray | None = None) -> Any:
        """Perturb the next observations of the environments ``which``, ``(n,)``, or all: a new array ``(n, *obs)``."""
        which = np.arange(len(self.choice)) if which is None else which
        result = each_part(np.copy, observations)
        for i, perturber in enumerate(self.perturbers):
            mine = np.flatnonzero(self.choice[which] == i)
            if len(mine):
                perturbed = perturber(each_part(lambda part, mine=mine: part[mine], observations), which[mine])
                each_part(lambda part, new, mine=mine: part.__setitem__(mine, new), result, perturbed)
        return result


class MixedVecEnv(PerturbedVecEnv):
    """
    Perturb the observations of each episode by one of several perturbations, or not at all.

    :param venv: The environments.
    :param perturbations: Names in :data:`~sb3_tdpg.robustness.PERTURBATIONS` with severities, ``("vector_noise", 3)``,
        and if wanted a factor of the scale.
    :param seed: Of the perturbations.
    :param scale: See :class:`~sb3_tdpg.robustness.PerturbedObservation`.
    :raises ValueError: if there is none, or one does not apply or is of the actions.
    """

    def __init__(
        self,
        venv: VecEnv,
        perturbations: Sequence[Sequence[Any]],
        *,
        seed: int | None = None,
        scale: Scale = None,
    ) -> None:
        if not perturbations:
            raise ValueError("perturbations=[] is empty: give names with severities, [('vector_noise', 3)]")
        super().__init__(venv, *perturbations[0][:2], seed=seed, scale=scale)
        perturbers = []
        for name, severity, *factor in perturbations:
            kind = PERTURBATIONS[name].kind if name in PERTURBATIONS else ""
            units: Any = scale
            if factor and scale is not None and kind == "vector":
                units = factor[0] * np.asarray(scale)
            perturbers.append(make_perturber(name, severity, venv, venv.num_envs, seed, units))
        if plant := [each.perturbation.name for each in perturbers if each.perturbation.kind == "action"]:
            raise ValueError(f"{plant} perturb actions: a mixture is one of observations")
        self._perturber: Any = Mixture(perturbers, venv.num_envs, seed)


def noise_range(low: float, high: float | Sequence[float]) -> Perturbation:
    """
    Return noise whose standard deviation is drawn for each episode, log-uniform between two values in scales.

    :param high: Of several upper values each episode draws one first.
    :raises ValueError: unless 0 < low <= high.
    """
    highs = np.atleast_1d(high)
    if not (0 < low <= highs.min() and highs.max() < math.inf):
        raise ValueError(f"low={low} and high={high} must be positive, low <= high")

    def draw(rng: np.random.Generator, n: int, value: float, sensor: Any) -> dict[str, np.ndarray]:
        return {"std": np.exp(rng.uniform(math.log(low), np.log(rng.choice(highs, n))))}

    def apply(y: np.ndarray, value: float, episode: Any, rng: np.random.Generator) -> np.ndarray:
        return y + episode["std"][:, None] * rng.standard_normal(y.shape)

    return Perturbation("noise_range", "vector", "standard deviation, scales", (highs.max(),) * 5, apply, draw)


class NoisyVecEnv(PerturbedVecEnv):
    """
    Add noise to every component of a vector, with a standard deviation that is drawn for each episode, log-uniform.

    :param venv: The environments.
    :param low: The smallest standard deviation, in scales.
    :param high: The largest one; of several, each episode draws one first.
    :param seed: Of the noise.
    :param scale: Of each component, ``(D,)``; 0: no noise. Default: 1, so that ``low`` and ``high`` have the units of
        the observation.
    """

    def __init__(
        self,
        venv: VecEnv,
        low: float = 0.01,
        high: float | Sequence[float] = 1.0,
        *,
        seed: int | None = None,
        scale: Scale = 1.0,
    ) -> None:
        super().__init__(venv, noise_range(low, high), 5, seed=seed, scale=scale)
