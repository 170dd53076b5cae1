"""The squeezing scene from the side, for pictures and videos; never an observation."""

import numpy as np

from .panda_arm import Configuration
from .panda_view import HEIGHT, WIDTH, ArmView
from .squeeze_scene import SqueezeScene, add_part, add_slot, load_robot


class SqueezeView(ArmView):
    """Robot, table, part and slot."""

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
