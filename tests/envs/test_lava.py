"""The lava problem, step by step."""

import gymnasium as gym
import numpy as np
import pytest

import sb3_tdpg  # noqa: F401  (registers the environments)
from sb3_tdpg.envs.lava import LAVA as LAVA_EDGE
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.envs.scenarios import LAVA, LAVA_TABLE_READING
from sb3_tdpg.vec_env import BatchedVecEnv

READINGS = {"text": {}, "table": LAVA_TABLE_READING}
ROOT5 = np.sqrt(5.0)


def lava_at(d, v, **kwargs):
    """A noiseless lava environment in a state of our choice at t = 0."""
    env = LavaEnv(**{"sensor_noise_std": 0.0, **kwargs})
    env.reset(seed=0)
    env._state = np.array([[d, v]], dtype=np.float64)
    return env


def run_plan(env, plan):
    """Apply the controls; return the states that follow and the costs."""
    states, costs = [], []
    for u in plan:
        _, reward, _, _, info = env.step(np.array([u]))
        states.append(tuple(info["state"]))
        costs.append(-reward)
    return states, costs


@pytest.mark.parametrize(("reading", "action_costs"), [("text", (0, 0, 0)), ("table", (1, 3, 2))])
def test_three_steps_between_wall_and_lava_have_the_states_and_costs_computed_by_hand(reading, action_costs):
    env = lava_at(1.0, 0.0, horizon=3, **READINGS[reading])
    states, costs = run_plan(env, [1.0, -3.0, 2.0])
    assert states == [(1.0, 1.0), (2.0, -2.0), (0.0, 0.0)]
    stage_costs = np.array([2.0, ROOT5, ROOT5]) + action_costs
    np.testing.assert_allclose(costs, stage_costs + np.array([0.0, 0.0, 300.0]))  # 100 |(0, 0) - (3, 0)| at the end


@pytest.mark.parametrize("reading", READINGS)
def test_the_control_is_lost_at_the_wall_and_a_robot_standing_there_can_leave_it(reading):
    env = lava_at(1.0, -2.0, **READINGS[reading])
    states, _ = run_plan(env, [5.0, 1.5, 0.0])
    assert states == [(0.0, 0.0), (0.0, 1.5), (1.5, 1.5)]


@pytest.mark.parametrize(("reading", "in_lava", "terminal"), [("text", 2.0, 200.0), ("table", 3.0, 300.0)])
def test_lava_absorbs_with_its_own_stage_and_terminal_cost(reading, in_lava, terminal):
    env = lava_at(4.0, 2.0, horizon=3, **READINGS[reading])
    states, costs = run_plan(env, [-2.0, -5.0, -5.0])
    assert states == [(5.0, 0.0)] * 3
    weight = env.action_cost
    np.testing.assert_allclose(costs, [ROOT5 + 2 * weight, in_lava + 5 * weight, in_lava + 5 * weight + terminal])


@pytest.mark.parametrize("reading", READINGS)
@pytest.mark.parametrize(("v", "state"), [(1.0, (5.0, 0.0)), (0.999, (4.999, 0.999))])
def test_lava_begins_at_five_metres_sharp(v, state, reading):
    assert run_plan(lava_at(4.0, v, **READINGS[reading]), [0.0])[0] == [state]


@pytest.mark.parametrize(("reading", "plan", "expected"), [
    ("text", [-5, 0, 3, -3, 0], 13.75),
    ("table", [-5, 0, 1.5, 0, -1.5], 23.0),
])  # fmt: skip
def test_the_best_open_loop_plan_costs_what_was_measured(reading, plan, expected):
    env = LavaEnv(sensor_noise_std=0.0, **READINGS[reading])
    state = np.zeros((5001, 2))
    state[:, 0] = np.linspace(0, 5, 5001)
    total = 0.0
    for t, u in enumerate(plan):
        step = env.step_batch(state, np.full((len(state), 1), u), is_last=t == 4)
        state, total = step.state, total + step.cost
    assert np.mean(total) == pytest.approx(expected, abs=0.6)


def test_an_action_out_of_bounds_counts_as_the_bound():
    assert (LavaEnv().action_space.low.item(), LavaEnv().action_space.high.item()) == (-100.0, 100.0)
    states, costs = run_plan(lava_at(1.0, 0.0, max_action=2.0, **LAVA_TABLE_READING), [50.0])
    assert states == [(1.0, 2.0)]
    assert costs == [4.0]  # |1 - 3| + |2|


def test_an_episode_starts_at_rest_anywhere_between_wall_and_lava():
    states, _ = LavaEnv().reset_batch(20_000)
    assert (states[:, 1] == 0).all()
    quantiles = np.quantile(states[:, 0], [0.0, 0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(quantiles, [0, 1.25, 2.5, 3.75, 5], atol=0.1)


def test_the_sensor_noise_has_the_standard_deviation_that_was_asked_for():
    state, observation = LavaEnv(sensor_noise_std=0.5).reset_batch(50_000)
    np.testing.assert_allclose((observation - state).std(axis=0), 0.5, rtol=0.02)


def test_the_rows_of_table_one_are_given_as_variances_and_set_as_standard_deviations():
    stds = [scenario.env_kwargs["sensor_noise_std"] for scenario in LAVA]
    np.testing.assert_allclose(np.square(stds), [1e-4, 1e-3, 1e-2, 1e-1, 1.0])
    for scenario in LAVA:
        gym.make(scenario.env_id, **scenario.env_kwargs)


def test_a_row_keeps_its_own_keywords_when_others_are_added():
    row = LAVA[2].with_kwargs(sensor_noise_std=7.0, **LAVA_TABLE_READING)
    assert row.env_kwargs["sensor_noise_std"] == pytest.approx(0.1)
    assert row.env_kwargs["lava_terminal_cost"] == 300.0
    assert row.paper == LAVA[2].paper


def test_rendering_gives_an_image_that_moves_with_the_robot():
    env = gym.make("Lava-v0", render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    images = []
    for d in (0.5, 4.0):
        env._state = np.array([[d, 0.0]])
        images.append(env.render())
    for image in images:
        assert image.shape == (96, 480, 3)
        assert image.dtype == np.uint8
    robot_columns = [np.flatnonzero((image[58] == (45, 90, 190)).all(-1)).mean() for image in images]
    assert robot_columns[1] - robot_columns[0] == pytest.approx(400 / 5 * 3.5, abs=2)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_an_action_that_is_not_finite_is_refused(bad):
    env = lava_at(1.0, 0.0)
    with pytest.raises(ValueError, match=r"action that is not finite.*diverged"):
        env.step(np.array([bad]))
    vec_env = BatchedVecEnv(LavaEnv(), 3)
    vec_env.reset()
    with pytest.raises(ValueError, match=r"action that is not finite.*diverged"):
        vec_env.step(np.array([[0.0], [bad], [0.0]]))


def test_a_step_before_the_first_reset_or_after_the_end_asks_for_a_reset():
    env = LavaEnv()
    with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) first"):
        env.step(np.zeros(1))
    for _ in range(2):
        env.reset(seed=0)
        for _ in range(5):
            env.step(np.zeros(1))
        with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) first"):
            env.step(np.zeros(1))


def test_nothing_leaves_the_lava():
    env = LavaEnv()
    state = np.array([[LAVA_EDGE, -1.0], [LAVA_EDGE + 0.1, -1.0]], np.float32)
    for _ in range(3):
        state = env.dynamics(state, np.full((2, 1), -3.0))
        assert state[:, 0] == pytest.approx([LAVA_EDGE] * 2)
