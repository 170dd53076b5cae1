"""Draw the figures of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from functools import partial
from itertools import cycle, islice
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from gymnasium import spaces

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import scenario_env
from sb3_tdpg.evaluation.figures import INK, PALETTE, WIDTH, import_matplotlib, legend_above, log_axis, new_panels
from sb3_tdpg.evaluation.randomness import evaluation_seeds
from sb3_tdpg.evaluation.rollout import rollout
from sb3_tdpg.report.numbers import Numbers
from sb3_tdpg.report.plan import Plan
from sb3_tdpg.report.rows import UNPERTURBED, Row
from sb3_tdpg.robustness import PerturbedVecEnv
from sb3_tdpg.robustness.core import Perturber
from sb3_tdpg.robustness.registry import PERTURBATIONS
from sb3_tdpg.robustness.sensor import Sensor

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MARKERS = "osD^vP"
MAX_STEPS = 100  # of the episode that shows the perturbations; more steps would be too close to each other


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
    """Draw, for each test row of the environment, each method's cost with its interval, and the costs of its models."""
    shown = numbers.levels[numbers.levels["kind"].isin(("unperturbed", "own"))]
    figure, axes = _by_row(numbers, shown.assign(value=shown["iqm"]), numbers.model_levels)
    axes.grid(alpha=0.25, axis="x")
    _log_if_wide(axes, shown, "x")
    axes.set_xlabel("episode cost", fontsize=9)
    legend_above(figure, axes, 4)
    return figure


def comparison_figure(numbers: Numbers) -> Figure:
    """Draw, for each method, the share of model pairs in which its model costs less than the first method's model."""
    reference = numbers.models[0]
    frame = numbers.comparisons[[numbers.can_be_clear(label) for label in numbers.comparisons["model"]]]
    costs = numbers.model_groups.pivot(index=["model", "train_seed"], columns="perturbation", values="cost")
    theirs = costs.loc[reference]
    shares = [((row < theirs) + 0.5 * (row == theirs)).mean().rename(key) for key, row in costs.iterrows()]
    dots = pd.concat(shares, axis=1).rename_axis(columns=["model", "train_seed"]).stack([0, 1], future_stack=True)
    is_clear = frame["cost"] != "undecided"
    figure, axes = _by_row(
        numbers, frame.assign(value=frame["p_cost"], is_filled=is_clear), dots.reset_index(name="cost")
    )
    axes.axvline(0.5, color=INK, linewidth=1)
    axes.set_xlim(-0.02, 1.02)
    axes.xaxis.set_major_formatter("{x:.0%}")
    axes.set_xlabel(f"pairs of models with a lower cost than {reference} (filled: clear)", fontsize=9)
    legend_above(figure, axes, 4)
    return figure


def _by_row(numbers: Numbers, frame: pd.DataFrame, of_models: pd.DataFrame) -> tuple[Figure, Axes]:
    """
    Draw a value for each perturbation (rows) and method, with a dot for each model.

    :param frame: Columns ``perturbation``, ``model``, ``value``, and either the ends of intervals or ``is_filled``.
    :param of_models: Columns ``perturbation``, ``model``, ``cost``.
    """
    names, labels = list(frame["perturbation"].unique()), list(frame["model"].unique())
    figure, ((axes,),) = new_panels(WIDTH, 1.1 + 0.24 * len(names))
    for i, label in enumerate(labels):
        style = _styles(numbers)[label]
        color = style["color"]
        rows = frame[frame["model"] == label].set_index("perturbation").loc[names]
        at = pd.Series(np.arange(len(names)) + 0.22 * (i - (len(labels) - 1) / 2), names)
        if "low" in rows:
            axes.hlines(at, rows["low"], rows["high"], color=color, linewidth=2, alpha=0.5)
        filled = rows.get("is_filled", pd.Series(True, names)).astype(bool)
        for fill, chosen in ((color, filled), ("white", ~filled)):
            style_of_points = dict(color=color, markerfacecolor=fill, markersize=4.5)
            axes.plot(rows["value"][chosen], at[chosen], style["marker"], **style_of_points)
        axes.plot([], [], style["marker"], color=color, markersize=4.5, label=label)
        dots = of_models[(of_models["model"] == label) & of_models["perturbation"].isin(names)]
        axes.plot(dots["cost"], at.loc[dots["perturbation"]], ".", color=color, markersize=3, alpha=0.6)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    return figure, axes


def vector_examples(plan: Plan, rows: Sequence[Row], model: Any) -> Figure:
    """
    Draw one component of the observations of an episode, unperturbed and under each perturbation.

    The model acts on the unperturbed observations, so that the true episode is the same in all panels. The figure shows
    the component with the largest variation, relative to its scale.
    """
    observations, space = _episode(plan, model)
    scales = plan.scale if isinstance(plan.scale, Mapping) else {"": plan.scale}
    parts = {key: np.concatenate([_part(each, key) for each in observations]) for key in scales}  # (T, *obs)
    spread = {
        key: (parts[key].std(axis=0) / np.where(scale > 0, scale, np.inf)).ravel() for key, scale in scales.items()
    }
    key = max(spread, key=lambda key: spread[key].max())
    component = int(np.argmax(spread[key]))
    unperturbed = parts[key].reshape(len(observations), -1)[:, component]
    shown = {"shown": [key or component]}  # only this group of components can fail
    sensor = Sensor(space, plan.scale, len(observations), shown)
    names = list(dict.fromkeys(row.perturbation for row in rows))
    figure, panels = _grid(len(names))
    shades = import_matplotlib().colormaps["viridis_r"]
    dots = "." if len(unperturbed) <= 30 else ""
    for axes, name in zip(panels.flat, names, strict=False):
        for row in (row for row in rows if row.perturbation == name):
            perturber = Perturber(PERTURBATIONS[name], row.severity, sensor, 1, seed=plan.seed)
            seen = [_part(perturber(observation), key).ravel()[component] for observation in observations]
            color = shades(0.1 + 0.8 * row.severity / 5)
            axes.plot(seen, dots + "-", color=color, linewidth=0.9, markersize=4, label=f"severity {row.severity}")
        axes.plot(unperturbed, dots + "-", color=INK, linewidth=1.6, markersize=5, label=UNPERTURBED, zorder=0)
        axes.set_title(name, fontsize=9)
    figure.supxlabel("time step $t$", fontsize=9)
    figure.supylabel(f"component {component} of {key or 'the observation'}", fontsize=9)
    legend_above(figure, panels[0, 0], 6)
    return figure


def _part(observation: Any, key: str) -> np.ndarray:
    return np.asarray(observation[key] if key else observation)


def _episode(plan: Plan, model: Any) -> tuple[list[Any], spaces.Space]:
    """Return the first observations of an episode, each ``(1, *obs)``, and their space."""
    seen: list[Any] = []

    def keep(observations: Any, rng: np.random.Generator) -> Any:
        seen.append(observations)
        return observations

    # The recorder is inside the model's wrappers, because they change the observations.
    sensor = partial(PerturbedVecEnv, perturbation=keep)
    scenario = Scenario(UNPERTURBED, plan.env_id, plan.env_kwargs, sensor=sensor)
    with closing(scenario_env(scenario, model, n_episodes=1, n_envs=1)) as env:
        steps = rollout(model, env, 1, seeds=evaluation_seeds(plan.seed), deterministic=plan.deterministic)
        n_steps = len(list(islice(steps, MAX_STEPS)))
        return seen[:n_steps], env.unwrapped.observation_space


def _grid(n: int) -> tuple[Figure, np.ndarray]:
    """Make a figure with n panels that share their axes, in rows of equal length with up to five panels."""
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
