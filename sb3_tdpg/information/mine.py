"""MINE: the Donsker-Varadhan bound with a trained critic (Belghazi et al., 2018), as the paper uses it."""

from __future__ import annotations

import math
from typing import Any

import torch as th

from sb3_tdpg.information.critic import CriticEstimator, Scores


def log_mean_exp(x: th.Tensor) -> th.Tensor:
    """Return the logarithm of the mean of ``exp(x)`` over all dimensions but the first: ``(T, ...) -> (T,)``."""
    x = x.flatten(1)
    return th.logsumexp(x, dim=1) - math.log(x.shape[1])


class Mine(CriticEstimator):
    r"""
    The Donsker-Varadhan bound :math:`E_p[F] - \log E_{p \times q}[e^F]` (Equation 8).

    For a fixed critic and *fresh* samples the estimate is a lower bound, except for an upward bias. The bias comes from
    the logarithm of a mean and is small for many samples. On the samples to which the critic was fitted, the estimate
    tends to be too high.

    :param ema_decay: Weight **on the past** of an exponential moving average over gradient steps. The average replaces
        the denominator of the critic's gradient (Equation 10) to reduce the bias of minibatches. A value of 0.99
        averages over about 100 steps. The paper's footnote puts alpha = 5e-5 on the past, which is almost no averaging.
        ``None``: no moving average, but the mean of each minibatch.
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
        # Logarithm of the moving average at each time step; NaN before the first minibatch.
        self.register_buffer("log_ema", th.full((horizon,), math.nan))

    log_ema: th.Tensor

    def _bound(self, scores: Scores) -> th.Tensor:
        return scores.joint.mean(dim=1) - log_mean_exp(scores.marginal)

    def _objective_gradient(self, values: th.Tensor, n: int, rows: slice | th.Tensor, steps: th.Tensor) -> th.Tensor:
        """Return the gradient in closed form (Equation 10): -1 / B at joint samples, a softmax at marginal samples."""
        gradient = th.zeros_like(values)
        marginal = values[rows, n:, 0]
        gradient[rows, :n, 0] = -1.0 / n
        weights = th.softmax(marginal, dim=1)
        if self.ema_decay is not None:
            log_mean = log_mean_exp(marginal)
            weights = weights * th.exp(log_mean - self._update_log_ema(log_mean, steps))[:, None]
        gradient[rows, n:, 0] = weights
        return gradient

    def _update_log_ema(self, log_mean: th.Tensor, steps: th.Tensor) -> th.Tensor:
        """Update the moving average of the denominator with a minibatch, in logarithms because e^F overflows."""
        assert self.ema_decay is not None
        past = self.log_ema[steps]
        log_decay = math.log(self.ema_decay) if self.ema_decay > 0 else -math.inf
        mixed = th.logaddexp(past + log_decay, log_mean + math.log1p(-self.ema_decay))
        self.log_ema[steps] = th.where(th.isnan(past), log_mean, mixed)
        return self.log_ema[steps]

    def _forget(self, steps: th.Tensor) -> None:
        self.log_ema[steps] = math.nan
