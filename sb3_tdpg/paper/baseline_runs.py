"""Timed runs of TDPG and of the algorithms of Stable-Baselines3 and sb3-contrib."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, make_output_format

from sb3_tdpg.common.files import replaced_atomically, write_atomically
from sb3_tdpg.experiments.runs import Run
from sb3_tdpg.experiments.training import read_schedule, take_env
from sb3_tdpg.hyperparams import load_hyperparams


@dataclass(frozen=True)
class TimedRun(Run):
    """A run that writes ``time.json``: the wall time and the CPU time of its training in seconds."""

    def train(self, attempt: int, folder: Path, progress_bar: bool) -> tuple[BaseAlgorithm, bool]:
        """Train as the base class does; a resumed call adds to the time, an interrupted one does not."""
        path = folder / "time.json"
        before = json.loads(path.read_text()) if path.exists() else dict(wall_s=0.0, cpu_s=0.0)
        wall, cpu = time.perf_counter(), time.process_time()
        trained = self._learn(attempt, folder, progress_bar)
        wall, cpu = before["wall_s"] + time.perf_counter() - wall, before["cpu_s"] + time.process_time() - cpu
        write_atomically(path, json.dumps(dict(wall_s=round(wall, 3), cpu_s=round(cpu, 3))))
        return trained

    def _learn(self, attempt: int, folder: Path, progress_bar: bool) -> tuple[BaseAlgorithm, bool]:
        return super().train(attempt, folder, progress_bar)


@dataclass(frozen=True)
class SB3Run(TimedRun):
    """
    A run of PPO or recurrent PPO, without a selection; an interrupted training begins anew.

    :param algo: ``"ppo"`` or ``"ppo_lstm"``; the block is in ``hyperparams/<algo>.yml``.
    """

    algo: str = "ppo"

    @property
    def settings(self) -> dict[str, Any]:
        """The block with the overrides."""
        return {**load_hyperparams(self.block, self.algo), **self.overrides}

    @property
    def config(self) -> dict[str, Any]:
        """The settings that make this run."""
        return {**super().config, "algo": self.algo}

    def _learn(self, attempt: int, folder: Path, progress_bar: bool) -> tuple[BaseAlgorithm, bool]:
        algorithm, path = _algorithm(self.algo), folder / "model.zip"
        if path.exists():
            return algorithm.load(path, device="cpu"), False
        settings = self.settings
        n_timesteps = int(settings.pop("n_timesteps"))
        env = take_env(self.env_id, settings)
        read_schedule(settings)
        model = algorithm(settings.pop("policy"), env, **settings, seed=self.seed, device="cpu")
        model.set_logger(Logger(str(folder), [make_output_format("csv", str(folder), log_suffix="_00000000")]))
        model.learn(n_timesteps, progress_bar=progress_bar)
        model.logger.close()
        with replaced_atomically(path) as partial:
            model.save(partial)
        return model, False


def _algorithm(name: str) -> Any:
    if name == "ppo":
        return PPO
    try:
        from sb3_contrib import RecurrentPPO
    except ImportError as e:
        raise ImportError("RecurrentPPO needs sb3-contrib: pip install sb3-contrib") from e
    return RecurrentPPO


def training_time(folder: Path) -> dict[str, float]:
    """Return the total ``wall_s`` and ``cpu_s`` of the training of a run, including failed attempts."""
    times = [json.loads(path.read_text()) for path in (folder / "time.json", *folder.glob("attempt*/time.json"))]
    return {name: sum(each[name] for each in times) for name in ("wall_s", "cpu_s")}
