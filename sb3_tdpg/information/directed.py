"""Bounds on the directed information, which counts information only once if the TRVs keep it for several steps."""

from __future__ import annotations

import torch as th

from sb3_tdpg.information.base import InformationBatch
from sb3_tdpg.information.logdet import LogDet
from sb3_tdpg.information.loo import LeaveOneOut

RIDGE = 1e-4  # penalty of the regression, relative to the mean variance of its inputs


class DirectedLogDet(LogDet):
    r"""
    The bound of :class:`~sb3_tdpg.information.logdet.LogDet`, applied to the residuals of a linear regression of the
    TRVs on the previous TRVs.

    It bounds the directed information from the sensor to the TRVs, which is the information that the sensor adds at
    each step. The influence of the actions on later observations does not count. Given x~_{t-1}, the TRVs
    depend on the past only through y_t, hence

    .. math::
        I[y_{0:T} \to \tilde x_{0:T}] = \sum_t I[y_{0:t}; \tilde x_t | \tilde x_{0:t-1}]
        \le \sum_t I[y_t; \tilde x_t | \tilde x_{t-1}]
        \le \sum_t \tfrac12 \log\det \mathrm{Cov}(\tilde x_t - A_t \tilde x_{t-1})
        - E[\textstyle\sum_i \log \sigma_i(e_t)]

    with the matrix A_t of a linear regression. The last inequality holds for two reasons. First, a Gaussian has the
    largest entropy for a given covariance. Second, the residual of the best linear prediction has at least the variance
    that the best prediction leaves. A bit that is kept for T steps costs one bit here, and T bits in the sum over time
    of I[x_t; x~_t]. The estimate is not a bound on that sum.
    """

    bound = "neither"  # type: ignore[assignment]  # not the inherited "upper": it bounds another quantity

    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        return super()._estimate(without_memory(batch), t)


class DirectedLeaveOneOut(LeaveOneOut):
    r"""
    The bound of :class:`~sb3_tdpg.information.loo.LeaveOneOut`, applied to the residuals of a linear regression of the
    TRVs on the previous TRVs.

    It bounds the same directed information as :class:`DirectedLogDet`. Let :math:`r_i = \tilde x_i - A_t \tilde x_{i,
    t-1}` be the residual, and :math:`q_j` its density in episode j, which is a Gaussian around :math:`\mu_j - A_t
    \tilde x_{j, t-1}`. Then

    .. math::
        I[y_t; \tilde x_t | \tilde x_{t-1}] \le h(r) - h(\tilde x_t | e_t) \le E\left[\frac1N \sum_i \log
        \frac{q_i(r_i)}{\frac{1}{N-1} \sum_{j \ne i} q_j(r_i)}\right].

    The first inequality follows from h(x~_t | x~_{t-1}) = h(r | x~_{t-1}) <= h(r), for any A_t. The second inequality
    holds for any shape of the density, so a bit costs about ln 2 at most. With the log-det bound, the cost of a bit
    grows with the distance between its two values, and the policy makes these values harder to distinguish.
    """

    bound = "neither"  # type: ignore[assignment]  # not the inherited "upper": it bounds another quantity

    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        return super()._estimate(without_memory(batch), t)


def without_memory(batch: InformationBatch) -> InformationBatch:
    """
    Subtract a prediction from the TRVs and their means: the linear regression of the means on the previous TRVs.

    :raises ValueError: if the batch has no ``prev_trvs``.
    """
    if batch.prev_trvs is None:
        raise ValueError("a directed estimator needs the prev_trvs of the batch, the TRVs of the step before")
    means, past = (x - x.mean(dim=1, keepdim=True) for x in (batch.means, batch.prev_trvs))
    gram = past.mT @ past
    # The first step has no past: without a ridge the system would be singular.
    ridge = RIDGE * gram.diagonal(dim1=1, dim2=2).mean(1).clamp(min=1e-6)
    system = gram + th.diag_embed(ridge[:, None].expand(-1, gram.shape[1]))
    predicted = past @ th.linalg.solve(system, past.mT @ means)
    return batch._replace(trvs=batch.trvs - predicted, means=batch.means - predicted)
