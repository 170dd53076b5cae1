"""The squeeze in PyBullet: where parts end, that nothing else matters, and the interface of SqueezeInsert-v0."""

import math

import gymnasium as gym
import numpy as np
import pytest

from sb3_tdpg.envs.panda_squeeze import PandaSqueezeEnv
from sb3_tdpg.envs.scenarios import PANDA_SQUEEZE
from sb3_tdpg.envs.squeeze_insert import SqueezeInsertEnv, wrap

DEGREE = math.pi / 180


@pytest.fixture(scope="module")
def env():
    """For tests that need no fresh environment: outcomes do not depend on the squeezes before."""
    env = PandaSqueezeEnv(sensor_noise_std=0.0)
    env.reset(seed=0)
    yield env
    env.close()


def parts(*yaws):
    """States with the given yaws in degrees."""
    yaw = np.array(yaws) * DEGREE
    return np.column_stack([np.sin(2 * yaw), np.cos(2 * yaw)])


def squeeze(env, yaws, *fingers):
    """Squeeze parts with jaws of the given yaws, all in degrees; return the yaws of the parts."""
    state = parts(*yaws)
    for yaw in fingers:
        state = env.dynamics(state, np.full((len(state), 1), yaw * DEGREE))
    return env.yaw(state) / DEGREE


def between(yaw, other):
    """Angles in degrees between rectangles of two yaws."""
    return np.abs(wrap((np.asarray(yaw) - other) * DEGREE)) / DEGREE


# -- one squeeze -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hand", [0.0, 50.0, -120.0, 180.0])
def test_a_part_within_the_basin_ends_aligned(env, hand):
    ends = squeeze(env, hand + np.array([-65.0, -40.0, -5.0, 0.0, 20.0, 65.0]), hand)
    assert between(ends, hand).max() < 0.5
    assert all(more["jaw_gap"] == pytest.approx(0.026, abs=1e-3) for more in env._details)


@pytest.mark.parametrize("hand", [0.0, 50.0])
def test_a_part_far_outside_the_basin_ends_across(env, hand):
    assert between(squeeze(env, hand + np.array([-80.0, 80.0, 88.0]), hand), hand).min() > 89.5
    assert all(more["jaw_gap"] == pytest.approx(0.08, abs=1e-3) for more in env._details)


def test_a_part_whose_diagonal_is_nearly_across_the_jaws_jams_and_stays(env):
    yaws = np.array([-74.0, 72.0, 69.0])
    np.testing.assert_allclose(squeeze(env, yaws, 0.0), yaws, atol=0.5)
    assert all(more["jaw_gap"] > 0.083 for more in env._details)
    assert np.abs(squeeze(env, yaws, 45.0, 0.0)).max() < 0.5  # not from another side


@pytest.mark.parametrize(("friction", "aligned", "stays"), [(0.0, 70.0, None), (0.4, 48.0, 55.0)])
def test_friction_decides_what_jams(friction, aligned, stays):
    env = PandaSqueezeEnv(friction=friction)
    assert abs(squeeze(env, [aligned], 0.0)[0]) < 0.5
    if stays is None:
        assert between(squeeze(env, [74.0], 0.0), 0.0)[0] > 89.5
    else:
        assert squeeze(env, [stays], 0.0)[0] == pytest.approx(stays, abs=0.5)
    env.close()


def test_the_fitted_model_agrees_outside_the_jam(env):
    model = SqueezeInsertEnv(**PANDA_SQUEEZE)
    model.reset(seed=0)
    yaws = np.array([-88.0, -79.0, -66.0, -30.0, 10.0, 50.0, 66.0, 79.0])
    assert between(squeeze(env, yaws, 0.0), squeeze(model, yaws, 0.0)).max() < 1.0


# -- episodes --------------------------------------------------------------------------------------------------------


def test_squeezing_aslant_and_then_along_inserts_every_part_without_looking(env):
    ends = squeeze(env, np.arange(-88.0, 90.0, 8.0), -50.0, 0.0)
    assert np.abs(ends).max() < 0.5


def test_the_costs_are_those_of_the_model(env):
    state, action = parts(40.0, -88.0), np.array([[0.2], [0.1]])
    model = SqueezeInsertEnv()
    for is_last in (False, True):
        step = env.step_batch(state, action, is_last=is_last)
        by_hand = 5 * np.array([40.0, 88.0]) * DEGREE
        if is_last:
            by_hand = by_hand + 100 * np.maximum(0.0, np.abs(env.yaw(step.state)) - 0.05)
        np.testing.assert_allclose(step.cost, by_hand)
        np.testing.assert_allclose(step.cost, model.cost(state, action) + is_last * model.terminal_cost(step.state))
    assert env.yaw(step.state) == pytest.approx([0.2, wrap(np.array(0.1 + math.pi / 2))], abs=0.01)


def test_the_info_says_whether_the_part_fits(env):
    step = env.step_batch(parts(40.0, 40.0), np.array([[0.03], [0.2]]), is_last=True)
    assert [more["success"] for more in step.details] == [more["is_success"] for more in step.details] == [True, False]
    np.testing.assert_array_equal([more["yaw_error"] for more in step.details], env.error(step.state))


def test_the_spaces_are_those_of_the_model(env):
    model = SqueezeInsertEnv()
    for name in ("observation_space", "action_space", "state_space", "state_names", "horizon", "tolerance"):
        assert getattr(env, name) == getattr(model, name)


def test_an_episode_repeats_from_its_seed_whatever_was_squeezed_before(env):
    def episode(env):
        observation, _ = env.reset(seed=5)
        steps = [env.step(np.array([u])) for u in (0.9, -0.4, 2.0, 0.0)]
        assert [step[2] for step in steps] == [False, False, False, True]
        return np.array([observation, *(step[0] for step in steps)])

    first = episode(env)
    squeeze(env, [71.0, 20.0], 33.0)
    np.testing.assert_array_equal(episode(env), first)
    fresh = gym.make("PandaSqueeze-v0", sensor_noise_std=0.0)
    np.testing.assert_array_equal(episode(fresh.unwrapped), first)
    fresh.close()


def test_the_picture_shows_the_hand_come_down_and_close():
    env = PandaSqueezeEnv(render_mode="rgb_array")
    with pytest.raises(ValueError, match="nothing to render before the first reset"):
        env.render()
    env.reset(seed=3)
    before = env.render()
    env.step(np.zeros(1))
    after = env.render()
    assert before.shape == after.shape == (240, 320, 3)
    assert before.dtype == np.uint8
    assert (before != after).any(-1).mean() > 0.1
    orange = [((p[..., 0] > 130) & (p[..., 2] < 0.4 * p[..., 0])).sum() for p in (before, after)]
    assert orange[0] > orange[1] > 50  # the jaws hide a part of it
    env.close()
    assert PandaSqueezeEnv().render() is None


def test_a_closed_environment_says_so():
    env = PandaSqueezeEnv()
    env.reset(seed=0)
    env.close()
    env.close()
    with pytest.raises(RuntimeError, match="has been closed: make a new one"):
        env.step(np.zeros(1))


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        (dict(friction=-0.1), "friction=-0.1 must be finite and not negative"),
        (dict(tolerance=-0.1), "tolerance=-0.1 must be finite and not negative"),
        (dict(sensor_noise_std=math.nan), "sensor_noise_std=nan must be finite"),
        (dict(horizon=0), "horizon=0 must be an integer of at least 1"),
        (dict(render_mode="human"), "render_mode='human' must be None or one of"),
    ],
)
def test_a_bad_keyword_is_named(keywords, message):
    with pytest.raises(ValueError, match=message):
        PandaSqueezeEnv(**keywords)


@pytest.mark.parametrize("keyword", ["turn", "basin", "cue"])
def test_what_the_engine_decides_is_no_keyword(keyword):
    with pytest.raises(TypeError, match=keyword):
        PandaSqueezeEnv(**{keyword: 1.0})
