"""
The application of a perturbation to the episodes of N environments, for both wrappers.

Dimension key: N environments, n of them at a time.
"""

import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_tdpg.robustness.registry import KEEP, NOTHING, Perturbation
from sb3_tdpg.robustness.sensor import UNKNOWN_HORIZON, Sensor, blank

CHUNK = 64  # images perturbed at once: bounds the memory
_DOMAIN = 0x50E7  # any constant: a perturbation must not draw what the environment with the same seed draws

Observations = Any
"""An array ``(n, *obs)``, or a dict of such."""


def each_part(function: Callable[..., Any], *observations: Observations) -> Observations:
    """Apply a function to arrays, or to the parts of dicts with the same keys."""
    first, *_ = observations
    if isinstance(first, dict):
        return {key: function(*(each[key] for each in observations)) for key in first}
    return function(*observations)


class Members(ABC):
    """
    What N episodes have of a family of perturbations: a member each.

    It has its own random generator, so the random numbers of the environment do not change.

    :param names: They are part of the seed: nested perturbations and parts must not draw the same numbers.
    :param seed: ``None``: random, until :meth:`reseed`.
    """

    uses_states = False
    """Whether a call needs the true states."""

    def __init__(self, *names: str, seed: int | None) -> None:
        names = tuple(filter(None, names))
        self._entropy = [_DOMAIN, *(zlib.crc32(name.encode()) for name in names), *([] if seed is None else [seed])]
        self._rng = np.random.default_rng(None if seed is None else self._entropy)

    def reseed(self, env_seed: int) -> None:
        """Restart the random generator from the seeds of the environments and of the perturbation."""
        self._rng = np.random.default_rng([*self._entropy, env_seed])

    def begin(self, which: np.ndarray) -> None:  # noqa: B027  (a function of the observations has nothing to draw)
        """Begin episodes in the environments with the indices ``which``, ``(n,)``: draw what is constant in them."""

    def repeat(self, n: int) -> "Members":
        """Give n episodes the member that the only one has, whose next observation is its first."""
        return self

    @abstractmethod
    def __call__(
        self, observations: Observations, which: np.ndarray | None = None, states: np.ndarray | None = None
    ) -> Observations:
        """
        Perturb the next observations of some episodes: a new array.

        :param observations: ``(n, *obs)``
        :param which: indices of the episodes, ``(n,)``; default: all.
        :param states: x_t, ``(n, X)``
        """


class Perturber(Members):
    """
    Apply a perturbation to whole batches, and remember what was drawn for each episode.

    The perturbation applies to the space. The scales of the components of a vector have the space's shape (by key in a
    ``Dict``); images and perturbations of the timing need none.
    """

    def __init__(
        self,
        perturbation: Perturbation,
        severity: int,
        space: spaces.Space,
        n_envs: int,
        *,
        seed: int | None = None,
        scale: Any = None,
        horizon: int | None = None,
        groups: Mapping[str, Sequence[Any]] | None = None,
        part: str = "",
    ) -> None:
        super().__init__(perturbation.name, part, seed=seed)
        self.perturbation = perturbation
        self.value = perturbation.value(severity)
        self.n_envs = n_envs
        self._episode: dict[str, np.ndarray] = {}
        self.parts: dict[str, Perturber] = {}  # of a Dict that has no timing in common
        if isinstance(space, spaces.Dict) and perturbation.kind != "any":
            for key, each in space.items():
                if perturbation.applies_to(each, horizon):
                    how: dict[str, Any] = dict(
                        seed=seed, scale=(scale or {}).get(key), horizon=horizon, part=f"{part} {key}".strip()
                    )
                    self.parts[key] = Perturber(perturbation, severity, each, n_envs, **how)
            return
        self.sensor = Sensor(space, scale, horizon or UNKNOWN_HORIZON, groups)
        self._spaces = dict(space.items()) if isinstance(space, spaces.Dict) else {"": space}
        self.begin(np.arange(n_envs))

    def reseed(self, env_seed: int) -> None:
        super().reseed(env_seed)
        for part in self.parts.values():
            part.reseed(env_seed)

    def begin(self, which: np.ndarray) -> None:
        if self.parts:
            for part in self.parts.values():
                part.begin(which)
            return
        drawn: dict[str, np.ndarray] = {"t": np.zeros(len(which), dtype=np.int64)}
        if self.perturbation.timing:
            for key, space in self._spaces.items():
                past = np.zeros((len(which), int(self.value) + 1, *(space.shape or ())), space.dtype)
                drawn |= {f"past {key}": past, f"shown {key}": past[:, 0].copy()}
        if self.perturbation.draw is not None:
            drawn |= self.perturbation.draw(self._rng, len(which), self.value, self.sensor)
        if len(which) == self.n_envs:
            self._episode = drawn
            return
        for name, values in drawn.items():
            self._episode[name][which] = values

    def repeat(self, n: int) -> Members:
        for part in self.parts.values():
            part.repeat(n)
        self._episode = {name: values.repeat(n, axis=0) for name, values in self._episode.items()}
        self.n_envs = n
        return self

    def __call__(
        self, observations: Observations, which: np.ndarray | None = None, states: np.ndarray | None = None
    ) -> Observations:
        if self.parts:
            return {**observations, **{key: part(observations[key], which) for key, part in self.parts.items()}}
        index = slice(None) if which is None else which
        episode = {name: values[index] for name, values in self._episode.items()}  # views of all, or copies
        perturbed = (self._in_time if self.perturbation.timing else self._in_units)(observations, episode)
        episode["t"] += 1
        if which is not None:
            for name, values in episode.items():
                self._episode[name][which] = values
        return perturbed

    def _in_time(self, observations: Observations, episode: dict[str, np.ndarray]) -> Observations:
        """Show other observations than the present ones, or nothing."""
        t = episode["t"]
        source = self.perturbation.apply(t, self.value, episode, self._rng)
        of_all = source if source.ndim == 1 else np.zeros_like(t)
        each, age = np.arange(len(t)), of_all.clip(0, t)  # until then, the first observation
        result = {}
        for key, now in observations.items() if isinstance(observations, dict) else [("", observations)]:
            past, shown = episode[f"past {key}"], episode[f"shown {key}"]
            past[each, t % past.shape[1]] = now
            seen = past[each, (t - age) % past.shape[1]]
            seen[of_all == KEEP] = shown[of_all == KEEP]
            shown[:] = seen
            nothing = blank(self._spaces[key])
            seen[of_all == NOTHING] = nothing
            if source.ndim == 2:
                for fails, group in zip((source == NOTHING).T, self.sensor.groups, strict=True):
                    if key in group:
                        at = np.ix_(fails, group[key])
                        seen.reshape(len(t), -1)[at] = nothing.ravel()[group[key]]
            result[key] = seen
        return result if isinstance(observations, dict) else result[""]

    def _in_units(self, observations: np.ndarray, episode: dict[str, np.ndarray]) -> np.ndarray:
        result = np.empty((len(observations), *self.sensor.space.shape), self.sensor.space.dtype)
        at_once = CHUNK if self.sensor.is_image else max(1, len(observations))
        for start in range(0, len(observations), at_once):
            part = slice(start, start + at_once)
            units = self.sensor.to_units(observations[part])
            shares = {name: values[part].repeat(self.sensor.n_frames, axis=0) for name, values in episode.items()}
            units = self.perturbation.apply(units, self.value, shares, self._rng)
            result[part] = self.sensor.from_units(units, observations[part])
        return result
