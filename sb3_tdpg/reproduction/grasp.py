"""Grasping from training to Table III: policy gradient, TDPG, and the control of the penalty."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import torch as th

from sb3_tdpg.envs.scenarios import PANDA_GRASP
from sb3_tdpg.evaluation import (
    aggregate_seeds,
    comparison_markdown,
    draw_mugs,
    encode_mugs,
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

# Seeds below 100 were seen while the blocks were made.
FIRST_SEED = 100

TRAINING, ROTATION, TRANSLATION = (row.name for row in PANDA_GRASP)

# The largest interquartile mean over seeds of the share of failures, by method and row.
GOALS: Mapping[str, Mapping[str, float]] = {
    "PG": {TRAINING: 0.02, ROTATION: 0.08, TRANSLATION: 0.15},
    "TDPG": {TRAINING: 0.03, ROTATION: 0.08, TRANSLATION: 0.15},
}

# The control differs from TDPG in nothing but the penalty.
SECOND_STAGE = dict(n_timesteps=8_000)
METHODS: tuple[Method, ...] = (
    Method("PG", "PandaGrasp-v0-pg"),
    Method("TDPG", "PandaGrasp-v0", "PG", overrides=SECOND_STAGE),
    Method("its control", "PandaGrasp-v0-pg", "PG", overrides=SECOND_STAGE),
)
COMPARISONS = (("TDPG", "its control"), ("TDPG", "PG"))
KINDS = {name.lower(): (name,) for name in (TRAINING, ROTATION, TRANSLATION)}

QUANTITY = "share of failed grasps"
COMPARISON = (
    "Probability that a seed of the method fails less often in these rows than a seed of what it is compared with: 0.5 "
    "is no difference."
)
KNOWLEDGE = (
    "Share of the variance (R^2 on mugs left out of the regression, mean over seeds) of the mug's position and of the "
    "sine and cosine of its yaw that TRVs, their squares and products explain; in training, and with all yaws. And "
    "bounds on the information in nats: I[x; x~] itself lies between them, since the image is a function of the mug's "
    "pose and there is no memory. The lower one cannot exceed ln 2000 = 7.6."
)
ESTIMATES = (
    "Of the first PG policy, in nats. A fitted critic's estimate bounds the information from below on fresh mugs; on "
    "those that it was fitted to it does not bound it at all."
)
N_MUGS = 10_000  # for the regression
N_BOUND = 2_000  # for the bounds, which compare every mug with every other
FITTED_MUGS = 400  # for MINE, as in an epoch
CRITICS: Mapping[str, Mapping[str, Any]] = {
    # Without guards, and with one optimiser from beginning to end.
    "MINE, as the paper prints it": dict(
        learning_rate=5e-5,
        warmup_gradient_steps=500_000,
        refit_below=-math.inf,
        refit_above=math.inf,
        reset_moments=False,
    ),
    "MINE, 2,000 steps at 1e-3": {},
    "MINE, 2,000 steps at 1e-3, standardised state": dict(standardize=True),
}


def reproduce_grasp(
    out: Path,
    *,
    n_seeds: int = 5,
    n_eval_episodes: int = 1000,
    n_timesteps: int | None = None,
    jobs: int | None = None,
    publish: Path | None = None,
) -> str:
    """
    Train every method with several seeds, evaluate it on the rows of Table III; write tables, figures and records.

    Finished runs are kept: the same call goes on where an interrupted one stopped.

    :param out: Folder for ``summary.md``, ``seeds.csv``, ``episodes.csv.xz``, figures, ``config.json`` and ``runs/``.
    :param n_seeds: Training seeds of each method.
    :param n_eval_episodes: Episodes of each row.
    :param n_timesteps: Environment steps of each training; default: as in the blocks.
    :param jobs: Runs at a time; default: the number of cores.
    :param publish: Folder that gets a copy of everything but ``runs/``.
    :return: the summary, as Markdown
    """
    seeds = range(FIRST_SEED, FIRST_SEED + n_seeds)
    overrides = {} if n_timesteps is None else {"n_timesteps": n_timesteps}
    trained = Trained("PandaGrasp-v0", out, [(m, seed) for m in METHODS for seed in seeds], overrides)
    trained.complete(lambda _: PANDA_GRASP, n_eval_episodes=n_eval_episodes, jobs=jobs)
    folders = trained.folders

    # Where the mug stood, and how it was grasped.
    poses = {f"final_mug_{i}": name for i, name in ((0, "x"), (1, "y"), (3, "yaw"))}
    poses.update({f"final_grasp_{i}": f"grasp_{name}" for i, name in enumerate(("x", "y", "z", "yaw"))})
    records = trained.records().rename(columns=poses)
    columns = ["model", "train_seed", "scenario", "episode", "cost", *poses.values(), "seed", "deterministic"]
    write_frame_atomically(records[columns].round(dict.fromkeys(poses.values(), 6)), out / "episodes.csv.xz")
    rotated = records[records["scenario"] == ROTATION]
    save_figure(failures_by_yaw(rotated), out / "yaw.png")
    first = {m.label: read_progress(folders[m.label, FIRST_SEED]) for m in METHODS}
    save_figure(training_curves(first), out / "training.png")
    by_seed = records.groupby(["model", "train_seed", "scenario"], sort=False)["cost"].mean().reset_index()
    write_frame_atomically(by_seed, out / "seeds.csv")
    how = provenance()
    write_run_config(out / "config.json", dict(runs=trained.configs, provenance=how))

    models = {key: TDPG.load(folder / "model.zip", device="cpu") for key, folder in folders.items()}
    with torch_threads(1):  # sums come out the same on any number of cores
        knowledge = _knowledge(models)
        estimates = _estimates(models["PG", FIRST_SEED])
    write_frame_atomically(knowledge, out / "knowledge.csv")
    means = knowledge.drop(columns="train_seed").groupby(["model", "poses"], sort=False).mean().reset_index()

    aggregated = aggregate_seeds(records)
    sections = [
        "# Grasping (Table III)",
        comparison_markdown(aggregated, PANDA_GRASP, quantity=QUANTITY, digits=3),
        "## Goals",
        goals_table(aggregated, GOALS),
        "## What the penalty is worth",
        COMPARISON,
        comparisons_table(records, COMPARISONS, KINDS),
        "## What the TRVs know",
        KNOWLEDGE,
        markdown_table(means, digits=2),
        "## How much information is it?",
        ESTIMATES,
        markdown_table(estimates, digits=2),
        how_made("make reproduce-grasp", how, commits_of(list(folders.values()))),
    ]
    summary = "\n\n".join(sections) + "\n"
    write_atomically(out / "summary.md", summary)
    if publish is not None:
        publish_files(out, publish)
    return summary


def _knowledge(models: Mapping[tuple[str, int], TDPG]) -> pd.DataFrame:
    """Tell what every model's TRVs know of the mugs in training and of mugs with any yaw."""
    rows = []
    for row in PANDA_GRASP[:2]:
        mugs = draw_mugs(row.env_kwargs, n_mugs=N_MUGS)
        for (label, seed), model in models.items():
            batch = encode_mugs(model, mugs)
            few = batch.select(th.arange(min(N_MUGS, N_BOUND)))
            rows.append(
                dict(model=label, train_seed=seed, poses=row.name.lower(), **grasp_knowledge(batch), **_bounds(few))
            )
    return pd.DataFrame(rows)


def _bounds(batch: InformationBatch) -> dict[str, float]:
    """Bound the information from below and from above; of two upper bounds the smaller one holds, too."""
    sizes = (batch.states.shape[2], batch.trvs.shape[2])
    upper = min(cls(1, *sizes)(batch).item() for cls in (LeaveOneOut, LogDet))
    return {"lower bound": own_sample_bound(batch).item(), "upper bound": upper}


def _estimates(model: TDPG) -> pd.DataFrame:
    """Hold what MINE makes of the information against the bounds."""
    few, fresh = (
        encode_mugs(model, draw_mugs(n_mugs=n, seed=seed)) for n, seed in ((FITTED_MUGS, 1), (min(N_MUGS, N_BOUND), 2))
    )
    rows: list[tuple[str, float, float]] = [(name, _bounds(few)[name], _bounds(fresh)[name]) for name in _bounds(few)]
    for name, settings in CRITICS.items():
        with th.random.fork_rng(devices=[]):
            th.manual_seed(0)
            critic = Mine(1, few.states.shape[2], few.trvs.shape[2], **settings)
            critic.fit(few)
            with th.no_grad():
                rows.append((name, critic(few).item(), critic(fresh).item()))
    return pd.DataFrame(rows, columns=["estimate", f"{FITTED_MUGS} mugs", f"{fresh.states.shape[1]} fresh mugs"])
