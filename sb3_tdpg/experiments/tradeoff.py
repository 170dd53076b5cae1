"""Draw the figures of a sweep and of a frontier: the cost of the runs against the information in their TRVs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sb3_tdpg.evaluation.figures import INK, WIDTH, import_matplotlib, legend_above, log_axis, new_panels, short_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ABOUT_NOTHING = 0.01  # nats: smaller differences have no meaning, although a logarithmic axis shows them
FLOOR = 1e-5  # nats
ORDERED = "Sensor noise"  # prefix of the scenarios that follow the reference in order
LIMIT_COLOR = "#D55E00"


def tradeoff_figure(runs: pd.DataFrame, rows: Mapping[str, str], best: pd.Series | None, cost_limit: float) -> Figure:
    """
    Draw two panels: cost against information with one point per run, and the cost of each run in each scenario.

    :param runs: ``label``, ``seed``, ``cost``, ``information`` (nats) and the columns of ``rows`` for each run, in the
        order of drawing. ``best`` is the selected run.
    :param rows: The column of the mean cost for each scenario's name; the reference scenario comes first.
    """
    matplotlib = import_matplotlib()
    has_rows = len(rows) > 1
    widths = (1, 1.15) if has_rows else (1,)
    figure, (panels,) = new_panels(WIDTH, 4.2, 1, len(widths), sharey=True, width_ratios=widths)
    labels = list(runs["label"].unique())
    shades = matplotlib.colormaps["viridis_r"](np.linspace(0.12, 1.0, len(labels)))
    colors = {label: INK if label == "inf" else shade for label, shade in zip(labels, shades, strict=True)}
    scatter = panels[0]
    for label, group in runs.groupby("label", sort=False):
        name = r"$\beta = \infty$ (PG)" if label == "inf" else rf"$\beta = {label}$"
        points = group["information"], group["cost"]
        scatter.scatter(*points, s=28, color=colors[label], label=name, alpha=0.85, zorder=3)
    information = runs["information"].clip(lower=FLOOR)
    if best is not None:
        point = max(best["information"], FLOOR), best["cost"]
        scatter.scatter(*point, s=150, facecolors="none", edgecolors=LIMIT_COLOR, lw=2, zorder=4, label="selected")
    low, high = 0.6 * information.min(), 1.7 * information.max()
    log_axis(scatter, "x", subs=(1,))
    scatter.set_xlim(low, max(high, 12 * low))  # at least one tick
    if low < ABOUT_NOTHING:
        span = low, min(ABOUT_NOTHING, high)
        scatter.axvspan(*span, color="#EEEEEE", zorder=0, label="information of about 0", linewidth=0)
    scatter.set_xlabel("information in the TRVs (nat, logarithmic axis)", fontsize=9)
    scatter.set_ylabel("mean episode cost", fontsize=9)
    costs = runs[list(rows.values())].to_numpy()
    if costs.min() > 0 and costs.max() > 4 * costs.min():
        log_axis(scatter, "y", subs=(1, 2, 5))
    if has_rows:
        _draw_rows(panels[1], runs, rows, colors)
    for axes in panels:
        axes.axhline(cost_limit, color=LIMIT_COLOR, linestyle=(0, (4, 3)), linewidth=1, zorder=1)
        axes.grid(alpha=0.25)
        axes.margins(y=0.08)
    where: dict[str, Any] = dict(xycoords=("axes fraction", "data"), textcoords="offset points", xytext=(0, 3))
    style: dict[str, Any] = dict(ha="right", fontsize=8, color=LIMIT_COLOR)
    scatter.annotate(f"cost limit {cost_limit:g}", (0.99, cost_limit), **where, **style)
    legend_above(figure, scatter, 8)
    return figure


def _draw_rows(axes: Axes, runs: pd.DataFrame, rows: Mapping[str, str], colors: Mapping[Any, Any]) -> None:
    """Draw a dot for each run in each row, a bar for the median over seeds, and a line through ordered rows."""
    names = list(rows)
    in_order = 1 + sum(name.startswith(ORDERED) for name in names)
    for i, (label, group) in enumerate(runs.groupby("label", sort=False)):
        seeds = group[list(rows.values())].to_numpy()  # (seeds, rows)
        at = np.arange(len(names)) + 0.5 * ((i + 0.5) / len(colors) - 0.5)
        median = np.median(seeds, axis=0)
        axes.plot(at, seeds.T, ".", color=colors[label], markersize=4, alpha=0.7)
        axes.plot(at, median, "_", color=colors[label], markersize=8, markeredgewidth=1.6)
        axes.plot(at[:in_order], median[:in_order], color=colors[label], linewidth=1.0, alpha=0.6)
    texts = ["train" if name == "Training" else short_name(name) for name in names]
    kinds = dict.fromkeys(name.rsplit(" ", 1)[0].lower() for name in names[1:] if short_name(name) != name)
    axes.set_xticks(range(len(names)), texts, rotation=30 if sum(map(len, texts)) > 36 else 0)
    axes.set_xlabel(f"{', then '.join(kinds) or 'scenario'} (bar: median over seeds)", fontsize=9)


def frontier_figure(runs: pd.DataFrame, table: pd.DataFrame, knee: str | None) -> Figure:
    """
    Draw cost against information: a dot for each run, the means with their intervals, the open loop and the knee.

    :param runs: ``label``, ``cost`` and ``information`` (nats) of each run.
    :param table: From :func:`~sb3_tdpg.experiments.frontier.frontier_table`.
    :param knee: Label of the row that is marked as the knee.
    """
    matplotlib = import_matplotlib()
    figure, ((axes,),) = new_panels(WIDTH * 0.75, 4.2)
    start, end = table.iloc[0], table.iloc[-1]
    points = table.iloc[:-1]
    shades = matplotlib.colormaps["viridis_r"](np.linspace(0.12, 1.0, len(points) - 1))
    axes.plot(points["nats"], points["cost"], color=INK, linewidth=0.8, zorder=2)
    mixture: dict[str, Any] = dict(color=LIMIT_COLOR, linestyle=(0, (1, 2)), linewidth=1.2, zorder=1)
    axes.plot([start["nats"], 0], [start["cost"], end["best"]], label="mixtures of the two", **mixture)
    sizes = np.linspace(9, 5, len(points))  # different sizes keep overlapping points visible
    for color, size, (_, row) in zip([INK, *shades], sizes, points.iterrows(), strict=True):
        seeds = runs[runs["label"] == row["label"]]
        axes.plot(seeds["information"], seeds["cost"], ".", color=color, markersize=5, alpha=0.6, zorder=3)
        errors = [[[row[n] - row[f"{n}_low"]], [row[f"{n}_high"] - row[n]]] for n in ("nats", "cost")]
        style: dict[str, Any] = dict(fmt="o", color=color, markersize=size, capsize=2, elinewidth=1, zorder=4)
        axes.errorbar(row["nats"], row["cost"], yerr=errors[1], xerr=errors[0], label=row["label"], **style)
        if row["label"] == knee:
            ring: dict[str, Any] = dict(facecolors="none", edgecolors=LIMIT_COLOR, linewidths=2, zorder=5)
            axes.scatter(row["nats"], row["cost"], s=170, label="knee", **ring)
    axes.scatter(0, end["best"], marker="D", s=90, color=LIMIT_COLOR, zorder=3, label="best open loop")
    axes.axhline(end["best"], color=LIMIT_COLOR, linestyle=(0, (4, 3)), linewidth=1, zorder=1)
    axes.margins(x=0.04, y=0.08)
    axes.grid(alpha=0.25)
    axes.set_xlabel("information in the TRVs (nat)", fontsize=9)
    axes.set_ylabel("mean episode cost", fontsize=9)
    legend_above(figure, axes, 5)
    return figure
