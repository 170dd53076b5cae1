"""
How much faster several workers finish a tuning study than one: real Lava trainings, and a journal file as the storage.

``python tests/benchmarks/study_workers.py`` on a machine whose cores are free. A training is counted from the moment at
which all workers have imported what they need, so that the time of a short study is not that of the imports.
"""

from __future__ import annotations

import argparse
import multiprocessing as mp
import os
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

# Before NumPy and PyTorch start their threads.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY))

import optuna  # noqa: E402

from sb3_tdpg.experiments.studies import open_storage, open_study, work  # noqa: E402
from sb3_tdpg.experiments.training import make_training  # noqa: E402
from sb3_tdpg.hyperparams import load_hyperparams  # noqa: E402

GOAL = 1.8  # times as fast with two workers


def train(learning_rate: float, n_timesteps: int) -> float:
    """Train on the lava problem and return the last epoch's cost."""
    block = {**load_hyperparams("Lava-v0-logdet"), "callback": [], "n_timesteps": n_timesteps}
    training = make_training("Lava-v0", block, learning_rate=learning_rate, seed=0, device="cpu")
    training.model.learn(training.n_timesteps)
    return float(training.model.rollout_buffer.episode_costs.mean())


def run_worker(storage: str, name: str, n_trials: int, n_timesteps: int, barrier: Any) -> None:
    """Be one worker; the clock runs between the barriers."""
    warnings.simplefilter("ignore")
    train(1e-3, 2500)  # what is imported and compiled in a first training
    sampler = optuna.samplers.TPESampler(seed=0, constant_liar=True)
    study = open_study(open_storage(storage), name, sampler=sampler, space={"learning_rate": [1e-4, 1e-2]})
    barrier.wait()

    def objective(trial: optuna.Trial) -> float:
        return train(trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True), n_timesteps)

    work(study, objective, n_trials, report=lambda _: None)
    barrier.wait()


def seconds_of(n_workers: int, storage: str, n_trials: int, n_timesteps: int) -> float:
    """Time a study."""
    context = mp.get_context("spawn")
    barrier = context.Barrier(n_workers + 1)
    arguments = (storage, f"{n_workers} workers {time.time()}", n_trials, n_timesteps, barrier)
    workers = [context.Process(target=run_worker, args=arguments) for _ in range(n_workers)]
    for worker in workers:
        worker.start()
    barrier.wait(600)
    begin = time.perf_counter()
    barrier.wait(3600)
    seconds = time.perf_counter() - begin
    for worker in workers:
        worker.join()
    return seconds


def main() -> int:
    """Print the times; 1 if the goal of two workers is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--trials", type=int, default=12)
    parser.add_argument("--n-timesteps", type=int, default=250_000, help="100 epochs of a training")
    parser.add_argument("--storage", default=None, help="default: a journal file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        storage = options.storage or str(Path(folder, "study.log"))
        one, several = (seconds_of(n, storage, options.trials, options.n_timesteps) for n in (1, options.workers))
    ratio = one / several
    print(f"{options.trials} trainings of {options.n_timesteps} steps, load of the machine {os.getloadavg()[0]:.1f}")
    print(f"1 worker {one:.1f} s, {options.workers} workers {several:.1f} s: {ratio:.2f} times as fast")
    if options.workers == 2:
        print(f"goal {GOAL}: {'met' if ratio >= GOAL else 'MISSED'}")
        return int(ratio < GOAL)
    return 0


if __name__ == "__main__":
    sys.exit(main())
