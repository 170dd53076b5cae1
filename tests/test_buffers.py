"""The buffer stores whole episodes; its axes are time step and episode."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_tdpg.buffers import STORED, EpisodeBuffer, RunningEpisodes

T, N, X, Z, U = 3, 4, 5, 2, 1
SHAPES = dict(observations=(2,), states=(X,), noise=(Z,), trvs=(Z,), means=(Z,), stds=(Z,), actions=(U,), costs=())


@pytest.fixture
def buffer():
    spaces_ = (spaces.Box(-1, 1, (2,), np.float32), spaces.Box(-1, 1, (U,), np.float32))
    buffer = EpisodeBuffer(T, *spaces_, device="cpu", n_envs=N, state_dim=X, trv_dim=Z)
    buffer.reset()
    return buffer


def rows(n, value):
    return {name: np.full((n, *shape), value, np.float32) for name, shape in SHAPES.items()}


def fill(buffer, value_of_step=lambda t: 1.0):
    """Store an epoch of N episodes with T steps each."""
    for t in range(T):
        buffer.add_step(np.full(N, t), np.arange(N), **rows(N, value_of_step(t)))
    buffer.full = True
    return buffer.episode_batch()


def test_a_step_is_stored_at_its_time_and_in_its_episode(buffer):
    buffer.add_step(np.array([0, 2, 1]), np.array([3, 0, 1]), **rows(3, 7.0))
    expected = np.zeros((T, N), np.float32)
    expected[[0, 2, 1], [3, 0, 1]] = 1.0
    np.testing.assert_array_equal(buffer.alive, expected)
    for name, shape in SHAPES.items():
        stored = getattr(buffer, name)
        assert stored.shape == (T, N, *shape)
        assert (stored[expected == 1] == 7).all()
        assert (stored[expected == 0] != 7).all()


def test_the_batch_has_every_field_as_a_tensor_and_does_not_change_with_the_next_epoch(buffer):
    batch = fill(buffer, float)
    for name in STORED:
        np.testing.assert_array_equal(getattr(batch, name), getattr(buffer, name))
        assert isinstance(getattr(batch, name), th.Tensor)
    kept = batch.costs.clone()
    buffer.reset()
    assert (buffer.full, buffer.alive.sum(), buffer.costs.sum()) == (False, 0, 0)
    buffer.add_step(np.zeros(N, int), np.arange(N), **rows(N, 9.0))
    th.testing.assert_close(batch.costs, kept)


def test_the_previous_trvs_are_those_of_the_step_before_and_zero_at_the_start(buffer):
    assert fill(buffer, lambda t: t + 1.0).prev_trvs[:, 0, 0].tolist() == [0, 1, 2]


def test_the_information_batch_has_a_mask_only_if_an_episode_ended_early(buffer):
    for t in range(T):
        buffer.add_step(np.full(N - 1, t), np.arange(N - 1), **rows(N - 1, 1.0))
    buffer.add_step(np.array([0]), np.array([N - 1]), **rows(1, 1.0))
    buffer.full = True
    mask = buffer.episode_batch().information_batch().alive
    assert mask.dtype == th.bool
    assert mask.sum(0).tolist() == [3, 3, 3, 1]
    buffer.add_step(np.array([1, 2]), np.array([N - 1, N - 1]), **rows(2, 1.0))
    assert buffer.episode_batch().information_batch().alive is None


def test_a_forgotten_episode_has_neither_cost_nor_life(buffer):
    fill(buffer)
    buffer.clear_episodes(np.array([1]))
    assert buffer.costs.sum(0).tolist() == [T, 0, *[T] * (N - 2)]
    assert buffer.alive.sum(0).tolist() == [T, 0, *[T] * (N - 2)]


def test_where_no_episode_runs_the_encoder_has_a_density(buffer):
    buffer.add_step(0, slice(None), **rows(N, 7.0))
    buffer.full = True
    stds = buffer.episode_batch().stds
    assert (stds[0] == 7).all()
    assert (stds[1:] == 1).all()  # so that the logarithm is finite


def test_each_environment_runs_its_share_of_a_number_of_episodes():
    episodes = RunningEpisodes(2, n_episodes=4, n_steps=100, horizon=9)
    assert episodes.column.tolist() == [0, 1]
    episodes.advance(np.array([True, False]))
    assert episodes.column.tolist() == [2, 1]
    episodes.advance(np.array([True, False]))  # the second and last episode of environment 0 ends
    assert episodes.column.tolist() == [-1, 1]
    assert episodes.running.tolist() == [1]
    episodes.advance(np.array([True, True]))
    episodes.advance(np.array([False, True]))
    assert episodes.running.size == 0


def test_with_a_number_of_steps_an_episode_begins_as_long_as_fewer_are_stored():
    episodes = RunningEpisodes(2, n_episodes=None, n_steps=6, horizon=9)
    episodes.advance(np.array([False, True]))  # one step of each of the two environments
    assert episodes.column.tolist() == [0, 2]
    episodes.advance(np.array([False, False]))
    episodes.advance(np.array([True, False]))  # after the sixth step the epoch ends with the running episodes
    assert episodes.column.tolist() == [-1, 2]
    episodes.advance(np.array([True, True]))
    assert episodes.running.size == 0
