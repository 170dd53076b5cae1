r"""
Bound the expected cost from above under every distribution that is close to the training distribution.

For the training distribution p, a shifted distribution :math:`\check p` and every :math:`\beta > 0`, the
Donsker-Varadhan formula gives

.. math::
    \mathbb E_{\check p}[c] \le \rho_\beta[c] + \tfrac1\beta \mathbb D[\check p \,\|\, p], \qquad
    \rho_\beta[c] = \tfrac1\beta \log \mathbb E_p\, e^{\beta c}.

Apart from the divergence, the right-hand side needs only costs under p. The bound corrects the paper's Theorem II.1.
The derivation is in ``docs/guide/certificate.md``.

Dimension key: N episodes, M points of a distribution.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.stats import beta as beta_distribution

# All of the 50 highest costs are kept, then ranks that grow by this factor; about 400 of a million costs remain.
_HIGHEST = 50
_RANK_FACTOR = 1.04


class CostDistribution(NamedTuple):
    """A distribution on M values that lies, with some confidence, stochastically above the distribution of a cost."""

    values: np.ndarray  #: (M,), ascending
    probabilities: np.ndarray  #: (M,)

    def with_largest(self, probability: float) -> CostDistribution:
        """Raise the lowest costs, up to a total probability of ``probability``, to the largest cost."""
        below = np.clip(np.cumsum(self.probabilities) - probability, 0.0, 1.0)
        below[-1] = 1.0
        return self._replace(probabilities=np.diff(below, prepend=0.0))

    def capped(self, level: float) -> tuple[CostDistribution, float]:
        """
        Cap the cost at the lowest value of the sample that it exceeds with a probability of at most ``level``.

        If there is no such value, the cap is the highest value of the sample.

        :return: the distribution of the capped cost, and the probability of a cost above the cap
        """
        n = len(self.values) - 1  # the last value is not from the sample
        below = np.cumsum(self.probabilities)[:n]
        last = min(int(np.searchsorted(below, 1 - level)), n - 1)
        kept = np.append(self.probabilities[:last], 1 - (below[last - 1] if last else 0.0))
        return self._replace(values=self.values[: last + 1], probabilities=kept), max(0.0, 1 - float(below[last]))


def entropic_risk(costs: np.ndarray, beta: float, probabilities: np.ndarray | None = None) -> float:
    r"""
    Compute the entropic risk (Equation 4), :math:`\frac1\beta \log \mathbb E\, e^{\beta c}`, without overflow.

    :param costs: ``(N,)``
    :param beta: Number of at least 0; 0 gives the mean, which is the limit for a small beta.
    :param probabilities: Probabilities of the costs, ``(N,)``; default: 1 / N each.
    """
    if not (np.isfinite(beta) and beta >= 0):
        raise ValueError(f"beta={beta} must be finite and at least 0")
    weights = np.full(len(costs), 1 / len(costs)) if probabilities is None else probabilities
    mean = float(weights @ costs)
    if beta == 0:
        return mean
    # Computed relative to the mean, since the difference from it is of the order of beta. scipy's logsumexp takes ten
    # times as long.
    exponents = beta * (costs - mean)
    largest = float(exponents.max())
    if largest < 1:  # expm1 does not round small differences from 1 away
        return mean + math.log1p(float(weights @ np.expm1(exponents))) / beta
    return mean + (largest + math.log(float(weights @ np.exp(exponents - largest)))) / beta


def cost_distribution(costs: np.ndarray, cost_bound: float, confidence: float = 0.95) -> CostDistribution:
    r"""
    Bound the distribution of the cost from above by a confidence band around a sample of costs.

    Let F be the distribution function of the cost. At the i-th lowest of N costs, :math:`F(c_{(i)})` is stochastically
    above a Beta(i, N + 1 - i) variable. With R used ranks, the lower quantiles of these variables at the level
    ``(1 - confidence) / R`` are lower bounds on F that hold simultaneously (Bonferroni). The step function through
    these quantiles is a lower bound on F. The band leaves a probability of about ``log(R / (1 - confidence)) / N``
    above the highest cost, and assigns it to ``cost_bound``. R is about 400 for a million costs. The band bounds the
    mean of every increasing function simultaneously, so the entropic risk may be optimised over beta.

    :param costs: Costs of independent episodes with the same distribution, ``(N,)``.
    :param cost_bound: Upper bound on the episode cost.
    :param confidence: Probability with which the band holds.
    """
    costs = np.asarray(costs, dtype=np.float64)
    if costs.ndim != 1 or len(costs) == 0 or not np.isfinite(costs).all():
        raise ValueError(f"costs must be a vector of finite numbers, one for each episode, not {costs!r}")
    costs = np.sort(costs)
    n = len(costs)
    ranks = _ranks(n)
    check_allowance(confidence, cost_bound)
    if costs[-1] > cost_bound:
        given = f"a cost of {costs[-1]:g} exceeds cost_bound={cost_bound:g}"
        raise ValueError(f"{given}: give a larger bound, or certify the clipped cost np.minimum(costs, cost_bound)")
    below = beta_distribution.ppf((1 - confidence) / len(ranks), ranks, n + 1 - ranks)
    return CostDistribution(np.append(costs[ranks - 1], cost_bound), np.diff(below, prepend=0.0, append=1.0))


def check_allowance(confidence: float, cost_bound: float) -> None:
    """Raise a ``ValueError`` if the confidence is not a probability, or the cost bound is not finite."""
    if not 0 < confidence < 1:
        raise ValueError(f"confidence={confidence} must lie between 0 and 1")
    if not np.isfinite(cost_bound):
        raise ValueError(f"cost_bound={cost_bound} must be finite: give an upper bound on the cost of an episode")


def worst_mean(distribution: CostDistribution, kl: float) -> float:
    r"""
    Bound the mean under any distribution within ``kl`` nats of the given distribution.

    The bound is the minimum of ``entropic_risk + kl / beta`` over beta. As a function of :math:`s = 1 / \beta`, the
    bound is convex (the perspective of a convex function plus a linear function), so a local search finds the minimum.
    Every beta gives a valid bound. Some distribution within ``kl`` nats attains the minimum.

    :param kl: D[shifted || training] in nats, or an upper bound on it; inf gives the largest cost.
    """
    if not kl >= 0:
        raise ValueError(f"kl={kl} must be at least 0")
    values, weights = distribution
    largest, width = float(values[-1]), float(values[-1]) - float(values[0])
    if kl == 0 or width == 0:
        return float(weights @ values)
    # The distribution that has all its weight on the largest value has this divergence from the given one.
    if kl >= -math.log(max(float(weights[values == largest].sum()), 1e-300)):
        return largest

    def objective(log_s: float) -> float:
        s = width * math.exp(log_s)
        return entropic_risk(values, 1 / s, weights) + kl * s

    best = minimize_scalar(objective, bounds=(-15.0, 15.0), method="bounded", options=dict(xatol=1e-3))
    return min(float(best.fun), largest)


def certificate(costs: np.ndarray, kl: float, *, cost_bound: float, confidence: float = 0.95) -> float:
    """
    Bound the expected cost under a shift, from costs in training (Equation 6, corrected).

    The costs are those of independent episodes; see :func:`cost_distribution` and :func:`worst_mean`.

    :param kl: D[shifted || training] of the two distributions over episodes in nats, or an upper bound on it.
    :return: the upper bound on the expected cost
    """
    return worst_mean(cost_distribution(costs, cost_bound, confidence), kl)


def _ranks(n: int) -> np.ndarray:
    """Choose ranks from 1 to n: the 50 highest, fewer and fewer below them, and 100 evenly spaced in the lower half."""
    from_top: list[np.ndarray] = [np.arange(min(_HIGHEST, n))]
    if n > _HIGHEST:
        n_steps = math.ceil(math.log(n / (2 * _HIGHEST) + 1) / math.log(_RANK_FACTOR))
        from_top += [_HIGHEST * _RANK_FACTOR ** np.arange(n_steps), np.linspace(n / 2, n - 1, 100)]
    return n - np.unique(np.concatenate(from_top).astype(np.int64).clip(0, n - 1))[::-1]
