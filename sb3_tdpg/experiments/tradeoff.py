"""The picture of a sweep: what the runs cost against how much their TRVs know, and how robust they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sb3_tdpg.evaluation.figures import INK, WIDTH, _import_matplotlib, _log_axis, _new_figure, _short, _tidy

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ABOUT_NOTHING = 0.01  # nats: differences below it mean nothing, though a logarithmic axis shows them
FLOOR = 1e-5  # nats
ORDERED = "Sensor noise"  # scenarios whose names begin so follow the reference in order


def tradeoff_figure(
    runs: pd.DataFrame,
    rows: Mapping[str, str],
    *,
    cost_limit: float | None = None,
    selected: tuple[str, int] | None = None,
    quantity: str = "mean episode cost",
) -> Figure:
    """
    Draw cost against information, a point for each run, and beside it the cost of each run in each scenario.

    :param runs: A row for each run: ``label``, ``seed``, ``cost``, ``information`` (nats) and the columns of ``rows``;
        the labels in the order in which they are to be drawn.
    :param rows: Column of the mean cost by name of the scenario, the reference first.
    :param cost_limit: Drawn as a line.
    :param selected: Label and seed of the run to be marked.
    :param quantity: What the cost is.
    """
    matplotlib = _import_matplotlib()
    has_rows = len(rows) > 1
    figure = _new_figure(WIDTH, 4.2)
    panels = figure.subplots(1, 2, sharey=True, width_ratios=(1, 1.15)) if has_rows else [figure.add_subplot()]
    labels = list(runs["label"].unique())
    shades = matplotlib.colormaps["viridis_r"](np.linspace(0.12, 1.0, len(labels)))
    colors = {label: INK if label == "inf" else shade for label, shade in zip(labels, shades, strict=True)}
    chosen = runs[[(row.label, row.seed) == selected for row in runs.itertuples()]]
    at_selected: dict[str, Any] = dict(
        marker="o", s=150, facecolors="none", edgecolors="#D55E00", linewidths=2, zorder=4
    )

    scatter = panels[0]
    for label, group in runs.groupby("label", sort=False):
        scatter.scatter(
            group["information"],
            group["cost"],
            s=28,
            color=colors[label],
            label=_beta(str(label)),
            alpha=0.85,
            zorder=3,
        )
    scatter.scatter(
        chosen["information"].clip(lower=FLOOR),
        chosen["cost"],
        label="selected" if len(chosen) else None,
        **at_selected,
    )
    information = runs["information"].clip(lower=FLOOR)
    low, high = 0.6 * information.min(), 1.7 * information.max()
    _log_axis(scatter, "x", subs=(1,))
    scatter.set_xlim(low, max(high, 12 * low))  # at least one tick
    if low < ABOUT_NOTHING:
        scatter.axvspan(
            low, min(ABOUT_NOTHING, high), color="#EEEEEE", zorder=0, label="information of about 0", linewidth=0
        )
    scatter.set_xlabel("information in the TRVs (nat, logarithmic axis)", fontsize=9)
    scatter.set_ylabel(quantity, fontsize=9)
    costs = runs[list(rows.values())].to_numpy()
    if costs.min() > 0 and costs.max() > 4 * costs.min():
        _log_axis(scatter, "y", subs=(1, 2, 5))
    if has_rows:
        _draw_rows(panels[1], runs, rows, colors)
    for axes in panels:
        if cost_limit is not None:
            axes.axhline(cost_limit, color="#D55E00", linestyle=(0, (4, 3)), linewidth=1, zorder=1)
        axes.grid(alpha=0.25)
        axes.margins(y=0.08)
        _tidy(axes)
    if cost_limit is not None:
        where: dict[str, Any] = dict(xycoords=("axes fraction", "data"), textcoords="offset points")
        scatter.annotate(
            f"cost limit {cost_limit:g}",
            (0.99, cost_limit),
            xytext=(0, 3),
            ha="right",
            fontsize=8,
            color="#D55E00",
            **where,
        )
    handles, names = scatter.get_legend_handles_labels()
    columns = min(len(names), 8)
    figure.legend(handles, names, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)
    return figure


def _draw_rows(axes: Axes, runs: pd.DataFrame, rows: Mapping[str, str], colors: Mapping[Any, Any]) -> None:
    """Draw each run as a dot in each row, and the median over seeds as a bar; a line where the rows have an order."""
    names = list(rows)
    in_order = 1 + sum(name.startswith(ORDERED) for name in names)
    for i, (label, group) in enumerate(runs.groupby("label", sort=False)):
        seeds = group[list(rows.values())].to_numpy()  # (seeds, rows)
        at = np.arange(len(names)) + 0.5 * ((i + 0.5) / len(colors) - 0.5)
        median = np.median(seeds, axis=0)
        axes.plot(at, seeds.T, ".", color=colors[label], markersize=4, alpha=0.7)
        axes.plot(at, median, "_", color=colors[label], markersize=8, markeredgewidth=1.6)
        axes.plot(at[:in_order], median[:in_order], color=colors[label], linewidth=1.0, alpha=0.6)
    texts = [_tick(name) for name in names]
    axes.set_xticks(range(len(names)), texts, rotation=30 if sum(map(len, texts)) > 36 else 0)
    axes.set_xlabel(_what(names), fontsize=9)


def _tick(name: str) -> str:
    return "train" if name == "Training" else _short(name)


def _what(names: Sequence[str]) -> str:
    kinds = list(dict.fromkeys(name.rsplit(" ", 1)[0].lower() for name in names[1:] if _short(name) != name))
    return f"{', then '.join(kinds)} (bar: median over seeds)" if kinds else "scenario (bar: median over seeds)"


def _beta(label: str) -> str:
    return r"$\beta = \infty$ (PG)" if label == "inf" else rf"$\beta = {label}$"
