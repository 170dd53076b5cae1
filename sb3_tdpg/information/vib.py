"""The variational information bottleneck: the divergence of the encoder from a learnt prior."""

from __future__ import annotations

import math

import torch as th

from sb3_tdpg.envs import checks
from sb3_tdpg.information.base import InformationBatch, InformationEstimator

EM_STEPS = 30  # steps of expectation-maximisation in each fit of several components

Prior = tuple[th.Tensor, th.Tensor, th.Tensor]  # means and variances, (T, K, Z), and logarithms of the weights, (T, K)


class VariationalBottleneck(InformationEstimator):
    r"""
    An upper bound from a learnt prior r_t that is independent of the encoder's input e_t = (x~_{t-1}, y_t) (Alemi et
    al., 2017; Barber and Agakov, 2003):

    .. math::
        I[x_t; \tilde x_t] \le I[e_t; \tilde x_t]
        = E\, D[q(\tilde x_t | e_t) \,\|\, r_t] - D[q(\tilde x_t) \,\|\, r_t]
        \le E\, D[q(\tilde x_t | e_t) \,\|\, r_t].

    The prior r_t of each time step is a mixture of K diagonal Gaussians :math:`w_k N_k`, fitted to each epoch's
    rollouts and frozen in the policy's loss. The divergence from a mixture has no closed form. The estimate is
    therefore an upper bound on this divergence. The bound follows from Jensen's inequality and needs no samples
    (Hershey and Olsen, 2007):

    .. math::
        D[q \,\|\, r_t] \le -\log \sum_k w_k e^{-D[q \| N_k]}.

    With one component this bound is exact, and the best prior has the moments of the TRVs. The estimate is then that of
    :class:`~sb3_tdpg.information.logdet.LogDet` without the covariances, so it is looser for correlated TRVs. A mixture
    is fitted by expectation-maximisation; the responsibility of a component for an episode is proportional to
    :math:`w_k e^{-D[q \| N_k]}`.

    Before the first fit the prior is the standard normal. On the samples to which the prior was fitted, the estimate is
    too low by about Z / N nats per component, for Z TRVs and N episodes.

    :param n_components: Number of Gaussians K in the prior of a time step.
    :raises ValueError: if ``n_components`` is not an integer of at least 1.
    """

    bound = "upper"

    def __init__(self, horizon: int, state_dim: int, trv_dim: int, *, n_components: int = 1) -> None:
        super().__init__(horizon, state_dim, trv_dim)
        self.n_components = checks.count("mi_kwargs: n_components", n_components)
        self.register_buffer("prior_mean", th.zeros(horizon, n_components, trv_dim))
        self.register_buffer("prior_var", th.ones(horizon, n_components, trv_dim))
        self.register_buffer("prior_log_weight", th.full((horizon, n_components), -math.log(n_components)))

    prior_mean: th.Tensor
    prior_var: th.Tensor
    prior_log_weight: th.Tensor

    @th.no_grad()
    def fit(self, batch: InformationBatch) -> dict[str, float]:
        """
        Fit the prior of each time step to the encoder's densities in the living episodes.

        The prior does not change at steps with fewer than ``min_episodes`` living episodes.
        """
        means, variances = batch.means.detach(), batch.stds.detach().square()  # (T, N, Z)
        enough = self.has_enough(batch)
        means, variances, alive = means[enough], variances[enough], batch.living[enough]
        # Values after the end of an episode are arbitrary.
        means, variances = (x.masked_fill(~alive[:, :, None], 1.0) for x in (means, variances))
        weight = alive.to(means.dtype)
        prior = one = _moments(means, variances, weight[:, :, None])  # one Gaussian: (T, 1, Z)
        if self.n_components > 1:
            prior = _moments(means, variances, self._slices(means, alive) * weight[:, :, None], pseudo=one)
            for _ in range(EM_STEPS):
                responsibility = th.softmax(_log_joint(means, variances, prior), dim=2)
                prior = _moments(means, variances, responsibility * weight[:, :, None], pseudo=one)
        self.prior_mean[enough], self.prior_var[enough], self.prior_log_weight[enough] = prior
        return {}

    def _slices(self, means: th.Tensor, alive: th.Tensor) -> th.Tensor:
        """Divide the episodes into K groups of equal size along the direction of largest variance: ``(T, N, K)``."""
        weight = alive[:, :, None].to(means.dtype)
        centred = (means - (weight * means).sum(1, keepdim=True) / weight.sum(1, keepdim=True)) * weight
        direction = th.linalg.eigh(centred.mT @ centred).eigenvectors[:, :, -1:]  # (T, Z, 1)
        along = (centred @ direction)[:, :, 0].masked_fill(~alive, math.inf)
        rank = along.argsort(dim=1).argsort(dim=1)
        slices = (rank * self.n_components // alive.sum(1, keepdim=True)).clamp(max=self.n_components - 1)
        return th.nn.functional.one_hot(slices, self.n_components).to(means.dtype)

    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        at = slice(None) if t is None else slice(t, t + 1)
        prior = (self.prior_mean[at], self.prior_var[at], self.prior_log_weight[at])
        return -th.logsumexp(_log_joint(batch.means, batch.stds.square(), prior), dim=2).mean(dim=1)


def _log_joint(means: th.Tensor, variances: th.Tensor, prior: Prior) -> th.Tensor:
    """Return log w_k - D[q || N_k] for every episode and component: ``(T, N, K)``."""
    mean, var, log_weight = (x[:, None] for x in prior)  # (T, 1, K, Z), and (T, 1, K)
    ratio = variances[:, :, None] / var
    divergence = 0.5 * ((means[:, :, None] - mean).square() / var + ratio - 1 - ratio.log()).sum(-1)
    return log_weight - divergence


def _moments(means: th.Tensor, variances: th.Tensor, responsibility: th.Tensor, pseudo: Prior | None = None) -> Prior:
    """
    Fit the moments of each component to the densities, weighted by its responsibilities (law of total variance).

    :param responsibility: responsibility of each component for each episode, ``(T, N, K)``
    :param pseudo: A Gaussian that counts as an additional episode of every component, so that no component is empty.
    """
    # The moments are taken around the mean of the living episodes, because second moments lose digits far from it.
    weight = responsibility.sum(2, keepdim=True)
    origin = (weight * means).sum(1, keepdim=True) / weight.sum(1, keepdim=True)
    centred = means - origin
    count = responsibility.sum(1)[:, :, None]  # (T, K, 1)
    first = responsibility.mT @ centred
    second = responsibility.mT @ (centred.square() + variances)
    if pseudo is not None:
        count, first = count + 1, first + (pseudo[0] - origin)
        second = second + (pseudo[0] - origin).square() + pseudo[1]
    mean = first / count
    return mean + origin, second / count - mean.square(), (count / count.sum(1, keepdim=True)).log()[:, :, 0]
