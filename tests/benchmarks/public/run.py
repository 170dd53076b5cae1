"""
``make reproduce-public``: our one preset, tuned blocks and a cost limit beside PPO and RecurrentPPO on public tasks.

Finished trainings are kept: the same call continues an interrupted one.
"""

from __future__ import annotations

import argparse
import os
import sys
from concurrent.futures import as_completed
from pathlib import Path

# Before NumPy and PyTorch start their threads.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from tqdm import tqdm

from sb3_tdpg.common.processes import process_pool, usable_cores
from tests.benchmarks.public.tasks import TASKS
from tests.benchmarks.public.trainings import Training, complete_training

SEEDS = range(200, 205)


def main() -> None:
    """Train all methods with all seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="parallel trainings")
    parser.add_argument("--out", type=Path, default=Path("results/public_tasks"))
    options = parser.parse_args()
    trainings = [
        Training(task, task.rival, seed)
        for hidden in (False, True)
        for seed in SEEDS
        for task in TASKS
        if task.hidden == hidden
    ]
    with tqdm(total=len(trainings), unit="training") as progress, process_pool(options.jobs) as pool:
        for done in as_completed([pool.submit(complete_training, each, options.out) for each in trainings]):
            done.result()
            progress.update()


if __name__ == "__main__":
    main()
