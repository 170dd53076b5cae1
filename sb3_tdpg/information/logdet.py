"""The log-determinant bound from the known density of the Gaussian encoder."""

from __future__ import annotations

import torch as th

from sb3_tdpg.information.base import InformationBatch, InformationEstimator


class LogDet(InformationEstimator):
    r"""
    Bound the information with the entropy of a Gaussian, the largest entropy for a given covariance.

    With the encoder's input e_t = (x~_{t-1}, y_t),

    .. math::
        I[x_t; \tilde x_t] \le I[e_t; \tilde x_t] = h(\tilde x_t) - h(\tilde x_t | e_t)
        \le \tfrac12 \log\det \mathrm{Cov}(\tilde x_t) - E[\textstyle\sum_i \log \sigma_i(e_t)].

    The first inequality is the data-processing inequality. The second inequality is exact for a Gaussian x~_t, and
    loose for a distribution with several modes. The covariance is computed as ``Cov(mean) + E[diag(std^2)]`` (law of
    total covariance). It therefore contains no sampling noise of the TRVs and is never singular.
    """

    bound = "upper"

    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        means, stds = batch.means, batch.stds
        centred = means - means.mean(dim=1, keepdim=True)
        covariance = centred.mT @ centred / (means.shape[1] - 1) + th.diag_embed(stds.square().mean(dim=1))
        # Dividing by the geometric mean of the stds first keeps the determinant representable.
        log_std = stds.log().mean(dim=1)  # (T, Z)
        scale = th.exp(-log_std)
        return 0.5 * th.logdet(covariance * scale[:, :, None] * scale[:, None, :])
