"""The reference picture of the ball-catching camera: PyBullet's TinyRenderer, one image at a time."""

from __future__ import annotations

import numpy as np

from .ball_scene import (
    FAR,
    IMAGE_SIZE,
    LIGHT,
    NEAR,
    PLANE_HALF,
    WALL_CENTRE_Z,
    WALL_SCALE,
    WALL_X,
    BallScene,
    floor_texture,
    plane_mesh,
)
from .bullet import BulletClient

UNTURNED = (0.0, 0.0, 0.0, 1.0)  # quaternion (x, y, z, w)


def add_plane(client: BulletClient, texture: np.ndarray, scale: float = 1.0) -> int:
    """Add a level textured square; return its body's id."""
    shape = client.createVisualShape(client.GEOM_MESH, **plane_mesh(scale * PLANE_HALF))
    body = client.createMultiBody(baseVisualShapeIndex=shape)
    client.changeVisualShape(body, -1, textureUniqueId=client.upload_texture(texture))
    return int(body)


def add_ball(client: BulletClient, scene: BallScene) -> int:
    """Add the ball; return its body's id."""
    shape = client.createVisualShape(
        client.GEOM_SPHERE, radius=scene.ball_radius, rgbaColor=[*scene.ball_color, 1.0], specularColor=[1, 1, 1]
    )
    return int(client.createMultiBody(baseVisualShapeIndex=shape))


class BulletRenderer:
    """
    The scene in a Bullet world of its own, in the robot's frame: camera and floor stand still, wall and ball move.

    :param scene: What is drawn.
    """

    def __init__(self, scene: BallScene) -> None:
        self.client = BulletClient()
        add_plane(self.client, floor_texture())
        self._wall = add_plane(self.client, scene.texture, WALL_SCALE)
        self._ball = add_ball(self.client, scene)
        # Level to upright: the plane's x axis points up, its normal towards the robot.
        self._upright = self.client.getQuaternionFromEuler([0.0, -np.pi / 2, 0.0])
        pitch = np.deg2rad(scene.camera_pitch)
        eye = (0.0, 0.0, scene.camera_height)
        ahead = (np.cos(pitch), 0.0, scene.camera_height + np.sin(pitch))
        self._camera = dict(
            width=IMAGE_SIZE,
            height=IMAGE_SIZE,
            viewMatrix=self.client.computeViewMatrix(eye, ahead, (0.0, 0.0, 1.0)),
            projectionMatrix=self.client.computeProjectionMatrixFOV(scene.fov, 1.0, NEAR, FAR),
            lightDirection=LIGHT.tolist(),
            shadow=0,
            renderer=self.client.ER_TINY_RENDERER,
        )

    def images(self, state: np.ndarray) -> np.ndarray:
        """Return one image for each state: ``(N, 3, 64, 64)`` uint8 from ``(N, 5)``."""
        images = np.empty((len(state), 3, IMAGE_SIZE, IMAGE_SIZE), np.uint8)
        place, draw = self.client.resetBasePositionAndOrientation, self.client.getCameraImage
        for image, (d, ball_x, ball_y) in zip(images, state[:, :3].tolist(), strict=True):
            place(self._wall, (WALL_X - d, 0.0, WALL_CENTRE_Z), self._upright)
            place(self._ball, (ball_x - d, 0.0, ball_y), UNTURNED)
            rgba = np.asarray(draw(**self._camera)[2], dtype=np.uint8).reshape(IMAGE_SIZE, IMAGE_SIZE, 4)
            image[...] = rgba[..., :3].transpose(2, 0, 1)
        return images

    def close(self) -> None:
        """Close the Bullet world."""
        self.client.close()
