"""Count the machine's cores, and limit the threads of torch and of NumPy's linear algebra."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch as th
from threadpoolctl import threadpool_limits


def usable_cores() -> int:
    """Count the processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def set_threads(n: int) -> None:
    """Limit torch and the linear algebra of NumPy and SciPy to ``n`` threads from now on."""
    th.set_num_threads(n)
    threadpool_limits(n, user_api="blas")


@contextmanager
def threads(n: int | None) -> Iterator[None]:
    """
    Limit torch and the linear algebra of NumPy and SciPy to ``n`` threads in a block or a decorated function.

    The decorator is ``@threads(n)``; ``n=None`` changes nothing. One thread is the safest choice for small arrays:
    two threads are at most about 10 % faster, if a core is free. If other programs use the cores, the two
    threads wait for each other at every step and can take a hundred times as long.
    """
    if n is None:
        yield
        return
    before = th.get_num_threads()
    with threadpool_limits(n, user_api="blas"):
        th.set_num_threads(n)
        try:
            yield
        finally:
            th.set_num_threads(before)
