"""Draw the figures of the reproductions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from sb3_tdpg.envs.lava import GOAL, LAVA, WALL
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.figures import (
    INK,
    PALETTE,
    WIDTH,
    import_matplotlib,
    legend_above,
    log_axis,
    new_figure,
    new_panels,
    short_name,
)  # fmt: skip
from sb3_tdpg.evaluation.records import rollout_states

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

N_BINS = 40  # number of bins of a histogram
NOISE_VARIANCES = (1e-4, 1.0)  # variances of the sensor noise in the figure of the trajectories


def cost_histograms(records: pd.DataFrame, scenarios: Sequence[Scenario]) -> Figure:
    """
    Draw histograms of the episode cost, as in the paper's Fig. 3: one panel for each scenario.

    :param records: From :func:`~sb3_tdpg.evaluation.evaluate_scenarios`.
    :param scenarios: The panels from left to right. The bins have equal widths on a logarithmic axis and cover at
        most three decades; lower costs are in the first bin.
    """
    shown = records[records["scenario"].isin([scenario.name for scenario in scenarios])]
    figure, (panels,) = new_panels(WIDTH, 2.9, 1, len(scenarios), sharex=True, sharey=True)
    high = shown["cost"].max()
    low = max(shown["cost"].min(), high / 1e3)  # a few costs near 0 are in the first bin: they would stretch the axis
    bins = np.geomspace(low, high * 1.001, N_BINS + 1)
    for axes, scenario in zip(panels, scenarios, strict=True):
        for color, (label, group) in zip(cycle(PALETTE), shown.groupby("model", sort=False), strict=False):
            costs = group.loc[group["scenario"] == scenario.name, "cost"].clip(lower=low)
            weights = np.full(len(costs), 1 / len(costs))
            axes.hist(costs, bins, weights=weights, color=color, alpha=0.45, label=str(label))
            axes.hist(costs, bins, weights=weights, color=color, histtype="step", linewidth=1.2)
            axes.axvline(costs.mean(), color=color, linestyle=(0, (3, 2)), linewidth=1.2)
        start = "training: " if scenario.name == "Training" else ""
        axes.set_title(start + _noise(scenario.env_kwargs["sensor_noise_std"] ** 2), fontsize=9)
    log_axis(panels[0], "x", subs=(1, 3))
    panels[0].set_ylabel("share of episodes", fontsize=9)
    figure.supxlabel("episode cost (logarithmic axis); dashed: mean", fontsize=9)
    legend_above(figure, panels[0])
    return figure


def lava_trajectories(
    models: Mapping[str, Any], env_kwargs: Mapping[str, Any] | None = None, n_episodes: int = 60
) -> Figure:
    """
    Draw the position of the robot of the lava problem over time: one column per model, one row per noise level.

    :param models: SB3 models; the keys are their labels.
    :param env_kwargs: Keywords of the environment other than its noise.
    :param n_episodes: Number of episodes in each panel; all panels have the same initial positions.
    """
    matplotlib = import_matplotlib()
    n_rows = len(NOISE_VARIANCES)
    figure, panels = new_panels(WIDTH, 0.6 + 2.4 * n_rows, n_rows, len(models), sharex=True, sharey=True)
    colors = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(WALL, LAVA), "viridis")
    for row, variance in zip(panels, NOISE_VARIANCES, strict=True):
        for axes, (label, model) in zip(row, models.items(), strict=True):
            scenario = Scenario(label, "Lava-v0", {**(env_kwargs or {}), "sensor_noise_std": variance**0.5})
            states, costs = rollout_states(model, scenario, n_episodes)
            d = states[:, :, 0]  # (T + 1, N)
            _draw_corridor(axes, horizon=len(d) - 1)
            for path in d.T:
                axes.plot(path, color=colors.to_rgba(path[0]), linewidth=0.8, alpha=0.8)
            in_lava = (d[-1] >= LAVA).mean()
            title = f"{label}, {_noise(variance)}\nmean cost {costs.mean():.0f}, {in_lava:.0%} in the lava"
            axes.set_title(title, fontsize=9)
    for axes in panels[-1]:
        axes.set_xlabel("time step $t$", fontsize=9)
    figure.supylabel("distance from the wall $d_t$ (m)", fontsize=9)
    figure.colorbar(colors, ax=panels, pad=0.01, aspect=40).set_label("start $d_0$ (m)", fontsize=9)
    return figure


def robustness_curves(records: pd.DataFrame, noise_rows: Sequence[str], other_rows: Sequence[str]) -> Figure:
    """
    Draw each method's mean cost in the scenarios of a table, with a dash at the median over seeds and a dot per seed.

    :param records: Episodes, with a column ``train_seed``.
    :param noise_rows: Scenarios of the left panel in the order of their noise; the training comes before them.
    :param other_rows: Scenarios of the right panel.
    """
    widths = len(noise_rows) + 1, len(other_rows)
    figure, (panels,) = new_panels(WIDTH, 3.6, 1, 2, sharey=True, width_ratios=widths)
    for axes, rows in zip(panels, (["Training", *noise_rows], list(other_rows)), strict=True):
        for color, model, at, seeds in _seed_means(records, "cost", rows, spacing=0.1):
            axes.plot(at, seeds.T.to_numpy(), ".", color=color, markersize=4, alpha=0.7)
            style = "-" if axes is panels[0] else ""
            axes.plot(at, seeds.median().to_numpy(), style + "_", color=color, linewidth=1.2, markersize=9, label=model)
        axes.set_xticks(range(len(rows)), [short_name(row) for row in rows])
    log_axis(panels[0], "y", subs=(1, 2, 5))
    panels[0].set_ylabel("mean episode cost", fontsize=9)
    panels[0].set_xlabel("standard deviation of the pixel noise", fontsize=9)
    panels[1].set_xlabel("test background", fontsize=9)
    legend_above(figure, panels[0])
    return figure


def diagnosis_bars(records: pd.DataFrame) -> Figure:
    """
    Draw each method's final distance from the ball in each scenario, with a bar at the median over seeds and a dot per
    seed.

    :param records: Episodes, with the columns ``train_seed`` and ``distance`` (m).
    """
    figure, ((axes,),) = new_panels(WIDTH, 3.2)
    rows, width = list(records["scenario"].unique()), 0.8 / records["model"].nunique()
    for color, model, at, seeds in _seed_means(records, "distance", rows, spacing=width):
        axes.bar(at, seeds.median(), width=0.9 * width, color=color, alpha=0.45, label=model)
        axes.plot(at, seeds.T.to_numpy(), ".", color=color, markersize=4)
    axes.set_xticks(range(len(rows)), rows)
    log_axis(axes, "y", subs=(1, 2, 5))
    axes.set_ylabel("final distance from the ball (m)", fontsize=9)
    legend_above(figure, axes)
    return figure


def _seed_means(
    records: pd.DataFrame, column: str, rows: list[str], spacing: float
) -> Iterator[tuple[str, str, np.ndarray, pd.DataFrame]]:
    """Yield each method's colour, label, positions on the axis, and means of a column, with shape ``(seeds, rows)``."""
    means = records.groupby(["model", "train_seed", "scenario"], sort=False)[column].mean()
    models = records["model"].unique()
    for i, (color, model) in enumerate(zip(cycle(PALETTE), models, strict=False)):
        at = np.arange(len(rows)) + spacing * (i - (len(models) - 1) / 2)
        yield color, model, at, means[model].unstack("scenario")[rows]


def failures_by_yaw(records: pd.DataFrame) -> Figure:
    """Draw the failure rate over the mug's yaw (rad) in polar coordinates."""
    figure = new_figure(5.2, 5.2)
    axes = figure.add_subplot(projection="polar")
    _draw_failures(figure, axes, records, records["yaw"] % (2 * np.pi), np.linspace(0, 2 * np.pi, 25))
    axes.set_title("share of failed grasps by the mug's yaw", fontsize=10, color=INK)
    axes.tick_params(labelsize=8)
    return figure


def failures_by_camera(records: pd.DataFrame, *, n_bins: int = 12) -> Figure:
    """Draw the failure rate over the column ``camera``, the height of the camera above its usual position (m)."""
    figure, ((axes,),) = new_panels(WIDTH * 0.7, 3.2)
    centimetres = 100 * records["camera"]
    edges = np.linspace(centimetres.min(), centimetres.max() + 1e-9, n_bins + 1)
    _draw_failures(figure, axes, records, centimetres, edges)
    axes.set_xlabel("height of the camera above its usual place, in cm", fontsize=9)
    axes.set_ylabel("share of failed grasps", fontsize=9)
    return figure


def _draw_failures(figure: Figure, axes: Axes, records: pd.DataFrame, at: pd.Series, edges: np.ndarray) -> None:
    """Draw the failure rate in each bin; in polar coordinates the curves are closed."""
    middles = (edges[:-1] + edges[1:]) / 2
    order = np.arange(len(middles) + (axes.name == "polar")) % len(middles)
    for color, (label, group) in zip(cycle(PALETTE), records.groupby("model", sort=False), strict=False):
        bins = np.digitize(at[group.index], edges) - 1
        share = group["cost"].groupby(bins).mean().reindex(range(len(middles))).to_numpy()
        axes.plot(middles[order], share[order], color=color, label=str(label), marker=".")
    axes.set_ylim(bottom=0)
    legend_above(figure, axes)


def _draw_corridor(axes: Axes, horizon: int) -> None:
    """Draw wall, goal and lava behind the trajectories."""
    low, high = WALL - 0.5, LAVA + 0.5
    axes.axhspan(low, WALL, color="#999999", linewidth=0)
    axes.axhspan(LAVA, high, color="#F0954B", linewidth=0)
    axes.axhline(GOAL[0], color=INK, linestyle=(0, (4, 3)), linewidth=1)
    for height, text in ((WALL - 0.25, "wall"), (LAVA + 0.25, "lava")):
        axes.text(0.98 * horizon, height, text, color=INK, fontsize=8, ha="right", va="center")
    axes.text(1.015 * horizon, GOAL[0], "goal", color=INK, fontsize=8, va="center")
    axes.set_ylim(low, high)
    axes.set_xlim(0, horizon)
    axes.set_xticks(range(horizon + 1))


def _noise(variance: float) -> str:
    """Return the label of a variance that is a power of ten, such as sigma^2 = 10^-3, in Matplotlib's notation."""
    return r"$\sigma^2 = 1$" if variance == 1 else rf"$\sigma^2 = 10^{{{round(np.log10(variance))}}}$"
