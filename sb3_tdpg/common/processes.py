"""Pools of worker processes."""

import multiprocessing as mp
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any

from sb3_tdpg.common.threads import set_threads


def usable_cores() -> int:
    """Count the processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def process_pool(
    n_processes: int, initializer: Callable[..., Any] | None = None, initargs: tuple[Any, ...] = ()
) -> Iterator[ProcessPoolExecutor]:
    """
    Open a pool of worker processes, which start tasks in the order in which they are submitted.

    Every worker computes with one thread, in a process that has computed nothing before; it calls the ``initializer``
    before its first task. Workers ignore Ctrl-C; an exception in the ``with`` block, such as ``KeyboardInterrupt``,
    stops all of them at once. They also end when this process is killed.
    """
    # All workers are forked from one process that has imported the package once and computed nothing.
    context: Any = mp.get_context("spawn")
    if "forkserver" in mp.get_all_start_methods():
        from multiprocessing import forkserver

        context = mp.get_context("forkserver")
        context.set_forkserver_preload(["sb3_tdpg.tdpg"])
        with _ignoring_ctrl_c():  # also while the server imports
            forkserver.ensure_running()
    # Only this process holds the writing end, so the workers see when it is closed, or when this process has died.
    reading, writing = context.Pipe(duplex=False)
    with ProcessPoolExecutor(n_processes, context, _start_worker, (reading, initializer, initargs)) as pool, reading:
        try:
            yield pool
        except BaseException:
            writing.close()
            raise
        pool.shutdown()
        writing.close()


@contextmanager
def _ignoring_ctrl_c() -> Iterator[None]:
    """Ignore Ctrl-C, here and for good in processes that are started meanwhile; in threads do nothing."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _start_worker(reading: Connection, initializer: Callable[..., Any] | None, initargs: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_exit_at_end_of, args=(reading,), daemon=True).start()
    set_threads(1)
    if initializer is not None:
        initializer(*initargs)


def _exit_at_end_of(pipe: Connection) -> None:
    try:
        pipe.recv()
    except EOFError:
        os._exit(1)
