"""What saved policies of the lava problem are certified to cost under the paper's shifts and under random ones."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from sb3_tdpg.certificates.shifts import Shift, TrainingEpisodes, lava_shift, random_lava_shifts
from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.provenance import provenance, write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import threads
from sb3_tdpg.envs.lava import GOAL, WALL
from sb3_tdpg.envs.scenarios import LAVA, Scenario
from sb3_tdpg.evaluation import save_figure
from sb3_tdpg.evaluation.environments import check_models_fit
from sb3_tdpg.evaluation.figures import INK, PALETTE, WIDTH, _legend_above, _log_axis, _new_figure, _tidy
from sb3_tdpg.paper.common import how_made, markdown_table
from sb3_tdpg.paper.lava import PAPER_INVERSE_BETAS
from sb3_tdpg.tdpg import TDPG

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Recorded episodes for the divergence: in the paper's rows, and in each of many random shifts.
N_BUDGET_EPISODES = 100_000
N_RANDOM_BUDGET_EPISODES = 20_000


def wall_cost(horizon: int) -> float:
    """Cost of an episode that is spent standing at the wall, the worst place to stand; in both readings."""
    return (horizon + 100.0) * float(GOAL[0] - WALL)


def certify_lava(
    models: Sequence[Path],
    out: Path,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    n_random_shifts: int = 0,
    n_episodes: int = 1_000_000,
    n_test_episodes: int = 2000,
    confidence: float = 0.95,
    cost_bound: float | None = None,
    seed: int = 0,
) -> str:
    """
    Certify policies, and hold the certificates against the cost in the shifted environments.

    :param models: Files that ``model.save()`` wrote.
    :param out: Folder for ``summary.md``, ``paper.csv``, ``theorem.csv``, ``config.json``, and with random shifts for
        ``random.csv`` and ``certificate.png``.
    :param env_kwargs: Keywords of the training environment.
    :param n_random_shifts: How many random shifts; see :func:`~sb3_tdpg.certificates.shifts.random_lava_shifts`.
    :param n_episodes: Recorded training episodes.
    :param n_test_episodes: Episodes in each random shift; ten times as many in each of the paper's.
    :param confidence: Of each certificate.
    :param cost_bound: Certify the cost clipped there; default: ``wall_cost``.
    :param seed: Of the episodes and of the shifts.
    :return: the summary, as Markdown
    :raises ValueError: if something does not fit; no episode has been run by then.
    """
    training = Scenario("Training", "Lava-v0", dict(env_kwargs or {}))
    _check_training(training)
    for name, value, least in (("seed", seed, 0), ("n_test_episodes", n_test_episodes, 2)):
        if value < least:
            raise ValueError(f"{name}={value} must be at least {least}")
    loaded = _load(models, training)
    out.mkdir(parents=True, exist_ok=True)  # so that a folder that cannot be made is not told at the very end
    std = float(training.env_kwargs.get("sensor_noise_std", LAVA[0].env_kwargs["sensor_noise_std"]))
    bound = wall_cost(next(iter(loaded.values())).horizon) if cost_bound is None else cost_bound
    n_budget = min(N_BUDGET_EPISODES, n_episodes)
    rows = [lava_shift(row.name, **row.env_kwargs, training_noise_std=std) for row in LAVA]
    shifts = random_lava_shifts(n_random_shifts, seed=seed, training_noise_std=std)
    paper: list[dict[str, Any]] = []
    theorem: list[dict[str, Any]] = []
    random: list[dict[str, Any]] = []
    with threads(1):
        for label, model in loaded.items():
            print(f"{label}: {n_episodes:,} training episodes")
            episodes = TrainingEpisodes(
                model, training, cost_bound=bound, n_episodes=n_episodes, n_budget_episodes=n_budget,
                confidence=confidence, seed=seed,
            )  # fmt: skip
            paper += [{"model": label, **_paper_row(episodes, row, 10 * n_test_episodes)} for row in rows]
            few = min(N_RANDOM_BUDGET_EPISODES, n_budget)
            random += [
                {"model": label, **_row(episodes, shift, few, n_test_episodes, seed + 2 + i)}
                for i, shift in enumerate(tqdm(shifts, desc=f"{label}: random shifts", disable=not shifts))
            ]
            theorem += [{"model": label, **row} for row in _theorem_rows(episodes)]

    frames = dict(paper=pd.DataFrame(paper), theorem=pd.DataFrame(theorem))
    if random:
        frames["random"] = pd.DataFrame(random)
        save_figure(certificate_figure(frames["random"], frames["paper"], bound), out / "certificate.png")
    for name, frame in frames.items():
        write_frame_atomically(frame, out / f"{name}.csv")
    how = provenance()
    settings = dict(
        models=[path.name for path in models], env_kwargs=dict(training.env_kwargs), n_random_shifts=n_random_shifts,
        n_episodes=n_episodes, n_test_episodes=n_test_episodes, confidence=confidence, cost_bound=bound, seed=seed,
    )  # fmt: skip
    write_run_config(out / "config.json", dict(**settings, provenance=how))
    summary = certificate_summary(frames, confidence, bound, how_made(how["command"], how, []))
    write_atomically(out / "summary.md", summary)
    return summary


def _check_training(training: Scenario) -> None:
    """The divergences are from a sensor without bias and a uniform start."""
    given = [name for name in ("sensor_bias", "start_beta") if training.env_kwargs.get(name) is not None]
    if given:
        raise ValueError(
            f"certify shifts the bias of the sensor and the start itself: leave {' and '.join(given)} out of env_kwargs"
        )


def _load(paths: Sequence[Path], training: Scenario) -> dict[str, TDPG]:
    models: dict[str, TDPG] = {}
    if twice := [str(path) for i, path in enumerate(paths) if path in paths[:i]]:
        raise ValueError(f"{twice[0]} is given twice")
    for path in paths:
        try:
            model = TDPG.load(path, device="cpu")
        except OSError as e:
            raise ValueError(f"{path} cannot be read ({e.strerror}): give .zip files that model.save() wrote") from e
        method = "PG" if model.beta == math.inf else "TDPG"
        # As short as can be; the whole path is of one model only.
        labels = (method, f"{method} ({path.parent.name}/{path.stem})", f"{method} ({path})")
        models[next(label for label in labels if label not in models)] = model
    check_models_fit(models, [training])
    return models


def _row(episodes: TrainingEpisodes, shift: Shift, n_budget: int | None, n_test: int, test_seed: int) -> dict[str, Any]:
    """Certify one shift, and measure it."""
    certified = episodes.certify(shift, n_budget)
    costs, measured_kl = episodes.measure(shift, n_test, seed=test_seed)
    return dict(
        shift=shift.name,
        **{key: shift.env_kwargs.get(key) for key in ("sensor_noise_std", "sensor_bias", "start_beta")},
        cost=costs.mean(),
        standard_error=costs.std(ddof=1) / math.sqrt(len(costs)),
        clipped_cost=np.minimum(costs, certified.trivial).mean(),
        bound=certified.bound,
        through_trvs=certified.through_trvs,
        through_sensor=certified.through_sensor,
        kl=certified.budget.kl,
        exceedance=certified.budget.exceedance,
        measured_kl=measured_kl,
        sensor_kl=certified.sensor_kl,
    )


def _paper_row(episodes: TrainingEpisodes, shift: Shift, n_test: int) -> dict[str, Any]:
    """As a random shift, with two more certificates: without allowance for sampling, and of the cost as it is."""
    env_bound = episodes.true_cost_bound
    return dict(
        **_row(episodes, shift, None, n_test, episodes.seed + 1),
        estimate=episodes.allowing(None).certify(shift).bound,
        unclipped_bound=episodes.allowing(episodes.confidence, env_bound).certify(shift).bound,
    )


def _theorem_rows(episodes: TrainingEpisodes) -> list[dict[str, Any]]:
    """Return the theorem's bound at the paper's beta, and what divergence its condition allows, as printed and not."""
    information = episodes.information
    return [
        dict(
            beta=f"1/{inverse}",
            information=information,
            bound=episodes.fixed_beta(1 / inverse, information).bound,
            corrected=information / inverse,
            printed=information * inverse,
        )
        for inverse in PAPER_INVERSE_BETAS
    ]


def certificate_summary(frames: Mapping[str, pd.DataFrame], confidence: float, cost_bound: float, made: str) -> str:
    """
    Write the summary as Markdown.

    :param frames: ``"paper"``, ``"theorem"`` and, if there are random shifts, ``"random"``: what :func:`certify_lava`
        wrote as CSV.
    :param confidence: Of the certificates.
    :param cost_bound: Where the cost is clipped.
    :param made: The last line.
    """
    parts = [_paper_section(frames["paper"], confidence, cost_bound)]
    if "random" in frames:
        parts.append(_random_section(frames["random"], cost_bound))
        parts.append(_theorem_section(frames["theorem"], frames["random"]))
    return "\n\n".join([*parts, made]) + "\n"


def _paper_section(paper: pd.DataFrame, confidence: float, bound: float) -> str:
    columns = {
        "model": "policy", "shift": "row", "cost": "cost", "measured_kl": "divergence, measured",
        "kl": "divergence, certified", "exceedance": "exceedance", "bound": f"bound ({confidence:.0%})",
        "estimate": "bound without allowance", "unclipped_bound": "bound of the unclipped cost",
    }  # fmt: skip
    table = paper[list(columns)].rename(columns=columns)
    for name in table.columns[3:6]:
        table[name] = table[name].map("{:.2g}".format)
    text = f"The cost is clipped at {bound:g} but in the last column."
    return f"## The paper's shifts\n\n{markdown_table(table, 1)}\n\n{text}"


def _random_section(random: pd.DataFrame, bound: float) -> str:
    rows = []
    for label, group in random.groupby("model", sort=False):
        certified = group[group["bound"] < 0.999 * bound]
        gap, ratio = certified["bound"] - certified["cost"], certified["bound"] / certified["cost"]
        below = int((group["cost"] <= group["bound"]).sum())
        rows.append(
            {
                "policy": label,
                "shifts": len(group),
                "cost at most the bound": below,
                "also with 3 standard errors": int(
                    (group["cost"] + 3 * group["standard_error"] <= group["bound"]).sum()
                ),
                "bound below the trivial one": len(certified),
                "bound - cost: median [range]": _spread(gap),
                "bound / cost: median [range]": _spread(ratio),
                "trivial bound / cost: median": f"{(bound / group['cost']).median():.3g}",
                "bound, median": f"{group['bound'].median():.3g}",
            }
        )
    text = f"The trivial bound is {bound:g}; the spreads are over the shifts with a bound below it."
    return f"## Random shifts\n\n{markdown_table(pd.DataFrame(rows))}\n\n{text}"


def _spread(values: pd.Series) -> str:
    return f"{values.median():.3g} [{values.min():.3g}, {values.max():.3g}]" if len(values) else "none"


def _theorem_section(theorem: pd.DataFrame, random: pd.DataFrame) -> str:
    """Count the shifts that meet the theorem's condition, and those of them that cost more than it says."""
    rows = []
    for at in theorem.to_dict("records"):
        shifts = random[random["model"] == at["model"]]
        row = {"policy": at["model"], "beta": at["beta"], "information": f"{at['information']:.2g}"}
        row["bound"] = f"{at['bound']:.1f}"
        for condition in ("corrected", "printed"):
            meet = shifts[shifts["measured_kl"] <= at[condition]]
            above = meet["cost"] - at["bound"]
            row[f"{condition}: divergence allowed"] = f"{at[condition]:.2g}"
            row["shifts" if condition == "corrected" else "shifts "] = str(len(meet))
            row["above the bound" if condition == "corrected" else "above the bound "] = (
                f"{(above > 0).sum()} ({(above > 3 * meet['standard_error']).sum()})"
            )
        rows.append(row)
    text = "In brackets: by more than three standard errors of the measured cost."
    return f"## The theorem at the paper's beta\n\n{markdown_table(pd.DataFrame(rows))}\n\n{text}"


def certificate_figure(random: pd.DataFrame, paper: pd.DataFrame, trivial: float) -> Figure:
    """
    Draw bound against cost, and both against the size of the shift.

    :param random: ``random.csv`` of :func:`certify_lava`.
    :param paper: ``paper.csv``; its rows are drawn large, but for the first, which is no shift.
    :param trivial: The bound that always holds.
    """
    figure = _new_figure(WIDTH, 4.0)
    against_cost, against_size = figure.subplots(1, 2, sharey=True)
    shown = paper[paper["sensor_kl"] > 0]
    for color, label in zip(cycle(PALETTE), random["model"].unique(), strict=False):
        group, rows = (frame[frame["model"] == label] for frame in (random, shown))
        moved = group[group["sensor_kl"] > 0]
        against_cost.scatter(group["cost"], group["bound"], s=7, color=color, alpha=0.5, label=label, linewidths=0)
        against_size.scatter(moved["sensor_kl"], moved["bound"], s=7, color=color, alpha=0.5, linewidths=0)
        against_size.scatter(moved["sensor_kl"], moved["cost"], s=7, color=color, alpha=0.5, marker="x", linewidths=0.6)
        for axes, column in ((against_cost, "cost"), (against_size, "sensor_kl")):
            axes.scatter(
                rows[column], rows["bound"], s=60, marker="D", color=color, edgecolors="white", zorder=4,
                label=f"{label}, the paper's noise rows" if axes is against_cost else None,
            )  # fmt: skip
    low = 0.8 * random["cost"].min()
    against_cost.plot([low, trivial], [low, trivial], color=INK, linewidth=1)
    against_cost.annotate(
        "cost = bound", (trivial, trivial), xytext=(-36, -22), textcoords="offset points",
        ha="right", fontsize=8, color=INK,
    )  # fmt: skip
    for axes in (against_cost, against_size):
        axes.axhline(trivial, color=INK, linestyle=(0, (4, 3)), linewidth=1)
        axes.grid(alpha=0.25)
        _tidy(axes)
    _log_axis(against_cost, "x", subs=(1, 3))
    _log_axis(against_cost, "y", subs=(1, 2, 5))
    against_size.set_xscale("log")
    against_cost.set_xlabel("mean cost of the episodes in the shifted environment", fontsize=9)
    against_cost.set_ylabel("certified bound (dashed: trivial)", fontsize=9)
    against_size.set_xlabel("divergence of sensor and start (nat); crosses: cost", fontsize=9)
    _legend_above(figure, against_cost)
    return figure
