"""Squeezing with the simulated arm: the funnel, the slot, and that nothing but state and action matters."""

import math

import numpy as np
import pytest

from sb3_tdpg.envs.panda_squeeze import PandaSqueezeEnv
from sb3_tdpg.envs.scenarios import PANDA_SQUEEZE
from sb3_tdpg.envs.squeeze_bullet import Inserted
from sb3_tdpg.envs.squeeze_fit import fit_angles, fit_squeeze
from sb3_tdpg.envs.squeeze_insert import SqueezeInsertEnv, wrap
from sb3_tdpg.envs.squeeze_scene import PART, SqueezeScene
from tests.envs.test_squeeze_insert import DEGREE, parts


@pytest.fixture(scope="module")
def env():
    """One environment for all tests: outcomes do not depend on the squeezes before."""
    env = PandaSqueezeEnv()
    env.reset(seed=0)
    yield env
    env.close()


def squeeze(env, state, jaws):
    """Angles between parts and jaws in degrees after a squeeze; the yaws of the jaws are in degrees."""
    jaws = np.broadcast_to(jaws, len(state)) * DEGREE
    return wrap(env.yaw(env.dynamics(state, jaws[:, None])) - jaws) / DEGREE


def episode(env, *jaws):
    """The infos of an episode; the yaws of the jaws are in degrees."""
    return [env.step(np.array([yaw * DEGREE]))[4] for yaw in jaws]


def test_a_part_within_the_basin_turns_to_the_jaws_for_any_yaw_of_the_hand(env):
    away = np.array([-60.0, -45.0, -20.0, 0.0, 10.0, 30.0, 50.0, 60.0])
    for jaws in (-180.0, -130.0, -90.0, -45.0, 0.0, 46.0, 89.0, 135.0):
        assert np.abs(squeeze(env, parts(*(jaws + away)), jaws)).max() < 1.0


def test_a_part_far_outside_the_basin_turns_across_the_jaws(env):
    away = np.array([-89.0, -80.0, -72.0, 72.0, 80.0, 89.0])
    for jaws in (-100.0, 0.0, 45.0):
        assert np.abs(squeeze(env, parts(*(jaws + away)), jaws)).min() > 89.0


def test_friction_holds_a_part_whose_diagonal_is_across_the_jaws_and_without_friction_it_turns(env):
    diagonal = 90.0 - math.atan2(PART[1], PART[0]) / DEGREE
    np.testing.assert_allclose(squeeze(env, parts(diagonal, -diagonal), 0.0), [diagonal, -diagonal], atol=1.0)
    smooth = PandaSqueezeEnv(friction=0.0)
    smooth.reset(seed=0)
    left = squeeze(smooth, parts(diagonal - 1.0, 1.0 - diagonal, diagonal + 3.0, -diagonal - 3.0), 0.0)
    np.testing.assert_allclose(np.abs(left), [0.0, 0.0, 90.0, 90.0], atol=1.0)
    smooth.close()


def test_a_squeeze_also_centres_the_part_and_leaves_it_flat_on_the_table(env):
    env.dynamics(parts(0.0, 30.0, -50.0, 80.0), np.zeros((4, 1)))
    for more in env._details:
        assert abs(more["offset"][1]) < 1e-3  # across the jaws
        assert abs(more["offset"][0]) < 1e-2
        assert more["tilt"] < 0.01


def test_the_jaws_are_longer_than_the_part_and_open_by_77_millimetres(env):
    simulation = env._world
    simulation._put_part((0.0, 2.0, 0.5), 0.0)  # out of the way
    simulation._put_arm(simulation._low)
    for along in (-0.044, -0.035, 0.0, 0.035, 0.044):
        for side in (-1, 1):
            start, end = (0.5 + along, 0.0, 0.02), (0.5 + along, side * 0.1, 0.02)
            body, _, _, position, _ = simulation.client.rayTest(start, end)[0]
            assert body == simulation._robot
            assert position[1] == pytest.approx(side * 0.0385, abs=1e-4)


def test_the_part_lies_off_the_middle_of_the_hand_by_the_centring_error():
    env = PandaSqueezeEnv(centring_error=0.003)
    env.reset(seed=0)
    # Parts that lie along the jaws slide across them only: along them the offset stays.
    env.dynamics(parts(*[0.0] * 40), np.zeros((40, 1)))
    along = np.array([more["offset"][0] for more in env._details])
    assert 0.0023 < np.abs(along).max() < 0.0035
    assert along.std() == pytest.approx(0.003 / math.sqrt(3), rel=0.25)
    env.close()


def test_the_fit_of_the_batched_model_holds(env):
    fit = fit_squeeze(env, n=72)
    np.testing.assert_allclose(fit.turn, PANDA_SQUEEZE["turn"], atol=0.003)
    assert fit.basin == pytest.approx(PANDA_SQUEEZE["basin"], abs=2 * DEGREE)
    assert fit.aligned_up_to < fit.across_from
    assert fit.residual < 0.5 * DEGREE
    assert 0.02 < fit.stuck < 0.09


def test_the_fit_finds_the_keywords_of_the_batched_model():
    model = SqueezeInsertEnv(turn=(0.96, 1.0), basin=50 * DEGREE)
    model.reset(seed=0)
    away = (np.arange(4000) + 0.5) / 4000 * math.pi - math.pi / 2
    fit = fit_angles(away, model.yaw(model.dynamics(parts(*(away / DEGREE)), np.zeros((4000, 1)))))
    np.testing.assert_allclose(fit.turn, (0.962, 0.998), atol=1e-3)  # 5 % and 95 % of the range
    assert fit.basin / DEGREE == pytest.approx(50.0, abs=0.1)
    assert fit.stuck == 0.0
    # A uniform share of 4 % has a standard deviation of 4 % / sqrt(12); the ways are between 0 and 50 degrees.
    assert fit.residual / DEGREE == pytest.approx(0.04 / math.sqrt(12) * 27.0, rel=0.1)
    with pytest.raises(ValueError, match="there is nothing to fit"):
        fit_angles(away, away * 0.0)


@pytest.mark.parametrize(("yaw", "jaws", "is_inserted"), [
    *((yaw, (45.0, 55.0, 0.0, 0.0), True) for yaw in (-80.0, -25.0, 65.0)), (80.0, (0.0, 0.0, 0.0, 0.0), False)
])  # fmt: skip
def test_squeezing_without_looking_inserts_the_part_unless_it_lies_across_the_slot(env, yaw, jaws, is_inserted):
    env.reset(seed=1)
    env._state = parts(yaw)
    *_, before, last = episode(env, *jaws)
    assert last["success"] == last["is_success"] == is_inserted
    assert last["height"] < 0.003 if is_inserted else last["height"] > 0.015
    assert set(before) == {"state", "cost", "offset", "tilt"}
    assert set(last) == {*before, "success", "is_success", "height"}
    assert is_inserted or last["cost"] > 100 * (89 * DEGREE - 0.05)


def test_the_cost_is_the_batched_model_s_of_the_engine_s_yaw(env):
    state = parts(40.0, 2.0)
    for is_last in (False, True):
        step = env.step_batch(state, np.array([[20 * DEGREE], [0.02]]), is_last=is_last)
        error = np.abs(env.yaw(step.state))
        terminal = 100 * np.maximum(0.0, error - 0.05)
        assert (terminal > 0).tolist() == [True, False]
        np.testing.assert_allclose(step.cost, 5 * np.array([40.0, 2.0]) * DEGREE + is_last * terminal)


def test_a_policy_for_the_batched_model_fits_this_environment(env):
    model = SqueezeInsertEnv()
    for name in ("observation_space", "action_space", "state_space", "state_names", "horizon", "tolerance"):
        assert getattr(env, name) == getattr(model, name)


@pytest.mark.parametrize("tolerance", [0.02, 0.1])
def test_the_slot_forgives_its_tolerance_and_no_more(tolerance):
    env = PandaSqueezeEnv(tolerance=tolerance)
    angles = tolerance * np.array([-1.3, -1.1, -0.95, -0.5, 0.0, 0.5, 0.95, 1.1, 1.3])
    inserted = [outcome.success for outcome in env._world.inserts(angles)]
    assert inserted == (np.abs(angles) < tolerance).tolist()
    env.close()


def test_the_corners_of_a_part_turned_by_the_tolerance_meet_the_edge_of_the_chamfer():
    for tolerance in (0.03, 0.2):
        # The high wall of a long side begins where the chamfer ends.
        edge = min(
            abs(box["position"][1]) - box["half_extents"][1]
            for box in SqueezeScene(0.05, tolerance).slot_boxes()
            if box["position"][1] != 0 and box["euler"] == (0.0, 0.0, 0.0) and box["half_extents"][2] == 0.01
        )
        assert edge == pytest.approx(PART[0] / 2 * math.sin(tolerance) + PART[1] / 2 * math.cos(tolerance))


def test_a_part_is_inserted_below_three_millimetres():
    assert [Inserted(height, 0.0).success for height in (-1e-3, 0.0029, 0.0031, 0.01)] == [True, True, False, False]


def test_squeezes_do_not_depend_on_their_order(env):
    rng = np.random.default_rng(0)
    given = rng.uniform(-1.5, 1.5, 40), rng.uniform(-3.0, 3.0, 40), rng.uniform(-0.003, 0.003, (40, 2))
    expected = [outcome.yaw for outcome in env._world.squeezes(*given)]
    order = rng.permutation(40)
    for k in order:
        env._world.insert(0.3 * k)
        (outcome,) = env._world.squeezes(*(array[k : k + 1] for array in given))
        assert outcome.yaw == expected[k]


def test_half_a_turn_of_the_hand_changes_nothing_and_the_wrist_stays_within_its_range(env):
    simulation = env._world
    for yaw in np.linspace(-math.pi, math.pi, 25):
        low, high = simulation._turned(yaw)
        assert abs(low[6]) < 1.6 and abs(high[6]) < 1.6
        assert low[6] - high[6] == pytest.approx(simulation._low[6] - simulation._high[6])
        np.testing.assert_allclose(simulation._turned(yaw + math.pi + 1e-9)[0], low, atol=1e-6)


def test_a_film_shows_the_last_squeeze_and_the_insertion(env):
    watched = PandaSqueezeEnv(render_mode="rgb_array")
    watched.reset(seed=2)
    pictures = [watched.render()]
    with pytest.raises(ValueError, match=r"no squeeze to show before step\(\)"):
        next(watched.film())
    episode(watched, 0.0, 0.0, 0.0, 0.0)
    assert 20 < len(watched._film) < 60  # of one squeeze and the insertion, not of the episode
    pictures += [watched.render(), *list(watched.film())[::16]]
    assert all(picture.shape == (256, 384, 3) and picture.dtype == np.uint8 for picture in pictures)
    assert all((pictures[0] != other).any() for other in pictures[1:])
    orange = (pictures[0][..., 0] > 150) & (pictures[0][..., 2] < 60)
    assert orange.sum() > 200  # the part is visible
    worlds = (watched._world, watched._view)
    watched.close()
    for world in worlds:  # of the physics and of the pictures
        with pytest.raises(RuntimeError, match="closed"):
            world.client.getNumBodies()
    with pytest.raises(ValueError, match="must be 'rgb_array' for a video"):
        next(env.film())
