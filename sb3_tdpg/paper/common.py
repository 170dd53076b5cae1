"""What the reproductions share: runs of several methods, small tables, how something was made, the copy for docs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import paired_difference, probability_of_improvement
from sb3_tdpg.experiments.runs import Run, complete_runs

RECORD_COLUMNS = ["model", "train_seed", "attempts", "selected", "scenario", "episode", "cost", "seed", "deterministic"]
"""What is kept of each episode."""


@dataclass(frozen=True)
class Method:
    """
    How one column of a table is trained and evaluated.

    :param label: The column's title.
    :param block: Block of ``hyperparams/tdpg.yml``.
    :param start: Label of the method whose policy it starts from, with the same seed; ``None``: from scratch.
    :param renderer: What draws the images that it is evaluated on, where the environment has several.
    :param overrides: Settings that replace those of the block.
    """

    label: str
    block: str
    start: str | None = None
    renderer: str = "fast"
    overrides: Mapping[str, Any] = field(default_factory=dict)


class Trained:
    """
    Runs of methods, of which some start from the policy of another one with the same seed.

    :param env_id: The training environment.
    :param out: Folder for ``runs/``.
    :param everything: Methods with their seeds, each after what it starts from.
    :param overrides: Settings that replace those of every method.
    """

    def __init__(
        self, env_id: str, out: Path, everything: Sequence[tuple[Method, int]], overrides: Mapping[str, Any]
    ) -> None:
        self.everything = everything
        self.folders: dict[tuple[str, int], Path] = {}
        self.runs: dict[tuple[str, int], Run] = {}
        for method, seed in everything:
            start = None if method.start is None else self.folders[method.start, seed]
            run = Run(method.label, env_id, method.block, seed, {**method.overrides, **overrides}, start=start)
            self.runs[method.label, seed], self.folders[method.label, seed] = run, out / "runs" / run.folder_name

    def complete(
        self,
        rows: Callable[[Method], Sequence[Scenario]],
        *,
        n_eval_episodes: int,
        jobs: int | None = None,
        is_long: Callable[[Method], bool] = lambda _: False,
    ) -> None:
        """
        Complete all runs, see :func:`~sb3_tdpg.experiments.runs.complete_runs`.

        :param rows: What each method is evaluated on.
        :param n_eval_episodes: Episodes of each row.
        :param jobs: Runs at a time; default: the number of cores.
        :param is_long: What to begin with, so that the cores finish together.
        """
        tasks = [
            (self.runs[method.label, seed], self.folders[method.label, seed], rows(method))
            for method, seed in sorted(self.everything, key=lambda item: not is_long(item[0]))
        ]
        complete_runs(tasks, n_eval_episodes=n_eval_episodes, jobs=jobs)

    def records(self) -> pd.DataFrame:
        """Return the episodes of all runs."""
        return pd.concat([pd.read_csv(f / "episodes.csv") for f in self.folders.values()], ignore_index=True)

    @property
    def configs(self) -> list[dict[str, Any]]:
        """What makes the runs."""
        return [run.config for run in self.runs.values()]


def met(condition: bool) -> str:
    """Say whether a goal was met, so that a miss is seen."""
    return "met" if condition else "MISSED"


def markdown_table(frame: pd.DataFrame, digits: int = 3) -> str:
    """Write a frame as a Markdown table."""
    header = [f"| {' | '.join(frame.columns)} |", "|" + "---|" * len(frame.columns)]
    rows = frame.itertuples(index=False)
    cells = ([f"{x:.{digits}f}" if isinstance(x, float) else str(x) for x in row] for row in rows)
    return "\n".join([*header, *(f"| {' | '.join(row)} |" for row in cells)])


def goals_table(aggregated: pd.DataFrame, goals: Mapping[str, Mapping[str, float]]) -> str:
    """
    Hold interquartile means against goals.

    :param aggregated: From :func:`~sb3_tdpg.evaluation.aggregate_seeds`.
    :param goals: The largest value by method and row.
    """
    cells = aggregated.set_index(["model", "scenario"])["iqm"]
    rows = [
        dict(
            method=method,
            row=row,
            goal=f"<= {goal:g}",
            ours=f"{cells[method, row]:.3g}",
            verdict=met(cells[method, row] <= goal),
        )
        for method, of_method in goals.items()
        for row, goal in of_method.items()
    ]
    return markdown_table(pd.DataFrame(rows))


def comparisons_table(
    table: pd.DataFrame, comparisons: Sequence[tuple[str, str]], kinds: Mapping[str, Sequence[str]]
) -> str:
    """
    Say how likely a seed of one method beats a seed of another, and by how much, seed by seed.

    :param table: Records with a column ``train_seed``.
    :param comparisons: Labels of a method and of what it is compared with; left out if one is not there.
    :param kinds: Rows over which the mean is taken, by name.
    """
    rows = []
    models = set(table["model"])
    for model, control in comparisons:
        if not {model, control} <= models:
            continue
        for name, members in kinds.items():
            part = table[table["scenario"].isin(members)]
            better, difference = (f(part, model, control) for f in (probability_of_improvement, paired_difference))
            cost = part.groupby("model")["cost"].mean()
            rows.append(
                {
                    "method": model,
                    "against": control,
                    "rows": name,
                    "P(improvement) [95 %]": "{:.2f} [{:.2f}, {:.2f}]".format(*better),
                    "mean cost": f"{cost[model]:.3g}",
                    "of the other": f"{cost[control]:.3g}",
                    "difference [95 %]": "{:+.3g} [{:+.3g}, {:+.3g}]".format(*difference),
                }
            )
    return markdown_table(pd.DataFrame(rows))


def commits_of(folders: Sequence[Path]) -> list[str]:
    """Return the commits at which the runs were made: more than one if the reproduction was resumed after a change."""
    gits = (json.loads((folder / "config.json").read_text())["provenance"]["git"] for folder in folders)
    return sorted({git["commit"][:7] for git in gits if git is not None})


def how_made(command: str, how: Mapping[str, Any], commits: Sequence[str]) -> str:
    """
    Say in a sentence how a summary was made.

    :param command: What makes it again.
    :param how: From :func:`~sb3_tdpg.common.provenance.provenance`.
    :param commits: Those of the runs.
    """
    versions = ", ".join(f"{name} {version}" for name, version in how["versions"].items() if version)
    git = how["git"]
    commit = (
        "outside a checkout" if git is None else git["commit"] + (" with uncommitted changes" if git["dirty"] else "")
    )
    runs = f"runs at {', '.join(commits)}; " if commits else ""
    return f"Made by `{command}` at commit {commit}, {runs}{how['utc_time']}, {versions}. {how['platform']}."


def publish_files(out: Path, publish: Path) -> None:
    """Copy the files of a folder, but not the folders in it."""
    publish.mkdir(parents=True, exist_ok=True)
    for path in out.iterdir():
        if path.is_file():
            shutil.copy2(path, publish / path.name)
