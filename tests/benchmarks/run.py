"""
``make bench``: what batching is worth, as ratios measured in this run on one thread.

Every ratio compares two ways to do the same thing, run in turn (A B B A ...), by their CPU times; where several
processes work, by their elapsed times. It is the median of the ratios of neighbours: what slows down both for a while
drops out.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from pathlib import Path

# Before NumPy and PyTorch start their threads.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY))

import torch as th  # noqa: E402

from sb3_tdpg.common.provenance import how_made, provenance  # noqa: E402
from tests.benchmarks.speed.critics import bench_critics  # noqa: E402
from tests.benchmarks.speed.environments import bench_camera, bench_environment  # noqa: E402
from tests.benchmarks.speed.grasping import GraspTrials, bench_grasp, bench_processes  # noqa: E402
from tests.benchmarks.speed.inference import bench_inference  # noqa: E402
from tests.benchmarks.speed.long_horizons import bench_long_horizons  # noqa: E402
from tests.benchmarks.speed.measure import FULL, QUICK, format_table  # noqa: E402
from tests.benchmarks.speed.training import bench_epoch, bench_training  # noqa: E402

BENCHES = (
    bench_epoch,
    bench_critics,
    bench_training,
    bench_long_horizons,
    bench_environment,
    bench_camera,
    bench_grasp,
    bench_processes,
    bench_inference,
)


def describe_machine() -> str:
    """Name the processor, the versions and the commit."""
    cpu_info = Path("/proc/cpuinfo")
    lines = cpu_info.read_text().splitlines() if cpu_info.exists() else []
    processor = next((line.split(": ")[1] for line in lines if line.startswith("model name")), platform.processor())
    return f"{processor}, {os.cpu_count()} cores. {how_made('make bench', provenance())}"


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that everything runs (seconds)")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "results" / "bench.md", help="Markdown file to write")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    sizes = QUICK if arguments.quick else FULL

    start = time.perf_counter()
    rows = [row for bench in BENCHES for row in bench(sizes)]
    split = GraspTrials(max(10, sizes.n_episodes // 5)).split(sizes.loop_repetitions)
    elapsed = time.perf_counter() - start
    title = "# Speed" + (" (--quick: not the paper's sizes)" if arguments.quick else "")
    notes = (
        "CPU time of one thread (elapsed time where the row says so), medians over repetitions in which both sides "
        "take turns; the ratio is the median of the ratios of neighbours, and its interval holds the true median with "
        "a confidence of at least 95 % (75 % with 3 repetitions, which have the lowest and the highest instead). The "
        "first policy epoch, with the critics' warm-up, is not counted. "
        f"{sizes.repetitions} repetitions ({sizes.loop_repetitions} of the loop over samples and of the paper's grasp, "
        f"{sizes.process_repetitions} of several processes), {elapsed:.0f} s in all."
    )
    report = "\n\n".join([title, describe_machine(), format_table(rows), split, notes]) + "\n"
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(report, encoding="utf-8")
    print(f"\n{report}\nwritten to {arguments.out}")


if __name__ == "__main__":
    main()
