"""
Compute statistics over a few training seeds with rliable.

The statistics follow Agarwal et al. (2021), "Deep reinforcement learning at the edge of the statistical precipice".
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdpg.evaluation.tables import one_or_all, summary_table

LEVEL = 0.95  # of the intervals
N_BOOTSTRAP = 2000


def aggregate_seeds(records_by_seed: pd.DataFrame) -> pd.DataFrame:
    """
    Summarise the costs of each method in each scenario over its training seeds.

    The summary is the interquartile mean of the seeds' mean costs, with a percentile bootstrap interval of 95 % over
    seeds.

    :param records_by_seed: Records with a column ``train_seed``
        (``evaluate_scenarios(..., labels=dict(train_seed=3))``).
    :return: one row for each model and scenario: ``n_seeds``, ``iqm``, ``low``, ``high``, ``min``, ``max``,
        ``episode_std`` (interquartile mean over seeds of the standard deviation over episodes), ``n`` (episodes of a
        seed), ``level``, ``seed`` and ``deterministic``
    """
    if "train_seed" not in records_by_seed:
        raise ValueError(f"the records have no column train_seed; they have {list(records_by_seed)}")
    rows = []
    for (model, scenario), group in summary_table(records_by_seed).groupby(["model", "scenario"], sort=False):
        means, stds = group[["mean", "std"]].to_numpy().T
        (point,), (low,), (high,) = interquartile_means(means[:, None])
        seeds = dict(n_seeds=len(means), iqm=point, low=low, high=high, min=means.min(), max=means.max())
        how = {name: one_or_all(group[name]) for name in ("seed", "deterministic")}
        more = dict(episode_std=_interquartile_mean(stds), level=LEVEL, n=one_or_all(group["n"]))
        rows.append(dict(model=model, scenario=scenario, **seeds, **more, **how))
    return pd.DataFrame(rows)


def probability_of_improvement(records_by_seed: pd.DataFrame, model: str, control: str) -> tuple[float, ...]:
    """
    Estimate the probability that a seed of one method has a lower mean cost than a seed of another method.

    The mean is over all given scenarios. The policy of a seed runs in all scenarios, so these are resampled together.

    :param records_by_seed: Records with a column ``train_seed``, of the scenarios to average over.
    :param control: Label of the method to compare with.
    :return: the probability, which is 0.5 if there is no difference (a tie counts half), and the ends of its 95 %
        interval
    """

    def share(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = x[:, None], y[None]
        return ((x < y) + 0.5 * (x == y)).mean(axis=(0, 1))

    means = _seed_means(records_by_seed, (model, control))
    costs, of_control = (means[label].to_numpy()[:, None] for label in (model, control))
    return tuple(estimate.item() for estimate in _bootstrap(share, costs, of_control))


def paired_difference(records_by_seed: pd.DataFrame, model: str, control: str) -> tuple[float, ...]:
    """
    Estimate the mean over seeds of the cost of one method minus the cost of another method with the same seed.

    Pairing removes the effects that a seed has equally on both methods, through the initial policy or the episodes.

    :param control: Label of the method to compare with; it must have the same seeds.
    :return: the mean difference over seeds, which is negative if ``model`` costs less, and the ends of its 95 %
        interval
    """
    means = _seed_means(records_by_seed, (model, control))
    seeds, of_control = (sorted(means[label].index) for label in (model, control))
    if seeds != of_control:
        raise ValueError(f"the seeds of {model!r} are {seeds}, those of {control!r} {of_control}: they must match")
    differences = (means[model] - means[control]).to_numpy()[:, None]
    return tuple(estimate.item() for estimate in _bootstrap(lambda x: x.mean(axis=0), differences))


def interquartile_means(scores: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Compute the interquartile mean over seeds for many rows at once; see :func:`~sb3_tdpg.evaluation.aggregate_seeds`.

    :param scores: ``(seeds, rows)``; each row is resampled on its own.
    :param seed: Seed of the resampling.
    :return: the means and the ends of their 95 % intervals, each ``(rows,)``
    """
    return _bootstrap(_interquartile_mean, scores, seed=seed)


def _interquartile_mean(x: np.ndarray) -> np.ndarray:
    """Compute the mean of the middle half along the first axis, like scipy's ``trim_mean`` but ten times as fast."""
    cut = len(x) // 4
    return np.asarray(np.sort(x, axis=0)[cut : len(x) - cut].mean(axis=0))


def _seed_means(records_by_seed: pd.DataFrame, models: Sequence[str]) -> pd.Series:
    """Average the mean costs over the scenarios; all seeds of the methods must have the same scenarios."""
    shown = records_by_seed[records_by_seed["model"].isin(models)]
    means = shown.groupby(["model", "train_seed", "scenario"])["cost"].mean().unstack()
    if means.isna().any(axis=None):
        missing = [index for index, row in means.iterrows() if row.isna().any()]
        raise ValueError(f"these methods and seeds lack a scenario that others have: {missing}")
    return means.mean(axis=1)


def _bootstrap(
    statistic: Callable[..., Any], *scores: np.ndarray, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Resample the seeds of arrays ``(seeds, rows)``; return a statistic and the ends of its percentile interval."""
    try:
        from rliable import library
    except ImportError as e:
        raise ImportError("statistics over seeds need rliable: pip install sb3_tdpg[plots]") from e
    # rliable draws from NumPy's global generator, whatever random_state it is given.
    state = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        of_scores = {"scores": scores if len(scores) > 1 else scores[0]}
        points, intervals = library.get_interval_estimates(
            of_scores, statistic, reps=N_BOOTSTRAP, confidence_interval_size=LEVEL
        )
    finally:
        np.random.set_state(state)  # noqa: NPY002
    return points["scores"], *intervals["scores"]
