"""Draw figures from records with Matplotlib's object-oriented interface, without windows or global state."""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sb3_tdpg.common.files import replaced_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# The palette of Okabe and Ito, safe for colour-blind readers: vermillion, blue, green, ...
PALETTE = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#999999", "#000000")
INK = "#333333"
# Markers and names of the bounds that give the limits of an information interval.
BOUNDS = {
    "lower": {"critic": ("^", "frozen critic"), "gaussian": ("o", "Gaussian critic"), "zero": ("_", "never negative")},
    "upper": {"logdet": ("v", "log-det"), "loo": ("s", "leave-one-out"), "marginal": ("D", "fitted marginal")},
}
MAX_ANNOTATED_STEPS = 15
WIDTH = 9.0  # inches: about the width of a README, so that text of 9 points stays readable


def training_curves(progress: Mapping[str, pd.DataFrame]) -> Figure:
    """
    Draw cost and information over the policy epochs; the cost axis is logarithmic if all costs are positive.

    :param progress: Logs of SB3's CSV logger by label, each read with ``pandas.read_csv("progress.csv")``.
    """
    figure, ((cost, information),) = new_panels(WIDTH, 2.8, 1, 2)
    for color, (label, frame) in zip(cycle(PALETTE), progress.items(), strict=False):
        epochs = frame["time/iterations"]
        cost.plot(epochs, frame["rollout/ep_cost_mean"], color=color, label=label)
        if "mi/total" in frame:
            information.plot(epochs, frame["mi/total"], color=color, label=label)
    if all((frame["rollout/ep_cost_mean"] > 0).all() for frame in progress.values()):
        log_axis(cost, "y", subs=(1, 2, 5))
    cost.set_ylabel("mean episode cost", fontsize=9)
    information.set_ylabel(r"$I[x_t; \tilde{x}_t]$, summed over $t$ (nat)", fontsize=9)
    for axes in (cost, information):
        axes.set_xlabel("policy epoch", fontsize=9)
        axes.grid(alpha=0.25)
    legend_above(figure, cost)
    return figure


def information_timeline(frame: pd.DataFrame) -> Figure:
    """
    Draw the interval for I[x_t; x~_t] over the time steps, with a marker for the bound that gives each limit.

    :param frame: The frame of an :class:`~sb3_tdpg.evaluation.InformationReport`.
    """
    figure, ((axes,),) = new_panels(WIDTH * 0.75, 3.4)
    t, lower, upper = frame["t"], frame["lower"], frame["upper"]
    axes.fill_between(t, lower, upper, color=PALETTE[1], alpha=0.12, linewidth=0)
    axes.vlines(t, lower, upper, color=PALETTE[1], alpha=0.25, linewidth=8)  # so that a single step is visible, too
    axes.plot(t, frame[["lower", "upper"]], color=PALETTE[1], linewidth=0.8)
    for limit, markers in BOUNDS.items():
        for name, (marker, label) in markers.items():
            rows = frame[frame[f"{limit}_name"] == name]
            if len(rows):
                axes.plot(rows["t"], rows[limit], marker, color=PALETTE[1], markersize=6, label=f"{limit}: {label}")
    cap = np.log(frame["n_episodes"].max())
    if upper.max() > 0.7 * cap:
        axes.axhline(cap, color=INK, linestyle=(0, (4, 3)), linewidth=1, label=r"$\ln N$: lower limits become loose")
    axes.set_ylim(bottom=0, top=max(1.05 * upper.max(), 0.1))
    axes.xaxis.set_major_locator(import_matplotlib().ticker.MaxNLocator(integer=True, min_n_ticks=1))
    axes.set_xlabel("time step $t$", fontsize=9)
    axes.set_ylabel(r"$I[x_t; \tilde{x}_t]$ (nat)", fontsize=9)
    legend_above(figure, axes)
    return figure


def knowledge_map(frame: pd.DataFrame) -> Figure:
    """
    Draw the information in the TRVs about each component of the state at each time step, as a heat map.

    A component is grey at steps at which it is constant or too few episodes are alive. Values in brackets have a lower
    confidence limit of 0.

    :param frame: Result of :func:`~sb3_tdpg.evaluation.state_knowledge`.
    :raises ValueError: if the frame has no component.
    """
    if len(frame) == 0:
        raise ValueError("the frame has no component: every one is constant, or too few episodes are alive")
    components = frame["component"].unique()
    table = frame.pivot(index="component", columns="t").loc[components]
    values, lower = table["nats"].to_numpy(), table["nats_lower"].to_numpy()  # (X, T) each
    n_rows, n_columns = values.shape
    figure = new_figure(min(max(3.0 + 0.6 * n_columns, 4.5), 10.0), 1.3 + 0.5 * n_rows)
    axes = figure.add_subplot()
    top = max(float(np.nanmax(values)), 0.1)
    axes.set_facecolor("#DDDDDD")
    image = axes.imshow(values, cmap="viridis", vmin=0, vmax=top, aspect="auto")
    for row, column in np.ndindex(values.shape) if n_columns <= MAX_ANNOTATED_STEPS else ():
        value = values[row, column]
        if np.isfinite(value):
            color = "white" if value < 0.6 * top else INK
            text = f"{value:.2f}" if lower[row, column] > 0 else f"({value:.2f})"
            axes.text(column, row, text, color=color, fontsize=8, ha="center", va="center")
    axes.set_yticks(range(n_rows), components, fontsize=9)
    axes.xaxis.set_major_locator(import_matplotlib().ticker.MaxNLocator(integer=True, min_n_ticks=1))
    axes.tick_params(labelsize=8, length=0)
    axes.set_xlabel("time step $t$", fontsize=9)
    axes.spines[:].set_visible(False)
    bar = figure.colorbar(image, pad=0.02)
    bar.set_label(r"$I[x^k_t; \tilde{x}_t]$ (nat), at least", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return figure


def short_name(row: str) -> str:
    """Shorten the name of a scenario for a tick label: "Sensor noise 0.10" -> "0.10"."""
    last = row.rsplit(" ", 1)[-1]
    return last if last[0].isdigit() else "0" if row == "Training" else row


def legend_above(figure: Figure, axes: Axes, most: int = 3) -> None:
    """Draw the legend of the axes above the figure, in at most ``most`` columns."""
    handles, labels = axes.get_legend_handles_labels()
    columns = -(-len(labels) // -(-len(labels) // most))  # use as few rows as possible, evenly filled
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)


def save_figure(figure: Figure, path: str | os.PathLike[str], dpi: int = 150) -> None:
    """
    Save a figure; the file appears only when it is complete.

    :param figure: A Matplotlib figure.
    :param path: The file, whose extension sets the format. Folders are created.
    :param dpi: Pixels per inch.
    """
    with replaced_atomically(Path(path)) as partial:
        figure.savefig(partial, dpi=dpi)


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure with a constrained layout; the size is in inches."""
    return import_matplotlib().figure.Figure(figsize=(width, height), layout="constrained")


def new_panels(
    width: float, height: float, n_rows: int = 1, n_columns: int = 1, **options: Any
) -> tuple[Figure, np.ndarray]:
    """Make a figure as :func:`new_figure` does, with tidy panels, ``(n_rows, n_columns)``."""
    figure = new_figure(width, height)
    panels = figure.subplots(n_rows, n_columns, squeeze=False, **options)
    for axes in panels.flat:
        tidy(axes)
    return figure, panels


def log_axis(axes: Axes, which: str, subs: tuple[float, ...]) -> None:
    """Make an axis logarithmic, with ticks at ``subs`` times the powers of ten, as plain numbers."""
    axes.set(**{f"{which}scale": "log"})
    axis = getattr(axes, f"{which}axis")
    axis.set_major_locator(import_matplotlib().ticker.LogLocator(subs=subs))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")


def tidy(axes: Axes) -> None:
    """Remove the spines at the top and at the right, and make the tick labels small."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def import_matplotlib() -> Any:
    """Import Matplotlib, which is an optional dependency."""
    try:
        import matplotlib.figure
        import matplotlib.ticker
    except ImportError as e:
        raise ImportError("figures need matplotlib: pip install sb3_tdpg[plots]") from e
    return matplotlib
