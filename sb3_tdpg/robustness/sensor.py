"""
The units of observations for perturbations, so that a severity means the same in every observation space.

Dimension key: N environments, C channels, H and W rows and columns, D components of a vector.
"""

from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

VAST = 1e6  # bounds further apart count as infinite: some environments use the largest float for "unbounded"


def finite_range(space: spaces.Box) -> np.ndarray:
    """Return the distance between the bounds of each component, in the space's shape; inf where there are none."""
    with np.errstate(over="ignore", invalid="ignore"):
        distance = space.high.astype(np.float64) - space.low.astype(np.float64)
    return np.where(distance <= VAST, distance, np.inf)


def kind_of(space: spaces.Space) -> str | None:
    """
    Return ``"image"``, ``"vector"`` or, if it is not a ``Box``, ``None``.

    An image has finite bounds and three dimensions, one of them the channels, or two dimensions and bytes.
    """
    if not isinstance(space, spaces.Box):
        return None
    has_pixels = len(space.shape) == 3 or (len(space.shape) == 2 and space.dtype == np.uint8)
    return "image" if has_pixels and np.isfinite(finite_range(space)).all() else "vector"


def horizon_of(env: gym.Env | VecEnv) -> int | None:
    """Return the attribute ``horizon`` of an environment, if it has one."""
    if isinstance(env, VecEnv):
        return env.get_attr("horizon", [0])[0] if env.has_attr("horizon") else None
    return env.get_wrapper_attr("horizon") if env.has_wrapper_attr("horizon") else None


@dataclass(frozen=True, eq=False)
class Sensor:
    """
    An observation space with the units that perturbations work in.

    An image becomes ``(N, C, H, W)`` float32, from 0 at the lowest bound of the space to 1 at the highest. A vector
    becomes ``(N, D)`` float64 in multiples of its scale; components with a scale of 0 are not perturbed.
    """

    space: spaces.Box
    scale: np.ndarray | None = None  # of the components of a vector, in the space's shape; see `observation_scale`

    @property
    def is_image(self) -> bool:
        """Whether there are pixels."""
        return kind_of(self.space) == "image"

    @property
    def is_depth(self) -> bool:
        """Whether a pixel is one float: a distance, not a colour."""
        return self.is_image and np.issubdtype(self.space.dtype, np.floating) and self.shape[0] == 1

    @property
    def channels_last(self) -> bool:
        """Whether the last axis holds the channels: as for Stable-Baselines3, unless the first one is the shortest."""
        return len(self.space.shape) == 3 and int(np.argmin(self.space.shape)) != 0

    @property
    def shape(self) -> tuple[int, ...]:
        """``(C, H, W)`` or ``(D,)``, whatever the order in the space."""
        shape = self.space.shape
        if not self.is_image:
            return (int(np.prod(shape)),)
        channels = (1,) if len(shape) == 2 else ()
        return (shape[2], *shape[:2]) if self.channels_last else (*channels, *shape)

    def to_units(self, observations: np.ndarray) -> np.ndarray:
        """Convert ``(N, *obs)`` to a new array ``(N, C, H, W)`` or ``(N, D)``."""
        if not self.is_image:
            assert self.scale is not None
            scale = np.where(self.scale > 0, self.scale, 1.0)
            return (observations / scale).reshape(len(observations), -1)
        low, high = float(self.space.low.min()), float(self.space.high.max())
        units = np.multiply(observations, np.float32(1 / (high - low)), dtype=np.float32)
        if low != 0:
            units -= np.float32(low / (high - low))
        return np.moveaxis(units, 3, 1) if self.channels_last else units.reshape(len(units), *self.shape)

    def from_units(self, units: np.ndarray, observations: np.ndarray) -> np.ndarray:
        """Convert back to the order, bounds and type of the space; components without a scale stay unperturbed."""
        low, high = self.space.low, self.space.high
        if self.is_image:
            units = np.moveaxis(units, 1, 3) if self.channels_last else units.reshape(observations.shape)
            if (low == low.flat[0]).all() and (high == high.flat[0]).all():
                low, high = low.flat[0], high.flat[0]  # much faster than arrays
            lowest, highest = float(np.min(low)), float(np.max(high))
            values = lowest + np.float32(highest - lowest) * units
        else:
            assert self.scale is not None
            values = np.where(self.scale > 0, units.reshape(observations.shape) * self.scale, observations)
        # Clip before a cast to integers, which wraps around, but after a cast to floats, which rounds.
        if np.issubdtype(self.space.dtype, np.integer):
            return np.rint(np.clip(values, low, high)).astype(self.space.dtype)
        return np.clip(values.astype(self.space.dtype), low, high)
