"""
Define perturbations for training. They have keywords instead of severities, and random strengths.

Dimension key: n images or episodes, C channels, H and W rows and columns, D components of a vector.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch as th
from torch.nn.functional import interpolate

from sb3_tdpg.robustness.registry import N_SEVERITIES, Episode, Perturbation
from sb3_tdpg.robustness.sensor import Sensor

PATTERN_SIZES = (2, 4, 8, 16, 32, 64)  # rows and columns of coloured cells in the random patterns

PATTERN_GROUP = 16  # number of images whose patterns have equally many cells


def images(
    *,
    held: bool = False,
    color: float = 0.35,
    pattern: float = 0.7,
    patch: float = 0.5,
    contrast: float = 0.7,
    noise: float = 0.1,
) -> Perturbation:
    r"""
    Return a mixture of random changes, which are applied in this order to an image y in [0, 1].

    1. colour: the channels are mixed, :math:`y \leftarrow M y`, where M is :math:`I + \mathtt{color} \cdot` a standard
       normal matrix. Each row of M is divided by its sum, or by 0.3 if the sum is smaller;
    2. pattern: :math:`y \leftarrow (1 - a) y + a p` with a random pattern p. The pattern is a grid of cells of random
       colours, with 2, 4, 8, 16, 32 or 64 rows and as many columns, and sharp or smooth edges. Groups of 16 images have
       the same number of cells and the same kind of edges. The opacity a is 0 with a probability of 0.3, and otherwise
       uniform up to ``pattern``. In one rectangle, a is 1; the rectangle's sides are uniform up to ``patch`` times the
       image's sides;
    3. contrast: :math:`y \leftarrow s y + o` with s uniform in ``[1 - contrast, 1]`` and an offset o that is uniform in
       ``[0, 1 - s]``;
    4. noise: Gaussian noise at every pixel, with a standard deviation that is uniform up to ``noise``.

    The information bounds that use the encoder's density (``"logdet"``, ``"loo"``, ``"vib"`` and the directed ones)
    bound the information about everything in the image, so they also count the information about these changes.

    :param held: Whether an episode keeps the changes that were drawn at its beginning, except for the noise. Otherwise
        every image has its own changes.
    :param color: Strength of the mixing; 0 leaves the colours unchanged.
    :param pattern: Largest opacity of the pattern, at most 1.
    :param patch: Largest side of the opaque rectangle as a fraction of the image's side, at most 1.
    :param contrast: Largest loss of contrast, at most 1.
    :param noise: Largest standard deviation of the noise, for pixels in [0, 1].
    :raises ValueError: if a strength is out of its range.
    """
    strengths = dict(color=color, pattern=pattern, patch=patch, contrast=contrast, noise=noise)
    for name, value in strengths.items():
        largest = np.inf if name in ("color", "noise") else 1.0
        if not 0 <= value <= largest:
            raise ValueError(f"{name}={value} must be between 0 and {largest:g}")

    def changes(rng: np.random.Generator, n: int, shape: Sequence[int]) -> dict[str, np.ndarray]:
        """Draw n changes of images ``(C, H, W)``, except the noise at each pixel."""
        channels, height, width = shape

        def uniform() -> np.ndarray:
            return rng.random((n, 1, 1, 1), dtype=np.float32)

        mixing = np.eye(channels, dtype=np.float32)
        mixing = mixing + np.float32(color) * rng.standard_normal((n, channels, channels), dtype=np.float32)
        amount = np.float32(pattern) * uniform() * (uniform() < 0.7)
        return dict(
            mixing=mixing / mixing.sum(axis=2, keepdims=True).clip(min=0.3),
            pattern=patterns(rng, n, channels, height, width),
            amount=np.maximum(amount, _rectangles(rng, n, height, width, patch)),
            scale=1 - np.float32(contrast) * uniform(),
            offset=uniform(),
            noise=np.float32(noise) * uniform(),
        )

    def draw(rng: np.random.Generator, n: int, value: float, sensor: Sensor) -> dict[str, np.ndarray]:
        return changes(rng, n, sensor.shape)

    def apply(y: np.ndarray, value: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
        return _changed(y, episode if held else changes(rng, len(y), y.shape[1:]), rng)

    return Perturbation(
        "images", "image", "strength", (1.0,) * N_SEVERITIES, apply, draw if held else None, on_depth=False
    )


def patterns(rng: np.random.Generator, n: int, channels: int, height: int, width: int) -> np.ndarray:
    """Draw random patterns of coloured cells: ``(n, C, H, W)``."""
    result = np.empty((n, channels, height, width), np.float32)
    for start in range(0, n, PATTERN_GROUP):
        group = result[start : start + PATTERN_GROUP]
        size, mode = rng.choice(PATTERN_SIZES), rng.choice(["nearest", "bilinear"])
        cells = th.from_numpy(rng.random((len(group), channels, size, size), dtype=np.float32))
        group[:] = interpolate(cells, size=(height, width), mode=str(mode)).numpy()
    return result


def _rectangles(rng: np.random.Generator, n: int, height: int, width: int, largest: float) -> np.ndarray:
    """Draw rectangles with sides uniform up to ``largest`` times the image's sides: ``(n, 1, H, W)``, 1 inside."""

    def interval(length: int) -> np.ndarray:
        size = largest * rng.random((n, 1))
        start = (1 - size) * rng.random((n, 1))
        at = (np.arange(length) + 0.5) / length
        return (at >= start) & (at < start + size)

    inside = interval(height)[:, None, :, None] & interval(width)[:, None, None, :]
    return inside.astype(np.float32)


def _changed(images: np.ndarray, drawn: Episode, rng: np.random.Generator) -> np.ndarray:
    """Apply the drawn changes and new noise to images ``(n, C, H, W)``, float32 in [0, 1]."""
    of = {name: th.from_numpy(values) for name, values in drawn.items() if name != "t"}  # torch is several times faster
    y = (of["mixing"] @ th.from_numpy(images).flatten(2)).unflatten(2, images.shape[2:])
    y = th.lerp(y, of["pattern"], of["amount"])
    y = of["scale"] * y + (1 - of["scale"]) * of["offset"]
    own = th.Generator().manual_seed(int(rng.integers(2**63)))
    return y.add_(th.randn(y.shape, generator=own).mul_(of["noise"])).numpy()


def noise_range(low: float = 0.01, high: float | Sequence[float] = 1.0) -> Perturbation:
    """
    Return noise whose standard deviation, in units of the scale, is drawn log-uniformly for each episode.

    :param low: The smallest standard deviation.
    :param high: The largest standard deviation; if several are given, each episode first draws one of them.
    :raises ValueError: unless 0 < low <= high.
    """
    highs = np.atleast_1d(high)
    if not (0 < low <= highs.min() and highs.max() < math.inf):
        raise ValueError(f"low={low} and high={high} must be positive, low <= high")

    def draw(rng: np.random.Generator, n: int, value: float, sensor: Sensor) -> dict[str, np.ndarray]:
        return {"std": np.exp(rng.uniform(math.log(low), np.log(rng.choice(highs, n))))}

    def apply(y: np.ndarray, value: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
        return y + episode["std"][:, None] * rng.standard_normal(y.shape)

    return Perturbation("noise_range", "vector", "standard deviation, scales", (highs.max(),) * 5, apply, draw)


WITH_KEYWORDS: dict[str, Callable[..., Perturbation]] = {"images": images, "noise_range": noise_range}
"""Perturbations, by name, that have keywords instead of severities in a declaration."""
