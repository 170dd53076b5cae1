"""TDPG learns, and it can be used like an algorithm of Stable-Baselines3."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from small_problems import (
    AtEveryEpoch,
    AtEveryStep,
    CountdownEnv,
    ToyEnv,
    assert_same_parameters,
    lava_env,
    parameters,
    same_parameters,
    tiny_tdpg,
    train_epochs,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper

from sb3_tdpg import TDPG, BatchedVecEnv
from sb3_tdpg.envs.base import POMDPEnv
from sb3_tdpg.envs.lava import LavaEnv


def test_the_cost_on_lava_falls_and_the_information_stays_without_a_penalty():
    costs = []
    model = tiny_tdpg(n_episodes=200, beta=math.inf, learning_rate=2e-3, policy_kwargs={})
    train_epochs(model, 100, callback=AtEveryEpoch(lambda m: costs.append(m.rollout_buffer.episode_costs.mean())))
    assert len(costs) == 100
    assert np.mean(costs[:5]) > 200
    assert np.mean(costs[-5:]) < 80
    batch = model.rollout_buffer.episode_batch().information_batch()
    assert model.estimator(batch).sum() > 1.0


def test_the_penalty_takes_the_information_out_of_the_trvs():
    model = tiny_tdpg(n_episodes=200, beta=1 / 75, learning_rate=5e-3, policy_kwargs={})
    information = []
    train_epochs(model, 150, callback=AtEveryEpoch(lambda m: information.append(m.information.sum())))
    assert information[0] > 0.1
    assert np.median(information[-50:]) < 0.2 * information[0]  # the median, because a single epoch can be an outlier


@pytest.mark.parametrize("encoder_gradient", ["score", "pathwise"])
def test_a_memory_is_learnt_where_it_is_needed(encoder_gradient):
    class Recall(POMDPEnv):
        """The policy must repeat at t = 1 the number that only the observation at t = 0 shows."""

        def __init__(self):
            super().__init__(horizon=2)
            self.state_space = spaces.Box(-1, 1, (2,), np.float64)
            self.observation_space = spaces.Box(-1, 1, (1,), np.float32)
            self.action_space = spaces.Box(-3, 3, (1,), np.float32)

        def initial_state(self, n):
            return np.stack([self.np_random.choice([-1.0, 1.0], n), np.zeros(n)], axis=1)

        def dynamics(self, state, action):
            return np.stack([state[:, 0], np.ones(len(state))], axis=1)

        def sensor(self, state):
            return (state[:, :1] * (state[:, 1:] == 0)).astype(np.float32)

        def cost(self, state, action):
            return (state[:, 1] == 1) * (action[:, 0] - state[:, 0]) ** 2

        def terminal_cost(self, state):
            return np.zeros(len(state))

    model = tiny_tdpg(
        BatchedVecEnv(Recall(), 200),
        n_episodes=200,
        beta=math.inf,
        learning_rate=1e-2,
        encoder_gradient=encoder_gradient,
        policy_kwargs=dict(net_arch=dict(encoder=[16], action_head=[16]), squash_trv_mean=False),
    )
    train_epochs(model, 200)
    # Without a memory the best action is 0, which costs 1 plus the action's variance.
    assert model.rollout_buffer.episode_costs.mean() < 0.6


def test_an_epoch_is_a_number_of_whole_episodes_and_one_update():
    model = tiny_tdpg(n_episodes=30)
    before = parameters(model.policy)
    train_epochs(model, 3)
    assert model.epoch == model._n_updates == 3
    assert model.num_timesteps == 3 * 30 * 5
    assert not same_parameters(before, parameters(model.policy))


def test_what_is_stored_is_what_the_environment_and_the_policy_produced():
    model = tiny_tdpg(BatchedVecEnv(LavaEnv(sensor_noise_std=0.0, action_cost=1.0, max_action=0.5), 20), beta=math.inf)
    old_policy = parameters(model.policy)
    train_epochs(model, 1)
    buffer = model.rollout_buffer
    np.testing.assert_array_equal(buffer.observations, buffer.states)
    np.testing.assert_allclose(buffer.trvs, buffer.means + buffer.stds * buffer.noise, rtol=1e-5, atol=1e-6)
    # The states follow from the actions, which the environment clips.
    env = model.env.env
    for t in range(4):
        state, action = buffer.states[t].astype(float), np.clip(buffer.actions[t], -0.5, 0.5)
        np.testing.assert_allclose(buffer.states[t + 1], env.dynamics(state, action), atol=1e-5)
        np.testing.assert_allclose(buffer.costs[t], env.cost(state, action), rtol=1e-4)
    assert_trvs_are_those_of(model, old_policy)


def assert_trvs_are_those_of(model, policy):
    model.policy.load_state_dict(policy)
    batch = model.rollout_buffer.episode_batch()
    rebuilt = model.policy.rebuild_trvs(model.policy.episode_features(batch), batch)
    np.testing.assert_allclose(rebuilt.trvs.detach(), batch.trvs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("baseline", ["value", "regression", "mean"])
def test_every_environment_runs_its_quota_of_episodes_however_short_they_are(baseline):
    # Environment 0 has short episodes. If the first N finished episodes counted, environment 0 would fill the epoch.
    lengths = [[1, 1, 1], [4, 3, 4], [2, 4, 1]]
    env = DummyVecEnv([lambda i=i: CountdownEnv(i, lengths[i]) for i in range(3)])
    model = tiny_tdpg(env, n_episodes=9, baseline=baseline, beta=math.inf).learn(1)
    buffer = model.rollout_buffer
    first = int(buffer.states[0, 0, 1])  # number of episodes that were skipped by the resets before learning
    for episode in range(9):
        name, number = episode % 3, episode // 3
        length = lengths[name][(abs(first) + number) % 3]
        assert buffer.alive[:, episode].tolist() == [1.0] * length + [0.0] * (4 - length)
        for t in range(length):
            expected = [name, abs(first) + number, t]
            assert buffer.observations[t, episode].tolist() == expected
            assert (-buffer.states[t, episode]).tolist() == expected
            assert buffer.costs[t, episode] == 100 * expected[1] + t
        assert (buffer.costs[length:, episode] == 0).all()
    # Every epoch starts with new episodes: an episode that the last epoch has cut off must not appear.
    model.learn(model.num_timesteps + 1, reset_num_timesteps=False)
    assert (buffer.observations[0, :, 2] == 0).all()


class LosesEpisodes(VecEnvWrapper):
    """Mark the second episode of environment 1 as lost, as ``RayVecEnv`` does after a restart."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observations, rewards, dones, infos = self.venv.step_wait()
        if dones[1] and self.venv.envs[1].episode % 4 == 1:  # after the auto-reset, the index of the next episode
            infos[1]["episode_lost"] = True
        return observations, rewards, dones, infos


def test_a_lost_episode_is_run_again_in_its_place():
    env = LosesEpisodes(DummyVecEnv([lambda i=i: CountdownEnv(i, [3, 4, 2, 2]) for i in range(2)]))
    model = tiny_tdpg(env, n_episodes=4, beta=math.inf)
    env.venv.env_method("__setattr__", "episode", -1)
    model.learn(1)
    buffer = model.rollout_buffer
    assert buffer.observations[0, :, 1].tolist() == [0, 1, 1, 2]  # environment 1 has lost its episode 0
    assert buffer.alive.sum(0).tolist() == [3, 4, 4, 2]
    np.testing.assert_array_equal(buffer.episode_costs, [3, 406, 406, 401])


@pytest.mark.parametrize("mi_estimator", ["mine", "logdet", "loo", "vib"])
def test_cartpole_ends_early_and_trains_with_a_mask(mi_estimator):
    model = tiny_tdpg(make_vec_env("CartPole-v1", n_envs=4, seed=0), n_episodes=8, mi_estimator=mi_estimator, beta=1.0)
    model.learn(600)
    buffer = model.rollout_buffer
    assert len(np.unique(buffer.alive.sum(0))) > 1
    np.testing.assert_array_equal(buffer.costs, -buffer.alive)
    assert (np.abs(buffer.observations[0]) <= 0.05).all()  # CartPole starts there
    assert (model.horizon, model.policy.time_varying) == (500, False)
    assert all(th.isfinite(p).all() for p in model.policy.parameters())


def test_more_episodes_than_environments_are_run_one_after_the_other():
    model = train_epochs(tiny_tdpg(lava_env(5), n_episodes=20), 1)
    old_policy = parameters(model.policy)
    train_epochs(model, 1, reset_num_timesteps=False)
    assert model.rollout_buffer.alive.all()
    assert_trvs_are_those_of(model, old_policy)  # the TRVs start from zero in every episode
    assert len(np.unique(model.rollout_buffer.states[0, :, 0])) == 20
    assert (model.rollout_buffer.states[0, :, 1] == 0).all()


def test_a_time_limit_is_the_horizon():
    model = tiny_tdpg(DummyVecEnv([lambda: TimeLimit(ToyEnv(horizon=100, declares_horizon=False), 3)] * 2))
    assert model.horizon == 3
    assert train_epochs(model, 1).rollout_buffer.alive.all()


@pytest.mark.parametrize("beta", [math.inf, 1 / 75])
def test_tdpg_fits_its_critics_without_being_asked_and_policy_gradient_never_does(beta):
    model = tiny_tdpg(beta=beta, mi_estimator="mine")
    before = parameters(model.estimator)
    train_epochs(model, 2)
    assert same_parameters(before, parameters(model.estimator)) == (model.information is None) == math.isinf(beta)
    assert model.estimator.is_warm == math.isfinite(beta)


def test_a_policy_gradient_model_warm_starts_tdpg(tmp_path):
    model = train_epochs(tiny_tdpg(beta=math.inf, mi_estimator="mine"), 1)
    model.save(tmp_path / "pg")
    loaded = TDPG.load(tmp_path / "pg", env=lava_env(), beta=1 / 75, device="cpu")
    assert_same_parameters(parameters(model.policy), parameters(loaded.policy))
    assert loaded.mi_coef == pytest.approx(75)
    train_epochs(loaded, 1)
    assert loaded.information is not None


def test_beta_may_follow_the_progress():
    model = tiny_tdpg(beta=lambda progress: 1 / (75 * (1.0001 - progress)))
    coefficients = []
    train_epochs(model, 4, callback=AtEveryEpoch(lambda m: coefficients.append(m.mi_coef)))
    np.testing.assert_allclose(coefficients, 75 * (np.arange(1, 5) / 4 + 0.0001), rtol=1e-6)  # the schedule in train()


@pytest.mark.parametrize("schedule", ["beta", "learning_rate"])
def test_schedules_are_never_asked_beyond_the_end_of_the_training(schedule):
    asked = []

    def value(progress):
        asked.append(progress)
        return 0.01 + progress

    model = tiny_tdpg(**{schedule: value})
    model.learn(150)  # one and a half epochs, so the second epoch goes 50 steps further
    assert model.num_timesteps == 200
    assert min(asked) >= 0.0
    assert max(asked) <= 1.0


def test_a_schedule_that_turns_bad_in_mid_training_stops_with_the_mend():
    model = tiny_tdpg(beta=lambda progress: 1.0 if progress in (0.0, 1.0) else math.nan)
    with pytest.raises(ValueError, match="beta=nan must be a positive number"):
        train_epochs(model, 4)


@pytest.mark.parametrize(("beta", "told"), [(1e-9, True), (1e9, False), (math.inf, None)])
def test_a_policy_that_hardly_looks_at_its_sensor_is_told_at_the_end(beta, told, capsys):
    model = tiny_tdpg(
        lava_env(50), n_episodes=50, beta=beta, learning_rate=5e-2, verbose=1, encoder_gradient="pathwise"
    )
    train_epochs(model, 1 if beta > 1 else 40, log_interval=None)
    said = capsys.readouterr().out
    assert ("nats kept, at a cost of" in said) == (told is not None)
    assert ("hardly looks at its sensor" in said) == bool(told)
    train_epochs(model, 4, callback=AtEveryStep(lambda callback: callback.n_calls < 3), log_interval=None)
    assert model.num_timesteps == 3 * 50  # a callback has stopped the first epoch, of which nothing is told
    assert "nats kept" not in capsys.readouterr().out
