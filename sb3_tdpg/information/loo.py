"""The leave-one-out bound from the known density of the Gaussian encoder (Poole et al., 2019)."""

from __future__ import annotations

import math

import torch as th

from sb3_tdpg.information.base import InformationBatch, InformationEstimator


class LeaveOneOut(InformationEstimator):
    r"""
    Bound the information; the mixture of the *other* episodes' encoder densities replaces the marginal q(x~_t).

    .. math::
        I[x_t; \tilde x_t] \le I[e_t; \tilde x_t] \le E\left[\frac1N \sum_i \log
        \frac{q(\tilde x_i | e_i)}{\frac{1}{N-1} \sum_{j \ne i} q(\tilde x_i | e_j)}\right],
        \qquad e_t = (\tilde x_{t-1}, y_t).

    This is an upper bound in expectation, for any shape of q(x~_t). It is loose if the information exceeds about ln N.
    If the steps of all times are pooled, the mixture for a sample leaves out all steps of its own episode.
    """

    bound = "upper"

    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        log_density = log_density_matrix(batch)
        own = log_density.diagonal(dim1=1, dim2=2)
        if batch.episode is None:
            same = th.eye(own.shape[1], dtype=th.bool, device=own.device)[None]
        else:
            same = batch.episode[:, :, None] == batch.episode[:, None, :]
        n_others = (~same).sum(dim=2)
        alone = n_others == 0  # no sample of another episode, so no estimate
        others = log_density.masked_fill(same & ~alone[..., None], -math.inf)
        bound = own - th.logsumexp(others, dim=2) + n_others.clamp(min=1).log()
        return bound.masked_fill(alone, 0.0).mean(dim=1)


def own_sample_bound(batch: InformationBatch) -> th.Tensor:
    r"""
    Bound the information from below with the mixture of the encoder densities of all episodes.

    .. math::
        I[e_t; \tilde x_t] \ge E\left[\frac1N \sum_i \log
        \frac{q(\tilde x_i | e_i)}{\frac1N \sum_j q(\tilde x_i | e_j)}\right], \qquad e_t = (\tilde x_{t-1}, y_t).

    The bound is InfoNCE with the optimal critic, and is at most ln N. If the encoder's input is a function of the state
    (no memory, T = 1, and no sensor noise), it is also a lower bound on :math:`I[x_t; \tilde x_t]`.

    :return: the bound for each step in nats, ``(T,)``
    """
    log_density = log_density_matrix(batch)
    own = log_density.diagonal(dim1=1, dim2=2)
    return (own - th.logsumexp(log_density, dim=2)).mean(dim=1) + math.log(log_density.shape[1])


def log_density_matrix(batch: InformationBatch) -> th.Tensor:
    """
    Return log q(x~_i | e_j) for every sample i and every episode j, up to a constant: ``(T, i, j)``.

    :param batch: A batch whose episodes are all alive.
    """
    trvs, means, stds = batch.trvs, batch.means, batch.stds
    precision = stds.square().reciprocal()  # (T, N, Z)
    # sum_z (x_iz - m_jz)^2 / s_jz^2 as matrix products, without a (T, N, N, Z) intermediate. The values are centred
    # first, since the expanded square loses digits far from the origin.
    centre = means.mean(dim=1, keepdim=True).detach()
    x, m = trvs - centre, means - centre
    quadratic = x.square() @ precision.mT - 2 * x @ (m * precision).mT + (m.square() * precision).sum(-1)[:, None, :]
    return -0.5 * quadratic - stds.log().sum(-1)[:, None, :]
