"""
Our MINE and that of ``benchmark-mi`` on the same samples, one right after the other on the same machine: times.

The machine may be slower at one time than at another, so that a ratio of times that were taken hours apart says little.
From the repository's root, in the project's environment, with the package's own as in ``generate.py``::

    python tests/benchmarks/benchmark_mi/beside.py build/venv_bmi/bin/python
    python tests/benchmarks/benchmark_mi/beside.py --table-only

It takes ten minutes of one core, and adds a row to ``beside.csv`` for each sample: those that have the fewest rows
come first, and of these the ones at which ours takes the longest. So it can be stopped and started again. Rows of an
older version of ours are to be removed by hand. On another processor, the package's estimates differ from those of
``theirs.csv``.
"""

from __future__ import annotations

import argparse
import math
import subprocess
import sys
import time
from pathlib import Path
from typing import IO, cast

import numpy as np
import pandas as pd
import torch as th
from compare import HERE, KEYS  # before all else it sees to it that there is one thread
from pairs import estimate_information

RESULTS = HERE / "beside.csv"
COLUMNS = [*KEYS, "truth", "theirs", "ours", "cpu_seconds_theirs", "cpu_seconds_ours"]
N_OURS = 3  # estimates for each of theirs, which takes ten times as long
AIM = 10  # times faster


def jobs(minimum: int) -> pd.DataFrame:
    """Samples of seed 0 with fewer than ``minimum`` rows, in the order in which they are to be estimated."""
    first = [pd.read_csv(HERE / name).query("seed == 0").set_index(KEYS) for name in ("theirs.csv", "ours.csv")]
    theirs, ours = (found[found["estimator"] == name] for found, name in zip(first, ("mine", "our mine"), strict=True))
    n_rows = pd.read_csv(RESULTS).groupby(KEYS).size() if RESULTS.exists() else pd.Series(dtype=int)
    theirs = theirs.assign(n_rows=n_rows.reindex(theirs.index, fill_value=0), ours=ours["cpu_seconds"])
    theirs = theirs.sort_values(["n_rows", "ours"], ascending=[True, False])
    return theirs[theirs["n_rows"] < minimum].reset_index()


def measure(python: Path, todo: pd.DataFrame, minutes: float) -> None:
    """Estimate every sample with both, in turn."""
    samples = np.load(HERE / "ranks.npz")  # all that our estimators use of them
    begin = time.perf_counter()
    command = [python, HERE / "generate.py", "--serve"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as worker:
        requests, answers = cast("IO[str]", worker.stdin), cast("IO[str]", worker.stdout)

        def ask(task: str, n: int) -> tuple[float, ...]:
            print("mine", task, n, 0, file=requests, flush=True)
            return tuple(map(float, answers.readline().split()))

        for i, (task, n, truth, frozen) in enumerate(todo[[*KEYS, "truth", "estimate"]].itertuples(index=False)):
            if time.perf_counter() - begin > 60 * minutes:
                break
            x, z = (samples[f"{task}/{variable}"][0, :n] for variable in "xz")
            if i == 0:  # the first estimate of either also loads what it needs
                ask(task, n)
                estimate_information(x, z)
            estimate, _, cpu = ask(task, n)
            if not np.isclose(estimate, frozen, atol=1e-4):
                print(f"{task}, n={n}: {estimate:.4f} on this processor, {frozen:.4f} in theirs.csv", file=sys.stderr)
            start = time.process_time()
            for _ in range(N_OURS):
                ours = estimate_information(x, z).estimate
            our_cpu = (time.process_time() - start) / N_OURS
            row = pd.DataFrame([(task, n, truth, estimate, ours, cpu, our_cpu)], columns=COLUMNS)
            row.round(6).to_csv(RESULTS, mode="a", header=not RESULTS.exists(), index=False)
            print(f"{task}, n={n}: {cpu:.2f} s, ours {our_cpu:.3f} s, {cpu / our_cpu:.1f} times", flush=True)
        requests.close()


def table(passes: pd.DataFrame) -> str:
    """For every task and size the ratio of times, the median where there are several rows, as Markdown."""
    ratio = passes["cpu_seconds_theirs"] / passes["cpu_seconds_ours"]
    groups = passes.assign(ratio=ratio).groupby(KEYS)
    both = groups.median(numeric_only=True)
    error = both[["theirs", "ours"]].sub(both["truth"], axis=0).abs()
    both["equal"] = error["ours"] <= error["theirs"]
    lines = [
        "| task | n | ours at least as accurate | package's CPU s | our CPU s | speed-up |",
        "|" + "---|" * 6,
    ]
    for (task, n), row in both.iterrows():
        ratios = groups.get_group((task, n))["ratio"]
        scatter = f" ({ratios.min():.1f} to {ratios.max():.1f})" if len(ratios) > 1 else ""
        lines.append(
            f"| `{task}` | {n} | {'yes' if row['equal'] else 'no'} | {row['cpu_seconds_theirs']:.2f} | "
            f"{row['cpu_seconds_ours']:.3f} | {row['ratio']:.1f}{scatter} |"
        )
    equal = both[both["equal"]]["ratio"]
    medians = equal.groupby("n").median()
    by_size = ", ".join(f"{value:.1f} at n = {n}" for n, value in medians.items())
    lines += [
        "",
        f"At least as accurate: {len(equal)} of {len(both)}; of these at least {AIM} times as fast: "
        f"{(equal >= AIM).sum()}. Least {equal.min():.1f}; median {by_size}",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure, print the table of all rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("python", type=Path, nargs="?", help="the interpreter of the package's environment")
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after this long; start again to go on")
    parser.add_argument("--rows", type=int, default=1, help="rows that each sample is to have")
    parser.add_argument("--table-only", action="store_true", help="print the table of the beside.csv that is there")
    args = parser.parse_args()
    th.set_num_threads(1)
    if not args.table_only:
        if args.python is None:
            parser.error("which Python has benchmark-mi? See generate.py")
        measure(args.python, jobs(args.rows), args.minutes)
    print(table(pd.read_csv(RESULTS)))


if __name__ == "__main__":
    main()
