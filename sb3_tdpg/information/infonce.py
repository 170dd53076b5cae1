"""InfoNCE: the contrastive lower bound (van den Oord et al., 2018)."""

from __future__ import annotations

import math

import torch as th

from sb3_tdpg.information.base import InformationBatch
from sb3_tdpg.information.critic import CriticEstimator, Scores


class InfoNCE(CriticEstimator):
    r"""
    The contrastive bound, whose critic distinguishes each state's TRVs from those of the other states in a minibatch:

    .. math::
        E\left[F(x_i, \tilde x_i) - \log \frac{1}{B} \sum_j e^{F(x_i, \tilde x_j)}\right].

    This lower bound has low variance. It cannot exceed ``ln B``, which is 3.9 nats with ``batch_size=50``.
    """

    bound = "lower"

    def _pair(self, states: th.Tensor, trvs: th.Tensor, other_trvs: th.Tensor) -> th.Tensor:
        """Pair every state with its own TRVs, then with all TRVs of the minibatch: ``(..., B + B * B, X + Z)``."""
        n = states.shape[-2]
        grid_states = states.unsqueeze(-2).expand(*states.shape[:-1], n, states.shape[-1]).flatten(-3, -2)
        grid_trvs = trvs.unsqueeze(-3).expand(*trvs.shape[:-2], n, *trvs.shape[-2:]).flatten(-3, -2)
        joint = th.cat([states, trvs], -1)
        return th.cat([joint, th.cat([grid_states, grid_trvs], -1)], dim=-2)

    def _n_pairs(self, n: int) -> int:
        return n + n * n

    def _bound(self, scores: Scores) -> th.Tensor:
        partition = th.logsumexp(scores.marginal, dim=2) - math.log(scores.marginal.shape[2])
        return (scores.joint - partition).mean(dim=1)

    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        states, trvs = self._scale(batch.states, t), batch.trvs
        n_steps, n = trvs.shape[:2]
        size = min(self.batch_size, n)
        n_groups = n // size
        # The bound is defined for groups of B samples, so it is averaged over the groups in the batch.
        states, trvs = (x[:, : n_groups * size].unflatten(1, (n_groups, size)) for x in (states, trvs))
        inputs = self._pair(states, trvs, trvs)  # (T, G, B + B * B, X + Z)
        flat = inputs.flatten(1, 2)
        values = self.critic(flat) if t is None else self.critic.at(flat[0], t)[None]
        scores = self._split(values.unflatten(1, inputs.shape[1:3]).flatten(0, 1), size)
        return self._bound(scores).unflatten(0, (n_steps, n_groups)).mean(dim=1)
