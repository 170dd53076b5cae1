"""Compare TDPG with baselines on lava and grasping: PPO, recurrent PPO, weight decay, VIB."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd

from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.common.provenance import write_frame_atomically
from sb3_tdpg.envs.scenarios import LAVA, PANDA_GRASP, Scenario
from sb3_tdpg.evaluation import aggregate_seeds
from sb3_tdpg.experiments.runs import Task, complete_runs
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.paper.common import (
    NO_PENALTY,
    RECORD_COLUMNS,
    Method,
    Options,
    make_tasks,
    read_records,
    seed_by_seed,
    write_results,
)
from sb3_tdpg.paper.grasp import TDPG_SECOND_STAGE as GRASP_SECOND_STAGE
from sb3_tdpg.paper.lava_tables import MAX_ATTEMPTS

# The number of environment steps of TDPG, in both of its stages if it has two.
LAVA_STEPS, GRASP_STEPS = 1.5e6, 3.2e4
# With the block's minibatches of 500 an update makes 50 optimiser steps instead of 10, and a training takes twice as
# long.
LAVA_PPO = dict(n_timesteps=LAVA_STEPS, batch_size=2500)

RECORDS = Path("docs", "results")
"""Folder with the records of the methods that are not trained again, from the other reproductions."""
N_RECORDED_SEEDS = 5
FORMER_LABELS = {"its control": NO_PENALTY}
"""Label of the ablation in older records."""


def training_time(folder: Path) -> dict[str, float]:
    """Return the total ``wall_s`` and ``cpu_s`` of the training of a run, including failed attempts."""
    times = [json.loads(path.read_text()) for path in (folder / "time.json", *folder.glob("attempt*/time.json"))]
    return {name: sum(each[name] for each in times) for name in ("wall_s", "cpu_s")}


def with_weight_decay(block: str, n_timesteps: float) -> Method:
    """Return PG with a weight decay of the policy's optimiser (Adam's: an L2 penalty)."""
    # On seed 350 of the lava problem, 1e-3 was better than 1e-2.
    policy_kwargs = {**load_hyperparams(block)["policy_kwargs"], "optimizer_kwargs": dict(weight_decay=1e-3)}
    return Method("PG, weight decay", block, overrides=dict(n_timesteps=n_timesteps, policy_kwargs=policy_kwargs))


VIB: dict[str, Any] = dict(mi_estimator="vib")


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """The baselines in one environment, and the recorded methods that they are compared with."""

    title: str
    env_id: str
    baselines: Sequence[Method]
    rows: Sequence[Scenario]  # that the policies are evaluated on, and the columns of the table
    first_seed: int  # as in the records
    records: Path  # of the methods that are not trained again, in the folder of results
    recorded: Mapping[str, str]  # label of these methods in the records -> in the table
    digits: int = 2

    def tasks(self, n_seeds: int, folder: Path, overrides: Mapping[str, Any] = MappingProxyType({})) -> list[Task]:
        """List the runs."""
        methods = seed_by_seed(self.baselines, self.first_seed, n_seeds)
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
        Method("TDPG (log-det)", "Lava-v0-logdet", max_attempts=MAX_ATTEMPTS, max_seeds=1),
        Method("PG", "Lava-v0-pg", overrides=dict(n_timesteps=LAVA_STEPS)),
        with_weight_decay("Lava-v0-pg", LAVA_STEPS),
        Method("VIB", "Lava-v0-logdet", overrides=VIB, max_attempts=MAX_ATTEMPTS),
        Method("PPO", "Lava-v0", algo="ppo", overrides=LAVA_PPO),
        Method("RecurrentPPO", "Lava-v0", algo="ppo_lstm", overrides=LAVA_PPO),
    ),
    rows=LAVA,
    first_seed=300,
    records=Path("lava", "episodes_text.csv.gz"),
    recorded={"TDPG (log-det)": "TDPG (log-det)"},
)

GRASP_BASELINES = Comparison(
    title="Grasping",
    env_id="PandaGrasp-v0",
    # An episode is one step: a recurrent policy has nothing to remember.
    baselines=(
        Method("first stage", "PandaGrasp-v0-pg", is_shown=False),
        Method("VIB", "PandaGrasp-v0", "first stage", overrides={**VIB, **GRASP_SECOND_STAGE}),
        with_weight_decay("PandaGrasp-v0-pg", GRASP_STEPS),
        Method("PPO", "PandaGrasp-v0", algo="ppo", overrides=dict(n_timesteps=GRASP_STEPS)),
    ),
    rows=PANDA_GRASP,
    first_seed=100,
    records=Path("panda_grasp", "episodes.csv.xz"),
    recorded={NO_PENALTY: "PG", "TDPG": "TDPG"},
    digits=3,
)


def reproduce_baselines(
    out: Path,
    *,
    n_seeds: int = 5,
    n_grasp_seeds: int = 1,
    records: Path = RECORDS,
    **options: Any,
) -> str:
    """
    Train the baselines with several seeds, evaluate them on the rows of the paper's tables; write table and records.

    :param out: Folder for ``summary.md``, ``seeds.csv``, ``episodes.csv.xz``, ``config.json`` and ``runs/``.
    :param n_seeds: Training seeds of each baseline on the lava problem.
    :param n_grasp_seeds: Training seeds of each baseline on grasping; 0 leaves it out.
    :param records: Folder of results, with the episodes of the methods that are not trained again.
    :param options: See :class:`~sb3_tdpg.paper.common.Options`.
    :return: the summary, as Markdown
    :raises ValueError: if these records are missing; nothing has been trained by then.
    """
    given = Options(**options)
    numbers = ((LAVA_BASELINES, n_seeds), (GRASP_BASELINES, n_grasp_seeds))
    comparisons = [(each, each.tasks(n, out / "runs", given.overrides)) for each, n in numbers if n > 0]
    if missing := [str(records / each.records) for each, _ in comparisons if not (records / each.records).exists()]:
        raise ValueError(
            f"{' and '.join(missing)} are missing: run this in the folder of the repository with the records of the "
            "release in docs/results, or make them first with 'make reproduce-lava reproduce-grasp'"
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
        table = table.sort_values("model", key=lambda column, each=each: column.map(each.labels.index), kind="stable")
        shown[each.title] = baselines_table(table, [row.name for row in each.rows], seeds, each.digits)
    frame = read_records(everything)[["env_id", *RECORD_COLUMNS]].round({"cost": 4})
    write_frame_atomically(frame, out / "episodes.csv.xz")
    write_frame_atomically(pd.concat(seed_tables, ignore_index=True).round(4), out / "seeds.csv")
    command = "make reproduce-baselines"
    return write_results(out, "baselines.md", everything, command, given.publish, comparisons=shown)


def training_times(tasks: Sequence[Task]) -> pd.DataFrame:
    """Return the training time of each run, with that of the run that it starts from."""
    stages = [(run, [folder] if run.start is None else [run.start, folder]) for run, folder, _ in tasks]
    rows = [(run, pd.DataFrame(map(training_time, folders)).sum()) for run, folders in stages]
    return pd.DataFrame([dict(model=run.method, train_seed=run.seed, **seconds) for run, seconds in rows])


def _seed_table(records: pd.DataFrame, tasks: Sequence[Task]) -> pd.DataFrame:
    """Return the training time of each run, and its mean cost in each row."""
    keys = ["env_id", "model", "train_seed"]
    labels = records.groupby(keys, sort=False)[["attempts", "selected"]].first().reset_index()
    costs = records.pivot_table("cost", keys, "scenario", sort=False).reset_index()
    return (
        labels.merge(training_times(tasks), on=keys[1:])
        .merge(costs, on=keys)
        .melt([*keys, "attempts", "selected", "cpu_s", "wall_s"], var_name="scenario", value_name="cost")
    )


def baselines_table(
    records: pd.DataFrame, rows: Sequence[str], seeds: pd.DataFrame | None = None, digits: int = 2
) -> str:
    """
    Write a table with a row for each method: its cost in each scenario, and the median time of its trainings.

    :param seeds: ``model``, ``cpu_s`` and ``wall_s`` of each training.
    """
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
