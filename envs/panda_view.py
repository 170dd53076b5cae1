"""The grasping scene from the side, for pictures, videos and PyBullet's window; never an observation."""

import os

import numpy as np

from .bullet import UNTURNED, BulletWorld, beside
from .panda_bullet import ARM_JOINTS, FINGER_JOINTS, Configuration
from .panda_scene import ASSETS, ROBOT_FILE, TABLE_FILE, TABLE_POSITION, PandaScene, add_mug_picture

HEIGHT, WIDTH = 256, 384  # pixels of the view
MIDDLE = (0.38, 0.0, 0.2)  # m, its target
DISTANCE, YAW, PITCH, FOV = 0.82, 145.0, -18.0, 46.0  # m and degrees: robot, mug and handle are visible
LIGHT = (1.0, 1.2, 2.5)  # direction
SHADOW_COLOR = (0.45, 0.36, 0.28, 1.0)
FLOOR_FILE = os.path.join(ASSETS, "plane.urdf")
FLOOR_HEIGHT = -0.625  # m
NEAREST, FURTHEST = 0.30, 0.61  # m, white and black in the picture of the depth


class PandaView(BulletWorld):
    """Robot, table and mug in a Bullet world of their own, without physics."""

    def __init__(self, scene: PandaScene, *, gui: bool = False) -> None:
        super().__init__(gui=gui)
        client = self.client
        if gui:
            client.show_window(DISTANCE, YAW, PITCH, MIDDLE)
        client.loadURDF(FLOOR_FILE, (0.0, 0.0, FLOOR_HEIGHT), useFixedBase=True)
        client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True)
        self._robot = int(client.loadURDF(ROBOT_FILE, useFixedBase=True))
        self._mug = add_mug_picture(client, scene)
        self._scene = scene
        # TinyRenderer draws no shadow on the table; without one, the picture does not show whether the mug is lifted.
        shadow = client.createVisualShape(
            client.GEOM_CYLINDER, radius=scene.mug_radius, length=0.001, rgbaColor=SHADOW_COLOR, specularColor=[0, 0, 0]
        )
        self._shadow = int(client.createMultiBody(baseVisualShapeIndex=shadow))

    def place(self, configuration: Configuration) -> None:
        """Move robot and mug to a configuration."""
        client, mug = self.client, (configuration.mug_position, configuration.mug_orientation)
        for joint, value in zip((*ARM_JOINTS, *FINGER_JOINTS), configuration.joints, strict=True):
            client.resetJointState(self._robot, joint, value)
        client.resetBasePositionAndOrientation(self._mug, *mug)
        right, ahead, _ = self._scene.cup_origin.tolist()
        (x, y, _), _ = client.multiplyTransforms(*mug, (right, ahead, 0.0), UNTURNED)
        client.resetBasePositionAndOrientation(self._shadow, (x, y, 0.0), UNTURNED)

    def picture(self, depth: np.ndarray) -> np.ndarray:
        """Draw the scene beside a depth image, ``(1, 128, 128)`` in m: ``(256, 644, 3)`` uint8."""
        return beside(self.scene_picture(HEIGHT, WIDTH), depth_picture(depth))

    def scene_picture(self, height: int, width: int) -> np.ndarray:
        """Draw the scene, ``(height, width, 3)`` uint8."""
        view = self.client.computeViewMatrixFromYawPitchRoll(MIDDLE, DISTANCE, YAW, PITCH, 0.0, 2)
        projection = self.client.computeProjectionMatrixFOV(FOV, width / height, 0.1, 10.0)
        return self.client.picture(height, width, view, projection, LIGHT, shadow=1)


def depth_picture(depth: np.ndarray) -> np.ndarray:
    """Draw a depth image, ``(1, H, W)`` in m, as a grey one, ``(H, W, 3)`` uint8; near points are bright."""
    brightness = np.clip((FURTHEST - depth[0]) / (FURTHEST - NEAREST), 0.0, 1.0)
    return np.rint(255 * brightness).astype(np.uint8)[..., None].repeat(3, axis=2)
