"""Training runs, from settings to per-episode records in folders that can be resumed; one at a time or many."""

from __future__ import annotations

import hashlib
import json
import multiprocessing as mp
import shutil
import signal
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, make_output_format
from tqdm import tqdm

from sb3_tdpg.callbacks import TrainingCheckpointCallback
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import evaluate_scenarios, write_frame_atomically, write_run_config
from sb3_tdpg.evaluation.provenance import jsonable
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.training import make_training
from sb3_tdpg.vec_env import usable_cores

# A checkpoint resets the environments, so that how often it is made belongs to the run.
MAX_CHECKPOINT_EPOCHS = 50
# Attempts must not share their seeds with other runs.
SEEDS_BETWEEN_ATTEMPTS = 1000


@dataclass(frozen=True)
class Run:
    """
    One method with one seed.

    :param method: The label in tables ("PG", "TDPG").
    :param env_id: The training environment.
    :param block: Block of ``hyperparams/tdpg.yml``.
    :param seed: Training seed.
    :param overrides: Settings that replace those of the block.
    :param max_attempts: Trainings from scratch, each with a seed of its own, until one meets the limits of the block's
        selection. The paper likewise chooses its policy from several trainings.
    :param start: Folder of a finished run whose policy the training starts from. The environment's random numbers begin
        anew: with the same seed, the training meets the initial states of that run's first epochs again.
    """

    method: str
    env_id: str
    block: str
    seed: int
    overrides: Mapping[str, Any] = field(default_factory=dict)
    max_attempts: int = 1
    start: Path | None = None

    @property
    def settings(self) -> dict[str, Any]:
        """The block with the overrides."""
        return {**load_hyperparams(self.block), **self.overrides}

    @property
    def folder_name(self) -> str:
        """A name that tells the method and the seed."""
        label = "".join(c if c.isalnum() else "-" for c in self.method.lower())
        return f"{'-'.join(filter(None, label.split('-')))}-seed{self.seed}"

    @property
    def config(self) -> dict[str, Any]:
        """What makes this run."""
        return dict(
            method=self.method,
            env_id=self.env_id,
            block=self.block,
            seed=self.seed,
            max_attempts=self.max_attempts,
            start=None if self.start is None else self.start.name,
            start_policy=None if self.start is None else _digest(self.start / "model.zip"),
            settings=self.settings,
        )

    def train(self, attempt: int, folder: Path, progress_bar: bool) -> tuple[BaseAlgorithm, bool]:
        """
        Train once, or go on where an earlier call was interrupted.

        :param attempt: Which of the trainings this is.
        :param folder: What it leaves behind: ``model.zip``, ``selected.json`` and the log.
        :param progress_bar: Show a progress bar.
        :return: the policy, and whether any epoch met the limits (otherwise it is the last epoch's)
        """
        return _train(self, attempt, folder, progress_bar)


def complete_run(
    run: Run,
    folder: Path,
    scenarios: Sequence[Scenario],
    *,
    n_eval_episodes: int = 1000,
    progress_bar: bool = False,
) -> Path:
    """
    Train and evaluate, or go on where an earlier call was interrupted, or do nothing if it was finished.

    ``folder`` then holds ``model.zip`` (the selected policy), ``selected.json`` (its epoch, cost and information;
    missing if no epoch met the limits), ``progress_<timestep>.csv`` (the training log), ``config.json`` (settings,
    seeds, versions, commit) and,
    written last, ``episodes.csv`` (a row for each evaluation episode). Attempts in vain stay as ``attempt<i>/``.

    :param run: What to train.
    :param folder: Where to.
    :param scenarios: What to evaluate; the environment keywords of the run apply beneath those of a scenario.
    :param n_eval_episodes: Episodes of each scenario.
    :param progress_bar: Show progress bars.
    :return: ``folder``
    :raises ValueError: if the folder holds a run with other settings, or there is no policy to start from; nothing is
        touched.
    """
    rows = [dict(name=row.name, env_id=row.env_id, env_kwargs=dict(row.env_kwargs)) for row in scenarios]
    if run.start is not None and not (run.start / "model.zip").exists():
        raise ValueError(f"{run.folder_name} starts from the policy in {run.start}, and there is none: train it first")
    config = {**run.config, "n_eval_episodes": n_eval_episodes, "scenarios": rows}
    _check_same_run(folder / "config.json", config)
    if (folder / "episodes.csv").exists():
        return folder
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "config.json").exists():
        write_run_config(folder / "config.json", config)

    for attempt in range(run.max_attempts):
        attempt_folder = folder / f"attempt{attempt}"
        model, selected = run.train(attempt, attempt_folder, progress_bar)
        if selected:
            break
    records = evaluate_scenarios(
        {run.method: model},
        scenarios,
        n_eval_episodes,
        env_kwargs=run.settings.get("env_kwargs"),
        labels=dict(train_seed=run.seed, attempts=attempt + 1, selected=selected),
        progress_bar=progress_bar,
    )
    shutil.copytree(attempt_folder, folder, dirs_exist_ok=True)
    write_frame_atomically(records, folder / "episodes.csv")
    shutil.rmtree(attempt_folder)
    return folder


def _digest(path: Path) -> str:
    """A name for the content of a file, if there is one."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12] if path.exists() else "not trained yet"


def _check_same_run(path: Path, config: Mapping[str, Any]) -> None:
    if not path.exists():
        return
    found = json.loads(path.read_text())
    found.pop("provenance")
    wanted = jsonable(config)
    changed = sorted(key for key in found if found[key] != wanted.get(key))
    if changed:
        raise ValueError(
            f"{path.parent} holds a run with another {', '.join(changed)}: choose another folder or remove it"
        )


def _train(run: Run, attempt: int, folder: Path, progress_bar: bool) -> tuple[TDPG, bool]:
    """
    Return the policy of one attempt, and whether any epoch met the limits (otherwise it is the last epoch's).

    ``folder`` keeps what a later call goes on from, and in the end ``model.zip``, ``selected.json`` and the log.
    """
    selected_path, checkpoint, result = (folder / name for name in ("selected.zip", "checkpoint.zip", "model.zip"))
    if result.exists():
        return TDPG.load(result, device="cpu"), selected_path.with_suffix(".json").exists()
    training = make_training(run.env_id, run.settings, seed=run.seed + SEEDS_BETWEEN_ATTEMPTS * attempt, device="cpu")
    n_timesteps, model = training.n_timesteps, training.model
    epochs = n_timesteps // (model.n_episodes * model.horizon)
    checkpoint_epochs = max(1, min(MAX_CHECKPOINT_EPOCHS, epochs // 4))
    if checkpoint.exists():
        model = TDPG.load(checkpoint, env=model.env, device="cpu")
        n_timesteps = model.remaining_timesteps
    elif run.start is not None:
        # Not the whole model: the optimiser's memory belongs to another objective.
        start = TDPG.load(run.start / "model.zip", device="cpu")
        model.policy.load_state_dict(start.policy.state_dict())
    log = make_output_format("csv", str(folder), log_suffix=f"_{model.num_timesteps:08d}")
    model.set_logger(Logger(str(folder), [log]))
    callbacks = [*training.callbacks, TrainingCheckpointCallback(checkpoint, checkpoint_epochs)]
    selection = training.selection
    if selection is not None:
        selection.save_path = selected_path
    model.learn(n_timesteps, callbacks, reset_num_timesteps=not checkpoint.exists(), progress_bar=progress_bar)
    model.logger.close()
    selected = selection is not None and selection.best is not None
    if selection is not None and selected:
        selection.restore(model)
    model.save(result)
    checkpoint.unlink(missing_ok=True)
    selected_path.unlink(missing_ok=True)
    return model, selected


def read_progress(folder: Path) -> pd.DataFrame:
    """Return the training log of a run, also of one that was resumed, one row for each epoch."""
    frames = [pd.read_csv(path) for path in sorted(folder.glob("progress_*.csv"))]
    log = pd.concat([frame for frame in frames if len(frame)], ignore_index=True)
    # Epochs after the last checkpoint were run again, with the same numbers.
    return log.drop_duplicates("time/total_timesteps", keep="last").sort_values(
        "time/total_timesteps", ignore_index=True
    )


def complete_runs(
    tasks: Sequence[tuple[Run, Path, Sequence[Scenario]]],
    *,
    n_eval_episodes: int = 1000,
    jobs: int | None = None,
) -> None:
    """
    Complete runs in parallel processes, with a progress bar; Ctrl-C keeps what is finished.

    :param tasks: Runs, their folders and what to evaluate, see :func:`complete_run`. One that starts from the policy of
        another one waits for it.
    :param n_eval_episodes: Episodes of each scenario.
    :param jobs: Runs at a time; default: the number of cores.
    """
    jobs = jobs or usable_cores()
    waiting, unfinished = list(tasks), {folder for _, folder, _ in tasks}
    running: dict[Future[Path], Path] = {}
    with (
        tqdm(total=len(tasks), unit="run", smoothing=0.1) as progress,
        ProcessPoolExecutor(jobs, mp.get_context("spawn"), initializer=_init_worker) as pool,
    ):
        try:
            while waiting or running:
                # No more than are at work, so that what has to wait keeps its place in the order.
                ready = [task for task in waiting if task[0].start not in unfinished]
                for task in ready[: jobs - len(running)]:
                    waiting.remove(task)
                    running[pool.submit(complete_run, *task, n_eval_episodes=n_eval_episodes)] = task[1]
                if not running:
                    raise ValueError(f"these runs wait for each other: {[task[0].folder_name for task in waiting]}")
                # With a timeout, so that Ctrl-C is seen at once.
                finished, _ = wait(running, timeout=1.0, return_when=FIRST_COMPLETED)
                for future in finished:
                    folder = future.result()
                    running.pop(future)
                    unfinished.remove(folder)
                    progress.set_postfix_str(folder.name, refresh=False)
                    progress.update()
        except BaseException:
            workers = list(getattr(pool, "_processes", {}).values())  # shutdown() forgets them
            pool.shutdown(wait=False, cancel_futures=True)
            for process in workers:
                process.terminate()
            progress.write("stopped; finished runs and checkpoints are kept, and the same command goes on from them")
            raise


def _init_worker() -> None:
    th.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides


@contextmanager
def torch_threads(n: int) -> Iterator[None]:
    """Run a block of code with this many torch threads."""
    before = th.get_num_threads()
    th.set_num_threads(n)
    try:
        yield
    finally:
        th.set_num_threads(before)
