"""Peers beside TDPG on the same environments with the same number of steps: PPO, recurrent PPO, augmentation, VIB."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, make_output_format

from sb3_tdpg.envs.scenarios import BALL_CATCH, LAVA, Scenario
from sb3_tdpg.evaluation import aggregate_seeds, provenance, write_frame_atomically, write_run_config
from sb3_tdpg.files import write_atomically
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.reproduction.ball import GROUPS, with_groups
from sb3_tdpg.reproduction.common import commits_of, comparisons_table, how_made, publish_files
from sb3_tdpg.reproduction.lava import MAX_ATTEMPTS
from sb3_tdpg.runs import Run, complete_runs
from sb3_tdpg.training import read_schedule, take_env

# Fixed before any policy was evaluated on the test rows; seeds below 400 were seen while settings were chosen.
FIRST_LAVA_SEED = 400
# As in the records of ball catching that the peers are put beside.
FIRST_BALL_SEED = 100

# Environment steps of every training: what TDPG has in its block, and in its two stages of ball catching.
LAVA_STEPS = 1_500_000
BALL_STEPS = 160_000

BALL_RECORDS = Path("docs", "results", "ball_catch", "episodes.csv.xz")
"""Episodes of policy gradient and TDPG on ball catching, from ``make reproduce-ball-controls``."""

# Labels of those records -> what they are here: all that were trained for BALL_STEPS.
BALL_FROM_RECORDS = {
    "control, plain images": "PG",
    "its control": "PG, perturbed images",
    "TDPG": "TDPG, perturbed images",
}


@dataclass(frozen=True)
class TimedRun(Run):
    """A run that leaves ``time.json`` in its folder: seconds that the training took, on the clock and of the CPU."""

    def train(self, attempt: int, folder: Path, progress_bar: bool) -> tuple[BaseAlgorithm, bool]:
        """Train as :class:`~sb3_tdpg.runs.Run` does; a training that is resumed adds to its time."""
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
    A run of an algorithm that is not ours; it has no selection, and an interrupted training begins anew.

    :param algo: ``"ppo"`` or ``"ppo_lstm"``; the block is one of ``hyperparams/<algo>.yml``.
    """

    algo: str = "ppo"

    @property
    def settings(self) -> dict[str, Any]:
        """The block with the overrides."""
        return {**load_hyperparams(self.block, self.algo), **self.overrides}

    @property
    def config(self) -> dict[str, Any]:
        """What makes this run."""
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
        model.save(path)
        return model, False


def _algorithm(name: str) -> Any:
    if name == "ppo":
        return PPO
    try:
        from sb3_contrib import RecurrentPPO
    except ImportError as e:
        raise ImportError("RecurrentPPO needs sb3-contrib: pip install sb3-contrib") from e
    return RecurrentPPO


@dataclass(frozen=True)
class Peer:
    """
    How one row of the table is trained.

    :param label: Its title.
    :param block: Block of ``hyperparams/<algo>.yml``.
    :param algo: ``"tdpg"``, ``"ppo"`` or ``"ppo_lstm"``.
    :param overrides: Settings that replace those of the block.
    :param max_attempts: See :class:`~sb3_tdpg.runs.Run`.
    """

    label: str
    block: str
    algo: str = "tdpg"
    overrides: Mapping[str, Any] = field(default_factory=dict)
    max_attempts: int = 1

    def run(self, env_id: str, seed: int, **overrides: Any) -> Run:
        """Name the run with one seed."""
        settings = {**self.overrides, **overrides}
        if self.algo == "tdpg":
            return TimedRun(self.label, env_id, self.block, seed, settings, self.max_attempts)
        return SB3Run(self.label, env_id, self.block, seed, settings, self.max_attempts, algo=self.algo)


def with_weight_decay(block: str, weight_decay: float) -> dict[str, Any]:
    """Return the override that gives the policy's optimiser of a block a weight decay (Adam's: an L2 penalty)."""
    policy_kwargs = load_hyperparams(block)["policy_kwargs"]
    return dict(policy_kwargs={**policy_kwargs, "optimizer_kwargs": dict(weight_decay=weight_decay)})


def with_perturbation(**strengths: float) -> dict[str, Any]:
    """Return the override that trains on images with these perturbations, and no others."""
    none = dict(color=0.0, pattern=0.0, patch=0.0, contrast=0.0, noise=0.0)
    return dict(vec_env_wrapper=[{"sb3_tdpg.perturbation.VecImagePerturbation": {**none, **strengths}}])


LAVA_PEERS: tuple[Peer, ...] = (
    Peer("PG", "Lava-v0-pg"),
    Peer("PG, weight decay", "Lava-v0-pg", overrides=with_weight_decay("Lava-v0-pg", 1e-3)),
    Peer("TDPG (log-det)", "Lava-v0-logdet", max_attempts=MAX_ATTEMPTS),
    Peer("VIB", "Lava-v0-logdet", overrides=dict(mi_estimator="vib"), max_attempts=MAX_ATTEMPTS),
    Peer("PPO", "Lava-v0", "ppo"),
    Peer("RecurrentPPO", "Lava-v0", "ppo_lstm"),
)
# The noise of the test rows has standard deviations of 0.10 to 0.25, the patterns those that TDPG is trained with.
BALL_PEERS: tuple[Peer, ...] = (
    Peer("PPO", "BallCatch-v0", "ppo"),
    Peer("PPO, pixel noise", "BallCatch-v0", "ppo", with_perturbation(noise=0.25)),
    Peer("PPO, random backgrounds", "BallCatch-v0", "ppo", with_perturbation(color=0.35, pattern=0.7, patch=0.5)),
)

LAVA_KINDS = {"training": (LAVA[0].name,), "the noisiest row": (LAVA[-1].name,)}
BALL_KINDS = {"training": ("Training",), **GROUPS}
BALL_ROWS = ("Training", *GROUPS)

COLUMNS = ("env_id", "model", "train_seed", "attempts", "selected", "scenario", "episode", "cost", "seed")
COLUMNS += ("deterministic",)


def reproduce_peers(
    out: Path,
    *,
    n_seeds: int = 5,
    n_ball_seeds: int = 5,
    n_eval_episodes: int = 1000,
    n_timesteps: int | None = None,
    jobs: int | None = None,
    publish: Path | None = None,
    ball_records: Path = BALL_RECORDS,
) -> str:
    """
    Train the peers with several seeds, evaluate them on the rows of Table I and II; write table, seeds and records.

    Finished runs are kept: the same call goes on where an interrupted one stopped.

    :param out: Folder for ``summary.md``, ``seeds.csv``, ``episodes.csv.xz``, ``config.json`` and ``runs/``.
    :param n_seeds: Training seeds of each method on the lava problem.
    :param n_ball_seeds: Training seeds of each peer on ball catching; 0 leaves it out.
    :param n_eval_episodes: Episodes of each row.
    :param n_timesteps: Environment steps of each training; default: as many as TDPG has.
    :param jobs: Runs at a time; default: the number of cores.
    :param publish: Folder that gets a copy of everything but ``runs/``.
    :param ball_records: Episodes of policy gradient and TDPG on ball catching, which are not trained again.
    :return: the summary, as Markdown
    :raises ValueError: if ``ball_records`` is not there; nothing has been trained by then.
    """
    if n_ball_seeds and not ball_records.exists():
        raise ValueError(
            f"{ball_records} is not there: run in the folder of the repository, or 'make reproduce-ball-controls' first"
        )
    # Seed by seed, so that an interrupted reproduction has as many of one method as of another.
    lava = [
        peer.run("Lava-v0", seed, n_timesteps=n_timesteps or LAVA_STEPS)
        for seed in range(FIRST_LAVA_SEED, FIRST_LAVA_SEED + n_seeds)
        for peer in LAVA_PEERS
    ]
    ball = [
        peer.run("BallCatch-v0", seed, n_timesteps=n_timesteps or BALL_STEPS)
        for seed in range(FIRST_BALL_SEED, FIRST_BALL_SEED + n_ball_seeds)
        for peer in BALL_PEERS
    ]
    ball_rows = [row.with_kwargs(renderer="fast") for row in BALL_CATCH]
    tasks: list[tuple[Run, Path, Sequence[Scenario]]] = []
    for runs, rows in ((lava, list(LAVA)), (ball, ball_rows)):
        tasks += [(run, out / "runs" / run.env_id / run.folder_name, rows) for run in runs]
    complete_runs(tasks, n_eval_episodes=n_eval_episodes, jobs=jobs)

    folders = [folder for _, folder, _ in tasks]
    records = pd.concat([pd.read_csv(folder / "episodes.csv") for folder in folders], ignore_index=True)
    order = {label: i for i, label in enumerate([*BALL_FROM_RECORDS.values(), *_labels(LAVA_PEERS, BALL_PEERS)])}
    records = records.sort_values(["env_id", "model", "train_seed"], kind="stable", ignore_index=True, key=_by(order))
    write_frame_atomically(records[list(COLUMNS)].round({"cost": 4}), out / "episodes.csv.xz")
    times = pd.DataFrame(
        dict(env_id=run.env_id, model=run.method, train_seed=run.seed, **training_time(folder))
        for run, folder, _ in tasks
    )
    keys = ["env_id", "model", "train_seed"]
    outcome = records.groupby(keys, sort=False)[["attempts", "selected"]].first().reset_index()
    by_row = records.pivot_table("cost", keys, "scenario", sort=False).reset_index()
    seeds = outcome.merge(times, on=keys).merge(by_row, on=keys)
    write_frame_atomically(seeds.round(4), out / "seeds.csv")

    of_lava = records[records["env_id"] == "Lava-v0"]
    sections = ["# Peers", "## Lava", _table(of_lava, [row.name for row in LAVA], times[times["env_id"] == "Lava-v0"])]
    sections += [comparisons_table(of_lava, [(m, "TDPG (log-det)") for m in of_lava["model"].unique()], LAVA_KINDS)]
    if n_ball_seeds:
        of_ball = pd.concat([_recorded(ball_records, n_eval_episodes), records[records["env_id"] == "BallCatch-v0"]])
        of_ball = with_groups(of_ball[of_ball["scenario"].isin([row.name for row in BALL_CATCH])])
        rows = [*BALL_ROWS, *(row.name for row in BALL_CATCH[1:])]
        of_ball_times = times[times["env_id"] == "BallCatch-v0"]
        sections += ["## Ball catching", _table(of_ball, BALL_ROWS, of_ball_times), "Row by row:"]
        sections += [_table(of_ball, rows[len(BALL_ROWS) :], None)]
    how = provenance()
    write_run_config(out / "config.json", dict(runs=[run.config for run, _, _ in tasks], provenance=how))
    sections += [how_made("make reproduce-peers", how, commits_of(folders))]
    summary = "\n\n".join(sections) + "\n"
    write_atomically(out / "summary.md", summary)
    if publish is not None:
        publish_files(out, publish)
    return summary


def training_time(folder: Path) -> dict[str, float]:
    """
    Add up what the training of a run took, attempts in vain included.

    :return: ``wall_s`` and ``cpu_s``
    """
    times = [json.loads(path.read_text()) for path in (folder / "time.json", *folder.glob("attempt*/time.json"))]
    return {name: sum(each[name] for each in times) for name in ("wall_s", "cpu_s")}


def _recorded(path: Path, n_eval_episodes: int) -> pd.DataFrame:
    """Read the policies that are not trained again, with the names that they have here."""
    records = pd.read_csv(path)
    records = records[records["model"].isin(list(BALL_FROM_RECORDS)) & (records["episode"] < n_eval_episodes)]
    return records.assign(model=records["model"].map(BALL_FROM_RECORDS), env_id="BallCatch-v0")


def _labels(*groups: Sequence[Peer]) -> list[str]:
    return [peer.label for group in groups for peer in group]


def _by(order: Mapping[str, int]) -> Any:
    return lambda column: column.map(order) if column.name == "model" else column


def _table(records: pd.DataFrame, rows: Sequence[str], times: pd.DataFrame | None) -> str:
    """Write a line for each method: its cost in each row, and what its training took (medians over seeds)."""
    aggregated = aggregate_seeds(records[records["scenario"].isin(rows)]).set_index(["model", "scenario"])
    best = aggregated["iqm"].groupby("scenario").min()
    header = ["method", "seeds", *rows, *([] if times is None else ["CPU s", "wall s"])]
    lines = [header, ["---"] + ["---:"] * (len(header) - 1)]
    for model in records["model"].unique():
        line = [model, str(aggregated.loc[(model, rows[0]), "n_seeds"])]
        for row in rows:
            cell = aggregated.loc[(model, row)]
            text = f"{cell['iqm']:.2f} [{cell['low']:.2f}, {cell['high']:.2f}]"
            line.append(f"**{text}**" if cell["iqm"] == best[row] else text)
        if times is not None:
            of_model = times[times["model"] == model]
            line += [f"{of_model[name].median():.0f}" if len(of_model) else "-" for name in ("cpu_s", "wall_s")]
        lines.append(line)
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)
