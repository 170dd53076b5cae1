"""The squeezing scene from the side, for pictures and videos; never an observation."""

import os

import numpy as np

from .bullet import BulletWorld
from .panda_bullet import ARM_JOINTS, FINGER_JOINTS
from .panda_scene import ASSETS, TABLE_FILE, TABLE_POSITION
from .squeeze_bullet import Snapshot
from .squeeze_scene import SqueezeScene, add_part, add_slot, load_robot

HEIGHT, WIDTH = 256, 384  # pixels
MIDDLE = (0.5, 0.085, 0.06)  # m, its target
DISTANCE, YAW, PITCH, FOV = 0.46, 150.0, -30.0, 46.0  # m and degrees
LIGHT = (1.0, 1.2, 2.5)  # direction


class SqueezeView(BulletWorld):
    """Robot, table, part and slot in a Bullet world of their own, without physics."""

    def __init__(self, scene: SqueezeScene) -> None:
        super().__init__()
        client = self.client
        client.loadURDF(os.path.join(ASSETS, "plane.urdf"), (0.0, 0.0, -0.625), useFixedBase=True)
        client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True)
        self._robot = load_robot(client)
        add_slot(client, scene)
        self._part = add_part(client)

    def picture(self, snapshot: Snapshot) -> np.ndarray:
        """Draw the scene, ``(256, 384, 3)`` uint8."""
        client = self.client
        for joint, value in zip((*ARM_JOINTS, *FINGER_JOINTS), snapshot.joints, strict=True):
            client.resetJointState(self._robot, joint, value)
        client.resetBasePositionAndOrientation(self._part, snapshot.part_position, snapshot.part_orientation)
        view = client.computeViewMatrixFromYawPitchRoll(MIDDLE, DISTANCE, YAW, PITCH, 0.0, 2)
        projection = client.computeProjectionMatrixFOV(FOV, WIDTH / HEIGHT, 0.05, 10.0)
        return client.picture(HEIGHT, WIDTH, view, projection, LIGHT, shadow=1)
