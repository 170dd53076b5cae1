"""
The ball-catching scene as data, for every renderer.

Coordinates: x forward, y to the left, z upward; the floor is z = 0, and the camera at (d, 0, camera_height) looks along
+x. Lengths are in metres.
"""

from dataclasses import dataclass

import numpy as np

IMAGE_SIZE = 64  # pixels a side
NEAR, FAR = 0.1, 20.0  # depth beyond which nothing is drawn; FAR cuts the top of the wall to white sky

# A plane is a square mesh, 30 m and 15 copies of its texture a side, like PyBullet's plane in 2020. (That of PyBullet
# 3.2.7 shifts the texture by half a copy.) The wall is four times as large.
PLANE_HALF, PLANE_COPIES = 15.0, 15
WALL_SCALE = 4.0
WALL_X, WALL_Z = 10.0, 42.0  # its centre

LIGHT = np.array([-50.0, 30.0, 100.0])  # PyBullet's default position of the light


@dataclass(frozen=True, eq=False)
class BallScene:
    """A wall, a floor, a ball and a camera."""

    texture: np.ndarray  # of the wall, (H, W, 3) uint8
    ball_color: tuple[float, ...]  # red, green and blue, each in [0, 1]
    ball_radius: float
    camera_height: float  # above the floor
    camera_pitch: float  # upward tilt in degrees
    fov: float  # field of view in degrees, the same in both directions
