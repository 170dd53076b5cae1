"""
Convert observations to the units of perturbations, so that a severity means the same for every space.

Dimension key: N environments, C channels, H and W rows and columns, D components of a vector.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces

UNKNOWN_HORIZON = 100  # steps
VAST = 1e6  # bounds further apart count as infinite: some environments use the largest float for "unbounded"


def finite_range(space: spaces.Box) -> np.ndarray:
    """Return the distance between the bounds of each component, in the space's shape; inf if it is above 1e6."""
    with np.errstate(over="ignore", invalid="ignore"):
        distance = space.high.astype(np.float64) - space.low.astype(np.float64)
    return np.where(distance <= VAST, distance, np.inf)


def kind_of(space: spaces.Space) -> str | None:
    """
    Return ``"image"`` or ``"vector"`` for a ``Box``, and ``None`` for any other space.

    An image has finite bounds. It has three dimensions, one of which is the channels, or it has two dimensions of
    bytes.
    """
    if not isinstance(space, spaces.Box):
        return None
    has_pixels = len(space.shape) == 3 or (len(space.shape) == 2 and space.dtype == np.uint8)
    return "image" if has_pixels and np.isfinite(finite_range(space)).all() else "vector"


def parts_of(space: spaces.Space) -> dict[str, spaces.Space]:
    """Return the parts of a ``Dict`` by key. Any other space counts as one part with the key ``""``."""
    return dict(space.items()) if isinstance(space, spaces.Dict) else {"": space}


@dataclass(frozen=True, eq=False)
class Sensor:
    """
    An observation space with the units that perturbations work in.

    An image becomes ``(N, C, H, W)`` float32, from 0 at the lowest bound of the space to 1 at the highest. A vector
    becomes ``(N, D)`` float64 in multiples of its scale; components with a scale of 0 are not perturbed. Perturbations
    of the timing need no units.
    """

    space: Any
    scale: Any = None  # of the components of a vector, in the space's shape (in a Dict by key); see `observation_scale`
    horizon: int = UNKNOWN_HORIZON

    @cached_property
    def parts(self) -> dict[str, "Sensor"]:
        """The sensor of each part of a ``Dict`` by key. Any other space counts as one part with the key ``""``."""
        if not isinstance(self.space, spaces.Dict):
            return {"": self}
        scale = self.scale or {}
        return {key: Sensor(part, scale.get(key), self.horizon) for key, part in self.space.items()}

    @cached_property
    def groups(self) -> list[tuple[str, np.ndarray]]:
        """
        What can fail by itself: a part of a ``Dict``, a channel of an image, or a component of a vector.

        Each group is the key of its part and the indices of its components in the flattened part.
        """
        sizes = {key: int(np.prod(part.space.shape or ())) for key, part in self.parts.items()}
        if isinstance(self.space, spaces.Dict):
            return [(key, np.arange(size)) for key, size in sizes.items()]
        components = np.arange(sizes[""])
        if not self.is_image:
            return [("", component) for component in components[:, None]]
        channels = np.moveaxis(components.reshape(-1, *self.frame), -1 if self.channels_last else 1, 0)
        return [("", channel.ravel()) for channel in channels]

    @property
    def blank(self) -> np.ndarray:
        """The observation of a dead sensor: a black image, or 0 clipped to the bounds."""
        if not isinstance(self.space, spaces.Box):
            return np.zeros(self.space.shape or (), self.space.dtype)
        low, high = self.space.low, self.space.high
        return low if self.is_image else np.clip(np.zeros_like(low), low, high)

    @cached_property
    def is_image(self) -> bool:
        """Whether the observation is an image."""
        return kind_of(self.space) == "image"

    @property
    def frame(self) -> tuple[int, ...]:
        """Shape of one image in the order of the space, with one channel if there are only rows and columns."""
        shape = self.space.shape
        return (1, *shape) if len(shape) == 2 else shape

    @property
    def channels_last(self) -> bool:
        """Whether the last axis holds the channels. As in SB3, the first axis holds them if it is the shortest."""
        return int(np.argmin(self.frame)) != 0

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape ``(C, H, W)`` or ``(D,)``, whatever the order of the space's axes."""
        if not self.is_image:
            return (int(np.prod(self.space.shape)),)
        return (self.frame[2], *self.frame[:2]) if self.channels_last else self.frame

    @property
    def is_depth(self) -> bool:
        """Whether a pixel is a single float, which is a distance and not a colour."""
        return self.is_image and np.issubdtype(self.space.dtype, np.floating) and self.shape[0] == 1

    def to_units(self, observations: np.ndarray) -> np.ndarray:
        """Convert ``(N, *obs)`` to a new array ``(N, C, H, W)`` or ``(N, D)``."""
        if not self.is_image:
            scale = np.where(self.scale > 0, self.scale, 1.0)
            return (observations / scale).reshape(len(observations), -1)
        low, high = float(self.space.low.min()), float(self.space.high.max())
        units = np.multiply(observations, np.float32(1 / (high - low)), dtype=np.float32)
        if low != 0:
            units -= np.float32(low / (high - low))
        units = units.reshape(-1, *self.frame)
        return np.moveaxis(units, 3, 1) if self.channels_last else units

    def from_units(self, units: np.ndarray, observations: np.ndarray) -> np.ndarray:
        """Convert back to the order, bounds and type of the space. Components with a scale of 0 stay as observed."""
        low, high = self.space.low, self.space.high
        if self.is_image:
            units = (np.moveaxis(units, 1, 3) if self.channels_last else units).reshape(observations.shape)
            if (low == low.flat[0]).all() and (high == high.flat[0]).all():
                low, high = low.flat[0], high.flat[0]  # much faster than arrays
            lowest, highest = float(np.min(low)), float(np.max(high))
            values = lowest + np.float32(highest - lowest) * units
        else:
            values = np.where(self.scale > 0, units.reshape(observations.shape) * self.scale, observations)
        # Clip before a cast to integers, which wraps around, but after a cast to floats, which rounds.
        if np.issubdtype(self.space.dtype, np.integer):
            return np.rint(np.clip(values, low, high)).astype(self.space.dtype)
        return np.clip(values.astype(self.space.dtype), low, high)
