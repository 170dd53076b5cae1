"""The pictures of a report."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg.evaluation.figures import INK, PALETTE, WIDTH, _import_matplotlib, _log_axis, _new_figure, _tidy
from sb3_tdpg.evaluation.randomness import evaluation_seeds, isolated_randomness
from sb3_tdpg.report.numbers import CLEAR, Numbers
from sb3_tdpg.report.records import Plan
from sb3_tdpg.report.rows import UNPERTURBED, Row
from sb3_tdpg.robustness.core import Perturber
from sb3_tdpg.robustness.registry import find
from sb3_tdpg.robustness.sensor import kind_of
from sb3_tdpg.vec_env import make_episodes_env

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = "osD^vP"


def degradation_curves(numbers: Numbers) -> Figure:
    """
    Draw each method's cost over the severities, with its interval: one panel for each perturbation, one scale.

    :param numbers: Of the report.
    """
    names = numbers.perturbations
    figure, panels = _grid(len(names))
    levels = numbers.levels
    for axes, name in zip(panels.flat, names, strict=False):
        for style, label in zip(_styles(), numbers.models, strict=False):
            of_model = levels[levels["model"] == label]
            curve = of_model[of_model["perturbation"].isin((UNPERTURBED, name))].sort_values("severity")
            axes.fill_between(curve["severity"], curve["low"], curve["high"], color=style["color"], alpha=0.2, lw=0)
            axes.plot(curve["severity"], curve["iqm"], **style, markersize=3.5, linewidth=1.3, label=label)
        axes.set_title(name, fontsize=9)
        axes.grid(alpha=0.25)
        _tidy(axes)
    panels[0, 0].set_xticks(sorted({0, *levels["severity"]}))
    _log_if_wide(panels[0, 0], levels, "y")
    figure.supxlabel("severity (0: unperturbed)", fontsize=9)
    figure.supylabel("episode cost", fontsize=9)
    _legend(figure, panels[0, 0])
    return figure


def own_rows_figure(numbers: Numbers) -> Figure:
    """
    Draw each method's cost in the environment's own rows, with its interval.

    :param numbers: Of the report; there must be such rows.
    """
    shown = numbers.levels[numbers.levels["kind"].isin(("unperturbed", "own"))]
    names = list(shown["perturbation"].unique())
    figure = _new_figure(WIDTH, 0.9 + 0.24 * len(names))
    axes = figure.add_subplot()
    models = numbers.models
    for i, (style, label) in enumerate(zip(_styles(), models, strict=False)):
        of_model = shown[shown["model"] == label].set_index("perturbation").loc[names]
        at = np.arange(len(names)) + 0.22 * (i - (len(models) - 1) / 2)
        axes.hlines(at, of_model["low"], of_model["high"], color=style["color"], linewidth=2, alpha=0.5)
        axes.plot(of_model["iqm"], at, style["marker"], color=style["color"], markersize=4.5, label=label)
    axes.set_yticks(range(len(names)), names, fontsize=9)
    axes.invert_yaxis()
    axes.grid(alpha=0.25, axis="x")
    _tidy(axes)
    _log_if_wide(axes, shown, "x")
    axes.set_xlabel("episode cost", fontsize=9)
    _legend(figure, axes)
    return figure


def comparison_figure(numbers: Numbers) -> Figure:
    """
    Draw how likely a model of each method costs less than one of the first method, perturbation by perturbation.

    :param numbers: Of the report; there must be probabilities.
    """
    frame = numbers.comparisons[numbers.comparisons["p_cost"].notna()]
    names = list(frame["perturbation"].unique())
    figure = _new_figure(WIDTH * 0.8, 1.1 + 0.21 * len(names))
    axes = figure.add_subplot()
    control = frame["control"].iloc[0]
    styles = dict(zip(numbers.models, _styles(), strict=False))
    labels = list(frame["model"].unique())
    for i, label in enumerate(labels):
        rows = frame[frame["model"] == label].set_index("perturbation").loc[names]
        at = np.arange(len(names)) + 0.22 * (i - (len(labels) - 1) / 2)
        style = styles[label]
        axes.hlines(at, rows["p_cost_low"], rows["p_cost_high"], color=style["color"], linewidth=2, alpha=0.5)
        axes.plot(rows["p_cost"], at, style["marker"], color=style["color"], markersize=5, label=label)
    axes.axvline(0.5, color=INK, linewidth=1)
    for edge in (1 - CLEAR, CLEAR):
        axes.axvline(edge, color=INK, linewidth=0.8, linestyle=(0, (3, 3)), alpha=0.6)
    axes.set_xlim(-0.02, 1.02)
    axes.set_yticks(range(len(names)), names, fontsize=9)
    axes.invert_yaxis()
    _tidy(axes)
    axes.set_xlabel(f"probability of a lower cost than {control} (dashed: {1 - CLEAR:.2g} and {CLEAR:.2g})", fontsize=9)
    _legend(figure, axes)
    return figure


def vector_examples(plan: Plan, rows: Sequence[Row], model: Any) -> Figure:
    """
    Draw one component of what is observed in an episode, as it is and as each perturbation shows it.

    The model acts on the unperturbed observations, so that the true episode is the same in all panels. The component is
    the one that varies most in it, in multiples of its scale.

    :param plan: Of the report.
    :param rows: Those with perturbations of the sensor.
    :param model: Which acts.
    """
    observations, space = _episode(plan, model)
    flat = observations.reshape(len(observations), -1)
    assert plan.scale is not None
    scale = np.asarray(plan.scale, dtype=np.float64).ravel()
    spread = flat.std(axis=0) / np.where(scale > 0, scale, np.inf)
    component = int(np.argmax(spread))
    names = list(dict.fromkeys(row.perturbation for row in rows))
    figure, panels = _grid(len(names))
    shades = _import_matplotlib().colormaps["viridis_r"]
    dots = "." if len(flat) <= 30 else ""
    for axes, name in zip(panels.flat, names, strict=False):
        for row in (row for row in rows if row.perturbation == name):
            perturber = Perturber(find(name), row.severity, space, 1, seed=plan.seed, scale=plan.scale)
            seen = [perturber(observation[None]).ravel()[component] for observation in observations]
            color = shades(0.1 + 0.8 * row.severity / 5)
            axes.plot(seen, dots + "-", color=color, linewidth=0.9, markersize=4, label=f"severity {row.severity}")
        axes.plot(flat[:, component], dots + "-", color=INK, linewidth=1.6, markersize=5, label=UNPERTURBED, zorder=0)
        axes.set_title(name, fontsize=9)
        _tidy(axes)
    figure.supxlabel("time step $t$", fontsize=9)
    figure.supylabel(f"component {component} of the observation", fontsize=9)
    _legend(figure, panels[0, 0], n_columns=6)
    return figure


def _episode(plan: Plan, model: Any) -> tuple[np.ndarray, spaces.Box]:
    """Return what is observed in an episode, ``(T, *obs)``, as it comes from the sensor, and its space."""
    env = make_episodes_env(plan.env_id, 1, env_kwargs=plan.env_kwargs, use_processes=False)
    seeds = evaluation_seeds(plan.seed)
    normalize: VecNormalize | None = model.get_vec_normalize_env()
    try:
        env.seed(seeds.env)
        observation = np.asarray(env.reset())
        seen: list[np.ndarray] = []
        memory, start = None, np.ones(1, dtype=bool)
        with isolated_randomness(seeds.policy, model):
            while len(seen) < 500:
                seen.append(observation[0])
                normal = observation if normalize is None else normalize.normalize_obs(observation)
                action, memory = model.predict(normal, memory, start, deterministic=plan.deterministic)
                shown, _, start, _ = env.step(action)
                observation = np.asarray(shown)
                if start[0]:
                    break
        space = env.observation_space
        assert isinstance(space, spaces.Box)
        return np.stack(seen), space
    finally:
        env.close()


def shows_images(space: spaces.Space) -> bool:
    """Tell whether there are images to show."""
    return kind_of(space) == "image"


def _grid(n: int) -> tuple[Figure, np.ndarray]:
    """Make a figure with n panels of common axes, in rows of five at the most that are as full as can be."""
    n_columns = n if n <= 5 else min((5, 4, 3), key=lambda columns: -n % columns)
    n_rows = -(-n // n_columns)
    figure = _new_figure(WIDTH, 0.7 + 1.8 * n_rows)
    panels = figure.subplots(n_rows, n_columns, sharex=True, sharey=True, squeeze=False)
    for axes in panels.flat[n:]:
        axes.set_axis_off()
    for axes in panels.flat[max(0, n - n_columns) : n]:
        axes.tick_params(labelbottom=True)  # also above a panel that is not there
    return figure, panels


def _styles() -> Any:
    return ({"color": color, "marker": marker} for color, marker in zip(cycle(PALETTE), cycle(MARKERS), strict=False))


def _log_if_wide(axes: Axes, frame: pd.DataFrame, which: str) -> None:
    """Make an axis logarithmic where costs are positive and range over more than a decade."""
    low, high = frame[["low", "iqm"]].min().min(), frame["iqm"].max()
    if low > 0 and high > 10 * low:
        _log_axis(axes, which, subs=(1, 3) if high < 300 * low else (1,))


def _legend(figure: Figure, axes: Axes, n_columns: int = 4) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=n_columns, frameon=False, fontsize=9)
