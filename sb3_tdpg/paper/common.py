"""Define the runs of a reproduction, and write the tables and files of its results."""

import json
import math
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.markdown import fill_template, markdown_table
from sb3_tdpg.common.provenance import how_made, provenance, write_frame_atomically, write_run_config
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import aggregate_seeds, paired_difference, probability_of_improvement
from sb3_tdpg.experiments.runs import Run, SB3Run, Task

NO_PENALTY = "TDPG without the penalty"
"""Label of the ablation, which differs from TDPG only in the missing penalty."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """
    The options of every reproduction. The same call continues an interrupted reproduction, and keeps finished runs.

    :param n_eval_episodes: Number of evaluation episodes of each scenario.
    :param n_timesteps: Environment steps of each training; default: the number in the method's block of settings.
    :param jobs: Number of parallel runs; default: the number of cores.
    :param publish: Folder for a copy of all files except ``runs/``.
    """

    n_eval_episodes: int = 1000
    n_timesteps: int | None = None
    jobs: int | None = None
    publish: Path | None = None

    @property
    def overrides(self) -> dict[str, Any]:
        """The settings that replace the settings of the blocks."""
        return {} if self.n_timesteps is None else {"n_timesteps": self.n_timesteps}

    @property
    def of_runs(self) -> dict[str, Any]:
        """The options that are arguments of :func:`~sb3_tdpg.experiments.runs.complete_runs`."""
        return dict(n_eval_episodes=self.n_eval_episodes, jobs=self.jobs)


@dataclass(frozen=True)
class Method:
    """A method with the name ``label``: how it is trained (see ``Run``) and evaluated."""

    label: str
    block: str
    start: str | None = None  # label of the method that trained the initial policy with the same seed
    renderer: str = "fast"  # renderer of the evaluation, if the environment has several
    overrides: Mapping[str, Any] = field(default_factory=dict)
    max_attempts: int = 1
    algo: str = "tdpg"  # or "ppo", "ppo_lstm"; the block is in hyperparams/<algo>.yml
    max_seeds: float = math.inf  # fewer for expensive methods

    def run(self, env_id: str, seed: int, start: Path | None = None, **overrides: Any) -> Run:
        """Return the run of this method with one seed."""
        run = Run(self.label, env_id, self.block, seed, {**self.overrides, **overrides}, self.max_attempts, start)
        return run if self.algo == "tdpg" else SB3Run(**vars(run), algo=self.algo)


def seed_by_seed(methods: Sequence[Method], first_seed: int, n_seeds: int) -> list[tuple[Method, int]]:
    """List the methods seed by seed, so that an interrupted reproduction has the same seeds for all methods."""
    return [(method, first_seed + i) for i in range(n_seeds) for method in methods if i < method.max_seeds]


def make_tasks(
    env_id: str,
    folder: Path,
    methods: Iterable[tuple[Method, int]],
    rows: Callable[[Method], Sequence[Scenario]],
    overrides: Mapping[str, Any],
) -> list[Task]:
    """
    Return a task for each method and seed: its run, its folder, and the scenarios for its evaluation.

    A method that starts from the policy of another method must come after that method.
    """
    tasks: list[Task] = []
    for method, seed in methods:
        start = None if method.start is None else folders_of(tasks)[method.start, seed]
        run = method.run(env_id, seed, start, **overrides)
        tasks.append((run, folder / run.folder_name, rows(method)))
    return tasks


def folders_of(tasks: Iterable[Task]) -> dict[tuple[str, int], Path]:
    """Return the folder of each method and seed."""
    return {(run.method, run.seed): folder for run, folder, _ in tasks}


def read_records(tasks: Iterable[Task]) -> pd.DataFrame:
    """Return the episodes of finished runs."""
    return pd.concat([pd.read_csv(folder / "episodes.csv") for _, folder, _ in tasks], ignore_index=True)


def means_by_seed(records: pd.DataFrame, *columns: str) -> pd.DataFrame:
    """Return the means of columns (default: the cost) over the episodes of each method, seed and scenario."""
    groups = records.groupby(["model", "train_seed", "scenario"], sort=False)
    return groups[list(columns or ["cost"])].mean().reset_index()


def training_times(tasks: Iterable[Task]) -> pd.DataFrame:
    """Return the training time ``wall_s`` and ``cpu_s`` of each run, including failed attempts."""
    rows = []
    for run, folder, _ in tasks:
        times = [json.loads(path.read_text()) for path in (folder / "time.json", *folder.glob("attempt*/time.json"))]
        rows.append(dict(model=run.method, train_seed=run.seed, **pd.DataFrame(times)[["wall_s", "cpu_s"]].sum()))
    return pd.DataFrame(rows)


def methods_table(records: pd.DataFrame, rows: Sequence[str], times: pd.DataFrame) -> str:
    """
    Make a table with a row for each method: the interquartile mean of its cost in each scenario, and the median of its
    training time.

    :param times: From :func:`training_times`.
    """
    shown = records[records["scenario"].isin(rows)]
    aggregated = aggregate_seeds(shown).set_index(["model", "scenario"])
    lowest = aggregated["iqm"].groupby("scenario").min()
    medians = times.groupby("model")[["cpu_s", "wall_s"]].median().map("{:.0f}".format)
    lines = []
    for model in shown["model"].unique():
        line = {"method": model, "seeds": str(aggregated.loc[(model, rows[0]), "n_seeds"])}
        for row in rows:
            cell = aggregated.loc[(model, row)]
            text = f"{cell['iqm']:.2f}"
            if cell["n_seeds"] > 1:
                text += f" [{cell['low']:.2f}, {cell['high']:.2f}]"
            line[row] = f"**{text}**" if cell["iqm"] == lowest[row] else text
        line["CPU time (s)"], line["wall time (s)"] = medians.loc[model]
        lines.append(line)
    return markdown_table(lines, align="lr")


def met(condition: bool) -> str:
    """Return "met" or "MISSED"; the capitals make a missed goal easy to see."""
    return "met" if condition else "MISSED"


def goals_table(aggregated: pd.DataFrame, goals: Mapping[str, Mapping[str, float]]) -> str:
    """Compare the interquartile means of ``aggregate_seeds`` with their upper limits, given for each method and row."""
    cells = aggregated.set_index(["model", "scenario"])["iqm"]
    rows = [
        [method, row, f"<= {goal:g}", f"{cells[method, row]:.3g}", met(cells[method, row] <= goal)]
        for method, of_method in goals.items()
        for row, goal in of_method.items()
    ]
    return markdown_table(rows, ["method", "row", "goal", "result", "verdict"])


def comparisons_table(
    table: pd.DataFrame,
    comparisons: Sequence[tuple[str, str]],
    kinds: Mapping[str, Sequence[str]],
    quantity: str = "mean cost",
) -> str:
    """
    Make a table with the probability that one method is better than another, and the paired difference of their means.

    The probability compares one random seed of each method. Each mean is over the rows of one of ``kinds``, and over
    the seeds that both methods have. A pair is left out if one of its methods has no records.
    """
    columns = ["method", "compared with", "rows", "seeds", "probability of being better [95 %]"]
    columns += [f"{quantity} of the method", f"{quantity} of the other", "difference [95 %]"]
    rows = []
    of_model = table.groupby("model")["train_seed"].unique().map(set)
    for model, other in [pair for pair in comparisons if set(pair) <= set(table["model"])]:
        seeds = of_model[model] & of_model[other]
        for name, members in kinds.items():
            part = table[table["scenario"].isin(members) & table["train_seed"].isin(seeds)]
            better = "{:.2f} [{:.2f}, {:.2f}]".format(*probability_of_improvement(part, model, other))
            difference = "{:+.3g} [{:+.3g}, {:+.3g}]".format(*paired_difference(part, model, other))
            costs = part.groupby("model")["cost"].mean()[[model, other]].map("{:.3g}".format)
            rows.append([model, other, name, str(len(seeds)), better, *costs, difference])
    return markdown_table(rows, columns)


def write_knowledge(knowledge: pd.DataFrame, by: Sequence[str], out: Path) -> str:
    """Write ``knowledge.csv``, and return a table of its means over seeds; ``by`` are the columns that define a row."""
    write_frame_atomically(knowledge, out / "knowledge.csv")
    means = knowledge.drop(columns="train_seed").groupby(list(by), sort=False).mean().reset_index()
    return markdown_table(means.rename(columns=dict(model="method")), digits=2)


def write_results(
    out: Path, template: str, tasks: Sequence[Task], command: str, publish: Path | None, **values: Any
) -> str:
    """Write ``summary.md`` and ``config.json``, copy all files but not ``runs/`` to ``publish``; return the summary."""
    how = provenance()
    write_run_config(out / "config.json", dict(runs=[run.config for run, *_ in tasks], provenance=how))
    # There are several commits if the reproduction was resumed after a change.
    gits = [json.loads((folder / "config.json").read_text())["provenance"]["git"] for _, folder, _ in tasks]
    commits = sorted({git["commit"][:7] for git in gits if git is not None})
    summary = fill_template("sb3_tdpg.paper", template, made=how_made(command, how, commits), **values)
    write_atomically(out / "summary.md", summary)
    if publish is not None:
        publish.mkdir(parents=True, exist_ok=True)
        for path in filter(Path.is_file, out.iterdir()):
            shutil.copy2(path, publish)
    return summary
