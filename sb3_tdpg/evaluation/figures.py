"""From records to figures, in Matplotlib's object-oriented interface: no window, no global state."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd

from sb3_tdpg.common.files import replaced_atomically
from sb3_tdpg.envs.lava import GOAL, LAVA, WALL
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.trajectories import rollout_states

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette, which readers with any colour vision can tell apart: vermillion, blue, green, ...
PALETTE = ("#D55E00", "#0072B2", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
INK = "#333333"
# Of the bounds that the limits of an information interval come from: marker and name.
LOWER_MARKERS = {
    "critic": ("^", "frozen critic"),
    "gaussian": ("o", "Gaussian critic"),
    "zero": ("_", "never negative"),
}
UPPER_MARKERS = {"logdet": ("v", "log-det"), "loo": ("s", "leave-one-out"), "marginal": ("D", "fitted marginal")}
MAX_ANNOTATED_STEPS = 15
WIDTH = 9.0  # inches: about as wide as a README is shown, so that 9 points stay readable


def cost_histograms(records: pd.DataFrame, scenarios: Sequence[Scenario], *, n_bins: int = 40) -> Figure:
    """
    Draw how often each model incurs which cost, as in the paper's Fig. 3: one panel for each scenario.

    :param records: From :func:`~sb3_tdpg.evaluation.evaluate_scenarios`.
    :param scenarios: The panels from left to right.
    :param n_bins: Bins, the same in all panels. They are equal on a logarithmic axis, since costs range over two
        decades, unless a cost is zero or negative.
    """
    names = [scenario.name for scenario in scenarios]
    shown = records[records["scenario"].isin(names)]
    if missing := sorted(set(names) - set(shown["scenario"])):
        raise ValueError(f"the records have no episodes of the scenarios {missing}")
    figure = _new_figure(WIDTH, 2.9)
    panels = _panels(figure, 1, len(scenarios))[0]
    low, high = shown["cost"].min(), shown["cost"].max()
    is_positive = low > 0
    if is_positive:
        low = max(low, high / 1e3)  # a few costs next to 0 must not stretch the axis; they go into the first bin
        bins = np.geomspace(low, high * 1.001, n_bins + 1)
    else:
        bins = np.histogram_bin_edges(shown["cost"], n_bins)
    for axes, scenario in zip(panels, scenarios, strict=True):
        for color, (label, group) in zip(cycle(PALETTE), shown.groupby("model", sort=False), strict=False):
            costs = group.loc[group["scenario"] == scenario.name, "cost"].clip(lower=low)
            weights = np.full(len(costs), 1 / len(costs))
            axes.hist(costs, bins, weights=weights, color=color, alpha=0.45, label=str(label))
            axes.hist(costs, bins, weights=weights, color=color, histtype="step", linewidth=1.2)
            axes.axvline(costs.mean(), color=color, linestyle=(0, (3, 2)), linewidth=1.2)
        axes.set_title(_title(scenario), fontsize=9)
    if is_positive:
        _log_axis(panels[0], "x", subs=(1, 3))
    panels[0].set_ylabel("share of episodes", fontsize=9)
    figure.supxlabel(f"episode cost{' (logarithmic axis)' if is_positive else ''}; dashed: mean", fontsize=9)
    _legend_above(figure, panels[0])
    return figure


def lava_trajectories(
    models: Mapping[str, Any],
    env_kwargs: Mapping[str, Any] | None = None,
    n_episodes: int = 60,
    seed: int = 0,
    *,
    noise_variances: Sequence[float] = (1e-4, 1.0),
    deterministic: bool = False,
) -> Figure:
    """
    Draw where the robot of the lava problem is over time: one column for each model, one row for each noise level.

    :param models: SB3 models by their label.
    :param env_kwargs: Keywords of the environment beside its noise.
    :param n_episodes: Episodes in a panel; the same start positions in all.
    :param seed: Seed of the episodes.
    :param noise_variances: sigma^2 of the sensor in each row.
    :param deterministic: Act without noise.
    """
    matplotlib = _import_matplotlib()
    figure = _new_figure(WIDTH, 0.6 + 2.4 * len(noise_variances))
    panels = _panels(figure, len(noise_variances), len(models))
    norm = matplotlib.colors.Normalize(WALL, LAVA)
    colors = matplotlib.cm.ScalarMappable(norm, "viridis")
    for row, variance in zip(panels, noise_variances, strict=True):
        for axes, (label, model) in zip(row, models.items(), strict=True):
            scenario = Scenario(label, "Lava-v0", {**(env_kwargs or {}), "sensor_noise_std": variance**0.5})
            states, costs = rollout_states(model, scenario, n_episodes, seed=seed, deterministic=deterministic)
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
    bar = figure.colorbar(colors, ax=panels, pad=0.01, aspect=40)
    bar.set_label("start $d_0$ (m)", fontsize=9)
    return figure


def training_curves(progress: Mapping[str, pd.DataFrame]) -> Figure:
    """
    Draw cost and information over the policy epochs; the cost on a logarithmic axis unless an epoch costs nothing.

    :param progress: By label, what SB3's CSV logger wrote: ``pandas.read_csv("progress.csv")``.
    """
    figure = _new_figure(WIDTH, 2.8)
    cost, information = (figure.add_subplot(1, 2, i) for i in (1, 2))
    for color, (label, frame) in zip(cycle(PALETTE), progress.items(), strict=False):
        epochs = frame["time/iterations"]
        cost.plot(epochs, frame["rollout/ep_cost_mean"], color=color, label=label)
        if "mi/total" in frame:
            information.plot(epochs, frame["mi/total"], color=color, label=label)
    if all((frame["rollout/ep_cost_mean"] > 0).all() for frame in progress.values()):
        _log_axis(cost, "y", subs=(1, 2, 5))
    cost.set_ylabel("mean episode cost", fontsize=9)
    information.set_ylabel(r"$I[x_t; \tilde{x}_t]$, summed over $t$ (nat)", fontsize=9)
    for axes in (cost, information):
        axes.set_xlabel("policy epoch", fontsize=9)
        axes.grid(alpha=0.25)
        _tidy(axes)
    _legend_above(figure, cost)
    return figure


def information_timeline(frame: pd.DataFrame) -> Figure:
    """
    Draw the interval that holds I[x_t; x~_t] over the time steps, with the bounds that its limits come from.

    :param frame: From :func:`~sb3_tdpg.evaluation.interval_frame`.
    """
    figure = _new_figure(WIDTH * 0.75, 3.4)
    axes = figure.add_subplot()
    _tidy(axes)
    t, lower, upper = frame["t"], frame["lower"], frame["upper"]
    axes.fill_between(t, lower, upper, color=PALETTE[1], alpha=0.12, linewidth=0)
    axes.vlines(t, lower, upper, color=PALETTE[1], alpha=0.25, linewidth=8)  # the only ones there are
    axes.plot(t, lower, color=PALETTE[1], linewidth=0.8)
    axes.plot(t, upper, color=PALETTE[1], linewidth=0.8)
    for limit, markers in (("lower", LOWER_MARKERS), ("upper", UPPER_MARKERS)):
        for name, (marker, label) in markers.items():
            rows = frame[frame[f"{limit}_name"] == name]
            if len(rows):
                axes.plot(rows["t"], rows[limit], marker, color=PALETTE[1], markersize=6, label=f"{limit}: {label}")
    cap = np.log(frame["n_episodes"].max())
    if upper.max() > 0.7 * cap:
        axes.axhline(cap, color=INK, linestyle=(0, (4, 3)), linewidth=1, label=r"$\ln N$: lower limits fall behind")
    axes.set_ylim(bottom=0, top=max(1.05 * upper.max(), 0.1))
    axes.xaxis.set_major_locator(_import_matplotlib().ticker.MaxNLocator(integer=True, min_n_ticks=1))
    axes.set_xlabel("time step $t$", fontsize=9)
    axes.set_ylabel(r"$I[x_t; \tilde{x}_t]$ (nat)", fontsize=9)
    _legend_above(figure, axes)
    return figure


def knowledge_map(frame: pd.DataFrame, quantity: Literal["nats", "r2"] = "nats") -> Figure:
    """
    Draw what the TRVs know of each component of the state at each time step, as a heat map.

    Grey where a component is constant. A value in brackets is not distinguishable from nothing.

    :param frame: From :func:`~sb3_tdpg.evaluation.state_knowledge`.
    :param quantity: What the colour shows.
    :raises ValueError: if the frame has no component.
    """
    if len(frame) == 0:
        raise ValueError("the frame has no component: every one is constant, or too few episodes are alive")
    components = frame["component"].unique()
    table = {name: frame.pivot(index="component", columns="t", values=name).loc[components] for name in
             (quantity, "nats_lower")}  # fmt: skip
    values = table[quantity].to_numpy()  # (X, T)
    n_rows, n_columns = values.shape
    figure = _new_figure(min(max(3.0 + 0.6 * n_columns, 4.5), 10.0), 1.3 + 0.5 * n_rows)
    axes = figure.add_subplot()
    top = 1.0 if quantity == "r2" else max(float(np.nanmax(values)), 0.1)
    axes.set_facecolor("#DDDDDD")
    image = axes.imshow(values, cmap="viridis", vmin=0, vmax=top, aspect="auto")
    for row, column in np.ndindex(values.shape) if n_columns <= MAX_ANNOTATED_STEPS else ():
        value = values[row, column]
        if np.isfinite(value):
            is_known = table["nats_lower"].to_numpy()[row, column] > 0
            color = "white" if value < 0.6 * top else INK
            text = f"{value:.2f}" if is_known else f"({value:.2f})"
            axes.text(column, row, text, color=color, fontsize=8, ha="center", va="center")
    axes.set_yticks(range(n_rows), components, fontsize=9)
    axes.xaxis.set_major_locator(_import_matplotlib().ticker.MaxNLocator(integer=True, min_n_ticks=1))
    axes.tick_params(labelsize=8, length=0)
    axes.set_xlabel("time step $t$", fontsize=9)
    axes.spines[:].set_visible(False)
    bar = figure.colorbar(image, pad=0.02)
    bar.set_label(r"$I[x^k_t; \tilde{x}_t]$ (nat), at least" if quantity == "nats" else "$R^2$", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return figure


def robustness_curves(
    records: pd.DataFrame, noise_rows: Sequence[str], other_rows: Sequence[str], reference: str = "Training"
) -> Figure:
    """
    Draw each method's mean cost over the rows of a table: a line for the median seed, a dot for each seed.

    :param records: With a column ``train_seed``.
    :param noise_rows: Scenarios that are ordered; they follow the reference in the left panel.
    :param other_rows: Scenarios without an order, for the right panel.
    :param reference: The scenario of the training.
    """
    figure = _new_figure(WIDTH, 3.6)
    panels = figure.subplots(1, 2, sharey=True, width_ratios=(len(noise_rows) + 1, len(other_rows)))
    means = records.groupby(["model", "train_seed", "scenario"], sort=False)["cost"].mean()
    models = list(records["model"].unique())
    for axes, rows in zip(panels, ([reference, *noise_rows], list(other_rows)), strict=True):
        for i, (color, model) in enumerate(zip(cycle(PALETTE), models, strict=False)):
            seeds = means[model].unstack("scenario")[rows]  # (seeds, rows)
            at = np.arange(len(rows)) + 0.1 * (i - (len(models) - 1) / 2)
            axes.plot(at, seeds.T.to_numpy(), ".", color=color, markersize=4, alpha=0.7)
            style = "-" if axes is panels[0] else ""
            axes.plot(at, seeds.median().to_numpy(), style + "_", color=color, linewidth=1.2, markersize=9, label=model)
        axes.set_xticks(range(len(rows)), [_short(row) for row in rows])
        _tidy(axes)
    _log_axis(panels[0], "y", subs=(1, 2, 5))
    panels[0].set_ylabel("mean episode cost", fontsize=9)
    panels[0].set_xlabel("standard deviation of the pixel noise", fontsize=9)
    panels[1].set_xlabel("test background", fontsize=9)
    _legend_above(figure, panels[0])
    return figure


def diagnosis_bars(records: pd.DataFrame) -> Figure:
    """
    Draw the final distance of each method in each scenario of a diagnosis: a bar for the median seed, a dot for each.

    :param records: With the columns ``train_seed`` and ``distance`` (m).
    """
    figure = _new_figure(WIDTH, 3.2)
    axes = figure.add_subplot()
    distances = records.groupby(["model", "train_seed", "scenario"], sort=False)["distance"].mean()
    models, rows = list(records["model"].unique()), list(records["scenario"].unique())
    width = 0.8 / len(models)
    for i, (color, model) in enumerate(zip(cycle(PALETTE), models, strict=False)):
        seeds = distances[model].unstack("scenario")[rows]
        at = np.arange(len(rows)) + width * (i - (len(models) - 1) / 2)
        axes.bar(at, seeds.median(), width=0.9 * width, color=color, alpha=0.45, label=model)
        axes.plot(at, seeds.T.to_numpy(), ".", color=color, markersize=4)
    axes.set_xticks(range(len(rows)), rows)
    _tidy(axes)
    _log_axis(axes, "y", subs=(1, 2, 5))
    axes.set_ylabel("final distance from the ball (m)", fontsize=9)
    _legend_above(figure, axes)
    return figure


def _short(row: str) -> str:
    """Return what tells a row of a table from its neighbours: "Sensor noise 0.10" -> "0.10"."""
    last = row.rsplit(" ", 1)[-1]
    return last if last[0].isdigit() else "0" if row == "Training" else row


def _legend_above(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    columns = -(-len(labels) // -(-len(labels) // 3))  # as few rows as hold them by three, evenly filled
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, frameon=False, fontsize=9)


def failures_by_yaw(records: pd.DataFrame, *, n_bins: int = 24) -> Figure:
    """
    Draw the share of failed grasps over the mug's yaw, in polar coordinates: it shows where the handle matters.

    :param records: Episodes with the columns ``model``, ``yaw`` (rad) and ``cost`` (1 for a failure).
    :param n_bins: Sectors of the circle.
    """
    figure = _new_figure(5.2, 5.2)
    axes = figure.add_subplot(projection="polar")
    edges = np.linspace(0, 2 * np.pi, n_bins + 1)
    middles = (edges[:-1] + edges[1:]) / 2
    for color, (label, group) in zip(cycle(PALETTE), records.groupby("model", sort=False), strict=False):
        sector = np.digitize(group["yaw"].to_numpy() % (2 * np.pi), edges) - 1
        share = group["cost"].groupby(sector).mean().reindex(range(n_bins)).to_numpy()
        axes.plot(np.append(middles, middles[0]), np.append(share, share[0]), color=color, label=str(label), marker=".")
    axes.set_title("share of failed grasps by the mug's yaw", fontsize=10, color=INK)
    axes.set_ylim(bottom=0)
    axes.tick_params(labelsize=8)
    axes.legend(loc="upper right", bbox_to_anchor=(1.1, 1.1), fontsize=8, frameon=False)
    return figure


def failures_by_camera(records: pd.DataFrame, *, n_bins: int = 12) -> Figure:
    """
    Draw the share of failed grasps over how much higher than usual the camera was.

    :param records: Episodes with the columns ``model``, ``camera`` (m) and ``cost`` (1 for a failure).
    :param n_bins: Parts of the range of heights.
    """
    figure = _new_figure(WIDTH * 0.7, 3.2)
    axes = figure.add_subplot()
    _tidy(axes)
    centimetres = 100 * records["camera"]
    edges = np.linspace(centimetres.min(), centimetres.max() + 1e-9, n_bins + 1)
    for color, (label, group) in zip(cycle(PALETTE), records.groupby("model", sort=False), strict=False):
        share = group["cost"].groupby(np.digitize(centimetres[group.index], edges) - 1).mean().reindex(range(n_bins))
        axes.plot((edges[:-1] + edges[1:]) / 2, share, color=color, label=str(label), marker=".")
    axes.set_xlabel("height of the camera above its usual place, in cm", fontsize=9)
    axes.set_ylabel("share of failed grasps", fontsize=9)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8, frameon=False)
    return figure


def save_figure(figure: Figure, path: str | os.PathLike[str], dpi: int = 150) -> None:
    """
    Write a figure so that at no time a half-written file is there.

    :param figure: A figure of this module.
    :param path: The file; its ending tells the format. Folders are made.
    :param dpi: Pixels an inch.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_atomically(path) as partial:
        figure.savefig(partial, format=path.suffix.lstrip("."), dpi=dpi)


def _draw_corridor(axes: Axes, horizon: int) -> None:
    """Wall, goal and lava behind the trajectories."""
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


def _title(scenario: Scenario) -> str:
    std = scenario.env_kwargs.get("sensor_noise_std")
    if std is None:
        return scenario.name
    return f"training: {_noise(std**2)}" if scenario.name == "Training" else _noise(std**2)


def _noise(variance: float) -> str:
    """sigma^2 = 10^-3 in Matplotlib's mathematics."""
    if variance == 0:
        return r"$\sigma^2 = 0$"
    exponent = np.log10(variance)
    if np.isclose(exponent, round(exponent)) and round(exponent) != 0:
        return rf"$\sigma^2 = 10^{{{round(exponent)}}}$"
    return rf"$\sigma^2 = {variance:.3g}$"


def _new_figure(width: float, height: float) -> Figure:
    return _import_matplotlib().figure.Figure(figsize=(width, height), layout="constrained")


def _panels(figure: Figure, n_rows: int, n_columns: int) -> np.ndarray:
    """Panels with common axes: ``(n_rows, n_columns)``."""
    panels = figure.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False)
    for axes in panels.flat:
        _tidy(axes)
    return panels


def _log_axis(axes: Axes, which: str, subs: tuple[int, ...]) -> None:
    """Make an axis logarithmic, with the ticks (10, 30, 100, ...) as plain numbers."""
    axes.set(**{f"{which}scale": "log"})
    axis = getattr(axes, f"{which}axis")
    axis.set_major_locator(_import_matplotlib().ticker.LogLocator(subs=subs))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter("")


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8)


def _import_matplotlib() -> Any:
    try:
        import matplotlib.cm
        import matplotlib.colors
        import matplotlib.figure
        import matplotlib.ticker
    except ImportError as e:
        raise ImportError("figures need matplotlib: pip install sb3_tdpg[plots]") from e
    return matplotlib
