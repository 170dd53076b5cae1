"""The variational information bottleneck: the divergence of the encoder from a learnt prior."""

from __future__ import annotations

import torch as th

from sb3_tdpg.information.base import InformationBatch, InformationEstimator


class VariationalBottleneck(InformationEstimator):
    r"""
    An upper bound from a learnt prior r_t that is independent of the encoder's input e_t = (x~_{t-1}, y_t) (Alemi et
    al., 2017; Barber and Agakov, 2003):

    .. math::
        I[x_t; \tilde x_t] \le I[e_t; \tilde x_t]
        = E\, D[q(\tilde x_t | e_t) \,\|\, r_t] - D[q(\tilde x_t) \,\|\, r_t]
        \le E\, D[q(\tilde x_t | e_t) \,\|\, r_t].

    The prior r_t of each time step is a diagonal Gaussian with the moments of the TRVs in each epoch's rollouts, frozen
    in the policy's loss. The estimate is that of :class:`~sb3_tdpg.information.logdet.LogDet` without the covariances,
    so it is looser for correlated TRVs.

    Before the first fit the prior is the standard normal. On the samples to which the prior was fitted, the estimate is
    too low by about Z / N nats, for Z TRVs and N episodes.
    """

    bound = "upper"

    def __init__(self, horizon: int, state_dim: int, trv_dim: int) -> None:
        super().__init__(horizon, state_dim, trv_dim)
        self.register_buffer("prior_mean", th.zeros(horizon, 1, trv_dim))
        self.register_buffer("prior_var", th.ones(horizon, 1, trv_dim))

    prior_mean: th.Tensor
    prior_var: th.Tensor

    @th.no_grad()
    def fit(self, batch: InformationBatch) -> dict[str, float]:
        """
        Fit the prior of each time step to the encoder's densities in the living episodes.

        The prior does not change at steps with fewer than ``min_episodes`` living episodes.
        """
        enough = self.has_enough(batch)
        alive = batch.living[enough][:, :, None]
        # Values after the end of an episode are arbitrary.
        means, stds = (x[enough].masked_fill(~alive, 0.0) for x in (batch.means, batch.stds))
        count = alive.sum(1, keepdim=True)
        mean = means.sum(1, keepdim=True) / count
        variances = alive * (means - mean).square() + stds.square()  # law of total variance
        self.prior_mean[enough], self.prior_var[enough] = mean, variances.sum(1, keepdim=True) / count
        return {}

    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        at = slice(None) if t is None else slice(t, t + 1)
        mean, var = self.prior_mean[at], self.prior_var[at]
        ratio = batch.stds.square() / var
        divergence = 0.5 * ((batch.means - mean).square() / var + ratio - 1 - ratio.log())
        return divergence.sum(-1).mean(dim=1)
