"""
What happens to images: functions of a batch, with values in [0, 1], and of what was drawn for its episodes.

Dimension key: n episodes side by side, C channels, H and W rows and columns; images are ``(n, C, H, W)`` float32.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

import numpy as np

from sb3_tdpg.envs.noise import noisy_pixels
from sb3_tdpg.envs.textures import random_texture
from sb3_tdpg.robustness.sensor import Sensor

Episode = Mapping[str, np.ndarray]  # arrays with a leading dimension of n, drawn at the start of an episode

MIN_BLUR = 0.35  # pixels: a narrower Gaussian does nothing
N_TEXTURES = 16
FIRST_TEXTURE = 1000  # a seed: users begin to count at 0


def noise(images: np.ndarray, std: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Add noise, new in every frame, and cut off what is outside [0, 1]."""
    return noisy_pixels(images, std, "clip", rng)


def noise_minmax(images: np.ndarray, std: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Add noise, and stretch each image to [0, 1], as the paper does."""
    return noisy_pixels(images, std, "minmax", rng)


def draw_sign(rng: np.random.Generator, n: int, value: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw whether it is more or less, for an episode."""
    return dict(sign=rng.choice(np.array([-1, 1], np.float32), (n, 1, 1, 1)))


def brightness(images: np.ndarray, amount: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Make all pixels of an episode brighter, or all of them darker."""
    return images + np.float32(amount) * episode["sign"]


def contrast(images: np.ndarray, factor: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Bring all pixels nearer to the mean of their image."""
    mean = images.mean(axis=(1, 2, 3), keepdims=True)
    return mean + np.float32(factor) * (images - mean)


def draw_turn(rng: np.random.Generator, n: int, degrees: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw which way the colours of an episode turn about the axis of greys."""
    from scipy.spatial.transform import Rotation

    angle = np.deg2rad(degrees) * rng.choice([-1.0, 1.0], n)
    turn = Rotation.from_rotvec(angle[:, None] * np.ones(3) / np.sqrt(3))
    return dict(turn=turn.as_matrix().astype(np.float32))  # (n, 3, 3)


def hue(images: np.ndarray, degrees: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Turn the colours; grey stays grey."""
    return (episode["turn"] @ images.reshape(*images.shape[:2], -1)).reshape(images.shape)


def blur(images: np.ndarray, width: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Blur by a Gaussian."""
    from scipy.ndimage import gaussian_filter

    std = max(MIN_BLUR, width * images.shape[2])
    return np.asarray(gaussian_filter(images, std, axes=(2, 3), mode="nearest"))


def draw_square(rng: np.random.Generator, n: int, side: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw where the occluder of an episode is, and its colour."""
    channels, *lengths = sensor.shape
    spans = []
    for length in lengths:
        size = max(1, round(side * length))
        start = rng.integers(0, length - size + 1, (n, 1))
        at = np.arange(length)
        spans.append((at >= start) & (at < start + size))
    return dict(rows=spans[0], columns=spans[1], color=rng.random((n, channels, 1, 1), dtype=np.float32))


def occlusion(images: np.ndarray, side: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Cover the same square of an episode's images by one colour."""
    inside = episode["rows"][:, None, :, None] & episode["columns"][:, None, None, :]
    return np.where(inside, episode["color"], images)


def dropped_pixels(images: np.ndarray, share: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Read the lowest value in some pixels, others in every frame."""
    n, _, height, width = images.shape
    is_dead = rng.random((n, 1, height, width), dtype=np.float32) < share
    return np.where(is_dead, np.float32(0), images)


@functools.cache
def _textures(channels: int, height: int, width: int) -> np.ndarray:
    """Return the textures in the size of an image: ``(16, C, H, W)``, read-only."""
    bank = np.stack([random_texture(FIRST_TEXTURE + i) for i in range(N_TEXTURES)]) / np.float32(255)
    rows, columns = (np.arange(length) * bank.shape[1] // length for length in (height, width))
    sized = bank[:, rows][:, :, columns].transpose(0, 3, 1, 2)
    sized = sized if channels == 3 else sized.mean(axis=1, keepdims=True)
    sized.flags.writeable = False
    return sized


def draw_texture(rng: np.random.Generator, n: int, opacity: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw the texture of an episode."""
    return dict(texture=rng.integers(0, N_TEXTURES, n))


def texture_overlay(images: np.ndarray, opacity: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Lay a half-transparent texture over the images of an episode."""
    texture = _textures(*images.shape[1:])[episode["texture"]]
    return np.float32(1 - opacity) * images + np.float32(opacity) * texture


def draw_shift(rng: np.random.Generator, n: int, distance: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw in which direction the camera of an episode looks aside, and turn it to whole pixels."""
    _, height, width = sensor.shape
    angle = rng.uniform(0, 2 * np.pi, n)
    shift = max(1.0, distance * height) * np.stack([np.sin(angle), np.cos(angle)])
    down, right = np.rint(shift).astype(int)[..., None]  # (n, 1) each
    return dict(
        from_rows=np.clip(np.arange(height) + down, 0, height - 1),
        from_columns=np.clip(np.arange(width) + right, 0, width - 1),
    )


def camera_shift(images: np.ndarray, distance: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Shift the images of an episode, as a camera does that is turned a little; the edge is repeated."""
    shifted = np.take_along_axis(images, episode["from_rows"][:, None, :, None], axis=2)
    return np.take_along_axis(shifted, episode["from_columns"][:, None, None, :], axis=3)
