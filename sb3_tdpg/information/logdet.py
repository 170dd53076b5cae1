"""The log-determinant bound from the known density of the Gaussian encoder."""

from __future__ import annotations

import torch as th

from sb3_tdpg.information.base import InformationBatch, InformationEstimator

RIDGE = 1e-4  # of a regression, in shares of the mean variance of its inputs


class LogDet(InformationEstimator):
    r"""
    A Gaussian has the largest entropy of all densities with the same covariance. With e_t = (x~_{t-1}, y_t),

    .. math::
        I[x_t; \tilde x_t] \le I[e_t; \tilde x_t] = h(\tilde x_t) - h(\tilde x_t | e_t)
        \le \tfrac12 \log\det \mathrm{Cov}(\tilde x_t) - E[\textstyle\sum_i \log \sigma_i(e_t)].

    The first step is the data-processing inequality. The second is exact for a Gaussian x~_t, and loose for one with
    several modes. The covariance follows from the law of total covariance, ``Cov(mean) + E[diag(std^2)]``: without the
    sampling noise of the TRVs, and never singular.
    """

    bound = "upper"

    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        return _gaussian_bound(batch.means, batch.stds)


class DirectedLogDet(InformationEstimator):
    r"""
    The bound of :class:`LogDet`, given the last TRVs: a memory is not charged again for what it keeps.

    The penalty becomes the directed information from the sensor to the TRVs. Given x~_{t-1}, the TRVs depend on the
    past only through y_t, hence by the chain rule it bounds all that an episode's TRVs know of its observations:

    .. math::
        I[y_{0:T}; \tilde x_{0:T}] \le \sum_t I[y_t; \tilde x_t | \tilde x_{t-1}]
        \le \sum_t \tfrac12 \log\det \mathrm{Cov}(\tilde x_t - A_t \tilde x_{t-1})
        - E[\textstyle\sum_i \log \sigma_i(e_t)]

    with the matrix A_t of a linear regression: a Gaussian has the largest entropy, and the best linear prediction
    leaves at least the variance of the best one. A bit that is kept for T steps costs one bit here, and T bits in the
    sum over time of I[x_t; x~_t], on which this is no bound.
    """

    bound = "neither"

    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        if batch.prev_trvs is None:
            raise ValueError("DirectedLogDet needs the prev_trvs of the batch, the TRVs of the step before")
        means, past = (x - x.mean(dim=1, keepdim=True) for x in (batch.means, batch.prev_trvs))
        gram = past.mT @ past
        # The first step has no past: without a ridge the system would be singular.
        ridge = RIDGE * gram.diagonal(dim1=1, dim2=2).mean(1).clamp(min=1e-6)
        system = gram + th.diag_embed(ridge[:, None].expand(-1, gram.shape[1]))
        return _gaussian_bound(means - past @ th.linalg.solve(system, past.mT @ means), batch.stds)


def _gaussian_bound(means: th.Tensor, stds: th.Tensor) -> th.Tensor:
    """Return the bound for Gaussians with means and standard deviations ``(T, N, Z)``: ``(T,)``."""
    centred = means - means.mean(dim=1, keepdim=True)
    covariance = centred.mT @ centred / (means.shape[1] - 1) + th.diag_embed(stds.square().mean(dim=1))
    # Dividing by the geometric mean of the stds first keeps the determinant representable.
    log_std = stds.log().mean(dim=1)  # (T, Z)
    scale = th.exp(-log_std)
    return 0.5 * th.logdet(covariance * scale[:, :, None] * scale[:, None, :])
