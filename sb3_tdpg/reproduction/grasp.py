"""Grasping from training to tables: policy gradient, TDPG, and the control of the penalty."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
import torch as th

from sb3_tdpg.envs.scenarios import PANDA_DRINK, PANDA_GRASP, PANDA_GRASP_DRINK, Scenario
from sb3_tdpg.evaluation import (
    aggregate_seeds,
    comparison_markdown,
    draw_mugs,
    encode_mugs,
    failures_by_level,
    failures_by_yaw,
    grasp_knowledge,
    provenance,
    save_figure,
    training_curves,
    write_frame_atomically,
    write_run_config,
)
from sb3_tdpg.files import write_atomically
from sb3_tdpg.information import InformationBatch, LeaveOneOut, LogDet, Mine, own_sample_bound
from sb3_tdpg.reproduction.common import (
    Method,
    Trained,
    commits_of,
    comparisons_table,
    goals_table,
    how_made,
    markdown_table,
    publish_files,
)
from sb3_tdpg.runs import read_progress, torch_threads
from sb3_tdpg.tdpg import TDPG

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Seeds below 100 were seen while the blocks were made.
FIRST_SEED = 100

TRAINING, ROTATION, TRANSLATION = (row.name for row in PANDA_GRASP)

TRAINING_X = (0.45, 0.55)  # m

# The largest interquartile mean over seeds of the share of failures, by method and row.
GOALS: Mapping[str, Mapping[str, float]] = {
    "PG": {TRAINING: 0.02, ROTATION: 0.08, TRANSLATION: 0.15},
    "TDPG": {TRAINING: 0.03, ROTATION: 0.08, TRANSLATION: 0.15},
}

COMPARISONS = (("TDPG", "its control"), ("TDPG", "PG"))
SECOND_STAGE = dict(n_timesteps=8_000)


def _methods(block: str) -> tuple[Method, ...]:
    """Return PG, and TDPG and its control from there, which differ in nothing but the penalty."""
    return (
        Method("PG", f"{block}-pg"),
        Method("TDPG", block, "PG", overrides=SECOND_STAGE),
        Method("its control", f"{block}-pg", "PG", overrides=SECOND_STAGE),
    )


@dataclass(frozen=True)
class Experiment:
    """
    What is trained on which mugs, and shown how.

    :param title: Of the summary.
    :param command: What makes it.
    :param methods: The columns of the table.
    :param rows: Its rows. Of the mugs of the first two is told what the TRVs know.
    :param figure: File name of a figure of failures.
    :param draw: What draws it, from the records.
    :param goals: Largest share of failures by method and row.
    :param compares_estimates: Whether MINE's estimates are held against the bounds.
    """

    title: str
    command: str
    methods: tuple[Method, ...]
    rows: Sequence[Scenario]
    figure: str
    draw: Callable[[pd.DataFrame], Figure]
    goals: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    compares_estimates: bool = False


def _draw_yaw(records: pd.DataFrame) -> Figure:
    return failures_by_yaw(records[records["scenario"] == ROTATION])


def _draw_level(records: pd.DataFrame) -> Figure:
    first, last = PANDA_DRINK["level_range"]
    of_row = records[records["scenario"] == PANDA_GRASP_DRINK[1].name]
    low, high = TRAINING_X
    told = low + (high - low) * (of_row["level"] - first) / (last - first)
    return failures_by_level(of_row.assign(error=told - of_row["x"]))


EXPERIMENTS = {
    "empty": Experiment(
        "Grasping (Table III)",
        "make reproduce-grasp",
        _methods("PandaGrasp-v0"),
        PANDA_GRASP,
        "yaw.png",
        _draw_yaw,
        GOALS,
        compares_estimates=True,
    ),
    "drink": Experiment(
        "Grasping (mugs with a drink)",
        "make reproduce-grasp-drink",
        _methods("PandaGrasp-v0-drink"),
        PANDA_GRASP_DRINK,
        "level.png",
        _draw_level,
    ),
}

QUANTITY = "share of failed grasps"
COMPARISON = (
    "Probability that a seed of the method fails less often in these rows than a seed of what it is compared with: 0.5 "
    "is no difference."
)
KNOWLEDGE = (
    "Share of the variance (R^2 on mugs left out of the regression, mean over seeds) of what makes a mug's image (of "
    "its yaw: of sine and cosine) that TRVs, their squares and products explain, on mugs of two rows of the table. And "
    "bounds on the information in nats: I[x; x~] itself lies between them, since the image is a function of the state "
    "and there is no memory. The lower one cannot exceed ln 2000 = 7.6."
)
ESTIMATES = (
    "Of the first seed's policies, in nats. A fitted critic's estimate bounds the information from below on fresh "
    "mugs; on those that it was fitted to it does not bound it at all. Critics are fitted to PG first (the paper's in "
    "500,000 steps, ours in 2,000), and then go on with TDPG (for 100,000 and 1,000)."
)
N_MUGS = 10_000  # for the regression
N_BOUND = 2_000  # for the bounds, which compare every mug with every other
FITTED_MUGS = 400  # for MINE, as in an epoch
CRITICS: Mapping[str, Mapping[str, Any]] = {
    # Without guards, and with one optimiser from beginning to end.
    "MINE, as the paper prints it": dict(
        learning_rate=5e-5,
        warmup_gradient_steps=500_000,
        gradient_steps=100_000,
        refit_below=-math.inf,
        refit_above=math.inf,
        reset_moments=False,
    ),
    "MINE at 1e-3": dict(gradient_steps=1000),
    "MINE at 1e-3, standardised state": dict(gradient_steps=1000, standardize=True),
}


def reproduce_grasp(
    out: Path,
    *,
    mug: str = "empty",
    n_seeds: int = 5,
    n_eval_episodes: int = 1000,
    n_timesteps: int | None = None,
    jobs: int | None = None,
    publish: Path | None = None,
) -> str:
    """
    Train every method with several seeds, evaluate it on every row; write tables, figures and records.

    Finished runs are kept: the same call goes on where an interrupted one stopped.

    :param out: Folder for ``summary.md``, ``seeds.csv``, ``episodes.csv.xz``, figures, ``config.json`` and ``runs/``.
    :param mug: ``"empty"``, Table III; or ``"drink"``, a scenario of our own.
    :param n_seeds: Training seeds of each method.
    :param n_eval_episodes: Episodes of each row.
    :param n_timesteps: Environment steps of each training; default: as in the blocks.
    :param jobs: Runs at a time; default: the number of cores.
    :param publish: Folder that gets a copy of everything but ``runs/``.
    :return: the summary, as Markdown
    """
    experiment = EXPERIMENTS[mug]
    methods, rows = experiment.methods, experiment.rows
    seeds = range(FIRST_SEED, FIRST_SEED + n_seeds)
    overrides = {} if n_timesteps is None else {"n_timesteps": n_timesteps}
    trained = Trained("PandaGrasp-v0", out, [(m, seed) for m in methods for seed in seeds], overrides)
    trained.complete(lambda _: rows, n_eval_episodes=n_eval_episodes, jobs=jobs)
    folders = trained.folders

    # Where the mug stood, and how it was grasped.
    poses = {f"final_mug_{i}": name for i, name in ((0, "x"), (1, "y"), (3, "yaw"))}
    poses.update({f"final_grasp_{i}": f"grasp_{name}" for i, name in enumerate(("x", "y", "z", "yaw"))})
    records = trained.records()
    if "final_state_4" in records:
        poses["final_state_4"] = "level"
    records = records.rename(columns=poses)
    columns = ["model", "train_seed", "scenario", "episode", "cost", *poses.values(), "seed", "deterministic"]
    write_frame_atomically(records[columns].round(dict.fromkeys(poses.values(), 6)), out / "episodes.csv.xz")
    save_figure(experiment.draw(records), out / experiment.figure)
    first = {m.label: read_progress(folders[m.label, FIRST_SEED]) for m in methods}
    save_figure(training_curves(first), out / "training.png")
    by_seed = records.groupby(["model", "train_seed", "scenario"], sort=False)["cost"].mean().reset_index()
    write_frame_atomically(by_seed, out / "seeds.csv")
    how = provenance()
    write_run_config(out / "config.json", dict(runs=trained.configs, provenance=how))

    models = {key: TDPG.load(folder / "model.zip", device="cpu") for key, folder in folders.items()}
    with torch_threads(1):  # sums come out the same on any number of cores
        knowledge = _knowledge(models, rows[:2])
        of_first = {label: models[label, FIRST_SEED] for label in ("PG", "TDPG")}
        estimates = _estimates(of_first) if experiment.compares_estimates else None
    write_frame_atomically(knowledge, out / "knowledge.csv")
    means = knowledge.drop(columns="train_seed").groupby(["model", "mugs"], sort=False).mean().reset_index()

    aggregated = aggregate_seeds(records)
    sections = [
        f"# {experiment.title}",
        comparison_markdown(aggregated, rows, quantity=QUANTITY, digits=3),
    ]
    if experiment.goals:
        sections += ["## Goals", goals_table(aggregated, experiment.goals)]
    kinds = {row.name.lower(): (row.name,) for row in rows}
    sections += [
        "## What the penalty is worth",
        COMPARISON,
        comparisons_table(records, COMPARISONS, kinds),
        "## What the TRVs know",
        KNOWLEDGE,
        markdown_table(means, digits=2),
    ]
    if estimates is not None:
        sections += ["## How much information is it?", ESTIMATES, markdown_table(estimates, digits=2)]
    sections.append(how_made(experiment.command, how, commits_of(list(folders.values()))))
    summary = "\n\n".join(sections) + "\n"
    write_atomically(out / "summary.md", summary)
    if publish is not None:
        publish_files(out, publish)
    return summary


def _knowledge(models: Mapping[tuple[str, int], TDPG], scenarios: Sequence[Scenario]) -> pd.DataFrame:
    """Tell what every model's TRVs know of mugs."""
    rows = []
    for row in scenarios:
        mugs = draw_mugs(row.env_kwargs, n_mugs=N_MUGS)
        for (label, seed), model in models.items():
            batch = encode_mugs(model, mugs)
            few = batch.select(th.arange(min(N_MUGS, N_BOUND)))
            rows.append(
                dict(model=label, train_seed=seed, mugs=row.name.lower(), **grasp_knowledge(batch), **_bounds(few))
            )
    return pd.DataFrame(rows)


def _bounds(batch: InformationBatch) -> dict[str, float]:
    """Bound the information from below and from above; of two upper bounds the smaller one holds, too."""
    sizes = (batch.states.shape[2], batch.trvs.shape[2])
    upper = min(cls(1, *sizes)(batch).item() for cls in (LeaveOneOut, LogDet))
    return {"lower bound": own_sample_bound(batch).item(), "upper bound": upper}


def _estimates(models: Mapping[str, TDPG]) -> pd.DataFrame:
    """Hold what MINE makes of the information in several policies, one after the other, against the bounds."""
    mugs = {
        f"{FITTED_MUGS} mugs": draw_mugs(n_mugs=FITTED_MUGS, seed=1),
        "fresh mugs": draw_mugs(n_mugs=min(N_MUGS, N_BOUND), seed=2),
    }
    columns = {}
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        critics: dict[str, Mine] = {}
        for label, model in models.items():
            batches = [encode_mugs(model, each) for each in mugs.values()]
            fitted = batches[0]
            for name, settings in CRITICS.items():
                critics.setdefault(name, Mine(1, fitted.states.shape[2], fitted.trvs.shape[2], **settings)).fit(fitted)
            for name, batch in zip(mugs, batches, strict=True):
                with th.no_grad():
                    estimates = {critic: critics[critic](batch).item() for critic in critics}
                columns[f"{label}, {name}"] = {**_bounds(batch), **estimates}
    return pd.DataFrame(columns).rename_axis("estimate").reset_index()
