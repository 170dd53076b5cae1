"""Declared families: every episode has its own member, whichever are asked for, and a new one when it begins."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from perturbed_problems import countdown, perturbed, run
from small_problems import LinearProblem, toy_vec_env
from stable_baselines3.common.env_util import make_vec_env

from sb3_tdpg import make_episodes_env
from sb3_tdpg.envs.ball_catch import BallCatchEnv
from sb3_tdpg.robustness import Perturbation, PerturbedVecEnv
from sb3_tdpg.robustness.core import take
from sb3_tdpg.robustness.families import Family, OneOf, SceneMembers

N = 40
SOME = np.array([27, 3, 12, 31, 8, 19, 0, 35])
OTHERS = np.setdiff1d(np.arange(N), SOME)
IMAGES = spaces.Box(0, 255, (3, 24, 24), np.uint8)
DEPTH = spaces.Box(0.2, 0.7, (1, 16, 16), np.float32)
VECTOR = spaces.Box(-100, 100, (16,), np.float32)
PARTS = spaces.Dict(camera=IMAGES, arm=VECTOR)


class Lamp(LinearProblem):
    """The sensor shows a position and the light of a lamp, eight times, in the unit of its scene."""

    def __init__(self, unit):
        super().__init__()
        self.unit, self.observation_space = unit, VECTOR
        self.state_space = spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def initial_state(self, n):
        return self.np_random.uniform(1, 2, (n, 2))

    def sensor(self, state):
        return np.tile(self.unit * state, 8).astype(np.float32)


def family(declared, space, **kwargs):
    return Family(declared, toy_vec_env(observation_space=space), **kwargs)


def scenes(n, seed=None):
    return SceneMembers([Lamp(1.0), Lamp(-1.0), Lamp(3.0)], [1], n, seed=seed)


def one_of(n, seed=None):
    return OneOf([scenes(n, seed), family({"vector_bias": 5}, VECTOR).members(n, seed)], n, seed)


MEMBERS = {
    "images": (IMAGES, family({"images": dict(noise=0.0, held=True)}, IMAGES).members),
    "a perturbation": (VECTOR, family({"vector_bias": 5}, VECTOR).members),
    "several": (VECTOR, family({"vector_bias": (1, 5)}, VECTOR).members),
    "a part": (PARTS, family({"vector_bias": 5}, PARTS).members),
    "several parts": (PARTS, family({"vector_bias": 5, "hue": 5}, PARTS).members),
    "scenes": (VECTOR, scenes),
    "one of two": (VECTOR, one_of),
}


def sampled(space, n=N, seed=0):
    rng = np.random.default_rng(seed)
    if isinstance(space, spaces.Dict):
        return {key: sampled(part, n) for key, part in space.items()}
    high = 256 if space.dtype == np.uint8 else min(space.high.flat[0], 100)
    return rng.uniform(max(space.low.flat[0], 0), high, (n, *space.shape)).astype(space.dtype)


def flat(seen):
    """Observations as vectors, ``(n, D)``."""
    parts = seen.values() if isinstance(seen, dict) else [seen]
    return np.concatenate([part.reshape(len(part), -1).astype(float) for part in parts], axis=1)


@pytest.fixture(params=MEMBERS)
def shows(request):
    """Members of a family, and what they show of some episodes; the plain sensor shows the same every time."""
    space, draw = MEMBERS[request.param]
    plain, states = sampled(space), np.random.default_rng(0).uniform(1, 2, (N, 2))
    members = draw(N, 0)

    def show(which, members=members):
        return flat(members(take(plain, which), which, states[which]))

    return draw, members, show


def test_episodes_that_are_asked_for_alone_show_what_they_show_among_all(shows):
    _, _, show = shows
    among_all = show(np.arange(N))
    assert len(np.unique(among_all, axis=0)) > N / 2  # the episodes differ
    np.testing.assert_array_equal(show(SOME), among_all[SOME])
    np.testing.assert_array_equal(show(SOME[2:3]), among_all[SOME[2:3]])


def test_an_episode_that_begins_gets_a_new_member_and_the_others_keep_theirs(shows):
    _, members, show = shows
    before = show(np.arange(N))
    members.begin(SOME)
    after = show(np.arange(N))
    np.testing.assert_array_equal(after[OTHERS], before[OTHERS])
    assert (after != before).any(axis=1)[SOME].mean() > 0.5  # two draws may agree


def test_the_seed_names_the_members(shows):
    draw, members, show = shows
    before = show(np.arange(N))
    np.testing.assert_array_equal(show(np.arange(N), draw(N, 0)), before)
    assert (show(np.arange(N), draw(N, 1)) != before).any()
    again, other = draw(N, 3), draw(N, 3)
    for each, env_seed in ((again, 5), (other, 6), (members, 5)):
        each.reseed(env_seed)
        each.begin(np.arange(N))
    assert (show(np.arange(N), again) != show(np.arange(N), other)).any()  # the environment's seed counts, too


@pytest.mark.parametrize(("space", "draw"), MEMBERS.values(), ids=MEMBERS)
def test_one_member_is_the_same_for_all_episodes(space, draw):
    def seen(seed, n=N):  # by n episodes that show what the first one shows
        return flat(draw(1, seed).repeat(n)(take(sampled(space), np.zeros(n, int)), None, np.full((n, 2), 1.5)))

    one = seen(1)
    assert (one == one[:1]).all()
    np.testing.assert_array_equal(one[:3], seen(1, 3))  # however many
    assert any((seen(seed) != one).any() for seed in (2, 3, 4))


def test_a_name_alone_stands_for_all_severities_and_no_two_episodes_draw_the_same_numbers():
    zeros = np.zeros((400, 16), np.float32)
    sizes = np.abs(family("vector_bias", VECTOR, scale=1.0).members(400, 0)(zeros))[:, 0].round(4)
    assert set(sizes) == set(np.float32([0.05, 0.1, 0.2, 0.4, 0.8]))
    noise = family({"vector_noise": (4, 5)}, VECTOR).members(400, 0)(zeros)
    assert len({(row / np.abs(row).max()).round(3).tobytes() for row in noise}) == 400


@pytest.mark.parametrize(("declared", "space"), [
    ({"noise": 1, "dropped_pixels": (1, 4), "brightness": 2}, DEPTH),
    ("images", IMAGES),
    ("images", PARTS),
    ("noise", IMAGES),
    ({"noise": (1, 3), "contrast": 4}, IMAGES),
    ({"vector_bias": (4, 5), "noise": (4, 5)}, PARTS),
    ({"noise_range": {}}, VECTOR),
    ([("vector_noise", 5), ("vector_bias", 3, 2.0)], VECTOR),
    ("vector_noise", spaces.Dict(arm=spaces.Box(-np.inf, np.inf, (2,)))),
    (Perturbation("mine", "vector", "offset", (1, 2, 3, 4, 5), lambda y, value, episode, rng: y + value), VECTOR),
    (lambda y, rng: y + np.asarray(rng.random(), y.dtype), VECTOR),
])  # fmt: skip
def test_a_declared_family_changes_the_observations_and_keeps_shape_and_type(declared, space):
    plain = sampled(space, 4)
    before = flat(plain).copy()
    after = family(declared, space).members(4, 0)(plain)
    np.testing.assert_array_equal(flat(plain), before)
    assert (flat(after) != before).any(axis=1).all()
    for seen, part in zip(*((x.values() if isinstance(x, dict) else [x]) for x in (after, plain)), strict=True):
        assert (seen.shape, seen.dtype) == (part.shape, part.dtype)


@pytest.mark.parametrize(("declared", "space", "fragment"), [
    ("images", DEPTH, "'images' does not apply: it changes colours"),
    ("images", VECTOR, "'images' does not apply: it is for images"),
    ("vector_noise", spaces.Dict(camera=IMAGES), "it is for vectors"),
    ({"noise": (1, 6)}, IMAGES, "severity=6"),
    ({"noise": (3, 1)}, IMAGES, "the lowest and the highest"),
    ({"images": dict(colour=1)}, IMAGES, "keywords of images"),
    ({"images": dict(color=-0.1)}, IMAGES, "color=-0.1 must be between 0 and inf"),
    ({"images": dict(pattern=1.5)}, IMAGES, "pattern=1.5 must be between 0 and 1"),
    ({"noise_range": dict(low=2.0, high=1.0)}, VECTOR, "low=2.0 and high=1.0 must be positive, low <= high"),
    ({}, IMAGES, "expected the name of a perturbation, a dict"),
    (3, IMAGES, "3 is no perturbation: expected the name"),
    ([3], IMAGES, "3 is no entry of a list"),
    ([("mine", lambda y, rng: y), ("actuator_gain", 3)], VECTOR, "perturbs actions and observations"),
    ({"env_kwargs": dict(texture="violet_dots")}, IMAGES, "needs an environment that can observe a given state"),
])  # fmt: skip
def test_a_wrong_declaration_is_explained(declared, space, fragment):
    with pytest.raises(ValueError, match=fragment):
        family(declared, space)


@pytest.mark.parametrize(("function", "fragment"), [
    (lambda y, rng: y[:, :1], r"shape \(4, 1\).*expected those it was given: \(4, 16\)"),
    (lambda y, rng: y + np.float32(np.nan), "NaN or infinite"),
])  # fmt: skip
def test_what_a_function_returns_is_checked(function, fragment):
    with pytest.raises(ValueError, match=fragment):
        family(function, VECTOR).members(4)(sampled(VECTOR, 4))


def test_each_episode_of_a_list_has_one_of_its_entries():
    declared = [None, ("vector_bias", 5), ("vector_bias", 5, 10.0)]
    clean = run(countdown(((3, 4),) * 300), 12)
    shown = run(perturbed(countdown(((3, 4),) * 300), declared, scale=np.array([1.0, 1.0, 0.0])), 12)
    difference = np.abs(shown.observations - clean.observations).round(4)
    assert not difference[..., 2].any()
    first = difference[:3, :, 0]
    assert (first == first[0]).all()  # held for the episode
    assert [(first[0] == size).mean() for size in (0.0, 0.8, 8.0)] == pytest.approx([1 / 3] * 3, abs=0.08)
    assert 0.5 < (difference[3, :, 0] != first[0]).mean() < 0.8  # the next episode draws anew
    last = np.abs(np.stack([x for _, x in shown.terminal]) - np.stack([x for _, x in clean.terminal])).round(4)
    assert last[[i for i, _ in clean.terminal].index(0), 0] == first[0, 0]


def test_a_mixture_of_actions_is_one_of_the_plant():
    env = perturbed(make_episodes_env("Lava-v0", 50, seed=0), {"actuator_gain": (1, 5)})
    plain = make_episodes_env("Lava-v0", 50, seed=0)
    np.testing.assert_array_equal(env.reset(), plain.reset())
    actions = np.full((50, 1), 0.5, np.float32)
    speeds, expected = (np.array([info["state"][1] for info in e.step(actions)[3]]) for e in (env, plain))
    assert len(np.unique((speeds / expected).round(3))) > 5


def test_another_scene_is_seen_in_the_same_state_also_after_an_automatic_reset():
    kwargs = [dict(texture="violet_dots"), dict(texture="grey_plaster")]
    env = make_episodes_env("BallCatch-v0", 6, env_kwargs=dict(renderer="fast"), seed=0)
    wrapped = PerturbedVecEnv(env, dict(env_kwargs=kwargs))
    seen = [(wrapped.reset(), env.reset_infos)]
    for _ in range(env.get_attr("horizon")[0] + 1):
        images, _, dones, infos = wrapped.step(np.zeros((6, 1), np.float32))
        seen.append((images, env.reset_infos if dones.all() else infos))
        if dones.all():
            seen.append((np.stack([info["terminal_observation"] for info in infos]), infos))
    for images, infos in seen:
        states = np.stack([info["state"] for info in infos])
        others = [BallCatchEnv(renderer="fast", **each).sensor(states) for each in kwargs]
        assert all(any((images[i] == other[i]).all() for other in others) for i in range(6))


def test_a_scene_may_redraw_components_of_the_state():
    env = make_episodes_env("BallCatch-v0", 6, env_kwargs=dict(renderer="fast"), seed=0)
    declared = {"env_kwargs": dict(robot_range=(1.0, 1.0)), "redraw": ["d (m)"]}
    seen = PerturbedVecEnv(env, declared).reset()
    states = np.stack([info["state"] for info in env.reset_infos])
    states[:, 0] = 1.0
    np.testing.assert_array_equal(seen, BallCatchEnv(renderer="fast").sensor(states))
    with pytest.raises(ValueError, match=r"redraw=\['e'\] must be .* of the state, some of \['d \(m\)'"):
        PerturbedVecEnv(env, {**declared, "redraw": ["e"]})
    with pytest.raises(ValueError, match="need the true state"):
        Family(declared, env).members(1)(seen[:1])


def test_the_scale_around_another_perturbation_is_that_of_the_plain_sensor():
    plain = make_vec_env("CartPole-v1", 2, seed=0)
    noisy = PerturbedVecEnv(make_vec_env("CartPole-v1", 2, seed=0), "vector_noise", 5)
    np.testing.assert_array_equal(*(Family("vector_bias", env)._measured_scale for env in (plain, noisy)))


def test_a_perturbation_around_another_one_draws_its_own_numbers():
    def noise(depth):
        env = toy_vec_env(8, horizon=50, observation_space=spaces.Box(-1e6, 1e6, (20,), np.float32))
        for _ in range(depth):
            env = PerturbedVecEnv(env, "vector_noise", 1, scale=1.0)
        env.seed(0)
        return env.reset() - env.unwrapped.buf_obs[None]

    assert noise(2).std() == pytest.approx(2**0.5 * noise(1).std(), rel=0.2)


def test_without_any_seed_the_wrapper_follows_torch():
    def observations(seed):
        th.manual_seed(seed)
        env = perturbed(toy_vec_env(observation_space=VECTOR), "vector_bias", seed=None)
        return np.sign(env.reset() - env.unperturbed)

    np.testing.assert_array_equal(observations(0), observations(0))
    assert (observations(0) != observations(1)).any()
