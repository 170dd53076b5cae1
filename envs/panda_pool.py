"""Grasps and depth images of a batch, in this process or shared among several."""

import multiprocessing
import signal
import warnings
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cached_property
from itertools import chain, repeat
from typing import Any

import numpy as np

from .panda_bullet import Configuration, GraspSimulation, Motion, Outcome
from .panda_camera import DepthCamera
from .panda_scene import PandaScene

SHARES = 8  # parts of a batch for each process, so that all end at about the same time


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

    def grasps(
        self, states: np.ndarray, poses: np.ndarray, watch: Callable[[Configuration], object] | None = None
    ) -> list[Outcome]:
        """Carry out one grasp for each mug, ``(N, 4)``, at its pose, ``(N, 4)``; ``watch`` as in ``grasp``."""
        return [self.simulation.grasp(mug, pose, watch) for mug, pose in zip(states, poses, strict=True)]

    def images(self, states: np.ndarray) -> np.ndarray:
        """Draw the depth images; see :meth:`~sb3_tdpg.envs.panda_camera.DepthCamera.images`."""
        return self.camera.images(states)

    def close(self) -> None:
        """Close the Bullet worlds."""
        for name in {"simulation", "camera"} & set(self.__dict__):
            getattr(self, name).close()


class GraspPool:
    """
    Several processes with a :class:`GraspWorld` each, which share a batch; the results are the same bit for bit.

    The processes ignore Ctrl-C and end with this one. If one dies, the next call raises
    :class:`concurrent.futures.process.BrokenProcessPool`.
    """

    def __init__(self, n_processes: int, *world_arguments: object) -> None:
        # Other start methods import the user's script, which then needs a guard `if __name__ == "__main__"`.
        method = "fork" if "fork" in multiprocessing.get_all_start_methods() else None
        self._n_processes = n_processes
        self._executor = ProcessPoolExecutor(
            n_processes, multiprocessing.get_context(method), initializer=_begin, initargs=world_arguments
        )

    def grasps(self, states: np.ndarray, poses: np.ndarray) -> list[Outcome]:
        """Carry out grasps as :meth:`GraspWorld.grasps` does."""
        return list(chain(*self._map("grasps", states, poses)))

    def images(self, states: np.ndarray) -> np.ndarray:
        """Draw depth images as :meth:`GraspWorld.images` does."""
        return np.concatenate(self._map("images", states))

    def _map(self, method: str, *arrays: np.ndarray) -> list[Any]:
        n_parts = min(len(arrays[0]), SHARES * self._n_processes)
        parts = [np.array_split(array, n_parts) for array in arrays]
        with warnings.catch_warnings():
            # Python 3.12 warns of PyTorch's threads in a forked process; these processes do not call PyTorch.
            warnings.filterwarnings("ignore", message=".*multi-threaded.*fork.*", category=DeprecationWarning)
            return list(self._executor.map(_call, repeat(method), *parts))

    def close(self) -> None:
        """End the processes."""
        self._executor.shutdown(wait=False, cancel_futures=True)


_world: GraspWorld  # of a process of a pool


def _begin(*world_arguments: Any) -> None:
    global _world
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _world = GraspWorld(*world_arguments)


def _call(method: str, *arrays: np.ndarray) -> Any:
    return getattr(_world, method)(*arrays)
