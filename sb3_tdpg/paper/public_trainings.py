"""Train and evaluate TDPG, or PPO and RecurrentPPO through rl-zoo3, on a public task."""

from __future__ import annotations

import argparse
import io
import json
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import rl_zoo3.import_envs  # registers CartPoleNoVel-v1 and PendulumNoVel-v1
import yaml
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg import TDPG
from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.provenance import check_same_config, jsonable, write_frame_atomically, write_run_config
from sb3_tdpg.experiments.training import make_training
from sb3_tdpg.information.logdet import LogDet

N_HOPPER_POSITIONS = 5  # number of positions in an observation; all other components are velocities
N_EVAL_ENVS = 10
EVAL_SEED = 10_000  # seed of the evaluation environments, the same for all methods

PRESET, TUNED, LIMIT = "TDPG, one preset", "TDPG, tuned", "TDPG, cost limit"
"""Methods: no settings; the block of ``hyperparams/tdpg.yml``; a cost limit, see :func:`with_limit`."""
SHARE = 0.95  # share of the return that the cost limit keeps


@dataclass(frozen=True)
class PublicTask:
    """
    A task that others made.

    :param env_id: Registered id of the task.
    :param block: Block of rl-zoo3's settings. It can be for an older version of the environment or for a similar one.
    :param n_timesteps: Length of a training in environment steps, the same for all methods.
    :param hidden: Whether the task needs a memory. If so, the baseline is RecurrentPPO instead of PPO.
    :param tuned: Block of ``hyperparams/tdpg.yml`` with tuned settings.
    """

    env_id: str
    block: str
    n_timesteps: int = 100_000
    hidden: bool = False
    tuned: str | None = None

    @property
    def rival(self) -> str:
        """The baseline: PPO or RecurrentPPO."""
        return "RecurrentPPO" if self.hidden else "PPO"

    def zoo_block(self) -> dict[str, Any]:
        """Read rl-zoo3's settings for the baseline."""
        file = Path(rl_zoo3.__file__).parent / "hyperparams" / ("ppo_lstm.yml" if self.hidden else "ppo.yml")
        block = dict(yaml.safe_load(file.read_text())[self.block])
        if isinstance(gym.spec(self.env_id).make().observation_space, gym.spaces.Discrete):
            block.pop("normalize")  # VecNormalize does not accept discrete observations
        return block


TASKS = (
    PublicTask("CartPole-v1", "CartPole-v1"),
    PublicTask("Acrobot-v1", "Acrobot-v1", tuned="Acrobot-v1"),
    PublicTask("Pendulum-v1", "Pendulum-v1"),
    PublicTask("MountainCarContinuous-v0", "MountainCarContinuous-v0", 20_000),
    PublicTask("InvertedDoublePendulum-v5", "InvertedDoublePendulum-v2"),
    PublicTask("Reacher-v5", "Reacher-v2"),
    PublicTask("Hopper-v5", "Hopper-v4"),
    PublicTask("HalfCheetah-v5", "HalfCheetah-v4"),
    PublicTask("Swimmer-v5", "Swimmer-v4", tuned="Swimmer-v5"),
    PublicTask("CartPoleNoVel-v1", "CartPoleNoVel-v1", hidden=True),
    PublicTask("PendulumNoVel-v1", "PendulumNoVel-v1", hidden=True),
    PublicTask("HopperNoVel-v5", "Hopper-v4", hidden=True),
    # rl-zoo3 has no settings for POPGym, so these tasks use the settings of the most similar task.
    PublicTask("NoisyPositionOnlyCartPoleEasy-v0", "CartPoleNoVel-v1", hidden=True),
    PublicTask("RepeatPreviousEasy-v0", "CartPoleNoVel-v1", hidden=True),
)


def make_hopper_without_velocities(**kwargs: Any) -> gym.Env:
    """Make Hopper-v5 whose observation contains only the positions, which are its first components."""
    env = gym.make("Hopper-v5", **kwargs)
    full: Any = env.observation_space
    low, high = (bound[:N_HOPPER_POSITIONS] for bound in (full.low, full.high))
    space = gym.spaces.Box(low, high, dtype=np.float64)
    return gym.wrappers.TransformObservation(env, lambda y: y[:N_HOPPER_POSITIONS], space)


gym.register("HopperNoVel-v5", make_hopper_without_velocities, max_episode_steps=1000)
# POPGym's environments end on their own, but they do not declare a time limit, which TDPG needs.
for _module, _name, _horizon in (
    ("noisy_position_only_cartpole", "NoisyPositionOnlyCartPoleEasy", 200),
    ("repeat_previous", "RepeatPreviousEasy", 51),
):
    gym.register(f"{_name}-v0", f"popgym.envs.{_module}:{_name}", max_episode_steps=_horizon)


@dataclass(frozen=True)
class Training:
    """
    One training of one method with one seed on one task.

    :param method: Label in tables.
    :param settings: Arguments of TDPG. ``None`` means the baseline with rl-zoo3's settings.
    """

    task: PublicTask
    method: str
    seed: int
    settings: dict[str, Any] | None = None
    n_eval_episodes: int = 100  # number of episodes without the policy's noise, and also with it

    @property
    def config(self) -> dict[str, Any]:
        """Everything that determines the result."""
        settings = self.task.zoo_block() if self.settings is None else self.settings
        task = {name: value for name, value in asdict(self.task).items() if name != "tuned"}
        return {**asdict(self), "task": task, "settings": settings}

    @property
    def labels(self) -> dict[str, Any]:
        """The values of the columns that all records have."""
        return dict(env_id=self.task.env_id, method=self.method, train_seed=self.seed)

    @property
    def folder_name(self) -> str:
        """The name of the folder, made from task, method and seed."""
        return f"{self.task.env_id}/{self.method.replace(', ', '-').replace(' ', '_')}/seed{self.seed}"


class EpisodeLog(BaseCallback):
    """Record step, return and length of every training episode."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[int, float, int]] = []

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if episode := info.get("episode"):
                self.rows.append((self.num_timesteps, float(episode["r"]), int(episode["l"])))
        return True


def complete_training(training: Training, root: Path) -> Path:
    """Train and evaluate, unless ``episodes.csv`` exists, which is written last."""
    folder = root / training.folder_name
    check_same_config(folder / "config.json", training.config, "training")
    if (folder / "episodes.csv").exists():
        return folder
    write_run_config(folder / "config.json", training.config)
    log, start = EpisodeLog(), time.perf_counter()
    model, learn = _ours(training, log) if training.settings is not None else _rival(training, log, folder)
    cpu_start = time.process_time()
    learn()
    record: dict[str, Any] = dict(cpu_s=time.process_time() - cpu_start, wall_s=time.perf_counter() - start)
    record.update(timesteps=model.num_timesteps, nats=nats_per_step(model) if isinstance(model, TDPG) else None)
    write_atomically(folder / "time.json", json.dumps(jsonable(record)))
    model.save(folder / "model.zip")
    write_frame_atomically(pd.DataFrame(log.rows, columns=["timestep", "return", "length"]), folder / "training.csv")
    write_frame_atomically(evaluate(training, model), folder / "episodes.csv")
    return folder


def with_limit(training: Training, root: Path) -> Training:
    """Return a training whose cost limit keeps 95 % of a finished training's return with the stochastic policy."""
    episodes = pd.read_csv(root / training.folder_name / "episodes.csv")
    reached = episodes.loc[~episodes["deterministic"], "return"].mean()
    limit = (1 - SHARE) * abs(reached) - reached
    return replace(training, method=LIMIT, settings=dict(cost_limit=float(f"{limit:.4g}")))


def _ours(training: Training, log: EpisodeLog) -> tuple[BaseAlgorithm, Callable[[], Any]]:
    """Make a TDPG model as a user would; return the model, and a function that trains it."""
    block = {"policy": "TRVPolicy", "n_timesteps": training.task.n_timesteps, **(training.settings or {})}
    model, callbacks, n_timesteps = make_training(training.task.env_id, block, seed=training.seed, device="cpu")
    return model, lambda: model.learn(n_timesteps, [*callbacks, log])


def _rival(training: Training, log: EpisodeLog, folder: Path) -> tuple[BaseAlgorithm, Callable[[], Any]]:
    """Make PPO or RecurrentPPO with rl-zoo3 and its settings for the task; return the model and a training function."""
    task, blocks = training.task, folder / "zoo.yml"
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
    with redirect_stdout(io.StringIO()):  # the manager prints its settings
        ready = manager.setup_experiment()
    assert ready is not None
    manager.callbacks.append(log)
    return ready[0], lambda: manager.learn(ready[0])


def nats_per_step(model: TDPG) -> float:
    """Return the log-det bound on the information per step that the TRVs have about the state in the last rollouts."""
    batch = model.rollout_buffer.episode_batch(whole_horizon=False).information_batch(pooled=True)
    return float(LogDet(1, model.state_dim, model.policy.trv_dim)(batch).sum())


def evaluate(training: Training, model: BaseAlgorithm) -> pd.DataFrame:
    """Return the returns of evaluation episodes with and without noise in the policy, one row per episode."""
    env = make_vec_env(training.task.env_id, n_envs=N_EVAL_ENVS)
    if (norm := model.get_vec_normalize_env()) is not None:
        env = VecNormalize(env, training=False, norm_reward=False)
        env.obs_rms = norm.obs_rms
    frames = []
    for deterministic in (True, False):
        env.seed(EVAL_SEED)
        returns: Any
        returns, lengths = evaluate_policy(
            model, env, training.n_eval_episodes, deterministic, return_episode_rewards=True
        )
        frame = pd.DataFrame({"episode": range(len(returns)), "return": returns, "length": lengths})
        frames.append(frame.assign(deterministic=deterministic))
    return pd.concat(frames, ignore_index=True).assign(**training.labels)
