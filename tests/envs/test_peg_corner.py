"""The peg and the corner, step by step."""

import numpy as np
import pytest

from sb3_tdpg.envs.peg_corner import HOLE, PegCornerEnv


def moved(state, *moves, **keywords):
    """The positions after the moves."""
    env = PegCornerEnv(sensor_noise_std=0.0, **keywords)
    state = np.array(state, dtype=float)
    for move in moves:
        state = env.dynamics(state, np.broadcast_to(move, state.shape))
    return state


def test_a_free_move_is_the_action_times_the_gain():
    np.testing.assert_allclose(moved([[3.0, 4.0]], (-1.0, 0.5)), [[2.0, 4.5]])
    np.testing.assert_allclose(moved([[3.0, 4.0]], (-1.0, 0.5), actuator_gain=0.8), [[2.2, 4.4]])


def test_the_fence_stops_the_peg_and_friction_brakes_the_motion_along_it():
    # 1.5 cm beyond the left side: friction takes 0.2 * 1.5 = 0.3 cm off the other component.
    np.testing.assert_allclose(moved([[1.0, 4.0]], (-2.5, -1.0)), [[0.0, 3.3]])
    np.testing.assert_allclose(moved([[1.0, 4.0]], (-2.5, 0.2)), [[0.0, 4.0]])  # it sticks
    np.testing.assert_allclose(moved([[1.0, 4.0]], (-2.5, -1.0), friction=0.0), [[0.0, 3.0]])


def test_three_pushes_into_the_corner_and_a_move_find_the_hole_from_everywhere():
    grid = np.stack(np.meshgrid(np.linspace(2, 6, 30), np.linspace(2, 6, 30)), -1).reshape(-1, 2)
    ends = moved(grid, *[(-2.5, -2.5)] * 3, HOLE)
    assert np.linalg.norm(ends - HOLE, axis=1).max() < 1e-9


def test_the_costs_are_those_computed_by_hand():
    env = PegCornerEnv(sensor_noise_std=0.0)
    state = HOLE + np.array([[3.0, 4.0]])
    step = env.step_batch(state, np.array([[-2.0, -2.0]]), is_last=True)
    assert step.cost == pytest.approx(5.0 + 30 * (np.hypot(1.0, 2.0) - 0.4))
    near = env.step_batch(HOLE + np.array([[0.3, 0.0]]), np.zeros((1, 2)), is_last=True)
    assert near.cost == pytest.approx(0.3)


def test_the_observation_is_the_position_with_noise():
    env = PegCornerEnv(sensor_noise_std=0.3)
    state, observation = env.reset_batch(20_000)
    assert (observation - state).std() == pytest.approx(0.3, rel=0.03)
    np.testing.assert_allclose(np.quantile(state, [0, 0.5, 1]), [2, 4, 6], atol=0.05)


def test_the_picture_shows_peg_hole_and_fence():
    env = PegCornerEnv(render_mode="rgb_array")
    env.reset(seed=0)
    env._state = np.array([[5.0, 5.0]])
    image = env.render()
    rows, columns = np.nonzero((image == (45, 90, 190)).all(-1))
    assert rows.mean() < 60 and columns.mean() > 140  # up and to the right
    rows, columns = np.nonzero((image == (90, 90, 95)).all(-1))
    assert rows.mean() > 130 and columns.mean() < 70
