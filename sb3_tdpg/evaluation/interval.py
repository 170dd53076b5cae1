"""
Compute confidence intervals for I[x_t; x~_t] from several lower and upper bounds.

Dimension key: T time steps, N episodes, X state, Z TRVs.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from scipy.special import owens_t

from sb3_tdpg.common.threads import threads
from sb3_tdpg.evaluation.density_critic import Encoded, varies
from sb3_tdpg.evaluation.interval_bounds import (
    Estimate,
    critic_bounds,
    draw_trvs,
    gaussian_bound,
    leave_one_out_bound,
    log_det_bound,
)
from sb3_tdpg.information.base import InformationBatch

MIN_EPISODES = 20
TINY = 1e-12  # nats
CONFIDENCE = 0.95  # of the interval of a time step, and of the one-sided lower limit for a component of the state
# Shares of the error probability of the lower and the upper limit. The rest allows for skewness, which turns 2 % into
# about 3 % above and 1.5 % below.
SPENT_BELOW, SPENT_ABOVE = 0.6, 0.2

LOWER_BOUNDS = ("critic", "gaussian")
UPPER_BOUNDS = ("logdet", "loo", "marginal")


@dataclass(frozen=True)
class InformationInterval:
    """95 % confidence limits of I[x_t; x~_t] at each time step, in nats; NaN with fewer than ``min_episodes`` alive."""

    lower: np.ndarray
    """``(T,)``: lower confidence limits, never below 0."""
    upper: np.ndarray
    """``(T,)``: upper confidence limits."""
    lower_name: tuple[str, ...]
    """The bound that gives the lower limit of each step: ``"critic"`` or ``"gaussian"``, ``"zero"`` where
    neither gives a positive limit, ``""`` where there is no limit."""
    upper_name: tuple[str, ...]
    """The bound that gives the upper limit of each step: ``"logdet"``, ``"loo"``, ``"marginal"`` or ``""``."""
    estimates: dict[str, np.ndarray]
    """Point estimate of each bound, ``(T,)``, by name."""
    errors: dict[str, np.ndarray]
    """Standard error of each estimate, ``(T,)``, by name."""
    n_episodes: np.ndarray
    """``(T,)``: number of living episodes."""

    @property
    def total(self) -> tuple[float, float]:
        """Sums of the lower and of the upper limits over the time steps that have limits; see :attr:`n_left_out`."""
        return float(np.nansum(self.lower)), float(np.nansum(self.upper))

    @property
    def n_left_out(self) -> int:
        """Number of time steps with too few living episodes for limits; :attr:`total` leaves them out."""
        return int(((self.n_episodes > 0) & np.isnan(self.upper)).sum())


def normal_quantile(miss: float) -> float:
    """Return the number of standard errors that a Gaussian exceeds with probability ``miss``."""
    return NormalDist().inv_cdf(1 - miss)


def miss_of_each_limit(miss: float, gap: float) -> float:
    r"""
    Divide the error probability between two limits, given the gap between their bounds.

    The true value lies in the gap, and a limit that is far from the true value hardly ever misses it. In the worst case
    the true value is at one end of the gap, where :math:`\Phi(-c) + \Phi(-c - \text{gap}) = \text{miss}` for limits
    that are c standard errors from their bounds (Imbens and Manski, 2004, Econometrica 72(6)). Without a gap each limit
    gets half of the probability. With a wide gap each limit gets the whole probability, because the true value can be
    close to only one limit.

    :param miss: Probability that either limit misses the true value.
    :param gap: Upper minus lower estimate, in standard errors; negative values and NaN count as 0.
    """
    from scipy.optimize import brentq  # its import takes half a second

    normal, gap, least = NormalDist(), max(0.0, gap), normal_quantile(miss)  # in this order NaN becomes 0

    def excess(c: float) -> float:
        return normal.cdf(-c) + normal.cdf(-c - gap) - miss

    # With a wide gap, rounding can put the root just below its lower limit.
    c = brentq(excess, least, normal_quantile(miss / 2) + 1e-9) if excess(least) > 0 else least
    return normal.cdf(-c)


def joint_quantile(miss: float, correlations: Sequence[float]) -> float:
    r"""
    Return a common upper limit c for several correlated Gaussians, in standard errors.

    The probability that at least one of the Gaussians exceeds c is at most ``miss``. Hunter's inequality (1976, Journal
    of Applied Probability 13(3)) bounds this probability from above: by the sum of the probabilities that each Gaussian
    exceeds c, minus the probabilities that the first Gaussian and each other Gaussian exceed c together.
    ``correlations`` are those of the first Gaussian with the others. With Owen's function T, the upper bound on the
    probability is
    :math:`\Phi(-c) + 2 \sum_k T(c, \sqrt{(1 - \rho_k) / (1 + \rho_k)})`. Fully correlated Gaussians give the quantile
    of a single Gaussian, and independent Gaussians give about Bonferroni's quantile. ``miss`` must be below 0.5.
    """
    from scipy.optimize import brentq

    slopes = np.sqrt([(1 - rho) / (1 + rho) for rho in np.clip(correlations, -1 + 1e-9, 1)])

    def excess(c: float) -> float:
        return NormalDist().cdf(-c) + 2 * owens_t(c, slopes).sum() - miss

    return brentq(excess, normal_quantile(miss) - 1e-9, normal_quantile(miss / (1 + len(slopes))) + 1e-9)


def limit(bounds: dict[str, Estimate], miss: float, sign: int) -> tuple[str, float]:
    """
    Return the name and the value of the tightest upper limit (``sign=1``) or lower limit (``sign=-1``).

    :param miss: Probability that at least one limit is on the wrong side of the expectation of its bound.
    """
    if not bounds:
        return "", sign * math.inf
    tightest, *others = sorted(bounds.values(), key=lambda bound: sign * bound.value)
    multiple = joint_quantile(miss, [tightest.correlation(other) for other in others])
    limits = {name: bound.value + sign * multiple * bound.error for name, bound in bounds.items()}
    name = min(limits, key=lambda name: sign * limits[name])
    return name, limits[name]


def _gap(below: Collection[Estimate], above: Collection[Estimate]) -> float:
    """Return the distance between the tightest lower and upper bounds, in standard errors."""
    if not (below and above):
        return math.nan
    lower, upper = max(below, key=lambda bound: bound.value), min(above, key=lambda bound: bound.value)
    return (upper.value - lower.value) / max(lower.error, upper.error, TINY)


def min_episodes(trv_dim: int) -> int:
    """Return the number of living episodes that an interval needs at a time step."""
    return max(MIN_EPISODES, 2 * trv_dim + 2)


def _steps(batch: InformationBatch, seed: int) -> Iterator[tuple[int, Encoded, np.random.Generator]]:
    """Yield the time steps with enough living episodes, each with draws of the TRVs and a random generator."""
    for t in np.flatnonzero(batch.living.sum(1).cpu() >= min_episodes(batch.trvs.shape[2])).tolist():
        rng = np.random.default_rng((seed, t))
        yield t, draw_trvs(batch.at(t), rng), rng


@threads(1)
def information_interval(batch: InformationBatch, *, seed: int = 0) -> InformationInterval:
    r"""
    Compute confidence limits (95 %) for I[x_t; x~_t] at every time step from fresh rollouts of a policy.

    **Lower limits** come from the Donsker-Varadhan bound of a critic on x and x~,

    .. math:: I[x_t; \tilde x_t] \ge E[F(x, \tilde x)] - \log E_\perp[e^{F(x, \tilde x)}],

    which holds for any F that is independent of the samples; x and x~ are independent in the second expectation.
    Critics are fitted to some of the episodes and evaluated on the others. Of two kinds of critics, the one with the
    higher limit counts:

    - ``"critic"``: :class:`~sb3_tdpg.evaluation.density_critic.DensityCritic`, fitted to halves of the episodes;
    - ``"gaussian"``: :class:`~sb3_tdpg.evaluation.density_critic.GaussianCritic`, fitted to most of the episodes.

    **Upper limits** are the lowest of the limits of three upper bounds on I[e_t; x~_t] >= I[x_t; x~_t], where
    e_t = (x~_{t-1}, y_t) is the input of the encoder with density q:

    - ``"logdet"``: :class:`~sb3_tdpg.information.logdet.LogDet`, with its bias removed by the jackknife;
    - ``"loo"``: :class:`~sb3_tdpg.information.loo.LeaveOneOut`;
    - ``"marginal"``: :math:`E \log q(\tilde x | e) / a(\tilde x)` with the marginal density a of the critic, also on
      fresh episodes.

    The confidence of 95 % holds for each step alone. Above about ``ln N`` nats the lower limit becomes loose; it cannot
    exceed about ``ln(N^2 / 10)``. ``docs/guide/information.md`` explains how the limits allow for the sampling error.

    :param batch: Rollouts ``(T, N, ...)`` of independent episodes that the encoder has not been trained on.
    :param seed: Seed of the divisions of the episodes and of the noise.
    """
    horizon, n_episodes = len(batch.trvs), batch.living.sum(1).cpu().numpy()
    estimates, errors = ({name: np.full(horizon, np.nan) for name in LOWER_BOUNDS + UPPER_BOUNDS} for _ in range(2))
    limits = np.full((2, horizon), np.nan)
    lower_by, upper_by = [""] * horizon, [""] * horizon
    for t, step, rng in _steps(batch, seed):
        critic, marginal = critic_bounds(step, rng)
        below = dict(critic=critic, gaussian=gaussian_bound(step, rng))
        above = dict(logdet=log_det_bound(step), loo=leave_one_out_bound(step), marginal=marginal)
        for name, bound in (below | above).items():
            estimates[name][t], errors[name][t] = bound.value, bound.error
        below, above = ({name: b for name, b in side.items() if np.isfinite(b.value)} for side in (below, above))
        gap = _gap(below.values(), above.values())
        miss = [miss_of_each_limit(spent * (1 - CONFIDENCE), gap) for spent in (SPENT_BELOW, SPENT_ABOVE)]
        lower_by[t], lower = limit(below, miss[0], sign=-1)
        upper_by[t], upper = limit(above, miss[1], sign=1)
        if lower <= 0:
            lower_by[t], lower = "zero", 0.0
        upper = max(upper, 0.0)
        limits[:, t] = min(lower, upper), upper
    return InformationInterval(limits[0], limits[1], tuple(lower_by), tuple(upper_by), estimates, errors, n_episodes)


def component_estimates(batch: InformationBatch, *, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    r"""
    Bound the information of the TRVs about each component of the state from below, I[x^k_t; x~_t].

    The bound is the larger of the two lower bounds of :func:`information_interval`, with one component in place of the
    state. If the TRVs depend on several components, their density given one component has a complicated shape, and the
    Gaussian critic can give the better bound.

    :param batch: As in :func:`information_interval`.
    :param seed: Seed of the division of the episodes and of the noise.
    :return: the estimates of the bounds and their lower 95 % confidence limits, ``(T, X)`` each, in nats; NaN where a
        component is constant or too few episodes are alive
    """
    values = np.full((2, len(batch.states), batch.states.shape[-1]), np.nan)
    for t, step, rng in _steps(batch, seed):
        for k in np.flatnonzero(varies(step.states)):
            of_one = step._replace(states=step.states[:, [k]])
            bounds = dict(critic=critic_bounds(of_one, rng)[0], gaussian=gaussian_bound(of_one, rng))
            values[0, t, k] = max(bound.value for bound in bounds.values())
            _, values[1, t, k] = limit(bounds, 1 - CONFIDENCE, sign=-1)
    return values[0], values[1]
