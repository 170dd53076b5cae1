"""The ball-catching scene from the side, for pictures, films and PyBullet's window: never an observation."""

from __future__ import annotations

import numpy as np

from .ball_bullet import UNTURNED, add_ball, add_plane
from .ball_scene import IMAGE_SIZE, LIGHT, WALL_CENTRE_Z, WALL_SCALE, WALL_X, BallScene, floor_texture
from .bullet import BulletClient

HEIGHT, WIDTH = 256, 512  # pixels of the view from the side
MIDDLE = (4.0, 0.0, 2.6)  # m, what it looks at
BESIDE = 9.5  # m, from where


def enlarge(image: np.ndarray, factor: int) -> np.ndarray:
    """Repeat every pixel of an image ``(H, W, 3)``."""
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


class SideView:
    """
    The scene in a Bullet world of its own, in the world's frame, with a body for the robot.

    :param scene: What is drawn.
    :param gui: Open PyBullet's window.
    """

    def __init__(self, scene: BallScene, *, gui: bool = False) -> None:
        self.scene = scene
        self.client = client = BulletClient(gui=gui)
        if gui:
            client.configureDebugVisualizer(client.COV_ENABLE_GUI, 0)
            client.resetDebugVisualizerCamera(BESIDE, 0, -8, MIDDLE)
        add_plane(client, floor_texture())
        wall = add_plane(client, scene.texture, WALL_SCALE)
        upright = client.getQuaternionFromEuler([0.0, -np.pi / 2, 0.0])
        client.resetBasePositionAndOrientation(wall, (WALL_X, 0.0, WALL_CENTRE_Z), upright)
        self._ball = add_ball(client, scene)
        self._mast = self._add_box((0.06, 0.06, scene.camera_height / 2), (0.25, 0.25, 0.28))
        self._head = self._add_box((0.22, 0.16, 0.16), (0.15, 0.25, 0.55))
        self._base = self._add_box((0.35, 0.3, 0.12), (0.15, 0.25, 0.55))

    def _add_box(self, half_sizes: tuple[float, float, float], color: tuple[float, float, float]) -> int:
        shape = self.client.createVisualShape(
            self.client.GEOM_BOX, halfExtents=half_sizes, rgbaColor=[*color, 1.0], specularColor=[0, 0, 0]
        )
        return int(self.client.createMultiBody(baseVisualShapeIndex=shape))

    def place(self, state: np.ndarray) -> None:
        """Move robot and ball to where a state, ``(5,)``, has them."""
        d, ball_x, ball_y = state[:3].tolist()
        height = self.scene.camera_height
        tilt = self.client.getQuaternionFromEuler([0.0, -np.deg2rad(self.scene.camera_pitch), 0.0])
        place = self.client.resetBasePositionAndOrientation
        place(self._ball, (ball_x, 0.0, ball_y), UNTURNED)
        place(self._mast, (d, 0.0, height / 2), UNTURNED)
        place(self._base, (d, 0.0, 0.12), UNTURNED)
        place(self._head, (d, 0.0, height), tilt)

    def picture(self, camera_image: np.ndarray) -> np.ndarray:
        """
        Draw the scene beside what the robot sees.

        :param camera_image: ``(3, 64, 64)`` uint8
        :return: ``(256, 772, 3)`` uint8
        """
        client = self.client
        view = client.computeViewMatrix((MIDDLE[0] - 1.5, -BESIDE, 3.4), MIDDLE, (0.0, 0.0, 1.0))
        projection = client.computeProjectionMatrixFOV(38.0, WIDTH / HEIGHT, 0.1, 60.0)
        rgba = client.getCameraImage(
            WIDTH, HEIGHT, view, projection, lightDirection=LIGHT.tolist(), shadow=1,
            renderer=client.ER_TINY_RENDERER,
        )[2]  # fmt: skip
        scene = np.asarray(rgba, dtype=np.uint8).reshape(HEIGHT, WIDTH, 4)[..., :3]
        seen = enlarge(camera_image.transpose(1, 2, 0), HEIGHT // IMAGE_SIZE)
        return np.concatenate([scene, np.full((HEIGHT, 4, 3), 255, np.uint8), seen], axis=1)

    def close(self) -> None:
        """Close the Bullet world."""
        self.client.close()
