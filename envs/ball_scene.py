"""
Define the ball-catching scene as data, for all renderers.

Coordinates: x points forward, y to the left and z upward. The floor is at z = 0. The camera is at
(d, 0, camera_height) and looks along +x, tilted upward by camera_pitch. Lengths are in metres.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

IMAGE_SIZE = 64  # pixels per side
NEAR, FAR = 0.1, 20.0  # only points between these depths are drawn, so that white sky replaces the top of the wall

# Floor and wall are square meshes with 15 copies of the texture per side, like PyBullet's plane in 2020. (The plane of
# PyBullet 3.2.7 shifts the texture by half a copy.) A side of the floor is 30 m long, a side of the wall 120 m.
PLANE_HALF, PLANE_COPIES = 15.0, 15
WALL_SCALE = 4.0
WALL_X, WALL_Z = 10.0, 42.0  # centre of the wall

LIGHT = np.array([-50.0, 30.0, 100.0])  # PyBullet's default position of the light


@dataclass(frozen=True, eq=False)
class BallScene:
    """The wall, the ball and the camera of a scene."""

    ball_color: ClassVar = (0.0, 1.0, 0.0)  # red, green and blue, each in [0, 1]
    fov: ClassVar = 90.0  # field of view in degrees, the same in both directions
    texture: np.ndarray  # of the wall, (H, W, 3) uint8
    ball_radius: float
    camera_height: float  # above the floor
    camera_pitch: float  # upward tilt in degrees
