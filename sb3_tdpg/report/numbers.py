"""
From records to the numbers of a report: costs with intervals, what a perturbation adds, who is more robust.

Dimension key: S models of a method, R rows, E episodes, G groups of rows (a perturbation with all its severities).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sb3_tdpg.evaluation.statistics import interquartile_means, probabilities_of_improvement
from sb3_tdpg.report.rows import UNPERTURBED

ALL = "all perturbations"
CLEAR = 0.95
"""Probability from which on a comparison counts as clear."""

MIN_CLEAR = 3
"""Models of a method without which none is: two are both ahead of two others by chance once in six times."""


@dataclass(frozen=True)
class Numbers:
    """The tables of a report."""

    levels: pd.DataFrame
    """Of each method in each row: ``model``, ``perturbation``, ``severity``, ``kind``, ``n_seeds``, ``iqm``, ``low``,
    ``high``."""
    groups: pd.DataFrame
    """Of each method under each perturbation, the mean over its severities: the same without ``severity``, and
    ``added``, ``added_low``, ``added_high``, which the cost is above the unperturbed one."""
    comparisons: pd.DataFrame
    """Of each method against the first one, a row for each perturbation: the probabilities ``p_cost`` that a model of
    it costs less, and ``p_added`` that the perturbation adds less to its cost, with ``..._low`` and ``..._high``; NaN
    where a method has one model only. ``cost`` and ``added`` put it into a word: ``"less"`` from a probability of 0.95
    on, ``"more"`` up to 0.05, ``"undecided"`` between them and with less than three models of a method."""

    @property
    def models(self) -> list[str]:
        """The methods, in the order given."""
        return list(self.levels["model"].unique())

    @property
    def perturbations(self) -> list[str]:
        """Those with severities."""
        rows = self.groups[self.groups["kind"].isin(("sensor", "scene"))]
        return list(rows["perturbation"].unique())


def make_numbers(records: pd.DataFrame, *, level: float = 0.95, n_bootstrap: int = 2000, seed: int = 0) -> Numbers:
    """
    Aggregate the records of ``run_row``.

    A model's number is its mean cost over episodes, of a perturbation also over severities. A method's is the
    interquartile mean over its models, with a stratified bootstrap interval over them. Of a single model the interval
    is that of its mean over episodes, by the normal approximation, or Wilson's where costs are 0 and 1 (failures): it
    is about this model, and not about a method.

    :param records: Of all rows.
    :param level: Coverage of the intervals.
    :param n_bootstrap: Resamples.
    :param seed: Of the resampling.
    """
    rows = records[["perturbation", "severity", "kind"]].drop_duplicates(ignore_index=True)
    costs = {label: _cube(of_model, rows) for label, of_model in records.groupby("model", sort=False)}
    groups = _groups(rows)
    plain = [rows.index[rows["kind"] == "unperturbed"].to_numpy()]
    how = dict(level=level, n_bootstrap=n_bootstrap, seed=seed)

    levels, summaries, by_seed = [], [], {}
    for label, cube in costs.items():
        is_share = bool(np.isin(cube, (0.0, 1.0)).all())
        iqm, low, high = _aggregate(cube, how, is_share)
        levels.append(
            pd.concat([rows, pd.DataFrame(dict(iqm=iqm, low=low, high=high))], axis=1).assign(
                model=label, n_seeds=len(cube)
            )
        )
        cost = _mean_of_rows(cube, list(groups.values()))  # (S, G, E)
        added = cost - _mean_of_rows(cube, plain)
        numbers = [*_aggregate(cost, how, is_share), *_aggregate(added, how)]
        names = ("iqm", "low", "high", "added", "added_low", "added_high")
        keys = pd.DataFrame(list(groups), columns=["perturbation", "kind"])
        table = pd.DataFrame(dict(zip(names, numbers, strict=True)))
        summaries.append(pd.concat([keys, table], axis=1).assign(model=label, n_seeds=len(cube)))
        by_seed[label] = cost.mean(axis=2), added.mean(axis=2)

    control, *others = costs
    comparisons = [_compare(label, control, by_seed, list(groups), how) for label in others]
    return Numbers(
        pd.concat(levels, ignore_index=True)[["model", "perturbation", "severity", "kind", "n_seeds", *names[:3]]],
        pd.concat(summaries, ignore_index=True)[["model", "perturbation", "kind", "n_seeds", *names]],
        pd.concat(comparisons, ignore_index=True) if comparisons else pd.DataFrame(),
    )


def _cube(of_model: pd.DataFrame, rows: pd.DataFrame) -> np.ndarray:
    """Return the costs of a method, ``(S, R, E)``."""
    keys = ["train_seed", "perturbation", "severity", "episode"]
    costs = of_model.set_index(keys)["cost"].unstack("episode")
    seeds = of_model["train_seed"].unique()
    wanted = pd.MultiIndex.from_tuples(
        [(seed, *row) for seed in seeds for row in rows[["perturbation", "severity"]].itertuples(index=False)]
    )
    return costs.loc[wanted].to_numpy().reshape(len(seeds), len(rows), -1)


def _groups(rows: pd.DataFrame) -> dict[tuple[str, str], np.ndarray]:
    """Return the indices of the rows of each perturbation, by its name and kind."""
    groups = {
        (str(name), str(kind)): group.index.to_numpy()
        for (name, kind), group in rows.groupby(["perturbation", "kind"], sort=False)
    }
    perturbed = rows.index[rows["kind"].isin(("sensor", "scene"))].to_numpy()
    if len(rows.loc[perturbed, "perturbation"].unique()) > 1:
        own = {key: groups.pop(key) for key in list(groups) if key[1] == "own"}
        groups = {**groups, (ALL, "all"): perturbed, **own}
    return groups


def _mean_of_rows(cube: np.ndarray, groups: Sequence[np.ndarray]) -> np.ndarray:
    """``(S, R, E)`` to ``(S, G, E)``: an episode begins in the same state in every row, and is averaged with itself."""
    return np.stack([cube[:, group].mean(axis=1) for group in groups], axis=1)


def _aggregate(
    cube: np.ndarray, how: dict[str, float | int], is_share: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``(S, G, E)`` to the aggregate over models, and the ends of its interval: ``(G,)`` each."""
    if len(cube) > 1:
        return interquartile_means(cube.mean(axis=2), **how)  # type: ignore[arg-type]
    from scipy.stats import norm

    mean, n = cube[0].mean(axis=1), cube.shape[2]
    if n == 1:
        return mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    z, variance = norm.ppf(0.5 + how["level"] / 2), cube[0].var(axis=1)
    if not is_share:
        half = z * np.sqrt(variance / (n - 1))
        return mean, mean - half, mean + half
    # Wilson's interval, with as many independent trials as give the mean this variance: n of a single row, more of
    # several. No failure in n trials does not mean that there are none.
    trials = np.divide(n * mean * (1 - mean), variance, out=np.full_like(mean, n), where=variance > 0)
    center, half = mean + z**2 / (2 * trials), z * np.sqrt(mean * (1 - mean) / trials + (z / (2 * trials)) ** 2)
    return mean, *(np.clip((center + sign * half) / (1 + z**2 / trials), 0.0, 1.0) for sign in (-1, 1))


def _compare(
    label: str,
    control: str,
    by_seed: dict[str, tuple[np.ndarray, np.ndarray]],
    groups: Sequence[tuple[str, str]],
    how: dict[str, float | int],
) -> pd.DataFrame:
    frame = pd.DataFrame(groups, columns=["perturbation", "kind"]).assign(model=label, control=control)
    for name, ours, theirs in zip(("cost", "added"), by_seed[label], by_seed[control], strict=True):
        if min(len(ours), len(theirs)) > 1:
            values = probabilities_of_improvement(ours, theirs, **how)  # type: ignore[arg-type]
        else:
            values = (np.full(len(groups), np.nan),) * 3
        for suffix, column in zip(("", "_low", "_high"), values, strict=True):
            frame[f"p_{name}{suffix}"] = column
        enough = min(len(ours), len(theirs)) >= MIN_CLEAR
        p = frame[f"p_{name}"]
        frame[name] = np.select([(p >= CLEAR) & enough, (p <= 1 - CLEAR) & enough], ["less", "more"], "undecided")
    frame.loc[frame["perturbation"] == UNPERTURBED, ["p_added", "p_added_low", "p_added_high"]] = np.nan  # no question
    return frame
