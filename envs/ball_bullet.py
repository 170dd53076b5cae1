"""The ball-catching scene in PyBullet: the reference of the camera's images, and the view from the side."""

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
from .bullet import UNTURNED, BulletClient, beside

HEIGHT, WIDTH = 256, 512  # pixels of the view from the side
MIDDLE = (4.0, 0.0, 2.6)  # m, its target
BESIDE = 9.5  # m, its distance


class BulletScene:
    """
    Floor, wall and ball in a Bullet world of their own.

    :param scene: What is drawn.
    :param gui: Open PyBullet's window.
    """

    def __init__(self, scene: BallScene, *, gui: bool = False) -> None:
        self.scene = scene
        self.client = client = BulletClient(gui=gui)
        self._add_plane(floor_texture())
        self._wall = self._add_plane(scene.texture, WALL_SCALE)
        ball = client.createVisualShape(
            client.GEOM_SPHERE, radius=scene.ball_radius, rgbaColor=[*scene.ball_color, 1.0], specularColor=[1, 1, 1]
        )
        self._ball = int(client.createMultiBody(baseVisualShapeIndex=ball))
        # Level to upright: the plane's x axis points up, its normal towards the robot.
        self._upright = client.getQuaternionFromEuler([0.0, -np.pi / 2, 0.0])

    def _move(self, body: int, position: tuple[float, ...], orientation: tuple[float, ...] = UNTURNED) -> None:
        self.client.resetBasePositionAndOrientation(body, position, orientation)

    def _add_plane(self, texture: np.ndarray, scale: float = 1.0) -> int:
        """Add a level textured square; return its body's id."""
        shape = self.client.createVisualShape(self.client.GEOM_MESH, **plane_mesh(scale * PLANE_HALF))
        body = self.client.createMultiBody(baseVisualShapeIndex=shape)
        self.client.changeVisualShape(body, -1, textureUniqueId=self.client.upload_texture(texture))
        return int(body)

    def close(self) -> None:
        """Close the Bullet world."""
        self.client.close()


class BulletRenderer(BulletScene):
    """The camera of the robot: it does not move, but wall and ball do."""

    def __init__(self, scene: BallScene) -> None:
        super().__init__(scene)
        pitch = np.deg2rad(scene.camera_pitch)
        ahead = (np.cos(pitch), 0.0, scene.camera_height + np.sin(pitch))
        self._camera = dict(
            viewMatrix=self.client.computeViewMatrix((0.0, 0.0, scene.camera_height), ahead, (0.0, 0.0, 1.0)),
            projectionMatrix=self.client.computeProjectionMatrixFOV(scene.fov, 1.0, NEAR, FAR),
            lightDirection=LIGHT.tolist(),
            shadow=0,
        )

    def images(self, state: np.ndarray) -> np.ndarray:
        """Return one image for each state: ``(N, 3, 64, 64)`` uint8 from ``(N, 5)``."""
        images = np.empty((len(state), 3, IMAGE_SIZE, IMAGE_SIZE), np.uint8)
        for image, (d, ball_x, ball_y) in zip(images, state[:, :3].tolist(), strict=True):
            self._move(self._wall, (WALL_X - d, 0.0, WALL_CENTRE_Z), self._upright)
            self._move(self._ball, (ball_x - d, 0.0, ball_y))
            image[...] = self.client.picture(IMAGE_SIZE, IMAGE_SIZE, **self._camera).transpose(2, 0, 1)
        return images


class SideView(BulletScene):
    """The scene from the side, with a body for the robot; for pictures and PyBullet's window, never an observation."""

    def __init__(self, scene: BallScene, *, gui: bool = False) -> None:
        super().__init__(scene, gui=gui)
        if gui:
            self.client.show_window(BESIDE, 0, -8, MIDDLE)
        self._move(self._wall, (WALL_X, 0.0, WALL_CENTRE_Z), self._upright)
        self._mast = self._add_box((0.06, 0.06, scene.camera_height / 2), (0.25, 0.25, 0.28))
        self._head = self._add_box((0.22, 0.16, 0.16), (0.15, 0.25, 0.55))
        self._base = self._add_box((0.35, 0.3, 0.12), (0.15, 0.25, 0.55))

    def _add_box(self, half_sizes: tuple[float, float, float], color: tuple[float, float, float]) -> int:
        shape = self.client.createVisualShape(
            self.client.GEOM_BOX, halfExtents=half_sizes, rgbaColor=[*color, 1.0], specularColor=[0, 0, 0]
        )
        return int(self.client.createMultiBody(baseVisualShapeIndex=shape))

    def place(self, state: np.ndarray) -> None:
        """Move robot and ball to a state, ``(5,)``."""
        d, ball_x, ball_y = state[:3].tolist()
        height = self.scene.camera_height
        tilt = self.client.getQuaternionFromEuler([0.0, -np.deg2rad(self.scene.camera_pitch), 0.0])
        self._move(self._ball, (ball_x, 0.0, ball_y))
        self._move(self._mast, (d, 0.0, height / 2))
        self._move(self._base, (d, 0.0, 0.12))
        self._move(self._head, (d, 0.0, height), tilt)

    def picture(self, camera_image: np.ndarray) -> np.ndarray:
        """
        Draw the scene beside the robot's camera image.

        :param camera_image: ``(3, 64, 64)`` uint8
        :return: ``(256, 772, 3)`` uint8
        """
        client = self.client
        scene = client.picture(
            HEIGHT,
            WIDTH,
            viewMatrix=client.computeViewMatrix((MIDDLE[0] - 1.5, -BESIDE, 3.4), MIDDLE, (0.0, 0.0, 1.0)),
            projectionMatrix=client.computeProjectionMatrixFOV(38.0, WIDTH / HEIGHT, 0.1, 60.0),
            lightDirection=LIGHT.tolist(),
            shadow=1,
        )
        return beside(scene, camera_image.transpose(1, 2, 0))
