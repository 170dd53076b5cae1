"""
Aggregate the records of a report: costs with intervals, added costs, comparisons of the methods.

Dimension key: S models of a method, R rows, E episodes, G groups of rows (a perturbation with all its severities).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
import pandas as pd

from sb3_tdpg.evaluation.statistics import LEVEL, interquartile_means
from sb3_tdpg.report.rows import ALL, PERTURBED, UNPERTURBED

CLEAR = 0.05
"""A difference counts as clear up to this p-value."""
MAX_EXACT = 8  # p-values are exact if a method has at most this many models (also with equal costs, unlike in SciPy)


@dataclass(frozen=True)
class Numbers:
    """The tables of a report."""

    levels: pd.DataFrame
    """The cost of each method in each row: ``model``, ``perturbation``, ``severity``, ``kind``, ``n_seeds``, ``iqm``,
    ``low``, ``high``."""
    groups: pd.DataFrame
    """The mean cost of each method over the severities of each perturbation. The columns are those of ``levels`` except
    ``severity``, and four more. ``added`` is the cost above the unperturbed cost, with its interval (``added_low``,
    ``added_high``). ``lowest`` is true if the method costs clearly less than every other method: its interval is below
    the other method's interval, and the p-value is at most 0.05."""
    comparisons: pd.DataFrame
    """The comparison of each method with the first method (``reference``), with a row for each perturbation. ``p_cost``
    is the share of the pairs of models in which the method's model costs less (a tie counts half). ``p_added`` is the
    share in which the perturbation adds less to the cost of the method's model. ``pvalue_...`` is from the two-sided
    Mann-Whitney test, which is exact if one of the two methods has at most ``MAX_EXACT`` models. ``cost`` and ``added``
    are the verdicts: ``"less"`` or ``"more"`` up to a p-value of 0.05, otherwise ``"undecided"``."""
    model_levels: pd.DataFrame
    """The mean cost of each model in each row: ``model``, ``train_seed``, ``perturbation``, ``severity``, ``cost``."""

    @property
    def models(self) -> list[str]:
        """The methods, in the given order."""
        return list(self.levels["model"].unique())

    def can_be_clear(self, label: str) -> bool:
        """Return whether a method and the first method have enough models for a clear difference."""
        n, of_reference = self.n_models(label), self.n_models(self.models[0])
        return p_value(np.arange(n), n + np.arange(of_reference)) <= CLEAR

    def n_models(self, label: str) -> int:
        """Count the models of a method."""
        return int(self.levels.loc[self.levels["model"] == label, "n_seeds"].iloc[0])

    @property
    def perturbations(self) -> list[str]:
        """The perturbations that have severities."""
        return list(self.groups.loc[self.groups["kind"].isin(PERTURBED), "perturbation"].unique())


def p_value(costs: np.ndarray, of_others: np.ndarray) -> float:
    """Return the p-value of a difference between the models of two methods."""
    from scipy.stats import mannwhitneyu

    # With equal costs "auto" uses a normal approximation, whose p-value is far too low for a few models.
    method = "exact" if min(len(costs), len(of_others)) <= MAX_EXACT else "auto"
    return float(mannwhitneyu(costs, of_others, method=method).pvalue)


def make_numbers(records: pd.DataFrame, *, seed: int = 0) -> Numbers:
    """
    Aggregate the records of ``run_row``.

    The cost of a model is its mean over episodes, and for a perturbation also over severities. The cost of a method is
    the interquartile mean over its models, with a stratified bootstrap interval over the models. If a method has a
    single model, the interval is for this model, not for the method. It is then the interval of the mean over episodes:
    a normal approximation, or Wilson's interval if all costs are 0 or 1 (failures).

    :param records: The records of all rows.
    :param seed: Seed of the bootstrap.
    """
    rows = records[["perturbation", "severity", "kind"]].drop_duplicates(ignore_index=True)
    groups = _groups(rows)
    keys = pd.DataFrame(list(groups), columns=["perturbation", "kind"])
    plain = rows.index[rows["kind"] == "unperturbed"]

    levels, summaries, by_seed = [], [], {}
    for label, of_model in records.groupby("model", sort=False):
        cube = _cube(of_model, rows)
        # An episode begins in the same state in every row, so that its costs can be averaged over rows.
        cost = np.stack([cube[:, group].mean(axis=1) for group in groups.values()], axis=1)  # (S, G, E)
        added = cost - cube[:, plain].mean(axis=1, keepdims=True)
        is_share = bool(np.isin(cube, (0.0, 1.0)).all())
        intervals = {**_interval_columns(cost, seed, is_share), **_interval_columns(added, seed, prefix="added")}
        summaries.append(pd.DataFrame(dict(model=label, **keys, n_seeds=len(cube), **intervals)))
        intervals = _interval_columns(cube, seed, is_share)
        levels.append(pd.DataFrame(dict(model=label, **rows, n_seeds=len(cube), **intervals)))
        by_seed[str(label)] = dict(cost=cost.mean(axis=2), added=added.mean(axis=2))

    comparisons = [_compare(label, by_seed, keys) for label in list(by_seed)[1:]]
    summary = pd.concat(summaries, ignore_index=True)
    return Numbers(
        pd.concat(levels, ignore_index=True),
        summary.assign(lowest=_lowest(summary, by_seed)),
        pd.concat(comparisons, ignore_index=True) if comparisons else pd.DataFrame(),
        records.groupby(["model", "train_seed", "perturbation", "severity"])["cost"].mean().reset_index(),
    )


def _lowest(summary: pd.DataFrame, by_seed: Mapping[str, Mapping[str, np.ndarray]]) -> np.ndarray:
    """Return for each method and group whether its cost is clearly below the cost of every other method."""
    n_groups = len(summary) // len(by_seed)
    low, high = (summary[name].to_numpy().reshape(len(by_seed), n_groups) for name in ("low", "high"))
    costs = [arrays["cost"] for arrays in by_seed.values()]
    result = np.full(low.shape, len(costs) > 1)
    for (one, group), (other, of_other) in product(np.ndindex(low.shape), enumerate(costs)):
        if one != other:
            is_below = high[one, group] < low[other, group]
            result[one, group] &= is_below and p_value(costs[one][:, group], of_other[:, group]) <= CLEAR
    return result.ravel()


def _cube(of_model: pd.DataFrame, rows: pd.DataFrame) -> np.ndarray:
    """Return the costs of a method, ``(S, R, E)``."""
    ordered = of_model.merge(rows.reset_index(names="row")).sort_values(["train_seed", "row", "episode"])
    return ordered["cost"].to_numpy().reshape(of_model["train_seed"].nunique(), len(rows), -1)


def _groups(rows: pd.DataFrame) -> dict[tuple[str, str], pd.Index]:
    """Return the indices of each perturbation's rows; the keys are its name and kind."""
    groups = {key: group.index for key, group in rows.groupby(["perturbation", "kind"], sort=False)}
    perturbed = rows[rows["kind"].isin(PERTURBED)]
    if perturbed["perturbation"].nunique() > 1:
        own = {key: groups.pop(key) for key in list(groups) if key[1] == "own"}
        groups.update({(ALL, "all"): perturbed.index, **own})
    return groups


def _interval_columns(cube: np.ndarray, seed: int, is_share: bool = False, prefix: str = "") -> dict[str, np.ndarray]:
    """Aggregate costs ``(S, G, E)`` over models and episodes; return columns with the result and its interval."""
    names = (prefix, f"{prefix}_low", f"{prefix}_high") if prefix else ("iqm", "low", "high")
    one = len(cube) == 1
    columns = _mean_of_one(cube[0], is_share) if one else interquartile_means(cube.mean(axis=2), seed)
    return dict(zip(names, columns, strict=True))


def _mean_of_one(costs: np.ndarray, is_share: bool) -> tuple[np.ndarray, ...]:
    """Return the mean over episodes of costs ``(G, E)``, and the ends of the mean's interval."""
    from scipy.stats import norm

    mean, variance, n = costs.mean(axis=1), costs.var(axis=1), costs.shape[1]
    if n == 1:
        return mean, mean * np.nan, mean * np.nan
    z = norm.ppf(0.5 + LEVEL / 2)
    if not is_share:
        half = z * np.sqrt(variance / (n - 1))
        return mean, mean - half, mean + half
    # Wilson's interval is computed for the number of independent trials that corresponds to the variance: n for one
    # row, more for several rows. Zero failures in n trials do not mean that the failure rate is zero.
    trials = np.divide(n * mean * (1 - mean), variance, out=np.full_like(mean, n), where=variance > 0)
    center, half = mean + z**2 / (2 * trials), z * np.sqrt(mean * (1 - mean) / trials + (z / (2 * trials)) ** 2)
    return mean, *(np.clip((center + sign * half) / (1 + z**2 / trials), 0.0, 1.0) for sign in (-1, 1))


def _compare(label: str, by_seed: Mapping[str, Mapping[str, np.ndarray]], keys: pd.DataFrame) -> pd.DataFrame:
    """Compare a method with the first method."""
    reference = next(iter(by_seed))
    frame = keys.assign(model=label, reference=reference)
    for name, costs in by_seed[label].items():
        theirs = by_seed[reference][name]
        share = ((costs[:, None] < theirs) + 0.5 * (costs[:, None] == theirs)).mean(axis=(0, 1))
        p = np.array([p_value(*pair) for pair in zip(costs.T, theirs.T, strict=True)])
        verdict = np.select([(p <= CLEAR) & (share > 0.5), (p <= CLEAR) & (share < 0.5)], ["less", "more"], "undecided")
        frame = frame.assign(**{f"p_{name}": share, f"pvalue_{name}": p, name: verdict})
    frame.loc[frame["perturbation"] == UNPERTURBED, ["p_added", "pvalue_added"]] = np.nan
    return frame
