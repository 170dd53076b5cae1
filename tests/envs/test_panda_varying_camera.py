"""A camera whose height varies: it is seen in the image, told in the state, and does not matter to a grasp."""

import numpy as np
import pytest
from panda_oracle import mixed_actions, oracle_actions

from sb3_tdpg.envs.panda_grasp import PandaGraspEnv
from sb3_tdpg.envs.scenarios import PANDA_CAMERA, PANDA_GRASP_CAMERA
from tests.envs.test_panda_camera import EYE, depth_by_hand, pixel

LOW, HIGH = PANDA_CAMERA["camera_range"]
YAW = -2.4  # turns the handle away from the camera


@pytest.fixture(scope="module")
def env():
    env = PandaGraspEnv(**PANDA_CAMERA)
    yield env
    env.close()


def test_the_heights_are_uniform_and_tell_nothing_of_the_mug(env):
    env.reset(seed=0)
    state = env.initial_state(20_000)
    assert env.state_space.shape == (5,) == state[0].shape
    assert env.state_names[4:] == ("camera height (m)",)
    share, _ = np.histogram(state[:, 4], bins=10, range=(LOW, HIGH))
    np.testing.assert_allclose(share, 2000, atol=200)
    assert abs(np.corrcoef(state.T[[0, 1, 3, 4]])[3, :3]).max() < 0.03
    usual = PandaGraspEnv()  # whose mugs stand in the same places
    np.testing.assert_array_equal(env.reset(seed=1)[1]["state"][:4], usual.reset(seed=1)[1]["state"])
    usual.close()


def test_the_rows_train_on_a_range_and_test_beyond_it():
    ranges = [row.env_kwargs["camera_range"] for row in PANDA_GRASP_CAMERA]
    assert ranges == [(LOW, HIGH), (2 * LOW, 2 * HIGH), (0.0, 0.0)]


@pytest.mark.parametrize("height", [-0.06, 0.03])
def test_a_raised_camera_sees_the_mug_from_where_it_is(env, height):
    """The points and their depth, computed by hand, are those for an eye that is moved upward."""
    x, y = 0.5, 0.0
    (image,) = env.sensor(np.array([[x, y, 0.0, YAW, height]]))
    camera = env._world.camera
    np.testing.assert_allclose(camera.eye, EYE, atol=1e-6)
    # The cup's wall, and the table beside it.
    axis = np.array([x, y]) - 0.012 * np.array([np.cos(YAW + np.pi / 2), np.sin(YAW + np.pi / 2)])
    towards = (EYE[:2] - axis) / np.linalg.norm(EYE[:2] - axis)
    aside = np.array([towards[1], -towards[0]])
    for point in (np.append(axis + 0.046 * towards, 0.04), np.append(axis + 0.06 * aside, 0.0)):
        row, column, depth = pixel(camera, point - [0, 0, height])
        assert depth == pytest.approx(depth_by_hand(point - [0, 0, height]), abs=1e-6)
        assert image[0, round(row), round(column)] == pytest.approx(depth, abs=0.004)


def test_at_no_height_the_image_is_the_usual_one_and_each_height_has_its_own(env):
    pose = [0.5, 0.0, 0.0, 0.5]
    usual, same, higher = (env.sensor(np.array([[*pose, *h]]))[0, 0] for h in ([], [0.0], [0.02]))
    np.testing.assert_array_equal(usual, same)
    is_table = np.isclose(usual, env._world.camera.table_depth()) & (higher > 0.5)
    assert is_table.sum() > 5000
    # Along the axis of view, which comes down at 45 degrees: the table there is 2 cm lower.
    np.testing.assert_allclose((higher / usual)[is_table], 1 + 0.02 / EYE[2], rtol=1e-4)


def test_the_height_does_not_matter_to_a_grasp_and_stays_as_it_is(env):
    states = np.concatenate([env.initial_state(8)[:, :4], np.linspace(LOW, HIGH, 8)[:, None]], axis=1)
    actions = mixed_actions(states[:, :4], seed=2)
    with_height, without = env.dynamics(states, actions), env.dynamics(states[:, :4], actions)
    np.testing.assert_array_equal(with_height[:, :4], without)
    np.testing.assert_array_equal(with_height[:, 4], states[:, 4])


def test_the_oracle_lifts_every_mug_and_the_film_keeps_the_image_of_its_camera():
    env = PandaGraspEnv(render_mode="rgb_array", **PANDA_CAMERA)
    _, info = env.reset(seed=3)
    start = info["state"]
    before = env.render()
    info = env.step(oracle_actions(start[None, :4])[0])[4]
    assert info["success"]
    np.testing.assert_array_equal(info["mug"], start[:4])
    assert info["state"][4] == start[4]
    np.testing.assert_array_equal(next(env.film())[:, -256:], before[:, -256:])
    env.close()


@pytest.mark.parametrize("shift", [0.03, -0.02])
def test_a_camera_that_is_higher_in_every_trial_sees_the_same_and_the_state_does_not_tell(env, shift):
    shifted, both = PandaGraspEnv(camera_shift=shift), PandaGraspEnv(**PANDA_CAMERA, camera_shift=shift)
    pose = [0.5, 0.01, 0.0, 0.4]
    expected = env.sensor(np.array([[*pose, shift]]))
    np.testing.assert_array_equal(shifted.sensor(np.array([pose])), expected)
    np.testing.assert_allclose(both.sensor(np.array([[*pose, 0.01]])), env.sensor(np.array([[*pose, 0.01 + shift]])))
    assert shifted.state_space.shape == (4,)
    (_, first), (_, second) = PandaGraspEnv().reset(seed=3), shifted.reset(seed=3)
    np.testing.assert_array_equal(first["state"], second["state"])
    shifted.close(), both.close()
