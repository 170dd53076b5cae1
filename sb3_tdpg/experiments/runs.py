"""Training runs, from settings to per-episode records in folders that can be resumed; one at a time or many."""

from __future__ import annotations

import hashlib
import multiprocessing as mp
import os
import shutil
import signal
import threading
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, field
from multiprocessing.sharedctypes import Synchronized, SynchronizedArray
from pathlib import Path
from typing import Any

import pandas as pd
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, make_output_format
from tqdm import tqdm

from sb3_tdpg.callbacks import SelectionCallback, TrainingCheckpointCallback
from sb3_tdpg.common.processes import usable_cores
from sb3_tdpg.common.provenance import check_same_config, write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import set_threads
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.experiments.training import make_training
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.tdpg import TDPG

# A checkpoint resets the environments, so that how often it is made belongs to the run.
MAX_CHECKPOINT_EPOCHS = 50
# Attempts must not share their seeds with other runs.
SEEDS_BETWEEN_ATTEMPTS = 1000
# Of a run, for the progress bar: the rest is its evaluation.
TRAINING = 0.9
BAR = "{l_bar}{bar}| {n:.1f}/{total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"


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


Task = tuple[Run, Path, Sequence[Scenario]]
"""A run, its folder, and what it is evaluated on."""


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
    seeds, versions, commit) and, written last, ``episodes.csv`` (a row for each evaluation episode). Attempts in vain
    stay as ``attempt<i>/``.

    :param run: What to train.
    :param folder: Where to.
    :param scenarios: What to evaluate; the environment keywords of the run apply beneath those of a scenario.
    :param n_eval_episodes: Episodes of each scenario.
    :param progress_bar: Show progress bars.
    :return: ``folder``
    :raises ValueError: if the folder holds a run with other settings, or there is no policy to start from; nothing is
        touched.
    """
    if not _begin(run, folder, scenarios, n_eval_episodes):
        return folder
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
    # A save that was killed leaves a part of a file behind.
    shutil.copytree(attempt_folder, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.partial"))
    write_frame_atomically(records, folder / "episodes.csv")
    shutil.rmtree(attempt_folder)
    return folder


def check_folder(run: Run, folder: Path, scenarios: Sequence[Scenario], n_eval_episodes: int) -> dict[str, Any]:
    """
    See whether a folder is free for a run, or holds it already; the parameters are those of :func:`complete_run`.

    :return: what ``config.json`` is to say
    :raises ValueError: if it holds a run with other settings.
    """
    rows = [dict(name=row.name, env_id=row.env_id, env_kwargs=dict(row.env_kwargs)) for row in scenarios]
    config = {**run.config, "n_eval_episodes": n_eval_episodes, "scenarios": rows}
    check_same_config(folder / "config.json", config, "run")
    return config


def _begin(run: Run, folder: Path, scenarios: Sequence[Scenario], n_eval_episodes: int) -> bool:
    """Make the folder of a run and say in it what the run is; False if the run is finished."""
    if run.start is not None and not (run.start / "model.zip").exists():
        raise ValueError(f"{run.folder_name} starts from the policy in {run.start}, and there is none: train it first")
    config = check_folder(run, folder, scenarios, n_eval_episodes)
    if (folder / "episodes.csv").exists():
        return False
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "config.json").exists():
        write_run_config(folder / "config.json", config)
    return True


def _digest(path: Path) -> str:
    """A name for the content of a file, if there is one."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:12] if path.exists() else "not trained yet"


def _train(run: Run, attempt: int, folder: Path, progress_bar: bool) -> tuple[TDPG, bool]:
    """
    Return the policy of one attempt, and whether any epoch met the limits (otherwise it is the last epoch's).

    ``folder`` keeps what a later call goes on from, and in the end ``model.zip``, ``selected.json`` and the log.
    """
    result = folder / "model.zip"
    if not result.exists():
        member = _prepare(run, attempt, folder)
        member.model.learn(
            member.n_timesteps,
            list(member.callbacks),
            reset_num_timesteps=member.reset_num_timesteps,
            progress_bar=progress_bar,
        )
        _finish(member, folder)
    return TDPG.load(result, device="cpu"), (folder / "selected.json").exists()


@dataclass
class _Attempt:
    """A training that can be begun or gone on with; the fields are arguments of ``TDPG.learn``."""

    model: TDPG
    n_timesteps: int
    callbacks: Sequence[BaseCallback]
    reset_num_timesteps: bool


def _prepare(run: Run, attempt: int, folder: Path) -> _Attempt:
    """Make the training of one attempt, or take it up where it was interrupted."""
    checkpoint = folder / "checkpoint.zip"
    training = make_training(run.env_id, run.settings, seed=run.seed + SEEDS_BETWEEN_ATTEMPTS * attempt, device="cpu")
    n_timesteps, model = training.n_timesteps, training.model
    epochs = n_timesteps // (model.n_episodes * model.horizon)
    checkpoint_epochs = max(1, min(MAX_CHECKPOINT_EPOCHS, epochs // 4))
    resumes = checkpoint.exists()
    if resumes:
        model = TDPG.load(checkpoint, env=model.env, device="cpu")
        n_timesteps = model.remaining_timesteps
    elif run.start is not None:
        # Not the whole model: the optimiser's memory belongs to another objective.
        start = TDPG.load(run.start / "model.zip", device="cpu")
        model.policy.load_state_dict(start.policy.state_dict())
    log = make_output_format("csv", str(folder), log_suffix=f"_{model.num_timesteps:08d}")
    model.set_logger(Logger(str(folder), [log]))
    callbacks = [*training.callbacks, TrainingCheckpointCallback(checkpoint, checkpoint_epochs)]
    if _SHARED is not None:
        callbacks.append(_CountEpochs(_SHARED, folder.parent))
    if training.selection is not None:
        training.selection.save_path = folder / "selected.zip"
    return _Attempt(model, n_timesteps, callbacks, reset_num_timesteps=not resumes)


def _finish(member: _Attempt, folder: Path) -> None:
    """Leave the selected policy behind, or the last one, and no checkpoint."""
    model = member.model
    model.logger.close()
    selection = next((c for c in member.callbacks if isinstance(c, SelectionCallback)), None)
    if selection is not None and selection.best is not None:
        selection.restore(model)
    model.save(folder / "model.zip")
    for name in ("checkpoint.zip", "selected.zip"):
        (folder / name).unlink(missing_ok=True)


def read_progress(folder: Path) -> pd.DataFrame:
    """Return the training log of a run, also of one that was resumed, one row for each epoch."""
    frames = [pd.read_csv(path) for path in sorted(folder.glob("progress_*.csv"))]
    log = pd.concat([frame for frame in frames if len(frame)], ignore_index=True)
    # Epochs after the last checkpoint were run again, with the same numbers.
    return log.drop_duplicates("time/total_timesteps", keep="last").sort_values(
        "time/total_timesteps", ignore_index=True
    )


def complete_runs(
    tasks: Sequence[Task],
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
    running: set[Future[Path]] = set()
    context = mp.get_context("spawn")
    folders = [folder for _, folder, _ in tasks]
    shared = _Shared(folders, context.Value("L", 0), context.Array("d", len(tasks)))
    with (
        tqdm(total=len(tasks), unit="run", smoothing=0.1, bar_format=BAR) as progress,
        ProcessPoolExecutor(jobs, context, initializer=_init_worker, initargs=(shared,)) as pool,
    ):
        try:
            while waiting or running:
                # No more than are at work, so that what has to wait keeps its place in the order.
                ready = [t for t in waiting if t[0].start not in unfinished]
                for task in ready[: max(0, jobs - len(running))]:
                    waiting.remove(task)
                    running.add(pool.submit(complete_run, *task, n_eval_episodes=n_eval_episodes))
                if not running:
                    raise ValueError(f"these runs wait for each other: {[task[0].folder_name for task in waiting]}")
                # With a timeout, so that Ctrl-C is seen at once.
                finished, running = wait(running, timeout=1.0, return_when=FIRST_COMPLETED)
                for future in finished:
                    unfinished.remove(future.result())
                progress.set_postfix_str(f"{shared.epochs.value:,} epochs of training", refresh=False)
                progress.update(shared.runs(unfinished) - progress.n)
                progress.refresh()
        except BaseException:
            workers = list(getattr(pool, "_processes", {}).values())  # shutdown() forgets them
            pool.shutdown(wait=False, cancel_futures=True)
            for process in workers:
                process.terminate()
            progress.write("stopped; finished runs and checkpoints are kept, and the same command goes on from them")
            raise


@dataclass(frozen=True)
class _Shared:
    """
    What the workers tell the process that shows the progress.

    :param folders: Of the runs.
    :param epochs: How many there were in all.
    :param trained: For each run, how much of its training is done, 0 to 1.
    """

    folders: Sequence[Path]
    epochs: Synchronized[int]
    trained: SynchronizedArray[float]

    def runs(self, unfinished: Collection[Path]) -> float:
        """How many runs are done, with the parts of those that are on their way."""
        parts = (TRAINING * x if f in unfinished else 1.0 for f, x in zip(self.folders, self.trained[:], strict=True))
        return sum(parts)


class _CountEpochs(BaseCallback):
    """Let the process that shows the progress know that there is some."""

    def __init__(self, shared: _Shared, folder: Path) -> None:
        super().__init__()
        self._shared, self._index = shared, shared.folders.index(folder)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        with self._shared.epochs.get_lock():
            self._shared.epochs.value += 1
        # The last epoch may go beyond it.
        self._shared.trained[self._index] = min(1.0, self.model.num_timesteps / self.model._total_timesteps)


_SHARED: _Shared | None = None  # in a worker


def _init_worker(shared: _Shared) -> None:
    global _SHARED
    _SHARED = shared
    end_with_parent()
    set_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides


def end_with_parent() -> None:
    """In a worker: end when the process that has started it ends, be it killed. Files are never half-written."""
    parent = mp.parent_process()
    assert parent is not None

    def wait_for_its_end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_its_end, daemon=True).start()
