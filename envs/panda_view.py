"""The grasping scene from a third person, for pictures, films and PyBullet's window: never an observation."""

from __future__ import annotations

import os

import numpy as np

from .ball_view import enlarge
from .bullet import BulletClient
from .panda_bullet import ARM_JOINTS, FINGER_JOINTS, FINGER_OPEN, HOME, Configuration
from .panda_camera import IMAGE_SIZE
from .panda_scene import (
    ASSETS,
    ROBOT_FILE,
    TABLE_FILE,
    TABLE_POSITION,
    UNTURNED,
    PandaScene,
    add_mug_picture,
)

HEIGHT, WIDTH = 256, 384  # pixels of the view
MIDDLE = (0.38, 0.0, 0.2)  # m, what it looks at
DISTANCE, YAW, PITCH, FOV = 0.82, 145.0, -18.0, 46.0  # m and degrees: from where it sees robot, mug and handle
LIGHT = (1.0, 1.2, 2.5)  # direction
SHADOW_COLOR = (0.45, 0.36, 0.28, 1.0)
FLOOR_FILE = os.path.join(ASSETS, "plane.urdf")
FLOOR_HEIGHT = -0.625  # m
NEAREST, FURTHEST = 0.30, 0.61  # m, what is white and what is black in the picture of the depth


class PandaView:
    """
    Robot, table and mug, as they look, in a Bullet world of their own in which nothing moves by itself.

    :param scene: The mug.
    :param gui: Open PyBullet's window.
    """

    def __init__(self, scene: PandaScene, *, gui: bool = False) -> None:
        self.client = client = BulletClient(gui=gui)
        if gui:
            client.configureDebugVisualizer(client.COV_ENABLE_GUI, 0)
            client.resetDebugVisualizerCamera(DISTANCE, YAW, PITCH, MIDDLE)
        client.loadURDF(FLOOR_FILE, (0.0, 0.0, FLOOR_HEIGHT), useFixedBase=True)
        client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True)
        self._robot = int(client.loadURDF(ROBOT_FILE, useFixedBase=True))
        self._mug = add_mug_picture(client, scene)
        self._scene = scene
        # TinyRenderer throws no shadow on the table, and without one a picture does not tell whether the mug is lifted.
        shadow = client.createVisualShape(
            client.GEOM_CYLINDER, radius=scene.mug_radius, length=0.001, rgbaColor=SHADOW_COLOR, specularColor=[0, 0, 0]
        )
        self._shadow = int(client.createMultiBody(baseVisualShapeIndex=shadow))

    @staticmethod
    def at_rest(position: tuple[float, float, float], yaw: float) -> Configuration:
        """Return the robot in its home position, and the mug upright."""
        half = yaw / 2
        orientation = (0.0, 0.0, float(np.sin(half)), float(np.cos(half)))
        return Configuration((*HOME, FINGER_OPEN, FINGER_OPEN), position, orientation)

    def place(self, configuration: Configuration) -> None:
        """Put everything where it is at one instant."""
        for joint, value in zip((*ARM_JOINTS, *FINGER_JOINTS), configuration.joints, strict=True):
            self.client.resetJointState(self._robot, joint, value)
        self.client.resetBasePositionAndOrientation(
            self._mug, configuration.mug_position, configuration.mug_orientation
        )
        right, ahead, _ = self._scene.cup_origin.tolist()
        (x, y, _), _ = self.client.multiplyTransforms(
            configuration.mug_position, configuration.mug_orientation, (right, ahead, 0.0), UNTURNED
        )
        self.client.resetBasePositionAndOrientation(self._shadow, (x, y, 0.0), UNTURNED)

    def picture(self, depth: np.ndarray) -> np.ndarray:
        """
        Draw the scene beside what the robot sees.

        :param depth: Depth image in m, ``(1, 128, 128)``.
        :return: ``(256, 644, 3)`` uint8
        """
        seen = enlarge(depth_picture(depth), HEIGHT // IMAGE_SIZE)
        return np.concatenate([self.scene_picture(HEIGHT, WIDTH), np.full((HEIGHT, 4, 3), 255, np.uint8), seen], axis=1)

    def scene_picture(self, height: int, width: int) -> np.ndarray:
        """Draw the scene, ``(height, width, 3)`` uint8."""
        client = self.client
        rgba = client.getCameraImage(
            width, height,
            client.computeViewMatrixFromYawPitchRoll(MIDDLE, DISTANCE, YAW, PITCH, 0.0, 2),
            client.computeProjectionMatrixFOV(FOV, width / height, 0.1, 10.0),
            lightDirection=LIGHT, shadow=1, renderer=client.ER_TINY_RENDERER,
        )[2]  # fmt: skip
        return np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[..., :3]

    def close(self) -> None:
        """Close the Bullet world."""
        self.client.close()


def depth_picture(depth: np.ndarray) -> np.ndarray:
    """Draw a depth image, ``(1, H, W)`` in m, as a grey one, ``(H, W, 3)`` uint8: what is near is bright."""
    brightness = np.clip((FURTHEST - depth[0]) / (FURTHEST - NEAREST), 0.0, 1.0)
    return np.rint(255 * brightness).astype(np.uint8)[..., None].repeat(3, axis=2)
