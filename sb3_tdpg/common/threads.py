"""How many threads a block of code computes with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th
from threadpoolctl import threadpool_limits


def set_threads(n: int) -> None:
    """Compute with this many threads from now on: those of torch, and those of NumPy's and SciPy's linear algebra."""
    th.set_num_threads(n)
    threadpool_limits(n, user_api="blas")


@contextmanager
def threads(n: int | None) -> Iterator[None]:
    """
    Run a block of code, or a function (``@threads(1)``), with this many threads; ``None``: with as many as there are.

    For arrays as small as those of policies for vectors, one is best. A second gains a tenth where a core is free for
    it; where other programs are at work, the two wait for each other at every step, and take up to a hundred times as
    long.

    :param n: threads of torch, and of NumPy's and SciPy's linear algebra
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
