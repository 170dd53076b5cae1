"""Draw side views of the arm's scenes for pictures and videos, not for observations."""

import os
from collections.abc import Callable

import numpy as np

from .bullet import UNTURNED, BulletClient, BulletWorld, beside
from .panda_arm import ARM_JOINTS, FINGER_JOINTS, Configuration
from .panda_scene import ASSETS, MUG_RADIUS, ROBOT_FILE, TABLE_FILE, TABLE_POSITION, add_mug_picture
from .squeeze_scene import SqueezeScene, add_part, add_slot, load_robot

HEIGHT, WIDTH = 256, 384  # pixels of the view
FOV = 46.0  # degrees
LIGHT = (1.0, 1.2, 2.5)  # direction
SHADOW_COLOR = (0.45, 0.36, 0.28, 1.0)
FLOOR_FILE = os.path.join(ASSETS, "plane.urdf")
FLOOR_HEIGHT = -0.625  # m
NEAREST, FURTHEST = 0.30, 0.61  # m, the depths that depth_picture() shows as white and as black


class ArmView(BulletWorld):
    """
    Draw floor, table and robot in a separate Bullet world without physics.

    :param load_robot: Function that loads the robot into the world and returns the id of its body.
    """

    # The camera's target in m (middle); its distance from the target in m, its yaw and its pitch in degrees
    # (viewpoint); and the smallest depth that is drawn, in m (near).
    middle: tuple[float, float, float]
    viewpoint: tuple[float, float, float]
    near = 0.1

    def __init__(self, load_robot: Callable[[BulletClient], int]) -> None:
        super().__init__()
        self.client.loadURDF(FLOOR_FILE, (0.0, 0.0, FLOOR_HEIGHT), useFixedBase=True)
        self.client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True)
        self._robot = load_robot(self.client)

    def place(self, configuration: Configuration) -> None:
        """Move the robot to a configuration."""
        for joint, value in zip((*ARM_JOINTS, *FINGER_JOINTS), configuration.joints, strict=True):
            self.client.resetJointState(self._robot, joint, value)

    def scene_picture(self, height: int, width: int) -> np.ndarray:
        """Draw the scene, ``(height, width, 3)`` uint8."""
        view = self.client.computeViewMatrixFromYawPitchRoll(self.middle, *self.viewpoint, 0.0, 2)
        projection = self.client.computeProjectionMatrixFOV(FOV, width / height, self.near, 10.0)
        return self.client.picture(height, width, view, projection, LIGHT, shadow=1)


class PandaView(ArmView):
    """Draw robot, table and mug."""

    middle = (0.38, 0.0, 0.2)
    viewpoint = (0.82, 145.0, -18.0)  # robot, mug and handle are visible

    def __init__(self, cup_origin: np.ndarray) -> None:
        super().__init__(lambda client: int(client.loadURDF(ROBOT_FILE, useFixedBase=True)))
        client = self.client
        self._mug = add_mug_picture(client, cup_origin)
        self._cup_origin = cup_origin
        # A disc is the mug's shadow, because TinyRenderer draws none on the table. Without a shadow the picture does
        # not show whether the mug is lifted.
        shadow = client.createVisualShape(
            client.GEOM_CYLINDER, radius=MUG_RADIUS, length=0.001, rgbaColor=SHADOW_COLOR, specularColor=[0, 0, 0]
        )
        self._shadow = int(client.createMultiBody(baseVisualShapeIndex=shadow))

    def place(self, configuration: Configuration) -> None:
        """Move robot and mug to a configuration."""
        super().place(configuration)
        client, mug = self.client, (configuration.position, configuration.orientation)
        client.resetBasePositionAndOrientation(self._mug, *mug)
        right, ahead, _ = self._cup_origin.tolist()
        (x, y, _), _ = client.multiplyTransforms(*mug, (right, ahead, 0.0), UNTURNED)
        client.resetBasePositionAndOrientation(self._shadow, (x, y, 0.0), UNTURNED)

    def picture(self, depth: np.ndarray) -> np.ndarray:
        """Draw scene and depth image, ``(1, 128, 128)`` in m, side by side in one picture, ``(256, 644, 3)`` uint8."""
        return beside(self.scene_picture(HEIGHT, WIDTH), depth_picture(depth))


class SqueezeView(ArmView):
    """Draw robot, table, part and slot."""

    middle = (0.5, 0.085, 0.06)
    viewpoint = (0.46, 150.0, -30.0)
    near = 0.05

    def __init__(self, scene: SqueezeScene) -> None:
        super().__init__(load_robot)
        add_slot(self.client, scene)
        self._part = add_part(self.client)

    def picture(self, configuration: Configuration) -> np.ndarray:
        """Draw the scene, ``(256, 384, 3)`` uint8."""
        self.place(configuration)
        self.client.resetBasePositionAndOrientation(self._part, configuration.position, configuration.orientation)
        return self.scene_picture(HEIGHT, WIDTH)


def depth_picture(depth: np.ndarray) -> np.ndarray:
    """Convert a depth image, ``(1, H, W)`` in m, to a grey image, ``(H, W, 3)`` uint8. Near points are bright."""
    brightness = np.clip((FURTHEST - depth[0]) / (FURTHEST - NEAREST), 0.0, 1.0)
    return np.rint(255 * brightness).astype(np.uint8)[..., None].repeat(3, axis=2)
