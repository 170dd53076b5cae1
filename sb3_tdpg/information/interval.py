"""
An interval that holds I[x_t; x~_t]: confidence limits from bounds whose names are told.

Dimension key: T time steps, N episodes, n of them at a step or in a half, X state, Z TRVs, K draws for each episode.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from statistics import NormalDist
from typing import NamedTuple

import numpy as np
import torch as th
from scipy.optimize import brentq

from sb3_tdpg.information.base import InformationBatch
from sb3_tdpg.information.density_critic import (
    LOG_2_PI,
    DensityCritic,
    Encoded,
    log_gaussians,
    varies,
)

MIN_EPISODES = 20
MAX_DRAWS = 16  # of the TRVs, for each episode
MAX_VALUES = 1_000_000  # densities of all draws under all episodes; bounds the memory
MAX_TRAINING = 500  # episodes that a critic is fitted to; bounds the time
DIVISIONS = (((0, 1), (2, 3)), ((0, 2), (1, 3)), ((0, 3), (1, 2)))  # of quarters of the episodes into halves
MAX_REDIVIDED = 300  # episodes that are divided more than once; bounds the time, and more gain little by it
TINY = 1e-12  # nats
SPENT = 0.4  # of the probability to miss; the rest is for the skewness that the limits neglect
MIN_HITS = 10  # pairs of a state with another episode's TRVs at the clip, to estimate the critic's denominator from

LOWER_BOUNDS = ("critic",)
UPPER_BOUNDS = ("logdet", "loo", "marginal")


@dataclass(frozen=True)
class InformationInterval:
    """
    Where I[x_t; x~_t] lies at every time step, in nats.

    NaN where too few episodes are alive: see ``min_episodes``.
    """

    lower: np.ndarray
    """``(T,)``: lower confidence limits, never below 0."""
    upper: np.ndarray
    """``(T,)``: upper confidence limits."""
    lower_name: tuple[str, ...]
    """For each step the bound that the lower limit comes from: ``"critic"``, ``"zero"`` where information is never
    negative says more, ``""`` where there is none."""
    upper_name: tuple[str, ...]
    """Likewise ``"logdet"``, ``"loo"`` or ``"marginal"``."""
    estimates: dict[str, np.ndarray]
    """By name of the bound, ``(T,)``: its point estimate."""
    errors: dict[str, np.ndarray]
    """By name of the bound, ``(T,)``: the standard error of the estimate."""
    n_episodes: np.ndarray
    """``(T,)``: episodes alive."""
    confidence: float
    """With which the interval of a step holds the truth."""

    @property
    def width(self) -> np.ndarray:
        """``(T,)``, nats"""
        return self.upper - self.lower

    @property
    def total(self) -> tuple[float, float]:
        """Sums of the lower and of the upper limits over the time steps that have any."""
        return float(np.nansum(self.lower)), float(np.nansum(self.upper))


def normal_quantile(miss: float) -> float:
    """Return how many standard errors a Gaussian exceeds with probability ``miss``."""
    return NormalDist().inv_cdf(1 - miss)


def miss_of_each_limit(miss: float, gap: float) -> float:
    r"""
    Share the probability to miss between two limits, whose bounds leave a gap that the truth lies in.

    The further the truth is from one bound, the less its limit can miss. It is worst at either end of the gap, where
    :math:`\Phi(-c) + \Phi(-c - \text{gap}) = \text{miss}` for limits that are c standard errors from their bounds
    (Imbens and Manski, 2004, Econometrica 72(6)): half of it each without a gap, all of it each with a wide one.

    :param miss: Of both limits together.
    :param gap: Upper less lower bound, in standard errors; below 0 and NaN count as 0.
    :return: the probability to miss of each limit by itself
    """
    normal, gap = NormalDist(), max(0.0, gap)  # in this order also of NaN

    def excess(c: float) -> float:
        return normal.cdf(-c) + normal.cdf(-c - gap) - miss

    c = brentq(excess, normal_quantile(miss), normal_quantile(miss / 2) + 1e-9)
    return normal.cdf(-c)


class Estimate(NamedTuple):
    """What a bound came to at one time step."""

    value: float  # nats
    parts: np.ndarray  # (n,): what each episode adds to the mean that the value is, but for a constant
    least_variance: float = 0.0  # of the value

    @property
    def error(self) -> float:
        """Standard error, nats."""
        return math.sqrt(max(self.parts.var(ddof=1) / len(self.parts), self.least_variance))


def min_episodes(trv_dim: int) -> int:
    """Return how many living episodes an interval needs at a time step."""
    return max(MIN_EPISODES, 2 * trv_dim + 2)


def information_interval(batch: InformationBatch, *, confidence: float = 0.95, seed: int = 0) -> InformationInterval:
    r"""
    Give confidence limits for I[x_t; x~_t] at every time step, from fresh rollouts of a policy.

    **Below** stands the Donsker-Varadhan bound of a critic on x and x~,

    .. math:: I[x_t; \tilde x_t] \ge E[F(x, \tilde x)] - \log E_\perp[e^{F(x, \tilde x)}],

    which holds for any F that the samples have no part in. Half of the episodes fit the critic
    (:class:`~sb3_tdpg.information.density_critic.DensityCritic`), it is frozen, and the other half is fresh; then the
    halves change places, and the mean of the two counts. Up to 300 episodes are divided in three ways, and the mean of
    these counts, since a division leaves out the pairs of episodes that it parts. Densities of the encoder alone give
    no such bound: they bound the information of its *input*, which may be larger.

    **Above** stands the smallest of three bounds on I[e_t; x~_t], which is not below I[x_t; x~_t], with
    e_t = (x~_{t-1}, y_t) the input of the encoder, whose density q is known:

    - ``"logdet"``: :class:`~sb3_tdpg.information.LogDet`, its bias taken off by the jackknife;
    - ``"loo"``: :class:`~sb3_tdpg.information.LeaveOneOut`;
    - ``"marginal"``: :math:`E \log q(\tilde x | e) / a(\tilde x)` with the critic's marginal density a, on fresh
      episodes, too.

    Since the encoder's density is known, its noise is drawn anew: each episode counts with the mean over several draws
    of x~ given e, which lessens the error and changes no expectation.

    Each limit is an estimate less or plus a multiple of its standard error. The multiples spend two fifths of the
    probability to miss, ``1 - confidence``. The rest is for what they neglect: the limits are asymptotic, they take the
    means over episodes as Gaussian. But what an episode adds is skewed like a chi-square, so that a mean that is too
    low comes with a standard error that is too small. What is spent is shared between the limits according to the gap
    between the estimates (``miss_of_each_limit``); above, a third of a share is for each of the bounds, since the
    smallest is taken (Bonferroni). The interval holds for each step by itself, not for all of them at once. Above about
    ``ln N`` nats the lower limit falls behind the truth; it cannot exceed about ``ln(N^2 / 40)``.

    :param batch: Rollouts ``(T, N, ...)`` that the encoder was not trained on since; the episodes are independent.
    :param confidence: Probability, at least, with which the interval of a step holds the truth.
    :param seed: Of the divisions into halves and of the noise.
    :raises ValueError: if the shapes do not fit, a value is not finite, or a standard deviation is not positive.
    """
    if not 0 < confidence < 1:
        raise ValueError(f"confidence={confidence} must lie between 0 and 1, for instance 0.95")
    check_batch(batch)
    names = (*LOWER_BOUNDS, *UPPER_BOUNDS)
    horizon, _, trv_dim = batch.trvs.shape
    estimates, errors = ({name: np.full(horizon, np.nan) for name in names} for _ in range(2))
    limits = np.full((2, horizon), np.nan)
    named: tuple[list[str], list[str]] = ([""] * horizon, [""] * horizon)
    n_episodes = np.zeros(horizon, dtype=int)
    for t in range(horizon):
        at_t = batch.at(t)
        n_episodes[t] = at_t.trvs.shape[1]
        if n_episodes[t] < min_episodes(trv_dim):
            continue
        rng = np.random.default_rng((seed, t))
        step = draw_trvs(at_t, rng)
        critic, marginal = critic_bounds(step, rng)
        uppers = dict(logdet=_log_det(step), loo=_leave_one_out(step), marginal=marginal)
        for name, estimate in (("critic", critic), *uppers.items()):
            estimates[name][t], errors[name][t] = estimate.value, estimate.error
        uppers = {name: upper for name, upper in uppers.items() if np.isfinite(upper.value)}
        nearest = min(uppers.values(), key=lambda upper: upper.value, default=critic)
        gap = (nearest.value - critic.value) / max(critic.error, nearest.error, TINY)
        miss = miss_of_each_limit(SPENT * (1 - confidence), gap)
        lower = critic.value - normal_quantile(miss) * critic.error
        multiple = normal_quantile(miss / len(UPPER_BOUNDS))
        candidates = {name: upper.value + multiple * upper.error for name, upper in uppers.items()}
        named[1][t], upper = min(candidates.items(), key=lambda item: item[1], default=("", math.inf))
        named[0][t] = "critic" if lower > 0 else "zero"  # also where it is NaN
        upper = max(upper, 0.0)
        limits[:, t] = min(lower, upper) if lower > 0 else 0.0, upper
    lower_limits, upper_limits = limits
    return InformationInterval(
        lower_limits, upper_limits, tuple(named[0]), tuple(named[1]), estimates, errors, n_episodes, confidence
    )


def component_estimates(batch: InformationBatch, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    r"""
    Bound from below what the TRVs know of each component of the state by itself, I[x^k_t; x~_t].

    The bound is the critic's of :func:`information_interval`, with one component of the state in place of the state.

    :param batch: As for :func:`information_interval`.
    :param seed: Of the division into halves and of the noise.
    :return: the estimates and their standard errors, ``(T, X)`` each, nats; NaN where a component is constant and where
        too few episodes are alive
    :raises ValueError: if the batch is not fit for an interval.
    """
    check_batch(batch)
    horizon, _, n_components = batch.states.shape
    values = np.full((2, horizon, n_components), np.nan)
    for t in range(horizon):
        at_t = batch.at(t)
        if at_t.trvs.shape[1] < min_episodes(at_t.trvs.shape[2]):
            continue
        rng = np.random.default_rng((seed, t))
        step = draw_trvs(at_t, rng)
        for k in np.flatnonzero(varies(step.states)):
            bound, _ = critic_bounds(step._replace(states=step.states[:, [k]]), rng)
            values[:, t, k] = bound.value, bound.error
    return values[0], values[1]


def check_batch(batch: InformationBatch) -> None:
    """
    Look at what an interval is to be made from.

    :raises ValueError: if the shapes do not fit, a value is not finite, or a standard deviation is not positive.
    """
    shapes = {name: tuple(getattr(batch, name).shape) for name in ("states", "trvs", "means", "stds")}
    states, *others = shapes.values()
    if len(states) != 3 or len(set(others)) != 1 or len(others[0]) != 3 or states[:2] != others[0][:2]:
        raise ValueError(
            f"the batch has shapes {shapes}: expected (T, N, X) for the states and (T, N, Z) for trvs, means and stds"
        )
    alive = slice(None) if batch.alive is None else batch.alive
    for name in shapes:
        if not th.isfinite(getattr(batch, name)[alive]).all():
            raise ValueError(f"the batch's {name} are not all finite: an interval needs numbers")
    if not (batch.stds[alive] > 0).all():
        raise ValueError("the batch's stds must be positive: they are the encoder's standard deviations")


def draw_trvs(batch: InformationBatch, rng: np.random.Generator) -> Encoded:
    """
    Draw the encoder's noise anew, beside the one that was rolled out.

    :param batch: One time step, ``(1, n, ...)``, all episodes alive.
    :param rng: For the noise.
    """
    states, trvs, means, stds = (x[0].detach().cpu().numpy().astype(np.float64) for x in batch[:4])
    n, dim = means.shape
    # Each noise comes with its mirror image, which cancels what is linear in it.
    n_pairs = int(np.clip(MAX_VALUES // (2 * n**2), 1, MAX_DRAWS // 2))
    noise = rng.standard_normal((n, n_pairs, dim))
    noise[:, 0] = (trvs - means) / stds
    draws = means[:, None] + stds[:, None] * np.concatenate([noise, -noise], axis=1)
    return Encoded(states, means, stds, draws)


def critic_bounds(step: Encoded, rng: np.random.Generator) -> tuple[Estimate, Estimate]:
    """
    Fit critics to halves of the episodes, and evaluate them on the other halves; the mean over several divisions.

    A division leaves out the pairs of episodes that it parts. Any two quarters of the episodes are together in one of
    three divisions, which leave out none.

    :param step: n episodes, an even number of draws each: the mirror images are the second half.
    :param rng: For the quarters.
    :return: the lower bound of the critic and the upper bound of its marginal density
    """
    n, n_pairs = len(step.states), step.trvs.shape[1] // 2
    quarters = np.array_split(rng.permutation(n), 4)
    divisions = DIVISIONS if n <= MAX_REDIVIDED else DIVISIONS[:1]
    lowers, uppers = [], []
    for i, division in enumerate(divisions):
        first, second = ([quarters[q] for q in half] for half in division)
        halves = np.concatenate(first), np.concatenate(second)
        # The draws are shared out among the divisions, each with its mirror image.
        mine = np.arange(i % n_pairs, n_pairs, len(divisions))
        fresh_draws = step._replace(trvs=step.trvs[:, np.concatenate([mine, mine + n_pairs])])
        bounds = []
        for train, fresh in (halves[::-1], halves):
            critic, evaluated = DensityCritic(step.select(train[:MAX_TRAINING])), fresh_draws.select(fresh)
            points = evaluated.trvs.reshape(-1, evaluated.trvs.shape[2])
            log_marginal = critic.log_marginal(points)
            scores = critic.scores(evaluated.states, points, log_marginal)
            bounds.append(
                (donsker_varadhan(scores, log_clip=1 + math.log(n)), _marginal_bound(evaluated, log_marginal))
            )
        order = np.argsort(np.concatenate(halves))
        lower, upper = (_of_halves(of_bound, order) for of_bound in zip(*bounds, strict=True))
        lowers.append(lower)
        uppers.append(upper)
    return _average(lowers), _average(uppers)


def _of_halves(halves: tuple[Estimate, ...], order: np.ndarray) -> Estimate:
    """Average what two halves of the episodes came to; ``order`` is that of the episodes in the halves."""
    values, parts, least_variances = zip(*halves, strict=True)
    centred = np.concatenate([part - part.mean() for part in parts])  # each half has a critic of its own
    return Estimate(float(np.mean(values)), centred[order], sum(least_variances) / len(halves) ** 2)


def _average(estimates: Iterable[Estimate]) -> Estimate:
    """Average over divisions, whose parts and whose variances are taken as if they were wholly dependent."""
    values, parts, least_variances = zip(*estimates, strict=True)
    return Estimate(float(np.mean(values)), np.mean(parts, axis=0), float(np.mean(least_variances)))


def donsker_varadhan(scores: np.ndarray, log_clip: float) -> Estimate:
    r"""
    Evaluate the Donsker-Varadhan bound of a frozen critic on fresh episodes, all pairs of which count.

    Scores are clipped from above, which leaves a critic like any other, and keeps single pairs from deciding on the
    mean of e^F. For the same reason this mean counts as at least that of a few clipped pairs: where the TRVs of no
    episode fit the state of another, it would be estimated as 0, and the bound as infinite.

    :param scores: F of the K draws of the TRVs of each episode with the state of each, ``(n K, n)``.
    :param log_clip: Highest score.
    """
    n = scores.shape[1]
    scores = np.minimum(scores, log_clip).reshape(n, -1, n)
    joint = scores[np.arange(n), :, np.arange(n)].mean(axis=1)  # (n,)
    ratios = np.exp(scores).mean(axis=1)  # (n, n)
    np.fill_diagonal(ratios, 0.0)
    n_pairs = n * (n - 1)
    mean = ratios.sum() / n_pairs
    floor = MIN_HITS * math.exp(log_clip) / n_pairs
    if mean < floor:
        mean, relative_variance = floor, 1 / MIN_HITS  # of the number of clipped pairs, which are rare events
        parts, least_variance = joint, joint.var(ddof=1) / n + relative_variance
    else:
        # An episode counts through its state and through its TRVs (Hoeffding's projection).
        influence = (ratios.sum(axis=0) + ratios.sum(axis=1)) / (n - 1) / mean
        relative_variance = influence.var(ddof=1) / n
        # Not less than that of as many independent pairs: by luck the projection can be next to constant.
        parts = joint - influence
        least_variance = float(np.square(ratios).sum() / n_pairs / mean**2 - 1) / n_pairs
    # The logarithm of a mean is biased downward by half its relative variance.
    return Estimate(float(joint.mean() - math.log(mean) - relative_variance / 2), parts, least_variance)


def _marginal_bound(step: Encoded, log_marginal: np.ndarray) -> Estimate:
    """Average log q(x~ | e) - log a(x~) for a density a that was fitted to other episodes, ``(n K,)``."""
    n, _, dim = step.trvs.shape
    noise = (step.trvs - step.means[:, None]) / step.stds[:, None]
    log_own = -0.5 * (np.square(noise).sum(axis=2) + dim * LOG_2_PI) - np.log(step.stds).sum(axis=1)[:, None]
    gaps = (log_own - log_marginal.reshape(n, -1)).mean(axis=1)
    return Estimate(float(gaps.mean()), gaps)


def _log_det(step: Encoded) -> Estimate:
    """Bound by the Gaussian of the same covariance; the jackknife takes off the bias of order 1/n."""
    n, dim = step.means.shape
    variances, log_stds = np.square(step.stds), np.log(step.stds).sum(axis=1)
    scale = np.sqrt(variances.mean(axis=0))
    centred, noise = (step.means - step.means.mean(axis=0)) / scale, variances / scale**2
    scatter = centred.T @ centred

    def bound(covariance: np.ndarray, log_std: np.ndarray) -> np.ndarray:
        sign, log_determinant = np.linalg.slogdet(covariance)
        return np.where(sign > 0, 0.5 * log_determinant, np.nan) + np.log(scale).sum() - log_std

    whole = bound(scatter / (n - 1) + np.diag(noise.mean(axis=0)), log_stds.mean())
    # About the mean of the others, the scatter of the others is less by n / (n - 1) times this episode's square.
    covariances = (scatter - n / (n - 1) * centred[:, :, None] * centred[:, None, :]) / (n - 2)  # (n, Z, Z)
    diagonal = np.arange(dim)
    covariances[:, diagonal, diagonal] += (noise.sum(axis=0) - noise) / (n - 1)
    without = bound(covariances, (log_stds.sum() - log_stds) / (n - 1))  # (n,)
    value = n * whole - (n - 1) * without.mean()
    return Estimate(float(value), -(n - 1) * without)


def _leave_one_out(step: Encoded) -> Estimate:
    """Bound by the mixture of the other episodes' densities; an episode counts through its TRVs and as a component."""
    n, n_draws, dim = step.trvs.shape
    log_density = log_gaussians(step.trvs.reshape(-1, dim), step.means, np.square(step.stds))  # (n K, n)
    draws, own = np.arange(n * n_draws), np.repeat(np.arange(n), n_draws)
    log_own = log_density[draws, own]
    log_density[draws, own] = -np.inf
    top = log_density.max(axis=1)
    density = np.exp(log_density - top[:, None], out=log_density)
    total = density.sum(axis=1)
    gaps = (log_own - np.log(total) - top + math.log(n - 1)).reshape(n, n_draws).mean(axis=1)
    shares = (1 / total) @ density / n_draws  # mean 1
    return Estimate(float(gaps.mean()), gaps - shares)
