"""
Our estimators on the frozen samples of ``benchmark-mi``, beside the package's own: ``ours.csv`` and a table.

From the repository's root, in the project's environment (``generate.py`` tells how the samples were made)::

    python tests/benchmarks/benchmark_mi/compare.py
    python tests/benchmarks/benchmark_mi/compare.py --table-only

It takes two minutes of one core, and prints the tables of docs/results/benchmark_mi.md.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from pathlib import Path

# One thread, as in generate.py. Before NumPy and PyTorch start theirs.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[2]))

import numpy as np  # noqa: E402
import pandas as pd  # noqa: E402
import torch as th  # noqa: E402
from pairs import estimate_information  # noqa: E402

# Name in the table, arguments of estimate_information, seeds of the benchmark.
PLAN = (
    ("our mine", dict(estimator="mine"), range(5)),
    ("our mine, 100 steps", dict(estimator="mine", max_gradient_steps=100), range(5)),
    ("our nwj, 100 steps", dict(estimator="nwj", max_gradient_steps=100), range(1)),
    ("our smile, 100 steps", dict(estimator="smile", max_gradient_steps=100), range(1)),
    ("our infonce, 100 steps", dict(estimator="infonce", max_gradient_steps=100), range(1)),
)
KEYS = ["task", "n"]
TOLERANCE = 0.1  # of the truth


def run(theirs: pd.DataFrame) -> pd.DataFrame:
    """Estimate every sample, one at a time, with the time each takes."""
    problems = theirs[[*KEYS, "truth"]].drop_duplicates()
    samples = np.load(HERE / "ranks.npz")  # all that our estimators use of them
    rows = []
    for name, kwargs, seeds in PLAN:
        for task, n, truth in problems.itertuples(index=False):
            for seed in seeds:
                x, z = (samples[f"{task}/{variable}"][seed, :n] for variable in "xz")
                wall, cpu = time.perf_counter(), time.process_time()
                result = estimate_information(x, z, **kwargs)
                wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
                rows.append((task, n, seed, truth, name, result.estimate, result.held_out, wall, cpu))
    columns = [*KEYS, "seed", "truth", "estimator", "estimate", "held_out", "seconds", "cpu_seconds"]
    return pd.DataFrame(rows, columns=columns).round(6)


def amortised(n_problems: int = 25, n: int = 500) -> float:
    """CPU seconds for each problem where 25 are estimated at once, as a policy's time steps are."""
    pair = th.randn(2, n_problems, n, 2, generator=th.Generator().manual_seed(0))
    start = time.process_time()
    estimate_information(pair[0], pair[0] + pair[1], max_gradient_steps=100)
    return (time.process_time() - start) / n_problems


def table(both: pd.DataFrame) -> str:
    """For every task and size the truth, and the mean of each estimator over its seeds, as Markdown."""
    means = both.pivot_table(index=KEYS, columns="estimator", values="estimate", sort=False, dropna=False)
    truth = both.groupby(KEYS, sort=False)["truth"].first()
    held_out = both[both["estimator"] == "our mine"].groupby(KEYS, sort=False)["held_out"].mean()
    columns = {"cca": "CCA", "ksg": "KSG", "mine": "MINE", "infonce": "InfoNCE"}
    ours = {"our mine": "our MINE", "our mine, 100 steps": "100 steps"}
    lines = [f"| task | n | truth | {' | '.join([*columns.values(), *ours.values()])} | held out | goal |"]
    lines.append("|" + "---|" * (len(columns) + len(ours) + 5))
    errors = means.div(truth, axis=0).sub(1).abs()
    for key in truth.index:
        row, error = means.loc[key], errors.loc[key]
        cells = [
            "-" if pd.isna(row[name]) else f"**{row[name]:.2f}**" if error[name] <= TOLERANCE else f"{row[name]:.2f}"
            for name in [*columns, *ours]
        ]
        goal = ""
        if error[["cca", "ksg"]].min() <= TOLERANCE:
            goal = "met" if error["our mine"] <= TOLERANCE else f"missed, {row['our mine'] / truth[key] - 1:+.0%}"
        lines.append(
            f"| `{key[0]}` | {key[1]} | {truth[key]:.2f} | {' | '.join(cells)} | {held_out[key]:.2f} | {goal} |"
        )
    return "\n".join(lines)


def summary(both: pd.DataFrame) -> str:
    """Errors and times of every estimator on the samples of seed 0, which all have estimated, as Markdown."""
    first = both[both["seed"] == 0].copy()
    first["error"] = (first["estimate"] / first["truth"] - 1).abs()
    lines = [
        "| estimator | n | tasks | median error | within 10 % | NaN | median CPU s | median elapsed s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for (name, n), group in first.groupby(["estimator", "n"], sort=False):
        seconds = " | ".join(f"{group[column].median():.3g}" for column in ("cpu_seconds", "seconds"))
        error = group["error"].fillna(np.inf)
        lines.append(
            f"| {name} | {n} | {len(group)} | {error.median():.0%} | {(error <= TOLERANCE).sum()} | "
            f"{group['estimate'].isna().sum()} | {seconds} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Estimate, write ``ours.csv``, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--table-only", action="store_true", help="print the tables of the ours.csv that is there")
    args = parser.parse_args()
    th.set_num_threads(1)
    theirs = pd.read_csv(HERE / "theirs.csv")
    if not args.table_only:
        run(theirs).to_csv(HERE / "ours.csv", index=False)
        print(f"25 problems at once, 100 steps, n=500: {amortised():.3f} CPU s each\n")
    both = pd.concat([theirs, pd.read_csv(HERE / "ours.csv")])
    print(summary(both), table(both), sep="\n\n")


if __name__ == "__main__":
    main()
