"""
``make reproduce-public``: our one preset, tuned blocks and a cost limit beside PPO and RecurrentPPO on public tasks.

Finished trainings are kept: the same call continues an interrupted one.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from concurrent.futures import as_completed
from pathlib import Path

# Before NumPy and PyTorch start their threads.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
sys.path.insert(0, str(Path(__file__).resolve().parents[3]))

from tqdm import tqdm

from sb3_tdpg.common.processes import process_pool, usable_cores
from sb3_tdpg.hyperparams import load_hyperparams
from tests.benchmarks.public.page import Records, published_labels
from tests.benchmarks.public.tasks import TASKS
from tests.benchmarks.public.trainings import PRESET, TUNED, Training, complete_training, with_limit

SEEDS = range(200, 205)  # those below 200 were used for tuning
PUBLISHED = Path("docs", "results", "public_tasks")


def make_trainings(seeds: Sequence[int]) -> list[Training]:
    """List all trainings, seed by seed, so that an interrupted call has the same seeds of all methods."""
    trainings = []
    for seed in seeds:
        for task in TASKS:
            trainings.append(Training(task, PRESET, seed, {}))
            if task.tuned is not None:
                block = load_hyperparams(task.tuned)
                trainings.append(Training(task, TUNED, seed, {**block, "n_timesteps": task.n_timesteps}))
            trainings.append(Training(task, task.rival, seed))
    return trainings


def complete(training: Training, root: Path) -> list[Training]:
    """Complete a training, and after that of the preset the one with a limit; return what is finished."""
    complete_training(training, root)
    if training.method != PRESET:
        return [training]
    limited = with_limit(training, root)
    complete_training(limited, root)
    return [training, limited]


def main() -> None:
    """Train what is missing, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=usable_cores(), help="parallel trainings")
    parser.add_argument("--out", type=Path, default=Path("results/public_tasks"), help="folder of the trainings")
    parser.add_argument("--publish", type=Path, default=PUBLISHED, help="folder of the records and the tables")
    parser.add_argument(
        "--published-methods", nargs="+", default=[], help="take the published records of these, where there are any"
    )
    options = parser.parse_args()
    published = published_labels(options.publish, options.published_methods)
    trainings = [each for each in make_trainings(SEEDS) if each.label not in published]
    with tqdm(total=len(trainings), unit="training") as progress, process_pool(options.jobs) as pool:
        tasks = [pool.submit(complete, each, options.out) for each in trainings]
        for task in as_completed(tasks):
            progress.set_postfix_str(task.result()[0].folder_name)
            progress.update()
    records = Records([done for task in tasks for done in task.result()], options.out)
    records.add_published(options.publish, published)
    records.write(options.publish, "make reproduce-public")
    print(f"records and tables: {options.publish}")


if __name__ == "__main__":
    main()
