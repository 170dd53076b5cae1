"""A snapshot puts back every generator, and the statistics of normalised observations."""

import pickle
import random

import numpy as np
import torch as th
from small_problems import lava_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg.common.random_state import RandomState


def draw(env):
    """Return a number from each generator."""
    (generator,) = env.get_attr("np_random", [0])
    return random.random(), np.random.random(), th.rand(1).item(), generator.random()  # noqa: NPY002


def test_every_generator_draws_the_same_again():
    env = lava_env(2)
    env.seed(0)
    env.reset()
    snapshot = pickle.loads(pickle.dumps(RandomState.capture(env)))
    first, second = draw(env), draw(env)
    assert all(a != b for a, b in zip(first, second, strict=True))
    snapshot.restore(env)
    assert draw(env) == first


def test_the_statistics_of_normalised_observations_come_back():
    env = VecNormalize(lava_env(4))
    env.reset()
    snapshot = pickle.loads(pickle.dumps(RandomState.capture(env)))
    mean = env.obs_rms.mean.copy()
    for _ in range(3):
        env.step(np.ones((4, 1), np.float32))
    assert (env.obs_rms.mean != mean).any()
    snapshot.restore(env)
    np.testing.assert_array_equal(env.obs_rms.mean, mean)
