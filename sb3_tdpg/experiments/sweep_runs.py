"""The runs of a sweep over beta: settings, folders and measurements."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.envs.scenarios import PANDA_GRASP_CAMERA, PAPER_ROWS, Scenario
from sb3_tdpg.evaluation.information import information_bounds, rollout_information
from sb3_tdpg.experiments.runs import Run
from sb3_tdpg.experiments.training import make_training
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.tdpg import TDPG

N_INFORMATION = 1000  # episodes


@dataclass(frozen=True)
class Sweep:
    """
    The settings that all runs share.

    :param env_id: The training environment.
    :param block: Block of ``hyperparams/tdpg.yml``.
    :param settings: Settings that replace those of the block.
    :param scenarios: Scenarios of the evaluation, the training scenario first.
    :param n_eval_episodes: Episodes of each scenario.
    """

    env_id: str
    block: str
    settings: Mapping[str, Any]
    scenarios: Sequence[Scenario]
    n_eval_episodes: int

    def run(self, inverse_beta: float, seed: int) -> Run:
        """Return the run of one beta and one seed."""
        beta = math.inf if inverse_beta == 0 else 1 / inverse_beta
        overrides = {**self.settings, "beta": beta}
        if "cost_limit" in load_hyperparams(self.block):
            overrides["cost_limit"] = None  # it belongs to beta="auto"
        return Run(f"beta {beta_label(inverse_beta)}", self.env_id, self.block, seed, overrides)

    def folder(self, out: Path, inverse_beta: float, seed: int) -> Path:
        """Return the folder of a run."""
        return out / "runs" / self.run(inverse_beta, seed).folder_name

    def row(self, folder: Path, inverse_beta: float, seed: int) -> dict[str, Any]:
        """Return a finished run's row of ``runs.csv``: its cost in each scenario and its information in the first."""
        path = folder / "sweep_row.json"
        if path.exists():
            return json.loads(path.read_text())
        records = pd.read_csv(folder / "episodes.csv")
        costs = records.groupby("scenario", sort=False)["cost"].agg(["mean", "std"])
        model = TDPG.load(folder / "model.zip", device="cpu")
        training = self.scenarios[0].with_kwargs(**self.run(inverse_beta, seed).settings.get("env_kwargs", {}))
        n_episodes = min(N_INFORMATION, max(self.n_eval_episodes, model.policy.trv_dim + 2))
        upper, lower = information_bounds(rollout_information(model, training, n_episodes))
        row: dict[str, Any] = dict(
            label=beta_label(inverse_beta),
            inverse_beta=inverse_beta,
            seed=seed,
            cost=float(costs["mean"].iloc[0]),
            std=float(costs["std"].iloc[0]),
            information=upper,
            information_lower=lower,
            met_block_limits=bool(records["selected"].iloc[0]),
            folder=folder.name,
            **{column: float(costs["mean"][name]) for name, column in self.columns.items()},
        )
        write_atomically(path, json.dumps(row))
        return row

    @property
    def columns(self) -> dict[str, str]:
        """Name of the column of ``runs.csv`` with the mean cost, by scenario."""
        return {scenario.name: f"cost: {scenario.name}" for scenario in self.scenarios}

    @property
    def config(self) -> dict[str, Any]:
        """Everything that makes one run comparable with another."""
        settings = {name: value for name, value in self.run(1.0, 0).settings.items() if name != "beta"}
        rows = {row.name: dict(env_id=row.env_id, env_kwargs=dict(row.env_kwargs)) for row in self.scenarios}
        config = dict(env_id=self.env_id, block=self.block, settings=settings)
        return {**config, "scenarios": rows, "n_eval_episodes": self.n_eval_episodes}


def parse_inverse_beta(beta: str | float) -> float:
    """
    Read a beta and return 1 / beta, the weight of the information; ``"inf"`` gives 0.

    :raises ValueError: if it is not a positive number.
    """
    try:
        inverse = 0.0 if str(beta) == "inf" else float(1 / Fraction(str(beta)))
    except (ValueError, ArithmeticError):
        inverse = -1.0
    if inverse < 0:
        raise ValueError(f"beta={beta!r} must be a positive number (0.04), a fraction (1/25) or inf (policy gradient)")
    return round(inverse, 9)


def beta_label(inverse_beta: float) -> str:
    """Name a beta: ``"1/75"``, ``"0.3"``, ``"2"``, ``"inf"``."""
    if inverse_beta == 0:
        return "inf"
    return f"1/{inverse_beta:.0f}" if inverse_beta == round(inverse_beta) > 1 else f"{1 / inverse_beta:.6g}"


def make_sweep(
    env_id: str, block: str, settings: Mapping[str, Any], n_timesteps: int | None, n_eval_episodes: int
) -> Sweep:
    """
    Describe a sweep, and build a model of it, so that errors in the settings are found before any training.

    :raises ValueError: if something does not fit.
    """
    for name in ("beta", "seed"):
        if name in settings:
            raise ValueError(f"{name} is varied by the sweep: leave it out of the settings")
    if n_timesteps is not None:
        settings = {**settings, "n_timesteps": n_timesteps}
    rows = PAPER_ROWS.get(env_id, (Scenario("Training", env_id),))
    scenarios = PANDA_GRASP_CAMERA if block.startswith("PandaGrasp-v0-camera") else rows
    plan = Sweep(env_id, block, dict(settings), scenarios, n_eval_episodes)
    try:
        env = make_training(env_id, plan.run(1.0, 0).settings, seed=0, device="cpu").model.env
    except KeyError as e:
        raise ValueError(f"{e.args[0]}: choose one with --block") from e
    except TypeError as e:
        raise ValueError(f"the settings of block {block!r} do not fit: {e}") from e
    assert env is not None
    env.close()
    return plan
