"""Grasps and depth images of a batch, in this process or shared among several."""

from __future__ import annotations

import multiprocessing
import signal
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cached_property

import numpy as np

from .panda_bullet import Configuration, GraspSimulation, Motion, Outcome
from .panda_camera import DepthCamera
from .panda_scene import PandaScene

SHARES = 8  # parts of a batch for each process, so that all end at about the same time


class GraspWorld:
    """
    Simulation and camera of one process, each made when it is first used.

    :param scene: The mug.
    :param motion: How a grasp is carried out.
    :param solver_iterations: ``None``: the motion's.
    """

    def __init__(self, scene: PandaScene, motion: Motion, solver_iterations: int | None) -> None:
        self._simulation_arguments = (scene, motion, solver_iterations)

    @cached_property
    def simulation(self) -> GraspSimulation:
        """The robot, the table and the mug."""
        return GraspSimulation(*self._simulation_arguments)

    @cached_property
    def camera(self) -> DepthCamera:
        """What draws the depth images."""
        return DepthCamera(self._simulation_arguments[0])

    def grasps(
        self, states: np.ndarray, poses: np.ndarray, watch: Callable[[Configuration], object] | None = None
    ) -> list[Outcome]:
        """
        Carry out one grasp for each mug.

        :param states: ``(N, 4)``
        :param poses: ``(N, 4)``
        :param watch: See :meth:`~sb3_tdpg.envs.panda_bullet.GraspSimulation.grasp`.
        """
        return [self.simulation.grasp(mug, pose, watch) for mug, pose in zip(states, poses, strict=True)]

    def images(self, states: np.ndarray) -> np.ndarray:
        """See :meth:`~sb3_tdpg.envs.panda_camera.DepthCamera.images`."""
        return self.camera.images(states)

    def close(self) -> None:
        """Close the Bullet worlds."""
        for name in ("simulation", "camera"):
            if name in self.__dict__:
                getattr(self, name).close()


class GraspPool:
    """
    The same for whole batches, by several processes. What comes out is the same bit for bit.

    The processes neither hear Ctrl-C, which is for the one that they serve, nor outlive it. Should one of them die, the
    next call raises :class:`concurrent.futures.process.BrokenProcessPool`.

    :param n_processes: At least 2.
    :param world_arguments: Of :class:`GraspWorld`.
    """

    def __init__(self, n_processes: int, *world_arguments: object) -> None:
        # A forked process goes on where this one is. Any other start method imports the user's script once more, which
        # must then guard what it does by `if __name__ == "__main__"`.
        method = "fork" if "fork" in multiprocessing.get_all_start_methods() else None
        self._n_processes = n_processes
        self._executor = ProcessPoolExecutor(
            n_processes, multiprocessing.get_context(method), initializer=_begin, initargs=world_arguments
        )

    def grasps(self, states: np.ndarray, poses: np.ndarray) -> list[Outcome]:
        """See :meth:`GraspWorld.grasps`."""
        return [outcome for part in self._map(_grasps, states, poses) for outcome in part]

    def images(self, states: np.ndarray) -> np.ndarray:
        """See :meth:`GraspWorld.images`."""
        return np.concatenate(self._map(_images, states))

    def _map(self, function: Callable[..., object], *arrays: np.ndarray) -> list:
        n_parts = min(len(arrays[0]), SHARES * self._n_processes)
        parts: list[Sequence[np.ndarray]] = [np.array_split(array, n_parts) for array in arrays]
        with warnings.catch_warnings():
            # From Python 3.12 on a fork warns of the threads of PyTorch; the processes do not call PyTorch.
            warnings.filterwarnings("ignore", message=".*multi-threaded.*fork.*", category=DeprecationWarning)
            return list(self._executor.map(function, *parts))

    def close(self) -> None:
        """End the processes."""
        self._executor.shutdown(wait=False, cancel_futures=True)


_world: GraspWorld  # of a process of a pool


def _begin(*world_arguments: object) -> None:
    global _world
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _world = GraspWorld(*world_arguments)  # type: ignore[arg-type]


def _grasps(states: np.ndarray, poses: np.ndarray) -> list[Outcome]:
    return _world.grasps(states, poses)


def _images(states: np.ndarray) -> np.ndarray:
    return _world.images(states)
