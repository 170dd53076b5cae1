"""The rollout loop that every evaluation shares."""

import random

import numpy as np
import pytest
import torch as th
from small_problems import CountdownEnv, ToyEnv, tiny_tdpg
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdpg import make_episodes_env
from sb3_tdpg.evaluation.randomness import EvaluationSeeds, evaluation_seeds, isolated_randomness
from sb3_tdpg.evaluation.rollout import rollout
from sb3_tdpg.problem import read_problem


def countdown():
    """Three environments whose episodes last for two and four, one, and three steps."""
    return DummyVecEnv([lambda: CountdownEnv(0, (2, 4)), lambda: CountdownEnv(1, (1,)), lambda: CountdownEnv(2, (3,))])


class Still:
    """A policy that remembers for how many steps it has acted since the start of the episode."""

    def __init__(self, env):
        self.action_space = env.action_space
        self.seen = []

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        steps = np.zeros(len(observation)) if state is None else state[0]
        steps = np.where(episode_start, 0, steps) + 1
        self.seen.append(np.array(observation))
        return np.zeros((len(observation), *self.action_space.shape), self.action_space.dtype), (steps,)


def test_each_environment_runs_its_quota_however_short_its_episodes_are():
    env = countdown()
    steps = list(rollout(Still(env), env, 7))
    ended = np.stack([step.finished for step in steps]).sum(axis=0)
    assert ended.tolist() == [2, 2, 3]  # shared out as evaluate_policy does
    assert all(step.dones[step.finished].all() for step in steps)
    assert not any((step.finished & (step.episode >= np.array([2, 2, 3]))).any() for step in steps)
    assert steps[-1].finished.any(), "it stops with the last episode that counts"


def test_time_and_memory_start_again_with_each_episode():
    env = countdown()
    for step in rollout(Still(env), env, 7):
        running = step.episode < np.array([2, 2, 3])
        np.testing.assert_array_equal(step.memory[0][running], step.t[running] + 1)
        assert (step.memory[0][~running] == 1).all(), "through its quota: the memory is cleared at every step"


def test_the_returns_are_those_of_evaluate_policy():
    model = tiny_tdpg(ToyEnv(horizon=4), n_episodes=4)
    env = make_vec_env(lambda: ToyEnv(horizon=4), n_envs=3)
    seeds, total, returns = evaluation_seeds(3), np.zeros(3), []
    for step in rollout(model, env, 8, seeds=seeds):
        total += step.rewards
        returns += total[step.finished].tolist()
        total[step.dones] = 0
    with isolated_randomness(seeds.policy, model):
        env.seed(seeds.env)
        expected, _ = evaluate_policy(model, env, 8, deterministic=False, return_episode_rewards=True)
    np.testing.assert_allclose(returns, expected, atol=1e-5)


@pytest.mark.parametrize("leave", ["break", "exception", "end"])
def test_the_global_generators_are_restored_however_the_loop_is_left(leave):
    model, env = tiny_tdpg(), make_episodes_env("Lava-v0", 4)
    th.manual_seed(5)
    expected = th.rand(1), np.random.get_state()[1].copy(), random.getstate()  # noqa: NPY002
    th.manual_seed(5)
    space = model.action_space
    try:
        for _ in rollout(model, env, 4, seeds=EvaluationSeeds(1, 2)):
            if leave == "break":
                break
            if leave == "exception":
                raise KeyError
    except KeyError:
        pass
    assert th.rand(1) == expected[0]
    assert (np.random.get_state()[1] == expected[1]).all()  # noqa: NPY002
    assert random.getstate() == expected[2]
    assert model.action_space is space


def test_the_states_and_the_densities_belong_to_their_observations_also_after_an_episode():
    model, env = tiny_tdpg(), make_episodes_env("Lava-v0", 6, env_kwargs=dict(sensor_noise_std=0.0))
    problem = read_problem(env)
    arguments = dict(seeds=EvaluationSeeds(1, 2), problem=problem)
    steps = list(rollout(model, env, 12, encode=True, **arguments))
    assert len(steps) == 2 * problem.horizon
    for step, plain in zip(steps, rollout(model, env, 12, **arguments), strict=True):
        np.testing.assert_allclose(step.states, step.observations, atol=1e-6)
        assert plain.encoded is None
        np.testing.assert_array_equal(plain.actions, step.actions)
        np.testing.assert_array_equal(plain.memory[0], step.encoded.trvs)
        rebuilt = step.encoded.means + step.encoded.stds * step.encoded.noise
        np.testing.assert_allclose(step.encoded.trvs, rebuilt, atol=1e-6)
    assert (steps[problem.horizon].t == 0).all()


def test_encoding_acts_as_predict_does_also_in_environments_that_are_through_their_quota():
    def env():
        return DummyVecEnv([lambda: CountdownEnv(0, (2,)), lambda: CountdownEnv(1, (4,))])

    model = tiny_tdpg(env(), n_episodes=4)
    assert model.policy.time_varying
    encoded, plain = (list(rollout(model, env(), 2, seeds=EvaluationSeeds(1, 2), encode=e)) for e in (True, False))
    assert len(encoded) == 4
    for ours, theirs in zip(encoded, plain, strict=True):
        np.testing.assert_allclose(ours.actions, theirs.actions, rtol=1e-6)


def test_the_policy_sees_what_observe_makes_of_the_observations_without_a_quota_for_ever():
    env = countdown()
    model = Still(env)
    for step, _ in zip(rollout(model, env, observe=lambda y: 2 * y), range(20), strict=False):
        np.testing.assert_array_equal(model.seen[-1], 2 * step.observations)
    assert len(model.seen) >= 20
