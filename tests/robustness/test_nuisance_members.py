"""Members of a nuisance: every episode has its own, whichever episodes are asked for, and a new one when it begins."""

import numpy as np
import pytest
from gymnasium import spaces
from small_problems import toy_vec_env

from sb3_tdpg.envs.base import POMDPEnv
from sb3_tdpg.robustness.nuisance import FunctionNuisance, PartsNuisance, SceneNuisance, UnionNuisance, make_nuisance

N = 40
SOME = np.array([27, 3, 12, 31, 8, 19, 0, 35])
OTHERS = np.setdiff1d(np.arange(N), SOME)
IMAGES = spaces.Box(0, 255, (3, 24, 24), np.uint8)
VECTOR = spaces.Box(-100, 100, (16,), np.float32)


class Lamp(POMDPEnv):
    """The sensor shows a position and the light of a lamp, eight times, in the unit of its scene."""

    def __init__(self, unit):
        super().__init__(horizon=2)
        self.unit = unit
        self.state_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.observation_space, self.action_space = VECTOR, spaces.Box(-1, 1, (1,), np.float32)

    def initial_state(self, n):
        return self.np_random.uniform(1, 2, (n, 2))

    def dynamics(self, state, action):
        return state

    def sensor(self, state):
        return np.tile(self.unit * state, 8).astype(np.float32)

    def cost(self, state, action):
        return np.zeros(len(state))

    def terminal_cost(self, state):
        return np.zeros(len(state))


def declared(value, space):
    return make_nuisance(value, space, toy_vec_env(observation_space=space))


def scenes():
    return SceneNuisance([Lamp(1.0), Lamp(-1.0), Lamp(3.0)], redraw=[1])


FAMILIES = {
    "images": lambda: (IMAGES, declared({"images": dict(noise=0.0)}, IMAGES)),
    "perturbation": lambda: (VECTOR, declared({"vector_bias": 5}, VECTOR)),
    "scenes": lambda: (VECTOR, scenes()),
    "parts": lambda: (VECTOR, PartsNuisance({"arm": declared({"vector_bias": 5}, VECTOR)})),
    "union": lambda: (VECTOR, UnionNuisance([scenes(), declared({"vector_bias": 5}, VECTOR)])),
}


@pytest.fixture(params=FAMILIES)
def shows(request):
    """Members of a family, and what they show of some episodes; the plain sensor shows the same every time."""
    space, family = FAMILIES[request.param]()
    rng = np.random.default_rng(0)
    plain = rng.uniform(1, space.high.flat[0], (N, *space.shape)).astype(space.dtype)
    states = rng.uniform(1, 2, (N, 2))
    members = family.members(N)

    def show(which):
        if request.param == "parts":
            return members({"arm": plain[which]}, states[which], which)["arm"]
        return members(plain[which], states[which], which)

    return members, show


def test_episodes_that_are_asked_for_alone_show_what_they_show_among_all(shows):
    _, show = shows
    among_all = show(np.arange(N))
    assert len(np.unique(among_all, axis=0)) > N / 2  # the episodes differ
    np.testing.assert_array_equal(show(SOME), among_all[SOME])
    np.testing.assert_array_equal(show(SOME[2:3]), among_all[SOME[2:3]])


def test_an_episode_that_begins_gets_a_new_member_and_the_others_keep_theirs(shows):
    members, show = shows
    before = show(np.arange(N))
    members.begin(SOME)
    after = show(np.arange(N))
    np.testing.assert_array_equal(after[OTHERS], before[OTHERS])
    changed = (after != before).reshape(N, -1).any(axis=1)
    assert changed[SOME].all()


def test_an_episode_that_begins_draws_its_family_anew():
    n = 400
    members = UnionNuisance([FunctionNuisance(lambda y, rng: y + 1), FunctionNuisance(lambda y, rng: y - 1)]).members(n)

    def family():
        return members(np.zeros((n, 1), np.float32), np.zeros((n, 1)), np.arange(n))[:, 0]

    before, begun = family(), np.arange(n) % 2 == 1
    members.begin(np.flatnonzero(begun))
    changed = family() != before
    assert not changed[~begun].any()
    assert 0.4 < changed[begun].mean() < 0.6
