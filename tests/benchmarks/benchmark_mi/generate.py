"""
Freeze samples of the tasks of ``benchmark-mi`` ("Beyond Normal") and what its own estimators make of them.

Runs in an environment of its own: the package needs an old JAX and an old NumPy. From the repository's root::

    python3.11 -m venv build/venv_bmi
    build/venv_bmi/bin/pip install benchmark-mi==0.1.3 "jax==0.4.33" "jaxlib==0.4.33" "numpy<2"
    build/venv_bmi/bin/python tests/benchmarks/benchmark_mi/generate.py

It writes ``ranks.npz`` and ``theirs.csv`` beside itself, and takes half an hour, nearly all of it for the package's
MINE and InfoNCE. Rows that ``theirs.csv`` has already are kept, so that it can be stopped and started again. Of the
samples only the ranks are kept, which are all that our estimators use: they are drawn anew each time, from the same
seeds, and must have the ranks that the file has.

Dimension key: S seeds, N samples, X and Z the components of the two variables.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

# One thread, as in compare.py. Before JAX and NumPy start theirs.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1", JAX_PLATFORMS="cpu")
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import bmi.estimators
import numpy as np
from bmi.benchmark import BENCHMARK_TASKS

HERE = Path(__file__).resolve().parent
COLUMNS = ("task", "n", "seed", "truth", "estimator", "estimate", "seconds", "cpu_seconds")
SIZES = (500, 1000)  # the smaller sample is the beginning of the larger one
SEEDS = (0, 1, 2, 3, 4)
# All tasks with at most five components on either side, but for those that differ from one of these only by a monotone
# map or by the degrees of freedom.
TASKS = (
    "1v1-normal-0.75",
    "1v1-additive-0.1",
    "1v1-additive-0.75",
    "1v1-bimodal-0.75",
    "wiggly-1v1-normal-0.75",
    "half_cube-1v1-normal-0.75",
    "student-identity-1-1-1",
    "asinh-student-identity-1-1-1",
    "swissroll_x-normal_cdf-1v1-normal-0.75",
    "multinormal-dense-2-2-0.5",
    "multinormal-dense-3-3-0.5",
    "multinormal-dense-5-5-0.5",
    "multinormal-sparse-2-2-2-2.0",
    "multinormal-sparse-3-3-2-2.0",
    "multinormal-sparse-5-5-2-2.0",
    "student-identity-2-2-1",
    "student-identity-3-3-2",
    "student-identity-5-5-2",
    "asinh-student-identity-2-2-1",
    "asinh-student-identity-3-3-2",
    "asinh-student-identity-5-5-2",
    "normal_cdf-multinormal-sparse-3-3-2-2.0",
    "normal_cdf-multinormal-sparse-5-5-2-2.0",
    "half_cube-multinormal-sparse-3-3-2-2.0",
    "half_cube-multinormal-sparse-5-5-2-2.0",
    "spiral-multinormal-sparse-3-3-2-2.0",
    "spiral-multinormal-sparse-5-5-2-2.0",
    "spiral-normal_cdf-multinormal-sparse-3-3-2-2.0",
)
# The neural estimators take seconds for each sample: one seed.
PLAN = (("cca", SEEDS), ("ksg", SEEDS), ("mine", SEEDS[:1]), ("infonce", SEEDS[:1]))


def build(estimator: str, n: int) -> Callable[[np.ndarray, np.ndarray], float]:
    """Return an estimator of the package at its defaults, but for a minibatch that fits into half of the sample."""
    # With the default of 256 its neural estimators return NaN for 500 samples: they train on half of them.
    batch_size = min(256, 2 ** int(math.log2(n // 2)))
    made = {
        "cca": lambda: bmi.estimators.CCAMutualInformationEstimator(),
        "ksg": lambda: bmi.estimators.KSGEnsembleFirstEstimator(),
        "mine": lambda: bmi.estimators.MINEEstimator(batch_size=batch_size, verbose=False),
        "infonce": lambda: bmi.estimators.InfoNCEEstimator(batch_size=batch_size, verbose=False),
    }
    return made[estimator]().estimate


def draw() -> dict[str, np.ndarray]:
    """Draw the samples of every task: ``"task/x"`` ``(S, N, X)`` and ``"task/z"`` ``(S, N, Z)``, float32."""
    samples = {}
    for task in TASKS:
        pairs = [BENCHMARK_TASKS[task].sample(max(SIZES), seed) for seed in SEEDS]
        for name, drawn in zip("xz", zip(*pairs, strict=True), strict=True):
            samples[f"{task}/{name}"] = np.stack([np.asarray(x, dtype=np.float32) for x in drawn])
    return samples


def rank(samples: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Replace every value by its rank among the N of its component, equal values alike: uint16, from 0."""

    def of_component(x: np.ndarray) -> np.ndarray:
        return np.unique(x, return_inverse=True)[1]

    return {name: np.apply_along_axis(of_component, 1, x).astype(np.uint16) for name, x in samples.items()}


def timed(estimator: str, x: np.ndarray, z: np.ndarray) -> tuple[float, float, float]:
    """Estimate, elapsed seconds and CPU seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    estimate = float(build(estimator, len(x))(x, z))
    return estimate, time.perf_counter() - wall, time.process_time() - cpu


def serve(samples: dict[str, np.ndarray]) -> None:
    """Estimate what each line of the input names, ``estimator task n seed``: for ``beside.py``."""
    for line in sys.stdin:
        estimator, task, n, seed = line.split()
        x, z = (samples[f"{task}/{variable}"][int(seed), : int(n)] for variable in "xz")
        print(*timed(estimator, x, z), flush=True)


def main() -> None:
    """Draw the samples, then run the estimators on them until done or until the time is up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("--minutes", type=float, default=math.inf, help="stop after this long; start again to go on")
    parser.add_argument("--estimators", nargs="+", default=sorted({name for name, _ in PLAN}))
    parser.add_argument("--serve", action="store_true", help="estimate what the input asks for; see beside.py")
    args = parser.parse_args()
    start = time.perf_counter()

    ranks_file, results_file = HERE / "ranks.npz", HERE / "theirs.csv"
    samples = draw()
    ranks = rank(samples)
    if not ranks_file.exists():
        np.savez_compressed(ranks_file, **ranks)
    frozen = np.load(ranks_file)
    changed = [name for name in ranks if not np.array_equal(ranks[name], frozen[name])]
    if changed and args.serve:  # only the time counts
        print(f"drawn otherwise than in {ranks_file} on this processor: {changed}", file=sys.stderr)
    elif changed:
        raise RuntimeError(f"{changed} are drawn otherwise than in {ranks_file}: use the versions named above")
    if args.serve:
        serve(samples)
        return
    done = set()
    if results_file.exists():
        with results_file.open(newline="") as file:
            done = {(row["task"], int(row["n"]), int(row["seed"]), row["estimator"]) for row in csv.DictReader(file)}

    with results_file.open("a", newline="") as file:
        writer = csv.writer(file)
        if not done:
            writer.writerow(COLUMNS)
        for estimator, seeds in PLAN:
            jobs = [(task, n, seed) for seed in seeds for n in SIZES for task in TASKS]
            for task, n, seed in jobs:
                if (task, n, seed, estimator) in done or estimator not in args.estimators:
                    continue
                if time.perf_counter() - start > 60 * args.minutes:
                    return
                x, z = samples[f"{task}/x"][seed, :n], samples[f"{task}/z"][seed, :n]
                estimate, wall, cpu = timed(estimator, x, z)
                truth = float(BENCHMARK_TASKS[task].mutual_information)
                row = (task, n, seed, f"{truth:.6f}", estimator, f"{estimate:.6f}", f"{wall:.4f}", f"{cpu:.4f}")
                writer.writerow(row)
                file.flush()


if __name__ == "__main__":
    main()
