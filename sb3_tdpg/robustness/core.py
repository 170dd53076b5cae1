"""
Apply perturbations to the episodes of N environments.

Dimension key: N environments, n of them in one call.
"""

import zlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_tdpg.buffers import each_part
from sb3_tdpg.robustness.registry import KEEP, NOTHING, Perturbation
from sb3_tdpg.robustness.sensor import Sensor

CHUNK = 64  # number of images perturbed at once, to limit the memory
_DOMAIN = 0x50E7  # any constant: perturbation and environment must draw different numbers from the same seed

Observations = Any
"""An array ``(n, *obs)``, or a dict of such arrays."""

Drawn = dict[str, np.ndarray]


def take(observations: Observations, which: Any) -> Observations:
    """Return the observations of some episodes."""
    return each_part(lambda part: part[which], observations)


def put(observations: Observations, which: Any, new: Observations) -> None:
    """Replace the observations of some episodes in place."""
    each_part(lambda part, values: part.__setitem__(which, values), observations, new)


class Members:
    """
    Perturb each of N episodes by one *member* of a family of perturbations. This base class changes nothing.

    The members have their own random generator, so the random numbers of the environment do not change. A subclass
    draws the values that stay constant in an episode, and calls :meth:`begin` at the end of its constructor.

    :param names: Names that enter the seed, so that nested perturbations and the parts of a ``Dict`` draw different
        numbers.
    :param seed: Seed of the generator. With ``None``, the seed is random until a call of :meth:`reseed`.
    :param children: Members that are reseeded, and begin episodes, together with this object.
    """

    def __init__(self, n: int, *names: str, seed: int | None = None, children: Iterable["Members"] = ()) -> None:
        codes = [zlib.crc32(name.encode()) for name in names if name]
        self._entropy = [_DOMAIN, *codes, *([] if seed is None else [seed])]
        self._rng = np.random.default_rng(None if seed is None else self._entropy)
        self.n, self.children = n, list(children)
        self._episode: Drawn = {}  # values drawn for each episode, and its running state: (N, ...)

    def reseed(self, env_seed: int) -> None:
        """Restart the random generator from the seeds of the environments and of the perturbation."""
        self._rng = np.random.default_rng([*self._entropy, env_seed])
        for child in self.children:
            child.reseed(env_seed)

    def begin(self, which: np.ndarray) -> None:
        """Begin episodes in the environments ``which``, ``(n,)``, and draw the values that each episode keeps."""
        for name, values in self._draw(len(which)).items():
            if len(which) == self.n:
                self._episode[name] = values
            else:
                self._episode[name][which] = values
        for child in self.children:
            child.begin(which)

    def repeat(self, n: int) -> "Members":
        """Copy the member of a single episode to n episodes; call this method before the first observation."""
        self._episode = {name: values.repeat(n, axis=0) for name, values in self._episode.items()}
        self.n, self.children = n, [child.repeat(n) for child in self.children]
        return self

    def __call__(self, observations: Observations, which: np.ndarray | None = None) -> Observations:
        """
        Perturb the next observations of some episodes, and return them as a new array.

        :param observations: The observations of these episodes, ``(n, *obs)``.
        :param which: Indices of the episodes, ``(n,)``. ``None`` means all.
        """
        if which is None:  # no copies
            return self._show(observations, np.arange(self.n), self._episode)
        episode = {name: values[which] for name, values in self._episode.items()}
        shown = self._show(observations, which, episode)
        for name, values in episode.items():
            self._episode[name][which] = values
        return shown

    def _draw(self, n: int) -> Drawn:
        """Draw the values that n new episodes keep: arrays ``(n, ...)``."""
        return {}

    def _show(self, observations: Observations, which: np.ndarray, episode: Drawn) -> Observations:
        """Perturb observations, and update the values in ``episode`` in place."""
        return each_part(np.copy, observations)


class Perturber(Members):
    """Apply a perturbation, which must be applicable to the sensor's space, to batches of observations or actions."""

    def __init__(
        self,
        perturbation: Perturbation,
        severity: int,
        sensor: Sensor,
        n: int,
        *,
        seed: int | None = None,
        part: str = "",
    ) -> None:
        self.perturbation, self.value, self.sensor = perturbation, perturbation.value(severity), sensor
        self.parts: dict[str, Perturber] = {}  # of a Dict, unless its parts share one timing
        if isinstance(sensor.space, spaces.Dict) and perturbation.kind != "any":
            for key, each in sensor.parts.items():
                if perturbation.objection(each.space, each.horizon) is None:
                    name = f"{part} {key}".strip()
                    self.parts[key] = Perturber(perturbation, severity, each, n, seed=seed, part=name)
        super().__init__(n, perturbation.name, part, seed=seed, children=self.parts.values())
        if not self.parts:
            self.begin(np.arange(n))

    def _draw(self, n: int) -> Drawn:
        if self.parts:
            return {}
        drawn: Drawn = {"t": np.zeros(n, dtype=np.int64)}
        if self.perturbation.timing:
            for key, sensor in self.sensor.parts.items():
                past = np.zeros((n, int(self.value) + 1, *(sensor.space.shape or ())), sensor.space.dtype)
                drawn |= {f"past {key}": past, f"shown {key}": past[:, 0].copy()}
        if self.perturbation.draw is not None:
            drawn |= self.perturbation.draw(self._rng, n, self.value, self.sensor)
        return drawn

    def _show(self, observations: Observations, which: np.ndarray, episode: Drawn) -> Observations:
        if self.parts:
            return {**observations, **{key: part(observations[key], which) for key, part in self.parts.items()}}
        perturbed = (self._in_time if self.perturbation.timing else self._in_units)(observations, episode)
        episode["t"] += 1
        return perturbed

    def _in_time(self, observations: Observations, episode: Drawn) -> Observations:
        """Replace the present observations by earlier ones, or by blank ones."""
        t = episode["t"]
        source = self.perturbation.apply(t, self.value, episode, self._rng)
        of_all = source if source.ndim == 1 else np.zeros_like(t)
        each, age = np.arange(len(t)), of_all.clip(0, t)  # the oldest is the first observation
        result = {}
        for key, now in observations.items() if isinstance(observations, dict) else [("", observations)]:
            past, shown = episode[f"past {key}"], episode[f"shown {key}"]
            past[each, t % past.shape[1]] = now
            seen = past[each, (t - age) % past.shape[1]]
            seen[of_all == KEEP] = shown[of_all == KEEP]
            shown[:] = seen
            nothing = self.sensor.parts[key].blank
            seen[of_all == NOTHING] = nothing
            if source.ndim == 2:
                for fails, (failing, components) in zip((source == NOTHING).T, self.sensor.groups, strict=True):
                    if key == failing:
                        seen.reshape(len(t), -1)[np.ix_(fails, components)] = nothing.ravel()[components]
            result[key] = seen
        return result if isinstance(observations, dict) else result[""]

    def _in_units(self, observations: np.ndarray, episode: Drawn) -> np.ndarray:
        result = np.empty((len(observations), *self.sensor.space.shape), self.sensor.space.dtype)
        at_once = CHUNK if self.sensor.is_image else max(1, len(observations))
        for start in range(0, len(observations), at_once):
            part = slice(start, start + at_once)
            units = self.sensor.to_units(observations[part])
            shares = {name: values[part] for name, values in episode.items()}
            units = self.perturbation.apply(units, self.value, shares, self._rng)
            result[part] = self.sensor.from_units(units, observations[part])
        return result
