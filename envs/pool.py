"""Share the work of a batch, such as grasps or images, among several processes."""

import multiprocessing
import os
import signal
import threading
import time
import warnings
from abc import abstractmethod
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import cached_property
from itertools import chain, repeat
from typing import Any

import numpy as np

from .base import POMDPEnv

# Cached properties of an environment that hold a Bullet world or processes. Each is created at its first use, in the
# process that uses it.
RESOURCES = {"_world", "_pool", "_view"}
SHARES = 8  # number of parts of a batch per process; small parts let all processes end at about the same time


class WorkPool:
    """
    Share a batch among several processes, each with its own worker object.

    The results equal those of one process bit for bit. The processes ignore Ctrl-C and end when this process ends. If
    one of them dies, the next call raises :class:`concurrent.futures.process.BrokenProcessPool`.

    :param n_processes: Number of processes.
    :param make_worker: Class or function that makes a worker. Each process calls this class or function once.
    :param arguments: Arguments of ``make_worker``.
    """

    def __init__(self, n_processes: int, make_worker: Callable[..., Any], *arguments: Any) -> None:
        # Other start methods import the user's script, which then needs a guard `if __name__ == "__main__"`.
        method = "fork" if "fork" in multiprocessing.get_all_start_methods() else None
        self._n_processes = n_processes
        context = multiprocessing.get_context(method)
        self._executor = ProcessPoolExecutor(
            n_processes, context, initializer=_begin, initargs=(os.getpid(), make_worker, *arguments)
        )

    def call(self, method: str, *arrays: np.ndarray) -> Any:
        """Split the arrays, ``(N, ...)``, call a method of the workers with each part, and join the results."""
        n_parts = min(len(arrays[0]), SHARES * self._n_processes)
        parts = [np.array_split(array, n_parts) for array in arrays]
        with warnings.catch_warnings():
            # Python 3.12 warns about PyTorch's threads in a forked process, but these processes do not call PyTorch.
            warnings.filterwarnings("ignore", message=".*multi-threaded.*fork.*", category=DeprecationWarning)
            results = list(self._executor.map(_call, repeat(method), *parts))
        return np.concatenate(results) if isinstance(results[0], np.ndarray) else list(chain(*results))

    def close(self) -> None:
        """End the processes."""
        self._executor.shutdown(wait=False, cancel_futures=True)


class SharedEnv(POMDPEnv):
    """Base class of environments that can use several processes, each with its own object, such as a Bullet world."""

    shares_work = True
    n_processes: int
    _is_closed = False

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes without Bullet worlds and processes, because a copy creates its own."""
        return {name: value for name, value in self.__dict__.items() if name not in RESOURCES}

    def check_open(self) -> None:
        """Raise a ``RuntimeError`` if the environment has been closed."""
        if self._is_closed:
            raise RuntimeError("this environment has been closed: make a new one")

    def close(self) -> None:
        """Close Bullet worlds and processes; a second call does nothing."""
        self._is_closed = True
        for name in RESOURCES & set(self.__dict__):
            getattr(self, name).close()

    @abstractmethod
    def _make_world(self) -> tuple[Any, ...]:
        """Return a class that draws or simulates, and the arguments of its constructor."""

    @cached_property
    def _world(self) -> Any:
        self.check_open()
        make, *arguments = self._make_world()
        return make(*arguments)

    @cached_property
    def _pool(self) -> WorkPool:
        return WorkPool(self.n_processes, *self._make_world())

    def _shared(self, method: str, *arrays: np.ndarray, **here: Any) -> Any:
        """Call a method with arrays of N episodes: in the pool, or in this process and with the keywords ``here``."""
        self.check_open()
        if self.n_processes > 1 and len(arrays[0]) > 1:
            return self._pool.call(method, *arrays)
        return getattr(self._world, method)(*arrays, **here)


_worker: Any  # the worker of this process, if it belongs to a pool


def _begin(parent: int, make_worker: Callable[..., Any], *arguments: Any) -> None:
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # the fork has copied the parent's handler
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    _worker = make_worker(*arguments)


def _end_with(parent: int) -> None:
    """End this process once its parent is gone, because a killed parent does not shut down its pool."""
    while os.getppid() == parent:
        time.sleep(0.5)
    os._exit(1)


def _call(method: str, *arrays: np.ndarray) -> Any:
    return getattr(_worker, method)(*arrays)
