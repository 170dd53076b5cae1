"""
What happens to vectors: functions of a batch, in multiples of the scale of each component.

Dimension key: n episodes side by side, D components; vectors are ``(n, D)`` float64.
"""

from __future__ import annotations

import numpy as np

from sb3_tdpg.robustness.history import evenly
from sb3_tdpg.robustness.images import Episode
from sb3_tdpg.robustness.sensor import Sensor


def noise(vectors: np.ndarray, std: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Add noise, new at every step."""
    return vectors + std * rng.standard_normal(vectors.shape)


def draw_signs(rng: np.random.Generator, n: int, value: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw for each component whether it is more or less, for an episode."""
    return dict(sign=rng.choice([-1.0, 1.0], (n, *sensor.shape)))


def bias(vectors: np.ndarray, offset: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Add a constant to every component of an episode."""
    return vectors + offset * episode["sign"]


def scale(vectors: np.ndarray, factor: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Multiply every component of an episode by the factor, or divide it by it."""
    return vectors * factor ** episode["sign"]


def draw_phase(rng: np.random.Generator, n: int, share: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw where the count of what is lost begins."""
    return dict(phase=rng.random(n))


def dropout(vectors: np.ndarray, share: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Read 0 in some components: the same share of all readings in every episode, spread at random over them."""
    n, size = vectors.shape
    rank = rng.permuted(np.tile(np.arange(size), (n, 1)), axis=1)
    reading = episode["t"][:, None] * size + rank
    return np.where(evenly(reading, share, episode["phase"][:, None]), 0.0, vectors)
