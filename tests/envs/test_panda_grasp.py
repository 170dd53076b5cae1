"""The grasping problem: what lifts the mug and what does not, and that an outcome depends on nothing else."""

import json

import numpy as np
import pytest
from panda_oracle import action_for, mixed_actions, oracle_actions, random_states, run_python

from sb3_tdpg.envs.panda_grasp import NOMINAL_GRASP, PandaGraspEnv


@pytest.fixture(scope="module")
def shared():
    """One environment for all tests: outcomes do not depend on the trials before."""
    env = PandaGraspEnv()
    yield env
    env.close()


def outcomes(env, states, actions):
    """Final states (N, 4) and contacts (N,)."""
    step = env.step_batch(np.asarray(states), np.asarray(actions), is_last=True)
    return step.state, np.array([more["contacts"] for more in step.details])


def test_a_grasp_at_the_rim_never_fails_over_200_poses(shared):
    states = random_states(200, half_width=0.075)
    step = shared.step_batch(states, oracle_actions(states), is_last=True)
    np.testing.assert_array_equal(step.cost, 0.0)
    assert all(more["success"] and more["is_success"] and more["contacts"] > 0 for more in step.details)
    np.testing.assert_array_equal([more["mug_height"] for more in step.details], step.state[:, 2])
    assert (step.state[:, 2] > 0.06).all()
    assert (abs(step.state[:, :2] - states[:, :2]) < 0.05).all()  # straight up


def test_a_grasp_in_empty_air_always_fails_and_leaves_the_mug_where_it_was(shared):
    states = random_states(30, seed=1)
    beside = action_for(np.c_[np.full(30, 0.36), np.where(states[:, 1] > 0, -0.14, 0.14), np.full((30, 2), 0.1)])
    above = oracle_actions(states)
    above[:, 2] = 1.0
    for actions in (beside, above):
        step = shared.step_batch(states, actions, is_last=True)
        np.testing.assert_array_equal(step.cost, 1.0)
        np.testing.assert_allclose(step.state, states, atol=1e-3)
        assert not any(more["success"] or more["contacts"] for more in step.details)


def test_the_cost_is_one_up_to_a_height_of_five_centimetres(shared, monkeypatch):
    states = np.array([[0.0, 0.0, height, 0.0] for height in (0.0, 0.05, 0.0501, 0.2)])
    np.testing.assert_array_equal(shared.terminal_cost(states), [1, 1, 0, 0])
    np.testing.assert_array_equal(shared.cost(states, np.zeros((4, 4))), 0)
    monkeypatch.setattr(shared, "_shared", lambda *_, **__: [(state, 0) for state in states])
    shared.dynamics(np.zeros((4, 4)), np.zeros((4, 4)))
    for name in ("success", "is_success"):
        assert [more[name] for more in shared._details] == [False, False, True, True]


def test_without_friction_nothing_is_lifted(shared):
    slippery = PandaGraspEnv(friction=0.0)
    states = random_states(10, seed=3)
    step = slippery.step_batch(states, oracle_actions(states), is_last=True)
    assert step.cost.mean() > 0.8
    slippery.close()


def test_the_paper_s_slow_motion_lifts_the_mug_too_and_has_the_fast_one_s_result_in_plain_cases():
    slow = PandaGraspEnv(motion="reference")
    states = random_states(4, seed=4)
    states[:, 3] = [-0.5, 0.0, 0.5, 0.7]
    step = slow.step_batch(states, oracle_actions(states), is_last=True)
    np.testing.assert_array_equal(step.cost, 0.0)
    away = action_for(np.tile([0.64, 0.14, 0.06, 0.5], (2, 1)))
    np.testing.assert_array_equal(slow.step_batch(states[:2] - [0.1, 0.1, 0, 0], away, is_last=True).cost, 1.0)
    slow.close()


def hit_from_above(env, state, point):
    """Height of what a ray straight down meets at a point (x, y) of the cup's frame: (0, 0) is its axis."""
    simulation = env._world.simulation
    simulation._restore(np.asarray(state))
    cos, sin = np.cos(state[3]), np.sin(state[3])
    x, y = point[0], point[1] - env.scene.frame_offset
    at = (state[0] + cos * x - sin * y, state[1] + sin * x + cos * y)
    body, _, _, position, _ = simulation.client.rayTest((*at, 0.2), (*at, -0.1))[0]
    return position[2], body == simulation._body


@pytest.mark.parametrize("scale", [1.0, 0.8])
def test_the_mug_is_hollow_has_a_wall_all_around_and_a_handle(scale):
    env = PandaGraspEnv(mug_scale=scale)
    radius, height = 0.0465 * scale, 0.081 * scale
    for state in random_states(5, seed=5):
        assert hit_from_above(env, state, (0.0, 0.0)) == (pytest.approx(0.006 * scale, abs=1e-3), True)  # its base
        for angle in np.arange(0.1, 2 * np.pi, 0.2):
            in_the_wall = (radius - 0.00375 * scale) * np.array([np.cos(angle), np.sin(angle)])
            assert hit_from_above(env, state, in_the_wall) == (pytest.approx(height, abs=1e-3), True)
            outside = 1.25 * in_the_wall
            if abs(outside[0]) > 0.01:  # not on the handle
                assert hit_from_above(env, state, outside) == (pytest.approx(0.0, abs=1e-3), False)
        upper_bar = 0.0775 * 0.81 * scale
        assert hit_from_above(env, state, (0.0, 0.065 * scale)) == (pytest.approx(upper_bar, abs=0.005), True)
        assert hit_from_above(env, state, (0.0, -0.065 * scale)) == (pytest.approx(0.0, abs=1e-3), False)
    env.close()


def test_a_finger_fits_between_handle_and_mug(shared):
    simulation = shared._world.simulation
    simulation._restore(np.array([0.5, 0.012, 0.0, 0.0]))  # the axis through (0.5, 0), the handle along +y

    def through_the_hole(y):
        body, *_ = simulation.client.rayTest((0.4, y, 0.0405), (0.6, y, 0.0405))[0]
        return body != simulation._body

    assert through_the_hole(0.06)
    assert not through_the_hole(0.087)  # the handle's upright bar
    assert not through_the_hole(0.0)  # the cup


def test_the_handle_can_block_a_grasp(shared):
    # The same grasp on the same cup, turned: with the handle away from the gripper, and with the handle in its way.
    def fails(handle_towards):
        yaw = handle_towards - np.pi / 2
        cup = np.array([0.5, 0.0])
        frame = cup + 0.012 * np.array([np.cos(handle_towards), np.sin(handle_towards)])
        radial = np.pi / 12  # the direction in which the gripper closes at its nominal yaw
        grasp = cup + 0.043 * np.array([np.cos(radial), np.sin(radial)])
        action = action_for([[*grasp, 0.05, np.pi / 6]])
        return shared.step_batch(np.array([[*frame, 0.0, yaw]]), action, is_last=True).cost[0]

    assert fails(np.pi) == 0
    assert fails(-np.pi / 2) == 0
    assert [fails(np.pi / 12 + off) for off in (-0.1, 0.0, 0.1)] == [1, 1, 1]


def test_the_mug_stands_still_when_nothing_touches_it(shared):
    state = np.array([0.5, 0.02, 0.0, 0.4])
    shared._world.simulation._restore(state)
    for _ in range(240):
        shared._world.simulation.client.stepSimulation()
    np.testing.assert_allclose(shared._world.simulation._mug_state(0.4), state, atol=5e-4)


def test_an_action_is_a_tenth_around_the_nominal_grasp_and_is_clipped_to_the_bounds(shared):
    low, high = [0.35, -0.15, 0.05, np.pi / 6 - 1], [0.65, 0.15, 0.16, np.pi / 6 + 1]
    actions = [[0.3, -0.2, 0.1, 1.0], [-99.0] * 4, [99.0] * 4, *action_for([low, high])]
    step = shared.step_batch(np.tile([0.5, 0.0, 0.0, 0.0], (5, 1)), np.array(actions), is_last=True)
    grasps = [more["grasp"] for more in step.details]
    np.testing.assert_allclose(grasps[0], [0.53, -0.02, 0.07, np.pi / 6 + 0.1], atol=1e-7)
    np.testing.assert_allclose(grasps[1:], [low, high] * 2, atol=1e-6)
    np.testing.assert_allclose(step.state[1:3], step.state[3:], atol=1e-6)


def test_the_hand_gets_to_where_the_action_says_all_over_the_action_space(shared):
    simulation, empty = shared._world.simulation, np.array([0.5, 0.5, 0.0, 0.0])
    low, high = shared.action_space.low.astype(float), shared.action_space.high.astype(float)
    for corner in np.ndindex(3, 3, 2, 3):
        pose = NOMINAL_GRASP + 0.1 * (low + np.array(corner) / [2, 2, 1, 2] * (high - low))
        joints = []
        simulation.grasp(empty, pose, lambda configuration, joints=joints: joints.append(configuration.joints))
        lowest = min(joints, key=lambda values: hand_position(simulation, values)[2])
        np.testing.assert_allclose(hand_position(simulation, lowest), np.add(pose[:3], (0, 0, 0.1)), atol=0.006)


def hand_position(simulation, joints):
    simulation._put_arm(joints[:7])
    return np.array(simulation.client.getLinkState(simulation._robot, 8, computeForwardKinematics=True)[4])


def test_outcomes_do_not_depend_on_the_order_of_trials_nor_on_other_environments(shared):
    states = random_states(60, seed=6)
    actions = mixed_actions(states)
    expected, contacts = outcomes(shared, states, actions)
    images = shared.sensor(states[:6])
    assert 0.2 < (expected[:, 2] > 0.05).mean() < 0.8
    order = np.random.default_rng(0).permutation(60)
    beside, other = PandaGraspEnv(), PandaGraspEnv(mug_scale=1.2, friction=0.9, frame_offset=0.0)
    outcomes(other, states[:6] + 0.01, actions[:6])
    other.sensor(states[:1])
    for again in (shared, beside):
        shuffled, shuffled_contacts = outcomes(again, states[order], actions[order])
        np.testing.assert_array_equal(shuffled, expected[order])
        np.testing.assert_array_equal(shuffled_contacts, contacts[order])
        np.testing.assert_array_equal(again.sensor(states[:6]), images)
    beside.close(), other.close()


IN_ANOTHER_PROCESS = """
import json, sys
import numpy as np
from sb3_tdpg.envs.panda_grasp import PandaGraspEnv
states, actions = (np.array(part) for part in json.load(sys.stdin))
env = PandaGraspEnv()
step = env.step_batch(states, actions, is_last=True)
print(json.dumps([step.state.tolist(), env.sensor(states).sum(axis=(1, 2, 3), dtype=float).tolist()]))
"""


def test_outcomes_and_images_are_the_same_in_another_process(shared):
    states = random_states(15, seed=7)
    actions = mixed_actions(states)
    expected, _ = outcomes(shared, states, actions)
    given = json.dumps([states[::-1].tolist(), actions[::-1].tolist()])
    final, sums = json.loads(run_python("-c", IN_ANOTHER_PROCESS, input=given).splitlines()[-1])
    np.testing.assert_array_equal(final[::-1], expected)
    np.testing.assert_array_equal(sums[::-1], shared.sensor(states).sum(axis=(1, 2, 3), dtype=float))
