"""Certify saved policies of the lava problem: bound their cost under the paper's shifts and under random shifts."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd
from tqdm import tqdm

from sb3_tdpg.certificates.models import compare, load_models, write_summary
from sb3_tdpg.certificates.shifts import Shift, TrainingEpisodes, lava_shift, random_lava_shifts, wall_cost
from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.common.provenance import write_frame_atomically
from sb3_tdpg.common.threads import threads
from sb3_tdpg.envs.scenarios import LAVA, Scenario
from sb3_tdpg.evaluation import save_figure
from sb3_tdpg.evaluation.figures import INK, PALETTE, WIDTH, legend_above, log_axis, new_panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER_INVERSE_BETAS = (25, 50, 75, 100)
# Number of recorded episodes for the divergence in the paper's rows and in each random shift.
N_BUDGET_EPISODES = 100_000
N_RANDOM_BUDGET_EPISODES = 20_000


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
    Certify policies, and compare the certified bounds with the cost in the shifted environments.

    :param models: Files that ``model.save()`` wrote.
    :param out: Folder for ``summary.md``, ``paper.csv``, ``theorem.csv`` and ``config.json``. With random shifts it
        also gets ``random.csv`` and ``certificate.png``.
    :param env_kwargs: Keywords of the training environment.
    :param n_random_shifts: Number of random shifts; see :func:`~sb3_tdpg.certificates.shifts.random_lava_shifts`.
    :param n_episodes: Number of recorded training episodes.
    :param n_test_episodes: Number of episodes in each random shift. Each of the paper's shifts has ten times as many.
    :param confidence: Confidence level of each certificate.
    :param cost_bound: Upper bound at which the certified cost of an episode is clipped; default: ``wall_cost``.
    :param seed: Seed of the episodes and of the shifts.
    :return: the summary, as Markdown
    :raises ValueError: if an argument is wrong; no episode has been run in this case.
    """
    training = Scenario("Training", "Lava-v0", dict(env_kwargs or {}))
    # The divergences are relative to a sensor without bias and a uniform start.
    if given := [name for name in ("sensor_bias", "start_beta") if training.env_kwargs.get(name) is not None]:
        raise ValueError(
            f"certify shifts the bias of the sensor and the start itself: leave {' and '.join(given)} out of env_kwargs"
        )
    for name, value, least in (("seed", seed, 0), ("n_test_episodes", n_test_episodes, 2)):
        if value < least:
            raise ValueError(f"{name}={value} must be at least {least}")
    if cost_bound is not None and not (math.isfinite(cost_bound) and cost_bound > 0):
        raise ValueError(f"cost_bound={cost_bound} must be finite and above 0: it bounds the cost of an episode")
    loaded = load_models(models, training)
    out.mkdir(parents=True, exist_ok=True)  # created first, so that an error does not come at the end
    std = float(training.env_kwargs.get("sensor_noise_std", LAVA[0].env_kwargs["sensor_noise_std"]))
    bound = wall_cost(next(iter(loaded.values())).horizon) if cost_bound is None else cost_bound
    settings: dict[str, Any] = dict(n_episodes=n_episodes, confidence=confidence, cost_bound=bound, seed=seed)
    n_budget = min(N_BUDGET_EPISODES, n_episodes)
    rows = [lava_shift(row.name, **row.env_kwargs, training_noise_std=std) for row in LAVA]
    shifts = random_lava_shifts(n_random_shifts, seed=seed, training_noise_std=std)
    paper, theorem, random = [], [], []
    with threads(1):
        for label, model in loaded.items():
            print(f"{label}: {n_episodes:,} training episodes")
            episodes = TrainingEpisodes(model, training, n_budget_episodes=n_budget, **settings)
            if cost_bound is not None and (highest := float(episodes.costs.max())) > cost_bound:
                raise ValueError(
                    f"cost_bound={cost_bound:g} is below a cost of {highest:g} that {label} had in training: give an "
                    "upper bound on the cost of an episode"
                )
            paper += [dict(model=label, **_paper_row(episodes, row, 10 * n_test_episodes)) for row in rows]
            few = min(N_RANDOM_BUDGET_EPISODES, n_budget)
            for i, shift in enumerate(tqdm(shifts, desc=f"{label}: random shifts", disable=not shifts)):
                row = _row(episodes, shift, n_test_episodes, seed=seed + 2 + i, n_budget=few)
                random.append(dict(model=label, **row))
            theorem += [dict(model=label, **_theorem_row(episodes, inverse)) for inverse in PAPER_INVERSE_BETAS]

    frames = dict(paper=pd.DataFrame(paper), theorem=pd.DataFrame(theorem))
    if random:
        frames["random"] = pd.DataFrame(random)
        save_figure(certificate_figure(frames["random"], frames["paper"], bound), out / "certificate.png")
    for name, frame in frames.items():
        write_frame_atomically(frame, out / f"{name}.csv")
    settings.update(n_random_shifts=n_random_shifts, n_test_episodes=n_test_episodes, env_kwargs=training.env_kwargs)
    return write_summary(out, _sections(frames, confidence, bound), models, settings)


def _row(episodes: TrainingEpisodes, shift: Shift, n_test: int, **how: Any) -> dict[str, Any]:
    keywords = {key: shift.env_kwargs.get(key) for key in ("sensor_noise_std", "sensor_bias", "start_beta")}
    return dict(shift=shift.name, **keywords, **compare(episodes, shift, n_test, **how))


def _paper_row(episodes: TrainingEpisodes, shift: Shift, n_test: int) -> dict[str, Any]:
    """Return a row with two more certificates: without an allowance for sampling, and for the unclipped cost."""
    row = _row(episodes, shift, n_test, seed=episodes.seed + 1)
    estimate = episodes.allowing(None).certify(shift).bound
    unclipped = episodes.allowing(episodes.confidence, episodes.true_cost_bound).certify(shift).bound
    return dict(**row, estimate=estimate, unclipped_bound=unclipped)


def _theorem_row(episodes: TrainingEpisodes, inverse_beta: float) -> dict[str, Any]:
    """Return the bound of Theorem II.1, and the divergence that its condition allows."""
    information = episodes.information
    bound = episodes.fixed_beta(1 / inverse_beta, information).bound
    row = dict(beta=f"1/{inverse_beta}", information=information, bound=bound)
    return dict(**row, corrected=information / inverse_beta, printed=information * inverse_beta)


def _sections(frames: Mapping[str, pd.DataFrame], confidence: float, cost_bound: float) -> list[str]:
    clipped = f"The cost is clipped at {cost_bound:g}, except in the last column."
    sections = ["## The paper's shifts", _paper_table(frames["paper"], confidence), clipped]
    if "random" in frames:
        sections += [
            "## Random shifts",
            _random_table(frames["random"], cost_bound),
            f"The trivial bound is {cost_bound:g}. The medians and ranges are over the shifts with a smaller bound.",
            "## Theorem II.1 at the paper's betas",
            _theorem_table(frames["theorem"], frames["random"]),
            "In brackets: shifts whose cost is above the bound by more than three standard errors.",
        ]
    return sections


def _paper_table(paper: pd.DataFrame, confidence: float) -> str:
    columns = {
        "model": "policy", "shift": "shift", "cost": "mean cost", "measured_kl": "measured divergence",
        "kl": "certified divergence", "exceedance": "probability of a larger divergence",
        "bound": f"upper bound ({confidence:.0%})", "estimate": "upper bound without allowance for sampling",
        "unclipped_bound": "upper bound on the unclipped cost",
    }  # fmt: skip
    short = {name: paper[name].map("{:.2g}".format) for name in ("measured_kl", "kl", "exceedance")}
    return markdown_table(paper.assign(**short)[list(columns)].rename(columns=columns), digits=1)


def _random_table(random: pd.DataFrame, trivial: float) -> str:
    rows = []
    for label, group in random.groupby("model", sort=False):
        cost, bound, error = group["cost"], group["bound"], group["standard_error"]
        is_certified = bound < 0.999 * trivial
        row = {"policy": label, "shifts": len(group), "cost at most the bound": int((cost <= bound).sum())}
        row["cost + 3 standard errors at most the bound"] = int((cost + 3 * error <= bound).sum())
        row["bound below the trivial bound"] = int(is_certified.sum())
        row["bound - cost: median [range]"] = _spread((bound - cost)[is_certified])
        row["bound / cost: median [range]"] = _spread((bound / cost)[is_certified])
        row["trivial bound / cost: median"] = f"{(trivial / cost).median():.3g}"
        rows.append({**row, "median bound": f"{bound.median():.3g}"})
    return markdown_table(rows)


def _spread(values: pd.Series) -> str:
    return f"{values.median():.3g} [{values.min():.3g}, {values.max():.3g}]" if len(values) else "none"


def _theorem_table(theorem: pd.DataFrame, random: pd.DataFrame) -> str:
    """Count the shifts that meet the theorem's condition, and how many of these shifts cost more than the bound."""
    rows = []
    for at in theorem.to_dict("records"):
        shifts = random[random["model"] == at["model"]]
        row = dict(policy=at["model"], beta=at["beta"])
        row.update(information=f"{at['information']:.2g}", bound=f"{at['bound']:.1f}")
        for condition in ("corrected", "printed"):
            meet = shifts[shifts["measured_kl"] <= at[condition]]
            above = meet["cost"] - at["bound"]
            clearly_above = (above > 3 * meet["standard_error"]).sum()
            row[f"{condition} condition: divergence allowed"] = f"{at[condition]:.2g}"
            row[f"{condition} condition: shifts that meet it"] = str(len(meet))
            row[f"{condition} condition: costs above the bound"] = f"{(above > 0).sum()} ({clearly_above})"
        rows.append(row)
    return markdown_table(rows)


def certificate_figure(random: pd.DataFrame, paper: pd.DataFrame, trivial: float) -> Figure:
    """Draw bound against cost, and both against the size of the shift; the frames are those of the CSV files."""
    figure, ((against_cost, against_size),) = new_panels(WIDTH, 4.0, 1, 2, sharey=True)
    for color, label in zip(cycle(PALETTE), random["model"].unique(), strict=False):
        group = random[random["model"] == label]
        rows = paper[(paper["model"] == label) & (paper["sensor_kl"] > 0)]
        moved = group[group["sensor_kl"] > 0]
        small = dict(s=7, color=color, alpha=0.5)
        large = dict(s=60, marker="D", color=color, edgecolors="white", zorder=4)
        against_cost.scatter(group["cost"], group["bound"], **small, linewidths=0, label=label)
        against_cost.scatter(rows["cost"], rows["bound"], **large, label=f"{label}, the paper's shifts")
        against_size.scatter(moved["sensor_kl"], moved["bound"], **small, linewidths=0)
        against_size.scatter(moved["sensor_kl"], moved["cost"], **small, marker="x", linewidths=0.6)
        against_size.scatter(rows["sensor_kl"], rows["bound"], **large)
    diagonal = [0.8 * random["cost"].min(), trivial]
    against_cost.plot(diagonal, diagonal, color=INK, linewidth=1)
    place = dict(xytext=(-36, -22), textcoords="offset points", ha="right")
    against_cost.annotate("cost = bound", (trivial, trivial), **place, fontsize=8, color=INK)
    for axes in (against_cost, against_size):
        axes.axhline(trivial, color=INK, linestyle=(0, (4, 3)), linewidth=1)
        axes.grid(alpha=0.25)
    log_axis(against_cost, "x", subs=(1, 3))
    log_axis(against_cost, "y", subs=(1, 2, 5))
    against_size.set_xscale("log")
    against_cost.set(xlabel="mean cost in the shifted environment", ylabel="certified upper bound (dashed: trivial)")
    against_size.set_xlabel("divergence of sensor and start (nat); crosses: cost")
    legend_above(figure, against_cost)
    return figure
