"""Mugs with a drink: its level is seen, tells what it is asked to tell, and does not matter to a grasp."""

import numpy as np
import pytest
from panda_oracle import mixed_actions, oracle_actions
from test_envs_panda_camera import EYE, depth_by_hand

from sb3_tdpg.envs.panda_grasp import PandaGraspEnv
from sb3_tdpg.envs.scenarios import PANDA_DRINK, PANDA_GRASP_DRINK

LOW, HIGH = PANDA_DRINK["level_range"]


@pytest.fixture(scope="module")
def env():
    env = PandaGraspEnv(**PANDA_DRINK)
    yield env
    env.close()


def levels(n=20_000, **keywords):
    env = PandaGraspEnv(**{"level_range": (LOW, HIGH), **keywords})
    env.reset(seed=0)
    state = env._initial_state(n)
    env.close()
    assert env.state_space.shape == (5,) == state[0].shape
    return state[:, 0], state[:, 4]


# -- what the level tells --------------------------------------------------------------------------------------------


def test_with_no_spread_the_level_tells_x():
    x, level = levels(level_spread=0.0)
    np.testing.assert_allclose(level, LOW + (HIGH - LOW) * (x - 0.45) / 0.1)


def test_a_range_the_other_way_round_turns_the_level_round():
    x, level = levels(level_spread=0.0, level_range=(HIGH, LOW))
    np.testing.assert_allclose(level, HIGH - (HIGH - LOW) * (x - 0.45) / 0.1)


@pytest.mark.parametrize("spread", [0.15, 0.5, 1.0])
def test_the_level_is_off_by_no_more_than_the_spread_and_any_level_is_as_likely(spread):
    x, level = levels(level_spread=spread)
    off = (level - LOW) / (HIGH - LOW) - (x - 0.45) / 0.1
    assert abs(off).max() <= spread
    assert abs(off).max() > 0.95 * spread
    share, _ = np.histogram(level, bins=10, range=(LOW, HIGH))
    np.testing.assert_allclose(share, 2000, atol=200)


def test_with_full_spread_the_level_tells_nothing():
    x, level = levels(level_spread=1.0)
    for low in np.linspace(0.45, 0.54, 10):
        here = level[(low <= x) & (x < low + 0.01)]
        assert here.mean() == pytest.approx((LOW + HIGH) / 2, abs=0.0015)
        assert here.std() == pytest.approx((HIGH - LOW) / 12**0.5, rel=0.05)


def test_a_mug_that_always_stands_in_the_middle_has_a_middle_level():
    _, level = levels(10, level_spread=0.0, xy_half_width=0.0)
    np.testing.assert_allclose(level, (LOW + HIGH) / 2)


def test_the_rows_train_on_levels_that_tell_x_and_test_on_others():
    tells = {}
    for row in PANDA_GRASP_DRINK[:3]:
        made = PandaGraspEnv(**row.env_kwargs)
        made.reset(seed=0)
        state = made._initial_state(20_000)
        tells[row.name] = np.corrcoef(state[:, 0], state[:, 4])[0, 1]
    assert tells["Training"] > 0.95
    assert abs(tells["Any level"]) < 0.02
    assert tells["Opposite level"] == pytest.approx(-tells["Training"], abs=1e-3)
    same, empty = (PandaGraspEnv(**row.env_kwargs) for row in PANDA_GRASP_DRINK[3:])
    same.reset(seed=0)
    assert np.ptp(same._initial_state(100)[:, 4]) == 0
    assert LOW < same._initial_state(1)[0, 4] < HIGH
    assert empty.state_space.shape == (4,)


# -- what it looks like ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("yaw", [0.0, 0.7, 4.0])
def test_the_surface_has_the_depth_computed_by_hand(env, yaw):
    x, y, level = 0.52, 0.02, 0.06
    (image,) = env._sensor(np.array([[x, y, 0.0, yaw, level]]))
    axis = np.array([x, y]) - 0.012 * np.array([np.cos(yaw + np.pi / 2), np.sin(yaw + np.pi / 2)])
    away = (axis - EYE[:2]) / np.linalg.norm(axis - EYE[:2])
    for shift in (0.0, 0.02, 0.03):  # towards the far wall, whose inner side is 37 mm from the axis
        point = np.append(axis + shift * away, level)
        row, column, depth = env._world.camera.pixel(point)
        assert depth == pytest.approx(depth_by_hand(point), abs=1e-6)
        assert image[0, round(row), round(column)] == pytest.approx(depth, abs=0.004)
    assert abs(image[0] - env._sensor(np.array([[x, y, 0.0, yaw]]))[0, 0]).max() > 0.02


def test_a_drink_is_seen_within_the_mug_alone(env):
    pose = [0.5, 0.0, 0.0, 0.5]
    empty = env._sensor(np.array([pose]))[0, 0]
    previous = 0
    for level in (0.03, 0.045, 0.06, 0.075):
        image = env._sensor(np.array([[*pose, level]]))[0, 0]
        changed = image != empty
        assert (image <= empty).all()
        assert changed.sum() > previous, "the higher, the more of the surface comes into sight"
        previous = changed.sum()
        rows, columns = np.nonzero(changed)
        ends = [env._world.camera.pixel((0.5 + dx, -0.01 + dy, z))[:2]
                for dx in (-0.05, 0.05) for dy in (-0.05, 0.05) for z in (0, 0.081)]  # fmt: skip
        (low_row, low_column), (high_row, high_column) = np.min(ends, axis=0), np.max(ends, axis=0)
        assert low_row < rows.min() <= rows.max() < high_row
        assert low_column < columns.min() <= columns.max() < high_column


def test_the_picture_of_the_scene_shows_the_drink():
    pictures = []
    for keywords in ({}, dict(level_range=(0.075, 0.075))):
        env = PandaGraspEnv(render_mode="rgb_array", **keywords)
        env.reset(seed=0)
        before = env.render().astype(int)
        env.step(oracle_actions(env._state[:, :4])[0])
        after = env.render().astype(int)
        assert len(list(env.film())) > 5
        pictures.append((before[:, :384], after[:, :384]))
        env.close()
    for empty, full in zip(*pictures, strict=True):
        changed = abs(full - empty).max(axis=-1) > 20
        assert 20 < changed.sum() < 2000
        dark = full[changed]
        assert (dark[:, 0] < 120).mean() > 0.8, "brown, in place of the inner side of a red mug"


# -- what it does not do ---------------------------------------------------------------------------------------------


def test_the_level_does_not_matter_to_a_grasp_and_stays_as_it_is(env):
    states = np.concatenate([env._initial_state(8)[:, :4], np.linspace(LOW, HIGH, 8)[:, None]], axis=1)
    actions = mixed_actions(states[:, :4], seed=2)
    with_drink, without = env._dynamics(states, actions), env._dynamics(states[:, :4], actions)
    np.testing.assert_array_equal(with_drink[:, :4], without)
    np.testing.assert_array_equal(with_drink[:, 4], states[:, 4])


def test_a_drink_changes_neither_where_the_mugs_stand_nor_an_empty_mug():
    with_drink, empty = PandaGraspEnv(**PANDA_DRINK), PandaGraspEnv()
    for seed in (0, 1):
        _, info = with_drink.reset(seed=seed)
        _, empty_info = empty.reset(seed=seed)
        np.testing.assert_array_equal(info["state"][:4], empty_info["state"])
    with_drink.close()
    empty.close()


def test_the_oracle_lifts_every_mug_and_info_has_pose_and_level():
    env = PandaGraspEnv(**PANDA_DRINK)
    _, info = env.reset(seed=3)
    start = info["state"]
    _, _, _, _, info = env.step(oracle_actions(start[None, :4])[0])
    assert info["success"]
    np.testing.assert_array_equal(info["mug"], start[:4])
    assert info["state"][4] == start[4]
    env.close()


def test_processes_give_the_same_images_with_a_drink(env):
    state = env._initial_state(6)
    shared = PandaGraspEnv(**PANDA_DRINK, n_processes=2)
    np.testing.assert_array_equal(shared._sensor(state), env._sensor(state))
    shared.close()


@pytest.mark.parametrize(("keywords", "message"), [
    (dict(level_range=(0.0, 0.05)), r"level_range=\(0.0, 0.05\) must be None or .* between 0.007 and 0.081 m"),
    (dict(level_range=("a", "b")), r"level_range=\('a', 'b'\) must be None or"),
    (dict(level_range=(0.01, 0.07), mug_scale=0.8), r"level_range=.* between 0.006 and 0.065 m"),
    (dict(level_range=0.05), "level_range=0.05 must be None or"),
    (dict(level_range=(0.01, np.nan)), "level_range=.* must be None or"),
    (dict(level_range=(0.01, 0.05), level_spread=1.5), "level_spread=1.5 must be between 0"),
    (dict(level_spread=np.nan), "level_spread=nan must be between 0"),
], ids=str)  # fmt: skip
def test_a_bad_level_is_refused_with_the_mend(keywords, message):
    with pytest.raises(ValueError, match=message):
        PandaGraspEnv(**keywords)
