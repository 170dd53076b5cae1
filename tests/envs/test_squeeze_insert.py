"""Squeezing and inserting, step by step."""

import math

import numpy as np
import pytest

from sb3_tdpg.envs.squeeze_insert import SqueezeInsertEnv

DEGREE = math.pi / 180


def parts(*yaws, kind=None):
    """States with the given yaws in degrees."""
    yaw = np.array(yaws) * DEGREE
    return np.column_stack([np.sin(2 * yaw), np.cos(2 * yaw), *([] if kind is None else [np.full(len(yaw), kind)])])


def squeeze(env, state, *fingers):
    """Squeeze with the given yaws of the fingers in degrees, without a cost; return the yaws of the parts."""
    for yaw in fingers:
        state = env.dynamics(state, np.full((len(state), 1), yaw * DEGREE))
    return env.yaw(state) / DEGREE


@pytest.fixture
def env():
    env = SqueezeInsertEnv(turn=(1.0, 1.0), sensor_noise_std=0.0)
    env.reset(seed=0)
    return env


def test_a_part_within_the_basin_turns_to_the_fingers_and_any_other_lies_across_them(env):
    np.testing.assert_allclose(squeeze(env, parts(64.0, -64.0, 10.0), 0.0), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(squeeze(env, parts(66.0, -66.0), 0.0)), 90.0)
    np.testing.assert_allclose(squeeze(env, parts(70.0, -80.0), 80.0), 80.0)  # -80 and 100 are the same
    np.testing.assert_allclose(squeeze(env, parts(10.0), 180.0), 0.0, atol=1e-9)


def test_an_incomplete_squeeze_leaves_a_share_of_the_angle():
    env = SqueezeInsertEnv(turn=(0.75, 0.75))
    env.reset(seed=0)
    np.testing.assert_allclose(squeeze(env, parts(40.0, -20.0), 0.0), [10.0, -5.0])
    np.testing.assert_allclose(squeeze(env, parts(70.0), 0.0), [85.0])  # turns away, towards 90


def test_squeezing_across_and_then_along_orients_every_part_without_looking(env):
    everywhere = parts(*np.linspace(-89.0, 89.0, 179))
    np.testing.assert_allclose(squeeze(env, everywhere, 45.0, 0.0), 0.0, atol=1e-9)
    assert np.abs(squeeze(env, everywhere, 0.0, 0.0)).max() == pytest.approx(90.0)


def test_the_turn_is_drawn_anew_for_each_part_and_squeeze():
    env = SqueezeInsertEnv(turn=(0.5, 1.0))
    env.reset(seed=0)
    left = squeeze(env, parts(*[60.0] * 10_000), 0.0)
    assert (left.min(), left.mean(), left.max()) == pytest.approx((0.0, 15.0, 30.0), abs=0.2)


def test_the_costs_are_those_computed_by_hand(env):
    state = parts(40.0)
    step = env.step_batch(state, np.zeros((1, 1)), is_last=False)
    assert step.cost == pytest.approx(5 * 40 * DEGREE)
    tilted = env.step_batch(state, np.full((1, 1), 30 * DEGREE), is_last=True)
    assert tilted.cost == pytest.approx(5 * 40 * DEGREE + 100 * (30 * DEGREE - 0.05))
    fits = env.step_batch(state, np.full((1, 1), 0.04), is_last=True)
    assert fits.cost == pytest.approx(5 * 40 * DEGREE)


def test_the_cue_says_which_way_a_part_must_lie_and_never_changes():
    env = SqueezeInsertEnv(cue=True, turn=(1.0, 1.0), sensor_noise_std=0.5)
    state, observation = env.reset_batch(4000)
    np.testing.assert_array_equal(observation[:, 2], state[:, 2])
    assert (observation[:, :2] - state[:, :2]).std() == pytest.approx(0.5, rel=0.05)
    assert abs(state[:, 2].mean()) < 0.06
    np.testing.assert_array_equal(env.dynamics(state, np.ones((4000, 1)))[:, 2], state[:, 2])
    np.testing.assert_allclose(env.error(parts(90.0, 0.0, 80.0, kind=-1.0)) / DEGREE, [0, 90, 10], atol=1e-6)
    np.testing.assert_allclose(env.error(parts(90.0, 0.0, 80.0, kind=1.0)) / DEGREE, [90, 0, 80], atol=1e-6)


def test_parts_start_with_any_yaw():
    env = SqueezeInsertEnv()
    state, _ = env.reset_batch(20_000)
    quantiles = np.quantile(env.yaw(state) / DEGREE, [0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_allclose(quantiles, [-90, -45, 0, 45, 90], atol=2)


def test_the_picture_shows_the_part_turn_and_the_fingers_after_a_squeeze():
    env = SqueezeInsertEnv(render_mode="rgb_array", turn=(1.0, 1.0))
    env.reset(seed=0)
    env._state = parts(40.0)
    before = env.render()
    env.step(np.zeros(1))
    after = env.render()
    assert before.shape == after.shape == (200, 200, 3)
    grey = (140, 140, 150)
    assert not (before == grey).all(-1).any()
    rows = np.flatnonzero((after == grey).all(-1).any(1))
    assert {rows.min(), rows.max()} == {47, 152}  # 0.53 above and below the middle
    orange = (after == (235, 130, 30)).all(-1)
    assert np.ptp(np.flatnonzero(orange.any(0))) == 71  # lies along the slot
    assert np.ptp(np.flatnonzero(orange.any(1))) == 19
