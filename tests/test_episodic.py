"""Rollouts have whole episodes: these tests check the end of an epoch and the state after an error."""

import copy
import math

import numpy as np
import pytest
from small_problems import AtEveryEpoch, AtEveryStep, CountdownEnv, lava_env, tiny_tdpg, toy_vec_env, train_epochs
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor

from sb3_tdpg import TDPG, MINECallback, TrainingDivergedError


def test_the_last_epoch_takes_the_steps_that_are_left():
    model = TDPG("TRVPolicy", "CartPole-v1", epoch_steps=400, batch_size=100, n_envs=1, seed=0, device="cpu").learn(600)
    assert model.epoch == 2
    assert 600 <= model.num_timesteps < 700  # at most one more episode
    before = model.num_timesteps
    model.learn(1, reset_num_timesteps=False)  # the minimum is a tenth of an epoch
    assert 40 <= model.num_timesteps - before < 140


def test_the_last_epoch_has_enough_episodes_for_an_estimate():
    model = TDPG(env=toy_vec_env(1, horizon=20), epoch_steps=100, device="cpu", seed=0)
    assert model.learn(410).epoch == 5


def test_an_episode_that_somebody_else_has_begun_is_not_gone_on_with():
    model = tiny_tdpg(toy_vec_env(2, horizon=3), n_episodes=2)
    train_epochs(model, 1)
    model.get_env().step(np.zeros((2, *model.action_space.shape), np.float32))
    train_epochs(model, 1, reset_num_timesteps=False)
    assert model.rollout_buffer.alive.all()
    np.testing.assert_allclose(model.rollout_buffer.observations[..., :1], model.rollout_buffer.states, rtol=1e-6)


def test_the_log_counts_the_stored_episodes_only():
    class Rows(KVWriter):
        def write(self, key_values, key_excluded, step=0):
            rows.append(dict(key_values))

    # Environment 1 continues after its episode of one step, but its further episodes are not stored.
    env = VecMonitor(DummyVecEnv([lambda: CountdownEnv(0, [4]), lambda: CountdownEnv(1, [1])]))
    model, rows = tiny_tdpg(env, n_episodes=2), []
    model.set_logger(Logger(None, [Rows()]))
    model.learn(2, callback=AtEveryStep(lambda each: each.model.dump_logs() is None), log_interval=None)
    assert [info["l"] for info in model.ep_info_buffer] == [1, 4]
    assert len(rows) == 4
    assert not any("rollout/ep_cost_mean" in row for row in rows)  # the mean would include unfinished episodes


def test_a_list_of_callbacks_of_the_user_s_own_keeps_its_hooks():
    class Counting(CallbackList):
        n_steps = 0

        def _on_step(self):
            self.n_steps += 1
            return super()._on_step()

    counting = Counting([MINECallback()])
    tiny_tdpg(lava_env(4), n_episodes=4).learn(20, callback=counting)
    assert counting.n_steps == 5


def test_a_policy_can_be_copied_in_mid_training():
    copies = []
    train_epochs(tiny_tdpg(), 2, callback=AtEveryEpoch(lambda m: copies.append(copy.deepcopy(m.policy))))
    assert len(copies) == 2


def test_after_an_error_the_next_training_begins_with_new_episodes():
    def poison(model):
        model.rollout_buffer.costs[1, 2] = math.nan

    env = toy_vec_env(n_envs=4)
    model = tiny_tdpg(env, n_episodes=4, beta=math.inf)
    with pytest.raises(TrainingDivergedError):
        model.learn(12, callback=AtEveryEpoch(poison))
    before = np.array(env.get_attr("n_resets"))
    model.learn(12, reset_num_timesteps=False)
    assert (env.get_attr("n_resets") - before == 2).all()  # one reset at the start and one after the episode
