"""
How much faster several workers finish a tuning study than one: real Lava trainings, and a journal file as the storage.

``python tests/benchmarks/study_workers.py`` on a machine whose cores are free. A training is counted from the moment at
which all workers have imported what they need, so that the time of a short study is not that of the imports.
"""

from __future__ import annotations

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

import optuna

from sb3_tdpg.experiments.training import make_training
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.zoo.studies import open_storage, open_study, work

GOAL = 1.8  # times as fast with two workers
N_TRIALS = 12
N_TIMESTEPS = 250_000  # 100 epochs of a training


def train(learning_rate: float, n_timesteps: int = N_TIMESTEPS) -> float:
    """Train on the lava problem and return the last epoch's cost."""
    block = {**load_hyperparams("Lava-v0-logdet"), "callback": [], "n_timesteps": n_timesteps}
    training = make_training("Lava-v0", block, learning_rate=learning_rate, seed=0, device="cpu")
    training.model.learn(training.n_timesteps)
    return float(training.model.rollout_buffer.episode_costs.mean())


def run_worker(storage: str, name: str, barrier: Any) -> None:
    """Be one worker; the clock runs between the barriers."""
    warnings.simplefilter("ignore")
    train(1e-3, 2500)  # what is imported and compiled in a first training
    sampler = optuna.samplers.TPESampler(seed=0, constant_liar=True)
    study = open_study(open_storage(storage), name, sampler=sampler, space={"learning_rate": [1e-4, 1e-2]})
    barrier.wait()

    def objective(trial: optuna.Trial) -> float:
        return train(trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True))

    work(study, objective, N_TRIALS, report=lambda _: None)
    barrier.wait()


def seconds_of(n_workers: int, storage: str) -> float:
    """Time a study."""
    context = mp.get_context("spawn")
    barrier = context.Barrier(n_workers + 1)
    arguments = (storage, f"{n_workers} workers", barrier)
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
    """Print the times; 1 if the goal is missed."""
    with tempfile.TemporaryDirectory() as folder:
        one, two = (seconds_of(n, str(Path(folder, "study.log"))) for n in (1, 2))
    print(f"{N_TRIALS} trainings of {N_TIMESTEPS} steps, load of the machine {os.getloadavg()[0]:.1f}")
    print(f"1 worker {one:.1f} s, 2 workers {two:.1f} s: {one / two:.2f} times as fast")
    print(f"goal {GOAL}: {'met' if one / two >= GOAL else 'MISSED'}")
    return int(one / two < GOAL)


if __name__ == "__main__":
    sys.exit(main())
