"""How two ways to do the same thing are measured against each other, and how a row of the table is printed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import quantile_test

from sb3_tdpg.common.markdown import markdown_table

SEED = 0


class Sizes(NamedTuple):
    """How much is measured."""

    n_episodes: int
    repetitions: int
    loop_repetitions: int  # of the per-sample loop, which takes many seconds
    process_repetitions: int  # of several processes: what else runs on the machine disturbs elapsed times
    epochs: int  # policy epochs in one measurement of a batched algorithm


FULL = Sizes(n_episodes=500, repetitions=7, loop_repetitions=3, process_repetitions=150, epochs=10)
QUICK = Sizes(n_episodes=100, repetitions=3, loop_repetitions=1, process_repetitions=10, epochs=3)


class Row(NamedTuple):
    """One line of the table; times are medians in seconds."""

    what: str
    ours: float
    reference: float
    ratio: float  # how many times faster ours is
    lowest: float  # of the interval of the ratio
    highest: float
    goal: float | None


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """
    Return two of the values that have the true median between them with a confidence of at least 95 %.

    It assumes no distribution (inverts a sign test), but independent values. There is no such pair of fewer than 6:
    then the lowest and the highest are returned; of n values they hold it with ``1 - 2**(1 - n)``.
    """
    low, high = quantile_test(values, p=0.5).confidence_interval(confidence_level=0.95)
    return (low, high) if np.isfinite([low, high]).all() else (min(values), max(values))


def compare(
    what: str,
    ours: Callable[[], float],
    reference: Callable[[], float],
    repetitions: int,
    goal: float | None = None,
) -> Row:
    """
    Measure two functions in turn, each as often the first of a pair, after one call of each that does not count.

    :param ours: returns its cost in seconds for each unit of work
    :param reference: likewise
    """
    ours()
    reference()
    our_times, reference_times = [], []
    for i in range(repetitions):
        for function, times in ((ours, our_times), (reference, reference_times))[:: 1 if i % 2 == 0 else -1]:
            times.append(function())
    ratios = [theirs / mine for mine, theirs in zip(our_times, reference_times, strict=True)]
    medians = map(statistics.median, (our_times, reference_times, ratios))
    row = Row(what, *medians, *median_interval(ratios), goal)
    print(f"{row.what}: {format_interval(row)}", flush=True)
    return row


def seconds(function: Callable[[], object], units: int = 1) -> float:
    """CPU time of a call for each of the units of work that it does: not disturbed by other processes."""
    start = time.process_time()
    function()
    return (time.process_time() - start) / units


def format_time(value: float) -> str:
    """Print seconds with a fitting unit and three digits."""
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if value >= scale:
            return f"{value / scale:.3g} {unit}"
    return f"{value / 1e-9:.3g} ns"


def format_ratio(value: float) -> str:
    """Print a ratio, and one of about 1 with one digit more."""
    return f"{value:.2f}" if value < 2 else f"{value:.1f}"


def format_interval(row: Row) -> str:
    """Print the ratio of a row, and its interval."""
    return f"{format_ratio(row.ratio)}x ({format_ratio(row.lowest)}-{format_ratio(row.highest)})"


def format_table(rows: Iterable[Row]) -> str:
    """Lay out the rows as a Markdown table."""
    lines = []
    for row in rows:
        met = ["-", "-"] if row.goal is None else [f"{row.goal:g}x", "yes" if row.ratio >= row.goal else "no"]
        lines.append([row.what, format_time(row.ours), format_time(row.reference), format_interval(row), *met])
    return markdown_table(lines, ["what", "ours", "reference", "ratio (interval)", "goal", "met"])
