"""The lava problem, step by step, and what every registered environment must satisfy."""

import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from small_problems import words
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_tdpg  # noqa: F401  (registers the environments)
from sb3_tdpg.envs import ENTRY_POINTS
from sb3_tdpg.envs.lava import LAVA as LAVA_EDGE
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.envs.scenarios import LAVA, LAVA_TABLE_READING
from sb3_tdpg.vec_env import BatchedVecEnv

ENV_IDS = sorted(ENTRY_POINTS)
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


# -- the dynamics and the costs by hand ----------------------------------------------------------------------


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
def test_lava_begins_at_five_metres_sharp(reading):
    states, _ = run_plan(lava_at(4.0, 1.0, **READINGS[reading]), [0.0])
    assert states == [(5.0, 0.0)]
    states, _ = run_plan(lava_at(4.0, 0.999, **READINGS[reading]), [0.0])
    assert states == [(4.999, 0.999)]


@pytest.mark.parametrize("reading", READINGS)
def test_standing_at_the_goal_costs_nothing(reading):
    states, costs = run_plan(lava_at(3.0, 0.0, **READINGS[reading]), [0.0] * 5)
    assert states == [(3.0, 0.0)] * 5
    assert costs == [0.0] * 5


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
    states, costs = run_plan(lava_at(1.0, 0.0, max_action=2.0, **LAVA_TABLE_READING), [50.0])
    assert states == [(1.0, 2.0)]
    assert costs == [4.0]  # |1 - 3| + |2|


def test_an_action_is_bounded_by_a_hundred_by_default():
    assert (LavaEnv().action_space.low.item(), LavaEnv().action_space.high.item()) == (-100.0, 100.0)


def test_an_episode_starts_at_rest_anywhere_between_wall_and_lava():
    states, _ = LavaEnv().reset_batch(20_000)
    assert (states[:, 1] == 0).all()
    quantiles = np.quantile(states[:, 0], [0.0, 0.25, 0.5, 0.75, 1.0])
    np.testing.assert_allclose(quantiles, [0, 1.25, 2.5, 3.75, 5], atol=0.1)


# -- the interface --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", ENV_IDS)
@pytest.mark.parametrize("check_env", [gymnasium_check_env, sb3_check_env], ids=["gymnasium", "sb3"])
def test_every_registered_environment_passes_the_checkers(env_id, check_env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Our observations and Lava's velocity have no bounds; everything else must be without a warning.
        warnings.filterwarnings("ignore", message=".*Box observation space m(in|ax)imum value is.*infinity.*")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*space.*")
        warnings.filterwarnings("ignore", message=".*Not able to test alternative render modes.*")
        # A depth image is in metres, not in bytes.
        warnings.filterwarnings("ignore", message="It seems that your observation.*is an image but")
        env = gym.make(env_id).unwrapped
        # A window needs a display.
        env.metadata = {**env.metadata, "render_modes": [m for m in env.metadata["render_modes"] if m != "human"]}
        check_env(env)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_every_registered_environment_is_reproducible_from_its_seed(env_id):
    def episode(seed):
        env = gym.make(env_id)
        env.action_space.seed(7)
        observations = [env.reset(seed=seed)[0]]
        ended = False
        while not ended:
            observation, _, ended, _, _ = env.step(env.action_space.sample())
            observations.append(observation)
        observations.append(env.reset()[0])
        return np.stack(observations)

    np.testing.assert_array_equal(episode(3), episode(3))
    assert not np.array_equal(episode(3), episode(4))


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_the_true_state_is_in_the_state_space_after_reset_and_after_every_step(env_id):
    env = gym.make(env_id)
    for seed in range(20):
        env.action_space.seed(seed)
        _, info = env.reset(seed=seed)
        ended = False
        while not ended:
            assert env.unwrapped.state_space.contains(info["state"])
            _, _, ended, _, info = env.step(env.action_space.sample())
        assert env.unwrapped.state_space.contains(info["state"])


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_every_component_of_the_state_has_a_name_with_a_unit(env_id):
    env = gym.make(env_id).unwrapped
    assert (len(env.state_names),) == env.state_space.shape
    assert all(re.fullmatch(r".+ \(.+\)", name) for name in env.state_names)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_the_state_in_info_is_a_copy_that_may_be_overwritten(env_id):
    env, untouched = gym.make(env_id), gym.make(env_id)
    action = np.zeros(env.action_space.shape, np.float32)
    _, info = env.reset(seed=0)
    untouched.reset(seed=0)
    info["state"][:] = 99.0
    _, _, _, _, info = env.step(action)
    _, _, _, _, expected = untouched.step(action)
    np.testing.assert_array_equal(info["state"], expected["state"])
    kept = info["state"].copy()
    env.step(action) if env.unwrapped.horizon > 1 else env.reset()
    np.testing.assert_array_equal(info["state"], kept)


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_the_end_of_the_horizon_is_terminated_and_not_truncated(env_id):
    env = gym.make(env_id)
    env.reset(seed=0)
    horizon = env.unwrapped.horizon
    ends = [env.step(np.zeros(env.action_space.shape, np.float32))[2:4] for _ in range(horizon)]
    assert ends == [(False, False)] * (horizon - 1) + [(True, False)]


@pytest.mark.parametrize("env_id", ENV_IDS)
def test_the_reward_is_the_negative_of_the_cost_in_info(env_id):
    env = gym.make(env_id)
    env.reset(seed=0)
    ended = False
    while not ended:
        _, reward, ended, _, info = env.step(env.action_space.sample())
        assert reward == -info["cost"]


@pytest.mark.parametrize("vectorise", [
    lambda **kwargs: DummyVecEnv([lambda: LavaEnv(**kwargs)]),
    lambda **kwargs: BatchedVecEnv(LavaEnv(**kwargs), 1),
], ids=["DummyVecEnv", "BatchedVecEnv"])  # fmt: skip
def test_sensor_noise_reaches_the_observation_in_every_episode_and_never_the_true_state(vectorise):
    def run(std):
        env = vectorise(sensor_noise_std=std)
        env.seed(0)
        observations, states = [env.reset()[0]], [env.reset_infos[0]["state"]]
        for _ in range(14):
            observation, _, dones, infos = env.step(np.full((1, 1), 0.3))
            observations.append(observation[0])
            states.append(env.reset_infos[0]["state"] if dones[0] else infos[0]["state"])
        return np.array(observations), np.array(states)

    observations, states = run(50.0)
    exact_observations, exact_states = run(0.0)
    np.testing.assert_array_equal(states, exact_states)
    np.testing.assert_allclose(exact_observations, exact_states, rtol=1e-6)
    for episode in range(3):
        noise = (observations - states)[5 * episode : 5 * episode + 5]
        assert 20 < noise.std() < 120, f"episode {episode}"


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


def test_nothing_is_rendered_without_a_render_mode():
    env = LavaEnv()
    env.reset(seed=0)
    assert env.render() is None


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
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(1))
    with pytest.raises(gym.error.ResetNeeded, match=r"call reset\(\) first"):
        env.step(np.zeros(1))
    env.reset()
    env.step(np.zeros(1))


@pytest.mark.parametrize(("keywords", "message"), [
    (dict(sensor_noise_std=-0.1), "sensor_noise_std=-0.1 must be finite and not negative"),
    (dict(sensor_noise_std=np.nan), "sensor_noise_std=nan must be finite"),
    (dict(sensor_noise_std=np.inf), "sensor_noise_std=inf must be finite"),
    (dict(horizon=0), "horizon=0 must be an integer of at least 1"),
    (dict(horizon=2.5), "horizon=2.5 must be an integer of at least 1"),
    (dict(max_action=0.0), "max_action=0.0 must be finite and positive"),
    (dict(max_action=np.inf), "max_action=inf must be finite and positive"),
    (dict(action_cost=np.nan), "action_cost=nan must be finite"),
    (dict(lava_stage_cost=np.inf), "lava_stage_cost=inf must be finite"),
    (dict(lava_terminal_cost=np.nan), "lava_terminal_cost=nan must be finite"),
    (dict(render_mode="human"), r"render_mode='human' must be None or one of \['rgb_array'\]"),
], ids=words)  # fmt: skip
def test_the_constructor_refuses_a_bad_keyword_and_names_the_mend(keywords, message):
    with pytest.raises(ValueError, match=message):
        LavaEnv(**keywords)


def test_a_misspelt_keyword_is_not_swallowed():
    with pytest.raises(TypeError, match="sensor_noise"):
        LavaEnv(sensor_noise=0.1)


def test_nothing_leaves_the_lava():
    env = LavaEnv()
    state = np.array([[LAVA_EDGE, -1.0], [LAVA_EDGE + 0.1, -1.0]], np.float32)
    for _ in range(3):
        state = env.dynamics(state, np.full((2, 1), -3.0))
        assert state[:, 0] == pytest.approx([LAVA_EDGE] * 2)
