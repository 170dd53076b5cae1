"""Draw the figures of a report."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from sb3_tdpg.evaluation.figures import PALETTE, WIDTH, legend_above, log_axis, new_panels
from sb3_tdpg.report.numbers import Numbers
from sb3_tdpg.report.rows import UNPERTURBED

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = "osD^vP"


def degradation_curves(numbers: Numbers) -> Figure:
    """Draw the cost of each method with its interval against the severity, in one panel per perturbation."""
    names, levels = numbers.perturbations, numbers.levels
    figure, panels = _grid(len(names))
    for axes, name in zip(panels.flat, names, strict=False):
        for label, style in _styles(numbers).items():
            of_model = levels[levels["model"] == label]
            curve = of_model[of_model["perturbation"].isin((UNPERTURBED, name))].sort_values("severity")
            axes.fill_between(curve["severity"], curve["low"], curve["high"], color=style["color"], alpha=0.2, lw=0)
            axes.plot(curve["severity"], curve["iqm"], **style, markersize=3.5, linewidth=1.3, label=label)
            each = numbers.model_levels.query("model == @label and perturbation in (@UNPERTURBED, @name)")
            axes.plot(each["severity"], each["cost"], ".", color=style["color"], markersize=3, alpha=0.6)
        axes.set_title(name, fontsize=9)
        axes.grid(alpha=0.25)
    panels[0, 0].set_xticks(sorted({0, *levels["severity"]}))
    _log_if_wide(panels[0, 0], levels, "y")
    figure.supxlabel("severity (0: unperturbed)", fontsize=9)
    figure.supylabel("episode cost", fontsize=9)
    legend_above(figure, panels[0, 0], 4)
    return figure


def own_rows_figure(numbers: Numbers) -> Figure:
    """Draw the cost of each method, with its interval and a dot for each model, in each test row of the environment."""
    shown = numbers.levels[numbers.levels["kind"].isin(("unperturbed", "own"))]
    names, styles = list(shown["perturbation"].unique()), _styles(numbers)
    figure, ((axes,),) = new_panels(WIDTH, 1.1 + 0.24 * len(names))
    for i, (label, style) in enumerate(styles.items()):
        color = style["color"]
        rows = shown[shown["model"] == label].set_index("perturbation").loc[names]
        at = pd.Series(np.arange(len(names)) + 0.22 * (i - (len(styles) - 1) / 2), names)
        axes.hlines(at, rows["low"], rows["high"], color=color, linewidth=2, alpha=0.5)
        axes.plot(rows["iqm"], at, style["marker"], color=color, markersize=4.5, label=label)
        each = numbers.model_levels.query("model == @label and perturbation in @names")
        axes.plot(each["cost"], at.loc[each["perturbation"]], ".", color=color, markersize=3, alpha=0.6)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.grid(alpha=0.25, axis="x")
    _log_if_wide(axes, shown, "x")
    axes.set_xlabel("episode cost", fontsize=9)
    legend_above(figure, axes, 4)
    return figure


def _grid(n: int) -> tuple[Figure, np.ndarray]:
    """Make a figure with n panels that share their axes, in rows of up to five panels, with as few gaps as possible."""
    n_columns = n if n <= 5 else min((5, 4, 3), key=lambda columns: -n % columns)
    n_rows = -(-n // n_columns)
    figure, panels = new_panels(WIDTH, 0.7 + 1.8 * n_rows, n_rows, n_columns, sharex=True, sharey=True)
    for axes in panels.flat[n:]:
        axes.set_axis_off()
    for axes in panels.flat[max(0, n - n_columns) : n]:
        axes.tick_params(labelbottom=True)  # needed above a missing panel
    return figure, panels


def _styles(numbers: Numbers) -> Mapping[str, dict[str, str]]:
    """Return the colour and the marker of each method."""
    styles = zip(numbers.models, cycle(PALETTE), cycle(MARKERS), strict=False)
    return {label: dict(color=color, marker=marker) for label, color, marker in styles}


def _log_if_wide(axes: Axes, frame: pd.DataFrame, which: str) -> None:
    """Make an axis logarithmic if all costs are positive and range over more than a decade."""
    low, high = frame[["low", "iqm"]].min().min(), frame["iqm"].max()
    if low > 0 and high > 10 * low:
        log_axis(axes, which, subs=(1, 3) if high < 300 * low else (1,))
