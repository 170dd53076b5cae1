"""Complete training runs: train and evaluate a model in a folder, resume it if needed, one run or many at a time."""

import hashlib
import json
import re
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, make_output_format
from tqdm import tqdm

from sb3_tdpg.callbacks import TrainingCheckpointCallback
from sb3_tdpg.checks import schedule_of
from sb3_tdpg.common.files import replaced_atomically, write_atomically
from sb3_tdpg.common.processes import process_pool
from sb3_tdpg.common.provenance import check_same_config, write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import usable_cores
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.experiments.training import make_training, take_env
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.tdpg import TDPG

# A checkpoint resets the environments, so the number of epochs between checkpoints changes the result of a run.
MAX_CHECKPOINT_EPOCHS = 50
# The attempts of a run must not use the seeds of other runs.
SEEDS_BETWEEN_ATTEMPTS = 1000


@dataclass(frozen=True)
class Run:
    """
    One training of one method with one seed.

    :param method: The label in tables ("PG", "TDPG").
    :param env_id: The training environment.
    :param block: Block of ``hyperparams/<algo>.yml``. With ``None``, the overrides are all settings.
    :param seed: Training seed.
    :param overrides: Settings that replace those of the block.
    :param max_attempts: Maximum number of trainings from scratch, each with its own seed, until one meets the limits of
        the block's selection. The paper also chooses its policy from several trainings.
    :param start: Folder of a finished run; the training starts from the policy of that run. With the same seed, it
        begins with the same initial states as that run.
    """

    method: str
    env_id: str
    block: str | None
    seed: int
    overrides: Mapping[str, Any] = field(default_factory=dict)
    max_attempts: int = 1
    start: Path | None = None
    algo = "tdpg"  # not a field: the records of a TDPG run do not contain it

    @property
    def settings(self) -> dict[str, Any]:
        """The settings of the block, with the overrides."""
        return {**(load_hyperparams(self.block, self.algo) if self.block else {}), **self.overrides}

    @property
    def folder_name(self) -> str:
        """The folder's name, made from method and seed. Points are kept, because "1.25" must differ from "1/25"."""
        return "-".join([*re.findall(r"[^\W_]+(?:\.\d+)*", self.method.lower()), f"seed{self.seed}"])

    @property
    def config(self) -> dict[str, Any]:
        """Everything that determines the result of the run."""
        config = {name: getattr(self, name) for name in ("method", "env_id", "block", "seed", "max_attempts")}
        start, policy = (None, None) if self.start is None else (self.start.name, "not trained yet")
        if self.start is not None and (path := self.start / "model.zip").exists():
            policy = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        return {**config, "start": start, "start_policy": policy, "settings": self.settings}

    def train(self, attempt: int, folder: Path, progress_bar: bool) -> tuple[BaseAlgorithm, bool]:
        """
        Train once, or resume an interrupted training.

        :param attempt: Number of the training, from 0.
        :param folder: Folder for ``model.zip``, ``selected.json``, the training log and ``time.json``, and for the
            checkpoint during the training. ``time.json`` contains wall time and CPU time in seconds; a resumed call
            adds to them.
        :param progress_bar: Show a progress bar.
        :return: the policy, and whether an epoch met the limits of the selection (if not, the policy is the last one)
        """
        path = folder / "time.json"
        before = json.loads(path.read_text()) if path.exists() else dict(wall_s=0.0, cpu_s=0.0)
        wall, cpu = before["wall_s"] - time.perf_counter(), before["cpu_s"] - time.process_time()

        def keep_times() -> None:
            times = dict(wall_s=round(wall + time.perf_counter(), 3), cpu_s=round(cpu + time.process_time(), 3))
            write_atomically(path, json.dumps(times))

        trained = self._train(attempt, folder, progress_bar, keep_times)
        keep_times()
        return trained

    def _train(
        self, attempt: int, folder: Path, progress_bar: bool, keep_times: Callable[[], None]
    ) -> tuple[BaseAlgorithm, bool]:
        result, checkpoint = folder / "model.zip", folder / "checkpoint.zip"
        if result.exists():
            return TDPG.load(result, device="cpu"), (folder / "selected.json").exists()
        seed = self.seed + SEEDS_BETWEEN_ATTEMPTS * attempt
        training = make_training(self.env_id, self.settings, seed=seed, device="cpu")
        model, n_timesteps, selection = training.model, training.n_timesteps, training.selection
        n_epochs = n_timesteps // model.epoch_size
        save_freq = max(1, min(MAX_CHECKPOINT_EPOCHS, n_epochs // 4))
        resumes = checkpoint.exists()
        if resumes:
            model = TDPG.load(checkpoint, env=model.env, device="cpu")
            n_timesteps = model.remaining_timesteps
        elif self.start is not None:
            # Only the policy is copied, because the optimiser's state belongs to another objective.
            start = TDPG.load(self.start / "model.zip", device="cpu")
            model.policy.load_state_dict(start.policy.state_dict())
        suffix = f"_{model.num_timesteps:08d}"
        model.set_logger(Logger(str(folder), [make_output_format("csv", str(folder), suffix)]))
        if selection is not None:
            selection.save_path = folder / "selected.zip"
        callbacks = [*training.callbacks, _TimedCheckpoint(checkpoint, save_freq, keep_times)]
        model.learn(n_timesteps, callbacks, reset_num_timesteps=not resumes, progress_bar=progress_bar)
        model.logger.close()
        if selection is not None and selection.best is not None:
            selection.restore(model)
        model.save(result)
        for path in (checkpoint, folder / "selected.zip"):
            path.unlink(missing_ok=True)
        return TDPG.load(result, device="cpu"), (folder / "selected.json").exists()


@dataclass(frozen=True)
class SB3Run(Run):
    """A run of PPO or recurrent PPO, without a selection. An interrupted training starts again from the beginning."""

    algo: str = "ppo"  # or "ppo_lstm"; the block is in hyperparams/<algo>.yml

    @property
    def config(self) -> dict[str, Any]:
        """Everything that determines the result of the run."""
        return {**super().config, "algo": self.algo}

    def _train(
        self, attempt: int, folder: Path, progress_bar: bool, keep_times: Callable[[], None]
    ) -> tuple[BaseAlgorithm, bool]:
        algorithm: Any = {"ppo": PPO, "ppo_lstm": RecurrentPPO}[self.algo]
        path = folder / "model.zip"
        if path.exists():
            return algorithm.load(path, device="cpu"), False
        settings = self.settings
        n_timesteps = int(settings.pop("n_timesteps"))
        env = take_env(self.env_id, settings)
        settings["learning_rate"] = schedule_of("learning_rate", settings["learning_rate"])
        model = algorithm(settings.pop("policy"), env, **settings, seed=self.seed, device="cpu")
        model.set_logger(Logger(str(folder), [make_output_format("csv", str(folder), log_suffix="_00000000")]))
        model.learn(n_timesteps, progress_bar=progress_bar)
        model.logger.close()
        with replaced_atomically(path) as partial:
            model.save(partial)
        return model, False


class _TimedCheckpoint(TrainingCheckpointCallback):
    """Save a checkpoint and the training time up to it, so that the time is known after a killed training."""

    def __init__(self, save_path: Path, save_freq: int, keep_times: Callable[[], None]) -> None:
        super().__init__(save_path, save_freq)
        self.keep_times = keep_times

    def _on_rollout_start(self) -> None:
        super()._on_rollout_start()
        if self.tdpg.epoch % self.save_freq == 0:
            self.keep_times()


Task = tuple[Run, Path, Sequence[Scenario]]
"""A run, its folder, and the scenarios for its evaluation."""


def complete_run(
    run: Run, folder: Path, scenarios: Sequence[Scenario], *, n_eval_episodes: int = 1000, progress_bar: bool = False
) -> Path:
    """
    Train and evaluate a run, or resume an interrupted run. Do nothing if the run is finished.

    ``folder`` then contains ``model.zip`` (the selected policy, or the last one if none was selected),
    ``selected.json`` (its epoch, cost and information; missing if none was selected), ``progress_<timestep>.csv`` (the
    training log), ``config.json`` (settings, seeds, versions, commit) and ``episodes.csv`` (a row for each evaluation
    episode, written last). Earlier attempts are in ``attempt<i>/``.

    :param run: The run to complete.
    :param folder: Folder of the run.
    :param scenarios: Scenarios to evaluate the policy on; their environment keywords replace those of the run.
    :param n_eval_episodes: Number of episodes of each scenario.
    :param progress_bar: Show progress bars.
    :return: ``folder``
    :raises ValueError: if the folder contains a run with other settings, or the policy to start from is missing; the
        folder is not changed.
    """
    if run.start is not None and not (run.start / "model.zip").exists():
        raise ValueError(f"{run.folder_name} starts from the policy in {run.start}, and there is none: train it first")
    config = check_folder(run, folder, scenarios, n_eval_episodes)
    if (folder / "episodes.csv").exists():
        return folder
    if not (folder / "config.json").exists():
        write_run_config(folder / "config.json", config)
    for attempt in range(run.max_attempts):
        attempt_folder = folder / f"attempt{attempt}"
        model, selected = run.train(attempt, attempt_folder, progress_bar)
        if selected:
            break
    env_kwargs = run.settings.get("env_kwargs") or {}
    # Only rows with the training environment get its keywords, which another environment may not have.
    rows = [row.with_kwargs(**env_kwargs) if row.env_id == run.env_id else row for row in scenarios]
    records = evaluate_scenarios(
        {run.method: model},
        rows,
        n_eval_episodes,
        labels=dict(train_seed=run.seed, attempts=attempt + 1, selected=selected),
        progress_bar=progress_bar,
    )
    # A process that is killed while it saves a file leaves a partial file.
    shutil.copytree(attempt_folder, folder, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.partial"))
    write_frame_atomically(records, folder / "episodes.csv")
    shutil.rmtree(attempt_folder)
    return folder


def check_folder(run: Run, folder: Path, scenarios: Sequence[Scenario], n_eval_episodes: int) -> dict[str, Any]:
    """
    Return the content of ``config.json`` for a run. The parameters are those of :func:`complete_run`.

    :raises ValueError: if the folder contains a run with other settings.
    """
    if (normalize := run.settings.get("normalize")) is not None and normalize.get("norm_obs", True):
        raise ValueError(
            f"normalize={normalize}: a run does not keep the statistics of observations. Give norm_obs=False (TDPG's "
            "policy has normalize_observations of its own), or train with sb3-tdpg train"
        )
    rows = [{k: v for k, v in vars(row).items() if k != "paper" and v is not None} for row in scenarios]
    config = {**run.config, "n_eval_episodes": n_eval_episodes, "scenarios": rows}
    check_same_config(folder / "config.json", config, "run")
    return config


def read_progress(folder: Path) -> pd.DataFrame:
    """Return the training log of a run, with one row for each epoch even if the run was resumed."""
    frames = [pd.read_csv(path) for path in sorted(folder.glob("progress_*.csv"))]
    log, step = pd.concat([frame for frame in frames if len(frame)]), "time/total_timesteps"
    # A resumed run repeats the epochs after the last checkpoint, with the same numbers.
    log = log.drop_duplicates(step, keep="last").sort_values(step, ignore_index=True)
    return log.assign(**{"time/iterations": range(1, len(log) + 1)})  # in a resumed log the numbers start from 1 again


def complete_runs(tasks: Sequence[Task], *, n_eval_episodes: int = 1000, jobs: int | None = None) -> None:
    """
    Complete runs (see :func:`complete_run`) with a progress bar, ``jobs`` at a time (default: the number of cores).

    A run that starts from the policy of another run waits for that run. Ctrl-C keeps finished runs and checkpoints.

    :raises ValueError: if a folder contains a run with other settings; in this case no run has started.
    """
    jobs = jobs or usable_cores()
    for run, folder, scenarios in tasks:  # errors are raised before the first run starts
        folder.parent.mkdir(parents=True, exist_ok=True)
        if run.start is None or (run.start / "model.zip").exists():
            check_folder(run, folder, scenarios, n_eval_episodes)
    waiting, unfinished = list(tasks), {folder for _, folder, _ in tasks}
    running: dict[Future[Path], Path] = {}
    with tqdm(total=len(tasks), unit="run") as progress, process_pool(jobs) as pool:
        while unfinished:
            # Submit only as many runs as there are free workers, so that a run that must wait keeps its place.
            for task in [t for t in waiting if t[0].start not in unfinished][: jobs - len(running)]:
                waiting.remove(task)
                running[pool.submit(complete_run, *task, n_eval_episodes=n_eval_episodes)] = task[1]
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                future.result()
                unfinished.remove(running.pop(future))
                progress.update()
