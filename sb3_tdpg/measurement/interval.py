"""
An interval that holds I[x_t; x~_t]: confidence limits from bounds whose names are told.

Dimension key: T time steps, N episodes, X state, Z TRVs.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
import torch as th
from scipy.optimize import brentq
from scipy.special import owens_t

from sb3_tdpg.common.threads import threads
from sb3_tdpg.information.base import InformationBatch
from sb3_tdpg.measurement.density_critic import varies
from sb3_tdpg.measurement.interval_bounds import (
    Estimate,
    critic_bounds,
    draw_trvs,
    gaussian_bound,
    leave_one_out_bound,
    log_det_bound,
)

MIN_EPISODES = 20
TINY = 1e-12  # nats
# Of the probability to miss, by the lower and by the upper limit; the rest is for the skewness that they neglect. It
# makes the upper limits too low and the lower ones lower than need be: 2 % come out as about 3 % and 1.5 %.
SPENT_BELOW, SPENT_ABOVE = 0.6, 0.2

LOWER_BOUNDS = ("critic", "gaussian")
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
    """For each step the bound that the lower limit comes from: ``"critic"`` or ``"gaussian"``, ``"zero"`` where
    information is never negative says more, ``""`` where there is none."""
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
        """Sums of the lower and of the upper limits over the time steps that have any; see :attr:`n_left_out`."""
        return float(np.nansum(self.lower)), float(np.nansum(self.upper))

    @property
    def n_left_out(self) -> int:
        """Time steps at which some episodes are alive, but too few for limits: no part of :attr:`total`."""
        return int(((self.n_episodes > 0) & np.isnan(self.upper)).sum())


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


def joint_quantile(miss: float, correlations: Sequence[float]) -> float:
    r"""
    Return how many standard errors any of several correlated Gaussians exceeds with probability ``miss``, at most.

    The probability that any does is at most the sum of all probabilities less those that two exceed it together, for
    the pairs of one with each other one (Hunter, 1976, Journal of Applied Probability 13(3)). With Owen's function T it
    is :math:`\Phi(-c) + 2 \sum_k T(c, \sqrt{(1 - \rho_k) / (1 + \rho_k)})`: between ``miss`` for bounds that go
    together and Bonferroni's inequality for independent ones.

    :param miss: Below 0.5.
    :param correlations: Of the one with each other one.
    """
    slopes = np.sqrt([(1 - rho) / (1 + rho) for rho in np.clip(correlations, -1 + 1e-9, 1)])

    def excess(c: float) -> float:
        return NormalDist().cdf(-c) + 2 * owens_t(c, slopes).sum() - miss

    return brentq(excess, normal_quantile(miss) - 1e-9, normal_quantile(miss / (1 + len(slopes))) + 1e-9)


def limit(bounds: dict[str, Estimate], miss: float, sign: int) -> tuple[str, float]:
    """
    Find the tightest of several bounds and its limit, all of which hold together but for a probability of ``miss``.

    :param bounds: By name.
    :param miss: Probability that a limit is on the wrong side of its bound's expectation.
    :param sign: 1 for limits from above, -1 from below.
    """
    if not bounds:
        return "", sign * math.inf
    tightest, *others = sorted(bounds.values(), key=lambda bound: sign * bound.value)
    multiple = joint_quantile(miss, [tightest.correlation(other) for other in others])
    limits = {name: bound.value + sign * multiple * bound.error for name, bound in bounds.items()}
    name = min(limits, key=lambda name: sign * limits[name])
    return name, limits[name]


def _gap(below: Collection[Estimate], above: Collection[Estimate]) -> float:
    """Return how far the tightest bounds are apart, in standard errors."""
    if not (below and above):
        return math.nan
    lower, upper = max(below, key=lambda bound: bound.value), min(above, key=lambda bound: bound.value)
    return (upper.value - lower.value) / max(lower.error, upper.error, TINY)


def min_episodes(trv_dim: int) -> int:
    """Return how many living episodes an interval needs at a time step."""
    return max(MIN_EPISODES, 2 * trv_dim + 2)


@threads(1)
def information_interval(batch: InformationBatch, *, confidence: float = 0.95, seed: int = 0) -> InformationInterval:
    r"""
    Give confidence limits for I[x_t; x~_t] at every time step, from fresh rollouts of a policy.

    **Below** stands the Donsker-Varadhan bound of a critic on x and x~,

    .. math:: I[x_t; \tilde x_t] \ge E[F(x, \tilde x)] - \log E_\perp[e^{F(x, \tilde x)}],

    which holds for any F that the samples have no part in: critics are fitted to some of the episodes, frozen, and
    evaluated on the others. There are two kinds, and the larger bound counts.

    - ``"critic"``: :class:`~sb3_tdpg.measurement.density_critic.DensityCritic`, fitted to one half of the episodes and
      evaluated on the other; then the halves change places. Up to 300 episodes are divided in three ways, since a
      division leaves out the pairs of episodes that it parts.
    - ``"gaussian"``: :class:`~sb3_tdpg.measurement.gaussian_critic.GaussianCritic`, which knows one shape only and is
      fitted at once, therefore often and to more episodes: to all but two of eight groups, and evaluated on the two
      (five groups with more than 300 episodes). It is tighter where states and TRVs are about Gaussian together.

    The means over the episodes and over the pairs are those of all critics of a kind, taken before the logarithm.
    Densities of the encoder alone give no such bound: they bound the information of its *input*, which may be larger.

    **Above** stands the smallest of three bounds on I[e_t; x~_t], which is not below I[x_t; x~_t], with
    e_t = (x~_{t-1}, y_t) the input of the encoder, whose density q is known:

    - ``"logdet"``: :class:`~sb3_tdpg.information.LogDet`, its bias taken off by the jackknife;
    - ``"loo"``: :class:`~sb3_tdpg.information.LeaveOneOut`;
    - ``"marginal"``: :math:`E \log q(\tilde x | e) / a(\tilde x)` with the critic's marginal density a, on fresh
      episodes, too.

    Since the encoder's density is known, its noise is drawn anew: each episode counts with the mean over several draws
    of x~ given e. And since the mean square of the noise is known, what the draws have too much or too little of it is
    taken off (control variates). Both lessen the error, and change no expectation.

    Each limit is an estimate less or plus a multiple of its standard error. The lower limit's multiple spends three
    fifths of the probability to miss, ``1 - confidence``, the upper one's one fifth. The rest is for what they neglect:
    the limits are asymptotic, they take the means over episodes as Gaussian. But what an episode adds is skewed like a
    chi-square, so that a mean that is too low comes with a standard error that is too small: the upper limits suffer,
    not the lower ones. Of what is spent, a limit gets its share according to the gap between the estimates
    (``miss_of_each_limit``), and a share is for all bounds of a side at once, since the tightest is taken: the closer
    they go together, the less that costs (``joint_quantile``). The interval holds for each step by itself, not for all
    of them at once. Above about ``ln N`` nats the lower limit falls behind the truth; it cannot exceed about
    ``ln(N^2 / 10)``.

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
        bounds = dict(
            critic=critic,
            gaussian=gaussian_bound(step, rng),
            logdet=log_det_bound(step),
            loo=leave_one_out_bound(step),
            marginal=marginal,
        )
        for name, bound in bounds.items():
            estimates[name][t], errors[name][t] = bound.value, bound.error
        below, above = (
            {name: bounds[name] for name in names if np.isfinite(bounds[name].value)}
            for names in (LOWER_BOUNDS, UPPER_BOUNDS)
        )
        gap = _gap(below.values(), above.values())
        miss_below, miss_above = (
            miss_of_each_limit(spent * (1 - confidence), gap) for spent in (SPENT_BELOW, SPENT_ABOVE)
        )
        (lower_name, lower), (upper_name, upper) = limit(below, miss_below, sign=-1), limit(above, miss_above, sign=1)
        named[0][t], named[1][t] = lower_name if lower > 0 else "zero", upper_name
        upper = max(upper, 0.0)
        limits[:, t] = min(lower, upper) if lower > 0 else 0.0, upper
    lower_limits, upper_limits = limits
    return InformationInterval(
        lower_limits, upper_limits, tuple(named[0]), tuple(named[1]), estimates, errors, n_episodes, confidence
    )


def component_estimates(
    batch: InformationBatch, *, confidence: float = 0.95, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    r"""
    Bound from below what the TRVs know of each component of the state by itself, I[x^k_t; x~_t].

    The bounds are the lower ones of :func:`information_interval`, with one component of the state in place of the
    state; the larger one counts. Where the TRVs tell several components, their density given one of them has a shape of
    its own, which the critic follows badly; the Gaussians then say more.

    :param batch: As for :func:`information_interval`.
    :param confidence: Of the lower limits, which are one-sided.
    :param seed: Of the division of the episodes and of the noise.
    :return: the estimates and their lower limits, ``(T, X)`` each, nats; NaN where a component is constant and where
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
            of_one = step._replace(states=step.states[:, [k]])
            bounds = dict(critic=critic_bounds(of_one, rng)[0], gaussian=gaussian_bound(of_one, rng))
            values[0, t, k] = max(bound.value for bound in bounds.values())
            _, values[1, t, k] = limit(bounds, 1 - confidence, sign=-1)
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
