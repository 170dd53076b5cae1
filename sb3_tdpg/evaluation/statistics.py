"""
Statistics over training seeds, as Agarwal et al. (2021, "Deep reinforcement learning at the edge of the statistical
precipice") recommend for few runs; computed by their library rliable.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdpg.evaluation.tables import one_or_all, require_columns, summary_table


def aggregate_seeds(
    records_by_seed: pd.DataFrame, *, level: float = 0.95, n_bootstrap: int = 2000, seed: int = 0
) -> pd.DataFrame:
    """
    Summarise over training seeds: how good is the method, not one policy of it.

    The number is the interquartile mean over the seeds' mean costs, with the percentile bootstrap interval from
    resampling seeds.

    :param records_by_seed: Records with a column ``train_seed``
        (``evaluate_scenarios(..., labels=dict(train_seed=3))``).
    :param level: Coverage of the interval.
    :param n_bootstrap: Resamples.
    :param seed: Seed of the resampling.
    :return: one row for each model and scenario: ``n_seeds``, ``iqm``, ``low``, ``high``, ``min``, ``max``,
        ``episode_std`` (interquartile mean over seeds of the standard deviation over episodes), ``n`` (episodes of a
        seed), and how it was made: ``level``, ``seed``, ``deterministic``
    :raises ImportError: without rliable (``pip install sb3_tdpg[plots]``).
    """
    require_columns(records_by_seed, ["train_seed"])
    if not 0 < level < 1:
        raise ValueError(f"level={level} must lie between 0 and 1")
    rliable, metrics = _import_rliable()
    rows = []
    for (model, scenario), group in summary_table(records_by_seed).groupby(["model", "scenario"], sort=False):
        means = group["mean"].to_numpy()
        (iqm,), (low, high) = _interval(
            rliable, means[:, None], lambda x: np.array([metrics.aggregate_iqm(x)]), level, n_bootstrap, seed
        )
        rows.append(
            dict(
                model=model,
                scenario=scenario,
                n_seeds=len(means),
                iqm=iqm,
                low=low,
                high=high,
                min=means.min(),
                max=means.max(),
                episode_std=metrics.aggregate_iqm(group["std"].to_numpy()),
                level=level,
                n=group["n"].iloc[0],
                seed=one_or_all(group["seed"]),
                deterministic=one_or_all(group["deterministic"]),
            )
        )
    return pd.DataFrame(rows)


def probability_of_improvement(
    records_by_seed: pd.DataFrame,
    model: str,
    control: str,
    *,
    level: float = 0.95,
    n_bootstrap: int = 2000,
    seed: int = 0,
) -> tuple[float, float, float]:
    """
    How likely a seed of one method has a lower mean cost, over all episodes given, than a seed of another.

    A seed's scenarios are one number, not several: it is the same policy that meets them, and they must be resampled
    together.

    :param records_by_seed: Records with a column ``train_seed``, of the scenarios to take the mean over.
    :param model: Label of the method.
    :param control: Label of the method that it is compared with.
    :param level: Coverage of the interval.
    :param n_bootstrap: Resamples of the seeds.
    :param seed: Seed of the resampling.
    :return: the probability, and the interval's ends; 0.5 is no difference
    """
    rliable, metrics = _import_rliable()
    means = records_by_seed.groupby(["model", "train_seed"])["cost"].mean()
    # rliable takes scores, of which more is better: (seeds, 1).
    scores = {label: -means[label].to_numpy()[:, None] for label in (model, control)}
    (value,), (low, high) = _interval(
        rliable,
        (scores[model], scores[control]),
        lambda x, y: np.array([metrics.probability_of_improvement(x, y)]),
        level,
        n_bootstrap,
        seed,
    )
    return float(value), float(low), float(high)


def paired_difference(
    records_by_seed: pd.DataFrame,
    model: str,
    control: str,
    *,
    level: float = 0.95,
    n_bootstrap: int = 2000,
    seed: int = 0,
) -> tuple[float, float, float]:
    """
    By how much the mean cost of a method exceeds that of another, seed by seed.

    Where the two of a seed have the same start and meet the same episodes, what the start is worth cancels.

    :param records_by_seed: Records with a column ``train_seed``, of the scenarios to take the mean over.
    :param model: Label of the method.
    :param control: Label of the method that it is compared with; it must have the same seeds.
    :param level: Coverage of the interval.
    :param n_bootstrap: Resamples of the seeds.
    :param seed: Seed of the resampling.
    :return: the mean over seeds of the difference, and the interval's ends; below 0 the method is better
    :raises ValueError: if the seeds are not the same.
    """
    rliable, _ = _import_rliable()
    means = records_by_seed.groupby(["model", "train_seed"])["cost"].mean()
    if sorted(means[model].index) != sorted(means[control].index):
        raise ValueError(
            f"the seeds of {model!r} are {sorted(means[model].index)}, those of {control!r} "
            f"{sorted(means[control].index)}: a paired difference needs the same of both"
        )
    differences = (means[model] - means[control]).to_numpy()
    (value,), (low, high) = _interval(
        rliable, differences[:, None], lambda x: np.array([x.mean()]), level, n_bootstrap, seed
    )
    return float(value), float(low), float(high)


def interquartile_means(
    scores: np.ndarray, *, level: float = 0.95, n_bootstrap: int = 2000, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return the interquartile mean over seeds of each of many rows.

    It is what :func:`~sb3_tdpg.evaluation.aggregate_seeds` tells, of many rows at once.

    :param scores: ``(seeds, rows)``
    :param level: Coverage of the intervals; each row is resampled by itself.
    :param n_bootstrap: Resamples.
    :param seed: Seed of the resampling.
    :return: the means and the ends of their intervals, each ``(rows,)``
    """
    rliable, _ = _import_rliable()
    cut = len(scores) // 4

    def means(x: np.ndarray) -> np.ndarray:  # scipy.stats.trim_mean, at a tenth of the time
        return np.sort(x, axis=0)[cut : len(x) - cut].mean(axis=0)

    points, (low, high) = _intervals(rliable, scores, means, level, n_bootstrap, seed)
    return points, low, high


def probabilities_of_improvement(
    costs: np.ndarray, of_control: np.ndarray, *, level: float = 0.95, n_bootstrap: int = 2000, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return how likely a seed has a lower cost than a seed of the control, row by row; ties count half.

    It is what :func:`~sb3_tdpg.evaluation.probability_of_improvement` tells, of many rows at once.

    :param costs: ``(seeds, rows)``
    :param of_control: ``(seeds of the control, rows)``
    :param level: Coverage of the intervals; each row is resampled by itself.
    :param n_bootstrap: Resamples.
    :param seed: Seed of the resampling.
    :return: the probabilities and the ends of their intervals, each ``(rows,)``
    """
    rliable, _ = _import_rliable()

    def share(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = x[:, None], y[None]
        return ((x < y) + 0.5 * (x == y)).mean(axis=(0, 1))

    points, (low, high) = _intervals(rliable, (costs, of_control), share, level, n_bootstrap, seed)
    return points, low, high


def _interval(
    rliable: Any, scores: Any, statistic: Callable[..., np.ndarray], level: float, n_bootstrap: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Point estimate and percentile interval of a statistic of one number under resampled seeds."""
    points, intervals = _intervals(rliable, scores, statistic, level, n_bootstrap, seed)
    return points, intervals[:, 0]


def _intervals(
    rliable: Any, scores: Any, statistic: Callable[..., np.ndarray], level: float, n_bootstrap: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Point estimates ``(k,)`` and percentile intervals ``(2, k)`` of a statistic under resampled seeds."""
    # rliable draws from NumPy's global generator, whatever random_state it is given.
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        points, intervals = rliable.get_interval_estimates(
            {"scores": scores}, statistic, reps=n_bootstrap, confidence_interval_size=level
        )
    finally:
        np.random.set_state(state)  # noqa: NPY002
    return points["scores"], intervals["scores"]


def _import_rliable() -> tuple[Any, Any]:
    try:
        from rliable import library, metrics
    except ImportError as e:
        raise ImportError("statistics over seeds need rliable: pip install sb3_tdpg[plots]") from e
    return library, metrics
