"""
Store the rollouts of one policy epoch by episode, and the outputs of the policy.

Dimension key: T horizon, N episodes, E environments, X state, Z TRVs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.preprocessing import get_obs_shape

from sb3_tdpg.features import flat_action_space
from sb3_tdpg.information import InformationBatch

STORED = ("observations", "states", "noise", "trvs", "means", "stds", "actions", "costs", "alive")

Observations = th.Tensor | dict[str, th.Tensor]


def each_part(function: Callable[..., Any], *arrays: Any) -> Any:
    """Apply a function to arrays, or key by key to dicts of arrays with the same keys."""
    first, *_ = arrays
    return {key: function(*(x[key] for x in arrays)) for key in first} if isinstance(first, dict) else function(*arrays)


class EpisodeBatch(NamedTuple):
    """
    An epoch's rollouts as tensors on the training device: whole episodes, or segments of them.

    For segments, T is the length of a segment and N the number of segments.
    """

    observations: Observations  #: ``(T, N, *obs)``, y_t, or a dict of such tensors
    states: th.Tensor  #: ``(T, N, X)``, x_t
    noise: th.Tensor  #: ``(T, N, Z)``, eps_t
    trvs: th.Tensor  #: ``(T, N, Z)``, x~_t
    means: th.Tensor  #: ``(T, N, Z)`` of q(x~_t | x~_{t-1}, y_t)
    stds: th.Tensor  #: ``(T, N, Z)``
    actions: th.Tensor  #: ``(T, N, U)``, u_t before clipping
    costs: th.Tensor  #: ``(T, N)``, zero after the end of the episode
    alive: th.Tensor  #: ``(T, N)``, 1.0 while the episode lasts
    advantages: th.Tensor  #: ``(T, N)``, zero until they are computed
    prev_trvs: th.Tensor  #: ``(T, N, Z)``, x~_{t-1}, zero at the first step of an episode
    episode: th.Tensor  #: ``(T, N)``, index of the episode, also for segments

    def select(self, columns: th.Tensor | slice) -> EpisodeBatch:
        """Select episodes or segments by their columns."""
        return EpisodeBatch(*(each_part(lambda v: v[:, columns], x) for x in self))

    def segments(self, n_steps: int) -> EpisodeBatch:
        """
        Cut the episodes into segments, and drop segments that begin after the end of their episode.

        :param n_steps: Length of a segment; the last segment of an episode is padded with steps that are not alive.
        """
        n_parts = math.ceil(self.alive.shape[0] / n_steps)
        padding = n_parts * n_steps - self.alive.shape[0]

        def cut(x: th.Tensor) -> th.Tensor:  # (T, N, ...) -> (n_steps, n_parts * N, ...)
            padded = th.cat([x, x.new_zeros(padding, *x.shape[1:])]) if padding > 0 else x
            return padded.unflatten(0, (n_parts, n_steps)).transpose(0, 1).flatten(1, 2)

        parts = EpisodeBatch(*(each_part(cut, x) for x in self))
        return parts.select(parts.alive[0].nonzero()[:, 0])

    def information_batch(self, pooled: bool = False) -> InformationBatch:
        """
        Return the samples that the mutual-information estimators use.

        :param pooled: Whether to treat the steps of all times, up to the end of each episode, as samples of one
            variable: ``(1, n, ...)``.
        """
        # The previous TRVs come from trvs, so that gradients also flow through them if trvs have been rebuilt.
        prev_trvs = th.cat([self.prev_trvs[:1], self.trvs[:-1]])
        alive = None if bool(self.alive.all()) else self.alive.bool()
        batch = InformationBatch(self.states, self.trvs, self.means, self.stds, alive, prev_trvs)
        return batch._replace(episode=self.episode).pooled() if pooled else batch


class PolicyStep(NamedTuple):
    """Actions and TRVs of N episodes at one time step."""

    actions: th.Tensor  # (N, U), not clipped
    trvs: th.Tensor  # (N, Z)
    means: th.Tensor  # (N, Z)
    stds: th.Tensor  # (N, Z)
    noise: th.Tensor  # (N, Z)


class EpisodeBuffer(RolloutBuffer):
    """
    A rollout buffer of ``(T, N, ...)`` arrays, indexed by time step and episode (in SB3: time step and environment).

    ``buffer_size`` is the horizon T, and ``n_envs`` is the number of episodes N, independent of the number of
    environments. The buffer grows if an epoch has more episodes. After the end of a short episode the arrays hold zeros
    (``stds``: ones), and ``alive`` is 0 there.

    :param state_dim: Number of components X of the state.
    :param trv_dim: Number of TRVs Z.
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

        def zeros(space: spaces.Space) -> np.ndarray:
            # The array of np.zeros takes memory only for the pages that are written to.
            return np.zeros((self.buffer_size, self.n_envs, *get_obs_shape(space)), space.dtype)

        def vectors(*dim: int) -> np.ndarray:
            return np.zeros((self.buffer_size, self.n_envs, *dim), np.float32)

        space = self.observation_space
        self.observations = each_part(zeros, space.spaces if isinstance(space, spaces.Dict) else space)
        self.states = vectors(self.state_dim)
        self.noise, self.trvs, self.means, self.stds = (vectors(self.trv_dim) for _ in range(4))
        self.stds += 1.0
        self.actions = vectors(self.action_dim)
        self.costs, self.alive = vectors(), vectors()
        self.full = False

    def add_step(self, t: np.ndarray | int, episode: np.ndarray | slice, **values: Any) -> None:
        """
        Store one step of some episodes.

        :param t: time step of each episode, ``(n,)``, or a single time step for all of them
        :param episode: column of each episode, ``(n,)``, or a slice of columns
        :param values: ``observations``, ``states``, ``noise``, ``trvs``, ``means``, ``stds``, ``actions``, ``costs``,
            each ``(n, ...)``
        """
        while isinstance(episode, np.ndarray) and episode.max() >= self.alive.shape[1]:
            self._double()
        for name, value in values.items():
            parts = value if isinstance(value, dict) else {name: value}
            arrays = getattr(self, name) if isinstance(value, dict) else {name: getattr(self, name)}
            for key, part in parts.items():
                arrays[key][t, episode] = part.reshape(-1, *arrays[key].shape[2:])
        self.alive[t, episode] = 1.0

    def _double(self) -> None:
        """Double the number of columns for episodes."""
        for name in STORED:
            setattr(self, name, each_part(lambda x: np.concatenate([x, np.zeros_like(x)], axis=1), getattr(self, name)))
        self.stds[:, self.stds.shape[1] // 2 :] = 1.0

    def clear_episodes(self, episodes: np.ndarray) -> None:
        """Clear the costs of the episodes in some columns, ``(n,)``, and mark their steps as not alive."""
        self.costs[:, episodes] = 0.0
        self.alive[:, episodes] = 0.0

    def episode_batch(self, whole_horizon: bool = True) -> EpisodeBatch:
        """
        Return the rollouts of the epoch as tensors.

        :param whole_horizon: Whether to include the time steps after the end of the longest episode.
        """
        assert self.full, "the epoch's rollouts are not complete"
        n_episodes = int(self.alive[0].sum())
        length = self.buffer_size if whole_horizon else int(self.alive.any(axis=1).sum())

        def tensor(x: np.ndarray) -> th.Tensor:
            return self.to_torch(x[:length, :n_episodes], copy=False)

        stored = {name: each_part(tensor, getattr(self, name)) for name in STORED}
        trvs = stored["trvs"]
        prev_trvs = th.cat([th.zeros_like(trvs[:1]), trvs[:-1]])
        episode = th.arange(n_episodes, device=trvs.device).expand(length, -1)
        advantages = th.zeros_like(stored["costs"])
        return EpisodeBatch(**stored, advantages=advantages, prev_trvs=prev_trvs, episode=episode)

    @property
    def episode_costs(self) -> np.ndarray:
        """Undiscounted cost of each episode, ``(N,)``."""
        return self.costs[:, self.alive[0] > 0].sum(axis=0)

    @property
    def mean_length(self) -> float:
        """Mean number of steps of an episode."""
        return float(self.alive.sum() / self.alive[0].sum())


class RunningEpisodes:
    """
    Track the time step and the buffer column of each environment's episode, and the end of an epoch.

    :param n_envs: Number of environments E.
    :param n_episodes: Number of episodes, divided equally among the environments. ``None``: an environment begins
        another episode while fewer than ``n_steps`` steps are stored.
    :param horizon: Largest number of steps T of an episode.
    """

    def __init__(self, n_envs: int, n_episodes: int | None, n_steps: int, horizon: int) -> None:
        self.n_episodes, self.n_steps, self.horizon = n_episodes, n_steps, horizon
        self.t = np.zeros(n_envs, np.int64)
        """``(E,)``: time step of each environment's episode."""
        self.column = np.arange(n_envs)
        """``(E,)``: buffer column of each environment; -1 after its last episode."""
        self._n_columns, self._n_stored = n_envs, 0

    @property
    def running(self) -> np.ndarray:
        """Indices of the environments whose steps are stored, in ascending order."""
        return np.flatnonzero(self.column >= 0)

    def advance(self, dones: np.ndarray, infos: Sequence[dict[str, Any]] = ()) -> np.ndarray:
        """
        Count a step of the running environments, and assign new columns where episodes have ended.

        :param dones: whether the episode of each environment has ended, ``(E,)``
        :param infos: The infos that the environments returned at this step.
        :return: columns of the lost episodes, which run again because RayVecEnv has restarted their environments
        :raises ValueError: if an episode is longer than the horizon.
        """
        running = self.running
        self._n_stored += running.size
        self.t = np.where(dones, 0, self.t + 1)
        lost = []
        for i in running[dones[running]]:
            if infos and infos[i].get("episode_lost", False):
                lost.append(self.column[i])
            elif self.n_episodes is not None:
                following = self.column[i] + len(self.column)
                self.column[i] = following if following < self.n_episodes else -1
            elif self._n_stored < self.n_steps:
                self.column[i] = self._n_columns
                self._n_columns += 1
            else:
                self.column[i] = -1
        if (self.t[self.running] >= self.horizon).any():
            raise ValueError(
                f"an episode did not end after horizon={self.horizon} steps: the environment must return "
                "terminated or truncated there (or declare its true horizon)"
            )
        return np.array(lost, np.int64)
