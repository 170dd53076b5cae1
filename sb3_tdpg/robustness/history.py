"""
Observations that come late or not at all: perturbations with a memory, in the space's own shape and type.

Dimension key: n episodes side by side, K steps of delay; observations are ``(n, *obs)``.
"""

from __future__ import annotations

import numpy as np

from sb3_tdpg.robustness.images import Episode
from sb3_tdpg.robustness.sensor import Sensor


def evenly(number: np.ndarray, share: float, phase: np.ndarray) -> np.ndarray:
    """
    Choose a share of consecutive numbers at even distances: of any 1 / share of them, at least one.

    (Systematic sampling. Independent choices would leave out short episodes altogether.)

    :param number: 0, 1, ...
    :param share: In [0, 1].
    :param phase: In [0, 1): where the first one is.
    :return: True where a number is chosen
    """
    return np.floor(share * (number + 1) + phase) > np.floor(share * number + phase)


def draw_delay(rng: np.random.Generator, n: int, steps: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Make room for what is on its way: ``(n, K, *obs)``."""
    return dict(waiting=np.empty((n, int(steps), *sensor.space.shape), sensor.space.dtype))


def delay(observations: np.ndarray, steps: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Show what was observed K steps ago, and the first observation until then."""
    waiting, t = episode["waiting"], episode["t"]
    begins = t == 0
    waiting[begins] = observations[begins][:, None]
    at = np.arange(len(t)), t % int(steps)
    late: np.ndarray = waiting[at]
    waiting[at] = observations
    return late


def draw_frames(rng: np.random.Generator, n: int, share: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw where the count of lost frames begins, and make room for the last one that arrived."""
    return dict(phase=rng.random(n), last=np.empty((n, *sensor.space.shape), sensor.space.dtype))


def dropped_frames(observations: np.ndarray, share: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Show the last frame that arrived. The first one of an episode always does."""
    last, t = episode["last"], episode["t"]
    arrived = (t == 0) | ~evenly(t - 1, share, episode["phase"])
    last[arrived] = observations[arrived]
    return last.copy()
