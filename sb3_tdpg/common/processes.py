"""Open pools of worker processes that stop on Ctrl-C or when their parent is killed."""

import multiprocessing as mp
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

from tqdm import tqdm

from sb3_tdpg.common.threads import set_threads


@contextmanager
def process_pool(
    n_processes: int, initializer: Callable[..., Any] | None = None, initargs: tuple[Any, ...] = ()
) -> Iterator[ProcessPoolExecutor]:
    """
    Open a pool of worker processes, which start tasks in the order in which they are submitted.

    Every worker computes with one thread, in a process that has computed nothing before. It calls the ``initializer``
    before its first task. Workers themselves ignore Ctrl-C. An exception in the ``with`` block, such as the
    ``KeyboardInterrupt`` of Ctrl-C, stops all workers at once. Workers also end when this process is killed.
    """
    # A fork server forks all workers from one process that has imported the package once and computed nothing.
    context: Any = mp.get_context("spawn")
    if "forkserver" in mp.get_all_start_methods():
        from multiprocessing import forkserver, resource_tracker

        context = mp.get_context("forkserver")
        context.set_forkserver_preload(["sb3_tdpg.tdpg", "sb3_tdpg.common.unblock"])
        resource_tracker.ensure_running()  # comes first, because it unblocks Ctrl-C
        with _postponing_ctrl_c(), _blocking_ctrl_c():  # the server must not get Ctrl-C while it imports
            forkserver.ensure_running()
    # Only this process holds the writing end of the pipe, so the workers notice when it is closed or this process has
    # died.
    reading, writing = context.Pipe(duplex=False)
    with _Pool(n_processes, context, _start_worker, (reading, initializer, initargs)) as pool, reading:
        try:
            yield pool
        except BaseException as e:
            writing.close()
            if isinstance(e, BrokenProcessPool):
                advice = "the same command goes on; with fewer --jobs it needs less memory"
                raise OSError(f"a worker process was killed, perhaps because memory was short: {advice}") from e
            raise
        pool.shutdown()
        writing.close()


class _Pool(ProcessPoolExecutor):
    """A pool that postpones Ctrl-C while a worker starts, so that no worker is left running without its queues."""

    def submit(self, *args: Any, **kwargs: Any) -> Future[Any]:
        with _postponing_ctrl_c():
            return super().submit(*args, **kwargs)


@contextmanager
def _postponing_ctrl_c() -> Iterator[None]:
    """Postpone Ctrl-C to the end of the block; do nothing outside the main thread."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pressed: list[int] = []
    handler = signal.signal(signal.SIGINT, lambda number, frame: pressed.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if pressed:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def _blocking_ctrl_c() -> Iterator[None]:
    """Block Ctrl-C for processes that are started in the block."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _start_worker(reading: Connection, initializer: Callable[..., Any] | None, initargs: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_at_end_of, args=(reading,), daemon=True).start()
    # The default lock of tqdm is a semaphore between processes, which a stopped worker would leave behind.
    tqdm.set_lock(threading.RLock())
    set_threads(1)
    if initializer is not None:
        initializer(*initargs)


def _exit_at_end_of(pipe: Connection) -> None:
    try:
        pipe.recv()
    except EOFError:
        os._exit(1)
