"""
The application of a perturbation to the episodes of N environments, for both wrappers.

Dimension key: N environments, n of them at a time.
"""

import zlib

import numpy as np
from gymnasium import spaces

from sb3_tdpg.robustness.registry import Perturbation
from sb3_tdpg.robustness.sensor import Sensor

CHUNK = 64  # images perturbed at once: bounds the memory
_DOMAIN = 0x50E7  # any constant: a perturbation must not draw what the environment with the same seed draws


class Perturber:
    """
    Apply a perturbation to whole batches, and remember what was drawn for each episode.

    The perturbation applies to the space. It has its own random generator, so the random numbers of the environment do
    not change. The scales of the components of a vector have the space's shape; images need none.
    """

    def __init__(
        self,
        perturbation: Perturbation,
        severity: int,
        space: spaces.Box,
        n_envs: int,
        *,
        seed: int | None = None,
        scale: np.ndarray | None = None,
    ) -> None:
        self.perturbation = perturbation
        self.value = perturbation.value(severity)
        self.sensor = Sensor(space, scale)
        self.n_envs = n_envs
        # The name is part of the seed: nested perturbations must not draw the same numbers.
        self._entropy = [_DOMAIN, zlib.crc32(perturbation.name.encode()), *([] if seed is None else [seed])]
        self._rng = np.random.default_rng(None if seed is None else self._entropy)
        self._episode: dict[str, np.ndarray] = {}
        self.begin(np.arange(n_envs))

    def reseed(self, env_seed: int) -> None:
        """Restart the random generator from the seeds of the environments and of the perturbation."""
        self._rng = np.random.default_rng([*self._entropy, env_seed])

    def begin(self, which: np.ndarray) -> None:
        """Begin episodes in the environments with the indices ``which``, ``(n,)``: draw what is constant in them."""
        drawn = {"t": np.zeros(len(which), dtype=np.int64)}
        if self.perturbation.draw is not None:
            drawn |= self.perturbation.draw(self._rng, len(which), self.value, self.sensor)
        if len(which) == self.n_envs:
            self._episode = drawn
            return
        for name, values in drawn.items():
            self._episode[name][which] = values

    def __call__(self, observations: np.ndarray, which: np.ndarray | None = None) -> np.ndarray:
        """Perturb the next observations of the environments ``which``, ``(n,)``, or all: a new array ``(n, *obs)``."""
        index = slice(None) if which is None else which
        episode = {name: values[index] for name, values in self._episode.items()}  # views of all, or copies
        if self.perturbation.raw:
            perturbed = self.perturbation.apply(observations, self.value, episode, self._rng)
        else:
            perturbed = self._in_units(observations, episode)
        episode["t"] += 1
        if which is not None:
            for name, values in episode.items():
                self._episode[name][which] = values
        return perturbed

    def _in_units(self, observations: np.ndarray, episode: dict[str, np.ndarray]) -> np.ndarray:
        result = np.empty((len(observations), *self.sensor.space.shape), self.sensor.space.dtype)
        at_once = CHUNK if self.sensor.is_image else max(1, len(observations))
        for start in range(0, len(observations), at_once):
            part = slice(start, start + at_once)
            units = self.sensor.to_units(observations[part])
            shares = {name: values[part] for name, values in episode.items()}
            units = self.perturbation.apply(units, self.value, shares, self._rng)
            result[part] = self.sensor.from_units(units, observations[part])
        return result
