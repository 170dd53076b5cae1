"""
Define the interface of all mutual-information estimators.

Dimension key: T time steps, N episodes, X state, Z task-relevant variables (TRVs).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar, Literal, NamedTuple

import torch as th
from torch import nn


class InformationBatch(NamedTuple):
    """Samples of x_t and of the TRVs, with the parameters of the encoder's density."""

    states: th.Tensor  # (T, N, X)
    trvs: th.Tensor  # (T, N, Z), x~_t = means + stds * noise
    means: th.Tensor  # (T, N, Z) of q(x~_t | x~_{t-1}, y_t)
    stds: th.Tensor  # (T, N, Z)
    alive: th.Tensor | None = None  # (T, N) bool; None: every episode lasts for all T steps
    prev_trvs: th.Tensor | None = None  # (T, N, Z), x~_{t-1}, for estimators of the directed information
    episode: th.Tensor | None = None  # (T, N), episode of each sample; None: each sample has its own episode

    @property
    def living(self) -> th.Tensor:
        """Whether each episode is alive at each step, also if ``alive`` is None: ``(T, N)`` bool."""
        return self.trvs.new_ones(self.trvs.shape[:2], dtype=th.bool) if self.alive is None else self.alive

    def at(self, t: int) -> InformationBatch:
        """Select step t of the n episodes that are alive at that step: ``(1, n, ...)``."""
        keep = slice(None) if self.alive is None else self.alive[t]
        return self._each(lambda x: x[t, keep][None])

    def select(self, episodes: th.Tensor) -> InformationBatch:
        """Select episodes by their indices: ``(T, n, ...)``."""
        alive = None if self.alive is None else self.alive[:, episodes]
        return self._each(lambda x: x[:, episodes])._replace(alive=alive)

    def pooled(self) -> InformationBatch:
        """Pool the steps of all times, up to the end of each episode, as samples of one variable: ``(1, n, ...)``."""
        return self._each(lambda x: x[self.living][None])

    def _each(self, take: Callable[[th.Tensor], th.Tensor]) -> InformationBatch:
        """Apply a selection to all fields except ``alive``, which becomes ``None``."""
        prev_trvs, episode = (None if x is None else take(x) for x in (self.prev_trvs, self.episode))
        states, trvs, means, stds = map(take, self[:4])
        return InformationBatch(states, trvs, means, stds, None, prev_trvs, episode)


class InformationEstimator(nn.Module):
    """
    Estimator of I[x_t; x~_t] in nats for all time steps at once.

    :param horizon: Number of time steps T.
    :param state_dim: Number of components X of the state.
    :param trv_dim: Number of TRVs Z.
    """

    bound: ClassVar[Literal["lower", "upper", "neither"]]
    """Whether the expected estimate is a lower or an upper bound on I[x_t; x~_t], or neither."""

    def __init__(self, horizon: int, state_dim: int, trv_dim: int) -> None:
        super().__init__()
        self.horizon = horizon
        self.state_dim = state_dim
        self.trv_dim = trv_dim

    def fit(self, batch: InformationBatch) -> dict[str, float]:
        """Fit the parameters of the estimator, if any, to samples without gradients; return diagnostics for the log."""
        return {}

    def forward(self, batch: InformationBatch) -> th.Tensor:
        """
        Estimate I[x_t; x~_t] with gradients for ``trvs``, ``means`` and ``stds``.

        The estimate is 0 at steps with too few living episodes, see :meth:`has_enough`.

        :return: the estimate for each step in nats, ``(T,)``
        """
        has_enough = self.has_enough(batch).tolist()
        if batch.alive is None and all(has_enough):
            return self._estimate(batch, None)
        zero = batch.trvs.new_zeros(1)
        return th.cat([self._estimate(batch.at(t), t) if enough else zero for t, enough in enumerate(has_enough)])

    def has_enough(self, batch: InformationBatch) -> th.Tensor:
        """Return for each step whether enough episodes are alive for an estimate: ``(T,)`` bool."""
        return batch.living.sum(dim=1) >= self.min_episodes(batch.trvs.shape[1])

    def min_episodes(self, n_episodes: int) -> int:
        """Return the number of living episodes that an estimate needs in a batch of ``n_episodes``."""
        return min(self.trv_dim + 2, n_episodes)

    @property
    def recommended_episodes(self) -> int:
        """Number of episodes per epoch below which the estimate is misleading."""
        return self.trv_dim + 2

    @abstractmethod
    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        """
        Estimate the information in nats at every step (``t=None``), or at one step t.

        With ``t=None`` all episodes are alive: ``(T, N, ...) -> (T,)``. For one step, the batch has only the n episodes
        that are alive: ``(1, n, ...) -> (1,)``.
        """
