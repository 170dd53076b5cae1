"""A snapshot puts back every generator."""

import pickle
import random

import numpy as np
import torch as th
from small_problems import lava_env

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
