"""Rollouts of whole episodes: where an epoch ends, the members of a nuisance, and what follows an error."""

import math
from functools import partial

import numpy as np
import pytest
import torch as th
from small_problems import AtEveryEpoch, CountdownEnv, tiny_tdpg, toy_vec_env, train_epochs
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdpg import TDPG, TrainingDivergedError, make_episodes_env
from sb3_tdpg.robustness.nuisance import Members, Nuisance


class Counting(Nuisance, Members):
    """A sensor that adds the number of episodes that an environment has begun since the members were drawn."""

    def members(self, n):
        self.begun = np.zeros(n, np.float32)
        return self

    def begin(self, which):
        self.begun[which] += 1

    def __call__(self, observations, states, which):
        return observations + self.begun[which, None]


def test_an_episode_of_a_rollout_has_one_member_and_the_next_one_another():
    env = DummyVecEnv([partial(CountdownEnv, 0, [4, 2, 3]), partial(CountdownEnv, 1, [1, 4, 2])])
    model = tiny_tdpg(env, n_episodes=6, beta=math.inf, nuisance=Counting(), nuisance_level="rollouts")
    model.train = lambda: None
    train_epochs(model, 1)
    batch = model.rollout_buffer.episode_batch()
    added = (batch.observations + batch.states)[..., 0]
    number = th.arange(6) // 2  # of the episode, in its environment
    th.testing.assert_close(added, batch.alive * number, rtol=0, atol=0)


def test_another_environment_brings_its_own_scenes():
    scenes = {"env_kwargs": dict(sensor_bias=[10.0, -10.0])}
    model = tiny_tdpg(make_episodes_env("Lava-v0", 20), nuisance=scenes)
    model.set_env(make_episodes_env("Lava-v0", 20, env_kwargs=dict(sensor_noise_std=0.0)))
    observations, states = np.zeros((3, 2), np.float32), np.array([[1.0, 0.5], [2.0, 0.0], [4.0, -1.0]])
    seen = model.nuisance_family.members(3)(observations, states, np.arange(3))
    np.testing.assert_array_equal(seen, states + np.array([10.0, -10.0]))


def test_the_last_epoch_takes_the_steps_that_are_left():
    model = TDPG("TRVPolicy", "CartPole-v1", epoch_steps=400, batch_size=100, n_envs=1, seed=0, device="cpu").learn(600)
    assert model.epoch == 2
    assert 600 <= model.num_timesteps < 700  # less than an episode more
    before = model.num_timesteps
    model.learn(1, reset_num_timesteps=False)  # a tenth of an epoch is the least
    assert 40 <= model.num_timesteps - before < 140


@pytest.mark.parametrize(("epoch_steps", "n_episodes"), [(8, 2), (9, 3)])
def test_no_episode_begins_once_an_epoch_has_its_steps(epoch_steps, n_episodes):
    env = DummyVecEnv([lambda: CountdownEnv(0, [4])])
    model = TDPG("TRVPolicy", env, epoch_steps=epoch_steps, beta=math.inf, baseline="mean", device="cpu")
    model.learn(epoch_steps)
    assert model.num_timesteps == 4 * n_episodes
    assert model.rollout_buffer.alive.sum() == 4 * n_episodes


def test_after_an_error_the_next_training_begins_with_new_episodes():
    def poison(model):
        model.rollout_buffer.costs[1, 2] = math.nan

    env = toy_vec_env(n_envs=4)
    model = tiny_tdpg(env, n_episodes=4, beta=math.inf)
    with pytest.raises(TrainingDivergedError):
        model.learn(12, callback=AtEveryEpoch(poison))
    before = np.array(env.get_attr("n_resets"))
    model.learn(12, reset_num_timesteps=False)
    assert (env.get_attr("n_resets") - before == 2).all()  # at its start, and after its episode
