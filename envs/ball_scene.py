"""
The ball-catching scene as data, for every renderer.

Coordinates: x forward, y to the left, z upward; the floor is z = 0, and the camera at (d, 0, camera_height) looks along
+x. Lengths are in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

IMAGE_SIZE = 64  # pixels a side
NEAR, FAR = 0.1, 20.0  # depth beyond which nothing is drawn; FAR cuts the top of the wall to white sky

# A plane is a square mesh, 30 m and 15 copies of its texture a side, like PyBullet's plane in 2020. (That of PyBullet
# 3.2.7 shifts the texture by half a copy.) The wall is four times as large.
PLANE_HALF, PLANE_COPIES = 15.0, 15
WALL_SCALE = 4.0
WALL_X, WALL_CENTRE_Z = 10.0, 42.0

# PyBullet's default light: a pixel is texel * (ambient + diffuse * max(0, n.l) + specular * max(0, r_z)^2) with the
# normal n, the direction l to the light and that of its reflection, r.
LIGHT = np.array([-50.0, 30.0, 100.0])
AMBIENT, DIFFUSE, SPECULAR = 0.6, 0.35, 0.05


@dataclass(frozen=True, eq=False)
class BallScene:
    """
    A wall, a floor, a ball and a camera.

    :param texture: Texture of the wall, ``(H, W, 3)`` uint8; see :mod:`sb3_tdpg.envs.textures`.
    :param ball_color: Red, green and blue, each in [0, 1].
    :param ball_radius: In metres.
    :param camera_height: Above the floor, in metres.
    :param camera_pitch: Upward tilt in degrees.
    :param fov: Field of view in degrees, the same in both directions.
    """

    texture: np.ndarray
    ball_color: tuple[float, float, float]
    ball_radius: float
    camera_height: float
    camera_pitch: float
    fov: float


def floor_texture() -> np.ndarray:
    """Draw the chequerboard of PyBullet's floor, ``(512, 512, 3)``: squares of 1 m, pale blue and white."""
    side = np.arange(512) // 256
    is_blue = side[:, None] == side
    return np.where(is_blue[..., None], (173, 199, 239), (255, 255, 255)).astype(np.uint8)


def plane_mesh(half: float) -> dict[str, Any]:
    """Return the level square of a plane as keywords of PyBullet's ``createVisualShape``."""
    corners = [(half, -half), (half, half), (-half, half), (-half, -half)]
    return dict(
        vertices=[(x, y, 0.0) for x, y in corners],
        indices=[0, 1, 2, 0, 2, 3],
        uvs=[(PLANE_COPIES * (x > 0), PLANE_COPIES * (y > 0)) for x, y in corners],
        normals=[(0.0, 0.0, 1.0)] * 4,
    )
