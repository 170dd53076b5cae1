"""
How often the information interval holds the truth, and how wide it is, on Gaussian channels of known information.

``python tests/benchmarks/interval_coverage.py`` prints the table of docs/guide/information.md.
"""

from __future__ import annotations

import argparse
import os
import sys
from itertools import product
from pathlib import Path

# Before NumPy and PyTorch start their threads.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
REPOSITORY = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "tests")]

import numpy as np  # noqa: E402
from information_problems import gaussian_channels  # noqa: E402

from sb3_tdpg.evaluation import information_interval  # noqa: E402

N_DRAWS = 200  # independent samples in each row
COLUMNS = ("N", "d", "truth", "held", "lower above", "upper below", "mean lower", "mean upper", "mean width",
           "95 % of widths below", "widest")  # fmt: skip


def measure(nats: float, dim: int, n_episodes: int, seed: int) -> tuple[str, ...]:
    """Return a row of the table."""
    rng = np.random.default_rng((seed, round(1000 * nats), dim, n_episodes))
    interval = information_interval(gaussian_channels(nats, dim, n_episodes, N_DRAWS, rng), seed=seed)
    above, below, width = interval.lower > nats, interval.upper < nats, interval.upper - interval.lower
    counts = (f"{1 - (above | below).mean():.1%}".replace("%", " %"), str(above.sum()), str(below.sum()))
    means = (interval.lower.mean(), interval.upper.mean(), width.mean(), np.quantile(width, 0.95))
    return (str(n_episodes), str(dim), f"{nats:g}", *counts, *(f"{x:.2f}" for x in means), f"{width.max():.3f}")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    seed = parser.parse_args().seed
    print("|", " | ".join(COLUMNS), "|")
    print("|---" * len(COLUMNS) + "|")
    for n_episodes, dim, nats in product((200, 500), (2, 8, 16), (0.1, 0.5, 1, 2, 2.9, 5, 8)):
        print("|", " | ".join(measure(nats, dim, n_episodes, seed)), "|", flush=True)


if __name__ == "__main__":
    main()
