"""Reproduce Table I (the lava problem) in a quick demonstration, or completely with many seeds."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.common.provenance import write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import threads
from sb3_tdpg.envs.scenarios import LAVA, LAVA_TABLE_READING
from sb3_tdpg.evaluation import (
    add_ratio,
    aggregate_seeds,
    comparison_markdown,
    save_figure,
    summary_table,
    training_curves,
)
from sb3_tdpg.experiments.runs import complete_run, complete_runs, read_progress
from sb3_tdpg.paper import common
from sb3_tdpg.paper.common import Method
from sb3_tdpg.paper.plots import cost_histograms, lava_trajectories
from sb3_tdpg.tdpg import TDPG

READINGS = ("table", "text")
"""Cost definitions of the lava problem: the one that fits Table I better, and the one in the text of the paper."""

# The block of hyperparams/tdpg.yml for each method. With the cost definition of the table it has the suffix "-table".
METHODS = {"PG": "Lava-v0-pg", "TDPG": "Lava-v0", "TDPG (log-det)": "Lava-v0-logdet"}

# Upper limits of the mean and standard deviation of the cost in training, and of the ratio (the mean cost at
# sigma^2 = 1 divided by the mean cost in training).
_TABLE_GOALS, _TEXT_GOALS = dict(mean=28.0, std=10.0, ratio=1.05), dict(mean=20.0, std=10.0, ratio=1.10)
GOALS: Mapping[str, Mapping[str, Mapping[str, float]]] = {
    "table": {"PG": dict(mean=14.0), "TDPG": _TABLE_GOALS, "TDPG (log-det)": _TABLE_GOALS},
    "text": {"PG": dict(mean=12.0), "TDPG": _TEXT_GOALS, "TDPG (log-det)": _TEXT_GOALS},
}

PAPER_INVERSE_BETAS = (25, 50, 75, 100)

# Seeds below 300 were used to tune the blocks.
FIRST_SEED = 300

# Maximum number of trainings of a policy with a penalty. A training is repeated only if it missed the block's limits.
MAX_ATTEMPTS = 3

TITLES = {
    "table": "Cost definition: table",
    "text": "Cost definition: text",
    "paper": "The paper's own settings (cost definition: table)",
}
RECORD_COLUMNS = ["model", "train_seed", "attempts", "selected", "scenario", "episode", "cost", "seed", "deterministic"]
SEED_COLUMNS = dict(model="method", train_seed="seed", attempts="trainings", selected="limits met")
COLUMNS = dict(mean="mean cost in training", std="standard deviation", ratio="ratio")


def methods(reading: str) -> list[Method]:
    """List PG and TDPG with each estimator for a cost definition, or with the paper's settings for ``"paper"``."""
    if reading == "paper":
        tdpg = [
            Method(f"paper's TDPG, 1/beta = {inverse}", "Lava-v0-paper", overrides=dict(beta=1 / inverse))
            for inverse in PAPER_INVERSE_BETAS
        ]
        return [Method("paper's PG", "Lava-v0-paper-pg"), *tdpg]
    suffix = "-table" if reading == "table" else ""
    return [
        Method(label, block + suffix, max_attempts=1 if label == "PG" else MAX_ATTEMPTS)
        for label, block in METHODS.items()
    ]


def _write_figures(
    out: Path, suffix: str, records: pd.DataFrame, folders: Mapping[str, Path], models: Mapping[str, TDPG], reading: str
) -> None:
    """Draw the figures of one seed; the keys of ``folders`` and ``models`` are the names of the methods."""
    env_kwargs = dict(LAVA_TABLE_READING) if reading == "table" else {}
    save_figure(cost_histograms(records, LAVA), out / f"histograms{suffix}.png")
    save_figure(lava_trajectories(models, env_kwargs), out / f"trajectories{suffix}.png")
    save_figure(training_curves({m: read_progress(f) for m, f in folders.items()}), out / f"training{suffix}.png")


def demo(
    out: Path, *, reading: str = "table", seed: int = 0, n_eval_episodes: int = 1000, n_timesteps: int | None = None
) -> str:
    """
    Train PG and TDPG on the lava problem, compare them on the rows of Table I, and draw figures.

    ``seed`` is the training seed, and the other parameters are those of :class:`~sb3_tdpg.paper.common.Options`.

    :param out: Folder for ``episodes.csv``, ``table.md``, ``histograms.png``, ``trajectories.png``, ``training.png``,
        ``config.json`` and the runs with their models.
    :param reading: The cost definition, ``"table"`` or ``"text"``.
    :return: the table, as Markdown
    """
    overrides = common.Options(n_timesteps=n_timesteps).overrides
    pair = [(method, seed) for method in methods(reading)[:2]]
    tasks = common.make_tasks("Lava-v0", out / "runs", pair, lambda _: LAVA, overrides)
    folders = {run.method: folder for run, folder, _ in tasks}
    with threads(1):
        for task in tasks:
            print(f"{task[0].method}: training and evaluating, {task[1]}")
            complete_run(*task, n_eval_episodes=n_eval_episodes, progress_bar=True)

        records = common.read_records(tasks)
        models = {method: TDPG.load(folder / "model.zip", device="cpu") for method, folder in folders.items()}
        table = comparison_markdown(summary_table(records).drop(columns="train_seed"), LAVA)
        write_frame_atomically(records, out / "episodes.csv")
        write_atomically(out / "table.md", table + "\n")
        _write_figures(out, "", records, folders, models, reading)
        for method, model in models.items():
            model.save(out / f"{method.lower()}.zip")
    write_run_config(out / "config.json", dict(reading=reading, runs=[run.config for run, *_ in tasks]))
    return table


def reproduce_lava(out: Path, *, n_seeds: int = 10, n_paper_seeds: int = 3, **options: Any) -> str:
    """
    Train all methods with many seeds on the lava problem, and write tables, figures and records.

    Every method is trained with both cost definitions, and policies are also trained with the paper's own settings.

    :param out: Folder for ``summary.md``, ``seeds.csv``, ``episodes_*.csv.gz``, figures, ``config.json`` and ``runs/``.
    :param n_seeds: Number of training seeds of each method.
    :param n_paper_seeds: Number of training seeds for the paper's own settings.
    :param options: See :class:`~sb3_tdpg.paper.common.Options`.
    :return: the summary, as Markdown
    """
    given = common.Options(**options)
    seeds = range(FIRST_SEED, FIRST_SEED + n_seeds)
    runs = {reading: [(method, seed) for method in methods(reading) for seed in seeds] for reading in READINGS}
    runs["paper"] = common.seed_by_seed(methods("paper"), FIRST_SEED, n_paper_seeds)
    tasks = {
        group: common.make_tasks("Lava-v0", out / "runs" / group, of_group, lambda _: LAVA, given.overrides)
        for group, of_group in runs.items()
    }
    everything = [task for of_group in tasks.values() for task in of_group]
    # The longest runs come first, so that the cores finish at about the same time.
    longest_first = sorted(everything, key=lambda task: (task[0].method != "TDPG", task[0].method == "PG"))
    complete_runs(longest_first, **given.of_runs)

    groups, seed_tables = {}, []
    for group, of_group in tasks.items():
        records = common.read_records(of_group)
        write_frame_atomically(records[RECORD_COLUMNS].round({"cost": 4}), out / f"episodes_{group}.csv.gz")
        by_seed = _seed_table(records)
        seed_tables.append(by_seed.assign(group=group))
        groups[TITLES[group]] = dict(
            comparison=comparison_markdown(aggregate_seeds(records), LAVA),
            goals=_goals_table(by_seed, GOALS.get(group, {})),
            seeds=markdown_table(by_seed.rename(columns={**SEED_COLUMNS, **COLUMNS})),
        )
        if group in READINGS:
            folders = {method: common.folders_of(of_group)[method, FIRST_SEED] for method in METHODS}
            models = {method: TDPG.load(folder / "model.zip", device="cpu") for method, folder in folders.items()}
            one_seed = records[(records["train_seed"] == FIRST_SEED) & records["model"].isin(["PG", "TDPG"])]
            _write_figures(out, f"_{group}", one_seed, folders, models, group)
    write_frame_atomically(pd.concat(seed_tables, ignore_index=True), out / "seeds.csv")
    return common.write_results(out, "lava.md", everything, "make reproduce-lava", given.publish, groups=groups)


def _seed_table(records: pd.DataFrame) -> pd.DataFrame:
    """Return mean and standard deviation of the cost in training and the noisiest row's ratio, by method and seed."""
    summary = add_ratio(summary_table(records))
    keys = ["model", "train_seed"]
    training = summary[summary["scenario"] == LAVA[0].name].set_index(keys)[["mean", "std"]]
    noisiest = summary[summary["scenario"] == LAVA[-1].name].set_index(keys)[["ratio"]]
    return training.join(noisiest).join(records.groupby(keys)[["attempts", "selected"]].first()).reset_index()


def _goals_table(seeds: pd.DataFrame, goals: Mapping[str, Mapping[str, float]]) -> str:
    """Summarise the seeds of each method, and compare them with the goals of the method."""
    rows = []
    for method, of_method in seeds.groupby("model", sort=False):
        spread = {
            f"{name}: mean (worst seed)": f"{of_method[c].mean():.3g} ({of_method[c].max():.3g})"
            for c, name in COLUMNS.items()
        }
        verdict = _verdict(of_method, goals[str(method)]) if method in goals else "none set"
        rows.append(dict(method=method, seeds=len(of_method), **spread, goals=verdict))
    return markdown_table(rows)


def _verdict(seeds: pd.DataFrame, goals: Mapping[str, float]) -> str:
    names = dict(mean="mean", std="standard deviation", ratio="ratio")
    verdicts = {column: common.met(seeds[column].mean() <= goal) for column, goal in goals.items()}
    if "ratio" in goals:
        verdicts["ratio"] = f"{(seeds['ratio'] <= goals['ratio']).sum()} of {len(seeds)} seeds"
    return "; ".join(f"{names[column]} <= {goal:g}: {verdicts[column]}" for column, goal in goals.items())
