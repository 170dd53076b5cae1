"""Compare TDPG with baselines on the same environments: PPO, recurrent PPO, augmentation, weight decay, VIB."""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger, make_output_format

from sb3_tdpg.common.files import replaced_atomically, write_atomically
from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.common.provenance import write_frame_atomically
from sb3_tdpg.envs.scenarios import BALL_CATCH, LAVA, PANDA_GRASP, Scenario
from sb3_tdpg.evaluation import aggregate_seeds
from sb3_tdpg.experiments.runs import Run, Task, complete_runs
from sb3_tdpg.experiments.training import take_env
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.paper.ball import GROUPS, NO_PENALTY_PLAIN, with_groups
from sb3_tdpg.paper.ball import SECOND_STAGE as BALL_SECOND_STAGE
from sb3_tdpg.paper.common import NO_PENALTY, RECORD_COLUMNS, Method, Options, make_tasks, read_records, write_results
from sb3_tdpg.paper.grasp import TDPG_SECOND_STAGE as GRASP_SECOND_STAGE
from sb3_tdpg.paper.lava import MAX_ATTEMPTS
from sb3_tdpg.settings import rate_schedule

# The number of environment steps of TDPG, in both of its stages if it has two.
LAVA_STEPS, BALL_STEPS, GRASP_STEPS = 1.5e6, 1.6e5, 3.2e4
# With the block's minibatches of 500 an update makes 50 optimiser steps instead of 10, and a training takes twice as
# long.
LAVA_PPO = dict(n_timesteps=LAVA_STEPS, batch_size=2500)

RECORDS = Path("docs", "results")
"""Folder with the records of the methods that are not trained again, from the other reproductions."""
N_RECORDED_SEEDS = 5
FORMER_LABELS = {"its control": NO_PENALTY, "control, plain images": NO_PENALTY_PLAIN}
"""Labels of the ablations in older records."""


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
    """A run of PPO or recurrent PPO, without a selection; an interrupted training begins anew."""

    algo: str = "ppo"  # or "ppo_lstm"; the block is in hyperparams/<algo>.yml

    @property
    def settings(self) -> dict[str, Any]:
        """The block with the overrides."""
        return {**load_hyperparams(self.block, self.algo), **self.overrides}

    @property
    def config(self) -> dict[str, Any]:
        """The settings that make this run."""
        return {**super().config, "algo": self.algo}

    def _learn(self, attempt: int, folder: Path, progress_bar: bool) -> tuple[BaseAlgorithm, bool]:
        algorithm: Any = {"ppo": PPO, "ppo_lstm": RecurrentPPO}[self.algo]
        path = folder / "model.zip"
        if path.exists():
            return algorithm.load(path, device="cpu"), False
        settings = self.settings
        n_timesteps = int(settings.pop("n_timesteps"))
        env = take_env(self.env_id, settings)
        settings["learning_rate"] = rate_schedule(settings["learning_rate"])
        model = algorithm(settings.pop("policy"), env, **settings, seed=self.seed, device="cpu")
        model.set_logger(Logger(str(folder), [make_output_format("csv", str(folder), log_suffix="_00000000")]))
        model.learn(n_timesteps, progress_bar=progress_bar)
        model.logger.close()
        with replaced_atomically(path) as partial:
            model.save(partial)
        return model, False


def training_time(folder: Path) -> dict[str, float]:
    """Return the total ``wall_s`` and ``cpu_s`` of the training of a run, including failed attempts."""
    times = [json.loads(path.read_text()) for path in (folder / "time.json", *folder.glob("attempt*/time.json"))]
    return {name: sum(each[name] for each in times) for name in ("wall_s", "cpu_s")}


@dataclass(frozen=True)
class Baseline(Method):
    """One row of the table: how it is trained."""

    algo: str = "tdpg"  # or "ppo", "ppo_lstm"; the block is in hyperparams/<algo>.yml
    max_seeds: float = math.inf  # fewer for expensive methods
    is_shown: bool = True  # a first stage need not be shown

    def run(self, env_id: str, seed: int, start: Path | None = None, **overrides: Any) -> Run:
        """Return the timed run of this baseline with one seed."""
        run = super().run(env_id, seed, start, **overrides)
        return TimedRun(**vars(run)) if self.algo == "tdpg" else SB3Run(**vars(run), algo=self.algo)


def with_weight_decay(block: str, n_timesteps: float) -> Baseline:
    """Return PG with a weight decay of the policy's optimiser (Adam's: an L2 penalty)."""
    # On seed 350 of the lava problem, 1e-3 was better than 1e-2.
    policy_kwargs = {**load_hyperparams(block)["policy_kwargs"], "optimizer_kwargs": dict(weight_decay=1e-3)}
    return Baseline("PG, weight decay", block, overrides=dict(n_timesteps=n_timesteps, policy_kwargs=policy_kwargs))


def with_perturbation(**strengths: float) -> dict[str, Any]:
    """Return the override that perturbs training images in these ways only."""
    none = dict(color=0.0, pattern=0.0, patch=0.0, contrast=0.0, noise=0.0)
    return dict(vec_env_wrapper=[{"sb3_tdpg.robustness.training.VecImagePerturbation": {**none, **strengths}}])


VIB: dict[str, Any] = dict(mi_estimator="vib")
# The noise of the test rows is 0.10 to 0.25; TDPG is trained with the same patterns.
NOISE = with_perturbation(noise=0.25)
BACKGROUNDS = with_perturbation(color=0.35, pattern=0.7, patch=0.5)


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The baselines in one environment, and the recorded methods that they are compared with."""

    title: str
    env_id: str
    baselines: Sequence[Baseline]
    rows: Sequence[Scenario]  # that the policies are evaluated on
    columns: Sequence[str]  # rows, or groups of rows, that the table shows
    first_seed: int  # as in the records
    records: Path  # of the methods that are not trained again, in the folder of results
    recorded: Mapping[str, str]  # label of these methods in the records -> in the table
    digits: int = 2

    def tasks(self, n_seeds: int, folder: Path, overrides: Mapping[str, Any] = MappingProxyType({})) -> list[Task]:
        """List the runs seed by seed, so that an interrupted call has the same seeds of all baselines."""
        methods = [
            (baseline, self.first_seed + i)
            for i in range(n_seeds)
            for baseline in self.baselines
            if i < baseline.max_seeds
        ]
        return make_tasks(self.env_id, folder / self.env_id, methods, lambda _: self.rows, overrides)

    @property
    def labels(self) -> list[str]:
        """The methods in the order of the table's rows."""
        shown = (baseline.label for baseline in self.baselines if baseline.is_shown)
        return list(dict.fromkeys([*self.recorded.values(), *shown]))

    def read_recorded(self, folder: Path, n_eval_episodes: int) -> pd.DataFrame:
        """Read the episodes of the methods that are not trained again, with the labels that they have here."""
        records = pd.read_csv(folder / self.records)
        records["model"] = records["model"].replace(FORMER_LABELS).map(self.recorded)
        seeds = range(self.first_seed, self.first_seed + N_RECORDED_SEEDS)
        is_wanted = records["model"].notna() & records["train_seed"].isin(seeds)
        is_wanted &= records["scenario"].isin([row.name for row in self.rows]) & (records["episode"] < n_eval_episodes)
        return records[is_wanted].assign(env_id=self.env_id)


LAVA_BASELINES = Comparison(
    title="Lava (cost definition: text)",
    env_id="Lava-v0",
    baselines=(
        # One seed, for its time.
        Baseline("TDPG (log-det)", "Lava-v0-logdet", max_attempts=MAX_ATTEMPTS, max_seeds=1),
        Baseline("PG", "Lava-v0-pg", overrides=dict(n_timesteps=LAVA_STEPS)),
        with_weight_decay("Lava-v0-pg", LAVA_STEPS),
        Baseline("VIB", "Lava-v0-logdet", overrides=VIB, max_attempts=MAX_ATTEMPTS),
        Baseline("PPO", "Lava-v0", algo="ppo", overrides=LAVA_PPO),
        Baseline("RecurrentPPO", "Lava-v0", algo="ppo_lstm", overrides=LAVA_PPO),
    ),
    rows=LAVA,
    columns=[row.name for row in LAVA],
    first_seed=300,
    records=Path("lava", "episodes_text.csv.gz"),
    recorded={"TDPG (log-det)": "TDPG (log-det)"},
)

BALL_BASELINES = Comparison(
    title="Ball catching",
    env_id="BallCatch-v0",
    baselines=(
        Baseline("first stage", "BallCatch-v0-perturbed-pg", is_shown=False),
        # One seed, for its time.
        Baseline(
            "TDPG, perturbed images", "BallCatch-v0-two-stages", "first stage", overrides=BALL_SECOND_STAGE, max_seeds=1
        ),
        Baseline(
            "VIB, perturbed images", "BallCatch-v0-two-stages", "first stage", overrides={**VIB, **BALL_SECOND_STAGE}
        ),
        with_weight_decay("BallCatch-v0-pg", BALL_STEPS),
        Baseline("PPO", "BallCatch-v0", algo="ppo"),
        Baseline("PPO, pixel noise", "BallCatch-v0", overrides=NOISE, algo="ppo"),
        Baseline("PPO, random backgrounds", "BallCatch-v0", overrides=BACKGROUNDS, algo="ppo"),
        Baseline("RecurrentPPO", "BallCatch-v0", algo="ppo_lstm"),
    ),
    rows=[row.with_kwargs(renderer="fast") for row in BALL_CATCH],
    columns=("Training", *GROUPS),
    first_seed=100,
    records=Path("ball_catch", "episodes.csv.xz"),
    # The recorded methods that were trained for as many steps: without the penalty, in two stages, too.
    recorded={NO_PENALTY_PLAIN: "PG", NO_PENALTY: "PG, perturbed images", "TDPG": "TDPG, perturbed images"},
)

GRASP_BASELINES = Comparison(
    title="Grasping",
    env_id="PandaGrasp-v0",
    # An episode is one step: a recurrent policy has nothing to remember.
    baselines=(
        Baseline("first stage", "PandaGrasp-v0-pg", is_shown=False),
        Baseline("VIB", "PandaGrasp-v0", "first stage", overrides={**VIB, **GRASP_SECOND_STAGE}),
        with_weight_decay("PandaGrasp-v0-pg", GRASP_STEPS),
        Baseline("PPO", "PandaGrasp-v0", algo="ppo", overrides=dict(n_timesteps=GRASP_STEPS)),
    ),
    rows=PANDA_GRASP,
    columns=[row.name for row in PANDA_GRASP],
    first_seed=100,
    records=Path("panda_grasp", "episodes.csv.xz"),
    recorded={NO_PENALTY: "PG", "TDPG": "TDPG"},
    digits=3,
)


def reproduce_baselines(
    out: Path,
    *,
    n_seeds: int = 5,
    n_ball_seeds: int = 5,
    n_grasp_seeds: int = 1,
    records: Path = RECORDS,
    **options: Any,
) -> str:
    """
    Train the baselines with several seeds, evaluate them on the rows of the paper's tables; write table and records.

    :param out: Folder for ``summary.md``, ``seeds.csv``, ``episodes.csv.xz``, ``config.json`` and ``runs/``.
    :param n_seeds: Training seeds of each baseline on the lava problem.
    :param n_ball_seeds: Training seeds of each baseline on ball catching; 0 leaves it out.
    :param n_grasp_seeds: Training seeds of each baseline on grasping; 0 leaves it out.
    :param records: Folder of results, with the episodes of the methods that are not trained again.
    :param options: See :class:`~sb3_tdpg.paper.common.Options`.
    :return: the summary, as Markdown
    :raises ValueError: if these records are missing; nothing has been trained by then.
    """
    given = Options(**options)
    numbers = ((LAVA_BASELINES, n_seeds), (BALL_BASELINES, n_ball_seeds), (GRASP_BASELINES, n_grasp_seeds))
    comparisons = [(each, each.tasks(n, out / "runs", given.overrides)) for each, n in numbers if n > 0]
    if missing := [str(records / each.records) for each, _ in comparisons if not (records / each.records).exists()]:
        raise ValueError(
            f"{' and '.join(missing)} are missing: run this in the folder of the repository, or make them first with "
            "'make reproduce-lava reproduce-ball-controls reproduce-grasp'"
        )
    everything = [task for _, tasks in comparisons for task in tasks]
    complete_runs(everything, **given.of_runs)

    shown, seed_tables = {}, []
    for each, tasks in comparisons:
        trained = read_records(tasks)
        seeds = _seed_table(trained, tasks)
        seed_tables.append(seeds)
        # A recorded method is trained again for its time only.
        new = trained[trained["model"].isin(set(each.labels) - set(each.recorded.values()))]
        table = pd.concat([each.read_recorded(records, given.n_eval_episodes), new], ignore_index=True)
        has_groups = set(GROUPS) <= set(each.columns)
        table = with_groups(table) if has_groups else table
        table = table.sort_values("model", key=lambda column, each=each: column.map(each.labels.index), kind="stable")
        row_names = [row.name for row in each.rows[1:]]
        shown[each.title] = dict(
            overview=baselines_table(table, each.columns, seeds, each.digits),
            rows=baselines_table(table, row_names, digits=each.digits) if has_groups else "",
        )
    frame = read_records(everything)[["env_id", *RECORD_COLUMNS]].round({"cost": 4})
    write_frame_atomically(frame, out / "episodes.csv.xz")
    write_frame_atomically(pd.concat(seed_tables, ignore_index=True).round(4), out / "seeds.csv")
    command = "make reproduce-baselines"
    return write_results(out, "baselines.md", everything, command, given.publish, comparisons=shown)


def _seed_table(records: pd.DataFrame, tasks: Sequence[Task]) -> pd.DataFrame:
    """Return the training time of each run, with that of the run that it starts from, and its mean cost in each row."""
    keys = ["env_id", "model", "train_seed"]
    labels = records.groupby(keys, sort=False)[["attempts", "selected"]].first().reset_index()
    stages = [[folder] if run.start is None else [run.start, folder] for run, folder, _ in tasks]
    # In the order of the runs, as the records.
    times = pd.DataFrame([pd.DataFrame(map(training_time, folders)).sum() for folders in stages])
    costs = records.pivot_table("cost", keys, "scenario", sort=False).reset_index()
    return (
        pd.concat([labels, times], axis=1)
        .merge(costs, on=keys)
        .melt([*keys, "attempts", "selected", "cpu_s", "wall_s"], var_name="scenario", value_name="cost")
    )


def baselines_table(
    records: pd.DataFrame, rows: Sequence[str], seeds: pd.DataFrame | None = None, digits: int = 2
) -> str:
    """Write a table with a row for each method: its cost in each scenario, and the median time of its trainings."""
    shown = records[records["scenario"].isin(rows)]
    aggregated = aggregate_seeds(shown).set_index(["model", "scenario"])
    lowest = aggregated["iqm"].groupby("scenario").min()
    lines = []
    for model in shown["model"].unique():
        line = {"method": model, "seeds": str(aggregated.loc[(model, rows[0]), "n_seeds"])}
        for row in rows:
            cell = aggregated.loc[(model, row)]
            text = f"{cell['iqm']:.{digits}f}"
            if cell["n_seeds"] > 1:
                text += f" [{cell['low']:.{digits}f}, {cell['high']:.{digits}f}]"
            line[row] = f"**{text}**" if cell["iqm"] == lowest[row] else text
        if seeds is not None:
            times = seeds[seeds["model"] == model]
            for title, name in (("CPU time (s)", "cpu_s"), ("wall time (s)", "wall_s")):
                line[title] = f"{times[name].median():.0f}" if len(times) else "-"
        lines.append(line)
    return markdown_table(lines, align="lr")
