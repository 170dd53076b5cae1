"""One training on a public task, and its evaluation: ours, or PPO and RecurrentPPO through rl-zoo3."""

from __future__ import annotations

import argparse
import io
import json
import time
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_normalize

from sb3_tdpg import TDPG
from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.provenance import check_same_config, jsonable, write_frame_atomically, write_run_config
from sb3_tdpg.experiments.public.tasks import PublicTask
from sb3_tdpg.experiments.training import make_training
from sb3_tdpg.information.logdet import LogDet

N_EVAL_ENVS = 10
EVAL_SEED = 10_000  # its environments are seeded alike for all methods
N_CURVE_POINTS = 50

LABEL = ["env_id", "method", "train_seed"]
PRESET, TUNED, LIMIT = "TDPG, one preset", "TDPG, tuned", "TDPG, cost limit"
"""Methods: without any setting; with the block of ``hyperparams/tdpg.yml``; with a limit, see :func:`with_limit`."""
SHARE = 0.95  # of the return


@dataclass(frozen=True)
class Training:
    """
    One method with one seed on one task.

    :param method: Label in tables.
    :param settings: Arguments of TDPG; ``None``: the rival with rl-zoo3's settings.
    """

    task: PublicTask
    method: str
    seed: int
    settings: dict[str, Any] | None = None
    n_eval_episodes: int = 100  # without and with the noise of the policy, each

    @property
    def config(self) -> dict[str, Any]:
        """Everything that determines the result."""
        settings = self.task.zoo_block() if self.settings is None else self.settings
        task = {name: value for name, value in asdict(self.task).items() if name != "tuned"}
        return {**asdict(self), "task": task, "settings": settings}

    @property
    def label(self) -> tuple[str, str, int]:
        """The values of the columns ``LABEL`` in all records."""
        return self.task.env_id, self.method, self.seed

    @property
    def folder_name(self) -> str:
        """A name made from task, method and seed."""
        return f"{self.task.env_id}/{self.method.replace(', ', '-').replace(' ', '_')}/seed{self.seed}"


class EpisodeLog(BaseCallback):
    """Keep step, return and length of every training episode."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[int, float, int]] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if episode := info.get("episode"):
                self.rows.append((self.num_timesteps, float(episode["r"]), int(episode["l"])))
        return True

    def frame(self) -> pd.DataFrame:
        """Return the episodes, one row each."""
        return pd.DataFrame(self.rows, columns=["timestep", "return", "length"])


def complete_training(training: Training, root: Path) -> Path:
    """Train and evaluate, unless ``episodes.csv``, written last, says that this is done."""
    folder = root / training.folder_name
    check_same_config(folder / "config.json", training.config, "training")
    if (folder / "episodes.csv").exists():
        return folder
    write_run_config(folder / "config.json", training.config)
    log, start = EpisodeLog(), time.perf_counter()
    model, cpu_s = train_ours(training, log) if training.settings is not None else train_rival(training, log, folder)
    record: dict[str, Any] = dict(cpu_s=cpu_s, wall_s=time.perf_counter() - start, timesteps=model.num_timesteps)
    record["nats"] = nats_per_step(model) if isinstance(model, TDPG) else None
    write_atomically(folder / "time.json", json.dumps(jsonable(record)))
    model.save(folder / "model.zip")
    write_frame_atomically(log.frame(), folder / "training.csv")
    write_frame_atomically(evaluate(training, model), folder / "episodes.csv")
    return folder


def with_limit(training: Training, root: Path) -> Training:
    """Add a cost limit: 95 % of the return, with the noise of the policy, that a finished training reached."""
    episodes = pd.read_csv(root / training.folder_name / "episodes.csv")
    reached = episodes.loc[~episodes["deterministic"], "return"].mean()
    limit = (1 - SHARE) * abs(reached) - reached
    return replace(training, method=LIMIT, settings=dict(cost_limit=float(f"{limit:.4g}")))


def train_ours(training: Training, log: EpisodeLog) -> tuple[BaseAlgorithm, float]:
    """Train TDPG as a user would; return the model and the CPU time of ``learn``."""
    assert training.settings is not None
    task = training.task
    block = {"policy": "TRVPolicy", "n_timesteps": task.n_timesteps, **training.settings}
    model, callbacks, n_timesteps = make_training(task.env_id, block, seed=training.seed, device="cpu")
    start = time.process_time()
    model.learn(n_timesteps, [*callbacks, log])
    return model, time.process_time() - start


def train_rival(training: Training, log: EpisodeLog, folder: Path) -> tuple[BaseAlgorithm, float]:
    """Train PPO or RecurrentPPO by rl-zoo3, with its settings for the task."""
    task = training.task
    blocks = folder / "zoo.yml"
    write_atomically(blocks, yaml.safe_dump({task.env_id: task.zoo_block()}))
    manager = ExperimentManager(
        argparse.Namespace(),
        "ppo_lstm" if task.hidden else "ppo",
        task.env_id,
        str(folder / "zoo"),
        n_timesteps=task.n_timesteps,
        eval_freq=-1,
        seed=training.seed,
        config=str(blocks),
        device="cpu",
        verbose=0,
        log_interval=-1,
    )
    with redirect_stdout(io.StringIO()):  # it prints its settings
        ready = manager.setup_experiment()
    assert ready is not None
    model, _ = ready
    manager.callbacks.append(log)
    start = time.process_time()
    manager.learn(model)
    return model, time.process_time() - start


def nats_per_step(model: TDPG) -> float:
    """Measure the information that the TRVs have about the state in the last rollouts: the log-det bound."""
    batch = model.rollout_buffer.episode_batch(whole_horizon=False).information_batch(pooled=True)
    return float(LogDet(1, model.state_dim, model.policy.trv_dim)(batch).sum())


def evaluate(training: Training, model: BaseAlgorithm) -> pd.DataFrame:
    """Return the returns of evaluation episodes, with and without noise in the policy: one row for each."""
    env = make_vec_env(training.task.env_id, n_envs=N_EVAL_ENVS)
    trained_in = model.get_env()
    assert trained_in is not None
    norm = unwrap_vec_normalize(trained_in)
    if norm is not None:
        env = VecNormalize(env, training=False, norm_reward=False)
        env.obs_rms = norm.obs_rms
    frames = []
    returns: Any
    for deterministic in (True, False):
        env.seed(EVAL_SEED)
        returns, lengths = evaluate_policy(
            model, env, training.n_eval_episodes, deterministic, return_episode_rewards=True
        )
        frames.append(pd.DataFrame({"episode": range(len(returns)), "return": returns, "length": lengths}))
        frames[-1]["deterministic"] = deterministic
    return pd.concat(frames, ignore_index=True).assign(**dict(zip(LABEL, training.label, strict=True)))


def learning_curve(folder: Path, n_timesteps: int) -> pd.DataFrame:
    """Average the returns of a training's episodes over equal numbers of steps."""
    episodes = pd.read_csv(folder / "training.csv")
    width = n_timesteps // N_CURVE_POINTS
    episodes["timestep"] = ((episodes["timestep"] - 1) // width + 1) * width
    return episodes.groupby("timestep", as_index=False)["return"].mean()
