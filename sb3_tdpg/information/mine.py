"""MINE: the Donsker-Varadhan bound with a trained critic (Belghazi et al., 2018), as the paper uses it."""

from __future__ import annotations

import math
from typing import Any

import torch as th

from sb3_tdpg.information.critic import CriticEstimator, Scores


def log_mean_exp(x: th.Tensor) -> th.Tensor:
    """Logarithm of the mean of ``exp(x)`` over all dimensions but the first: ``(T, ...) -> (T,)``."""
    x = x.flatten(1)
    return th.logsumexp(x, dim=1) - math.log(x.shape[1])


class Mine(CriticEstimator):
    r"""
    The Donsker-Varadhan bound :math:`E_p[F] - \log E_{p \times q}[e^F]` (eq:kl mine).

    A lower bound for a fixed critic on *fresh* samples. On the samples that it was fitted to it is neither, and tends
    to be too high.

    :param ema_decay: With it the denominator of the critic's gradient (eq:grad mine) is an exponential moving average
        over the gradient steps, to lessen the bias of minibatches. It is the weight **on the past**: 0.99 averages over
        about 100 steps. The paper's footnote puts alpha = 5e-5 on the past, which is almost no averaging. ``None``: each
        minibatch's own mean.
    :param kwargs: See :class:`~sb3_tdpg.information.critic.CriticEstimator`.
    :raises ValueError: if ``ema_decay`` is not in [0, 1).
    """

    bound = "lower"

    def __init__(
        self, horizon: int, state_dim: int, trv_dim: int, *, ema_decay: float | None = None, **kwargs: Any
    ) -> None:
        super().__init__(horizon, state_dim, trv_dim, **kwargs)
        if ema_decay is not None and not 0 <= ema_decay < 1:
            raise ValueError(f"mi_kwargs: ema_decay={ema_decay} must be in [0, 1): it is the weight on the past")
        self.ema_decay = ema_decay
        # Logarithm of the moving average for each time step; NaN until the first minibatch.
        self.register_buffer("log_ema", th.full((horizon,), math.nan))

    log_ema: th.Tensor

    def _bound(self, scores: Scores) -> th.Tensor:
        return scores.joint.mean(dim=1) - log_mean_exp(scores.marginal)

    def _objective(self, scores: Scores, steps: th.Tensor) -> th.Tensor:
        if self.ema_decay is None:
            return self._bound(scores)
        log_mean = log_mean_exp(scores.marginal)
        with th.no_grad():
            past, new = self.log_ema[steps], log_mean.detach()
            decay = max(self.ema_decay, 1e-38)
            mixed = th.logaddexp(past + math.log(decay), new + math.log1p(-self.ema_decay))
            log_ema = th.where(th.isnan(past), new, mixed)
            self.log_ema[steps] = log_ema
        # The gradient of log E[e^F] is E[F' e^F] / E[e^F]: the denominator is replaced by its moving average.
        return scores.joint.mean(dim=1) - th.exp(log_mean - log_ema)

    def _forget(self, steps: th.Tensor) -> None:
        self.log_ema[steps] = math.nan
