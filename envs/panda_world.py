"""The grasping problem in PyBullet: the simulation and the camera of one process."""

from functools import cached_property

import numpy as np

from .panda_arm import Watch
from .panda_bullet import GraspSimulation, Motion, Outcome
from .panda_camera import DepthCamera
from .panda_scene import PandaScene


class GraspWorld:
    """Simulation and camera of one process; each is made when it is first used."""

    def __init__(self, scene: PandaScene, motion: Motion, solver_iterations: int | None) -> None:
        self._simulation_arguments = (scene, motion, solver_iterations)

    @cached_property
    def simulation(self) -> GraspSimulation:
        """The robot, the table and the mug."""
        return GraspSimulation(*self._simulation_arguments)

    @cached_property
    def camera(self) -> DepthCamera:
        """The depth camera."""
        return DepthCamera(self._simulation_arguments[0])

    def grasps(self, states: np.ndarray, poses: np.ndarray, watch: Watch | None = None) -> list[Outcome]:
        """Carry out one grasp for each mug, ``(N, 4)``, at its pose, ``(N, 4)``; ``watch`` as in ``grasp``."""
        return [self.simulation.grasp(mug, pose, watch) for mug, pose in zip(states, poses, strict=True)]

    def images(self, states: np.ndarray) -> np.ndarray:
        """Draw the depth images; see :meth:`~sb3_tdpg.envs.panda_camera.DepthCamera.images`."""
        return self.camera.images(states)

    def close(self) -> None:
        """Close the Bullet worlds."""
        for name in {"simulation", "camera"} & set(self.__dict__):
            getattr(self, name).close()
