"""
The rollouts of one policy epoch, episode by episode.

Dimension key: T horizon, N episodes, X state, Z TRVs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_tdpg.features import flat_action_space
from sb3_tdpg.information import InformationBatch


class EpisodeBatch(NamedTuple):
    """An epoch's rollouts as tensors on the training device."""

    observations: th.Tensor  #: ``(T, N, *obs)``, y_t
    states: th.Tensor  #: ``(T, N, X)``, x_t
    noise: th.Tensor  #: ``(T, N, Z)``, eps_t
    trvs: th.Tensor  #: ``(T, N, Z)``, x~_t
    means: th.Tensor  #: ``(T, N, Z)`` of q(x~_t | x~_{t-1}, y_t)
    stds: th.Tensor  #: ``(T, N, Z)``
    actions: th.Tensor  #: ``(T, N, U)``, u_t before clipping
    costs: th.Tensor  #: ``(T, N)``, zero after the end
    alive: th.Tensor  #: ``(T, N)``, 1.0 while the episode lasts

    def select(self, episodes: th.Tensor | slice) -> EpisodeBatch:
        """Select episodes by their columns."""
        return EpisodeBatch(*(x[:, episodes] for x in self))

    def information_batch(self) -> InformationBatch:
        """Return what the mutual-information estimators use, detached."""
        alive = None if bool(self.alive.all()) else self.alive.bool()
        return InformationBatch(self.states, self.trvs, self.means, self.stds, alive)


class EpisodeBuffer(RolloutBuffer):
    """
    A rollout buffer of ``(T, N, ...)`` arrays: time step by episode instead of SB3's time step by environment.

    ``buffer_size`` is the horizon T and ``n_envs`` the number of episodes N, whatever the number of environments. After
    the end of a short episode the arrays hold zeros, and ``alive`` is 0 there.

    :param state_dim: X
    :param trv_dim: Z
    :param kwargs: See :class:`~stable_baselines3.common.buffers.RolloutBuffer`.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        *,
        state_dim: int,
        trv_dim: int,
        **kwargs: Any,
    ) -> None:
        self.state_dim = state_dim
        self.trv_dim = trv_dim
        super().__init__(buffer_size, observation_space, flat_action_space(action_space), **kwargs)

    def reset(self) -> None:
        """Clear the buffer."""
        shape = (self.buffer_size, self.n_envs)
        assert self.observation_space.dtype is not None
        self.observations = np.zeros((*shape, *self.obs_shape), self.observation_space.dtype)
        self.states = np.zeros((*shape, self.state_dim), np.float32)
        self.noise = np.zeros((*shape, self.trv_dim), np.float32)
        self.trvs = np.zeros((*shape, self.trv_dim), np.float32)
        self.means = np.zeros((*shape, self.trv_dim), np.float32)
        self.stds = np.ones((*shape, self.trv_dim), np.float32)
        self.actions = np.zeros((*shape, self.action_dim), np.float32)
        self.costs = np.zeros(shape, np.float32)
        self.alive = np.zeros(shape, np.float32)
        self.full = False

    def add_step(self, t: np.ndarray | int, episode: np.ndarray | slice, **values: np.ndarray) -> None:
        """
        Store one step of some episodes.

        :param t: time step of each, ``(n,)``, or of all
        :param episode: column of each, ``(n,)``, or a slice of them
        :param values: ``observations``, ``states``, ``noise``, ``trvs``, ``means``, ``stds``, ``actions``, ``costs``,
            each ``(n, ...)``
        """
        for name, value in values.items():
            getattr(self, name)[t, episode] = value
        self.alive[t, episode] = 1.0

    def clear_episodes(self, episodes: np.ndarray) -> None:
        """
        Forget some episodes.

        :param episodes: their columns, ``(n,)``
        """
        self.costs[:, episodes] = 0.0
        self.alive[:, episodes] = 0.0

    def episode_batch(self) -> EpisodeBatch:
        """Return the epoch as tensors."""
        assert self.full, "the epoch's rollouts are not complete"
        return EpisodeBatch(*(self.to_torch(getattr(self, name), copy=False) for name in EpisodeBatch._fields))

    @property
    def episode_costs(self) -> np.ndarray:
        """Undiscounted cost of each episode, ``(N,)``."""
        return self.costs.sum(axis=0)
