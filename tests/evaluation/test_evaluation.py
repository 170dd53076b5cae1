"""Records of evaluations, one for each episode, and the curves of a training."""

import math
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from small_problems import ToyEnv
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnvWrapper, VecFrameStack, VecNormalize

from sb3_tdpg import TDPG, BatchedVecEnv, make_episodes_env
from sb3_tdpg.envs.lava import GOAL
from sb3_tdpg.envs.scenarios import LAVA, Scenario
from sb3_tdpg.evaluation import evaluate_scenarios, rollout_states, summary_table, training_curves
from sb3_tdpg.evaluation.records import _final_columns

TWO_ROWS = (LAVA[0], LAVA[-1])


@pytest.fixture(scope="module")
def tdpg():
    return TDPG("TRVPolicy", "Lava-v0", beta=math.inf, n_episodes=50, seed=0).learn(500)


@pytest.fixture(scope="module")
def ppo():
    return PPO("MlpPolicy", make_episodes_env("Lava-v0", 4), n_steps=5, batch_size=20, seed=0, device="cpu")


@pytest.fixture(scope="module")
def records(tdpg, ppo):
    return evaluate_scenarios({"PG": ppo, "TDPG": tdpg}, LAVA, 20, seed=1)


def test_every_episode_of_every_model_and_scenario_has_a_row(records):
    assert len(records) == 2 * 5 * 20
    assert list(records["model"].unique()) == ["PG", "TDPG"]
    assert list(records["scenario"].unique()) == [scenario.name for scenario in LAVA]
    assert (records.groupby(["model", "scenario"])["episode"].apply(list).map(lambda e: e == list(range(20)))).all()
    assert list(records.columns) == [
        "model", "scenario", "env_id", "episode", "cost", "length",
        "final_state_0", "final_state_1", "final_cost", "seed", "deterministic",
    ]  # fmt: skip
    assert not records.isna().any().any()


def test_the_final_columns_belong_to_the_episode_of_their_row(records):
    # c_T + c_{T-1}: the terminal cost is 100 times the distance of the final state from the goal.
    terminal = 100 * np.linalg.norm(records[["final_state_0", "final_state_1"]] - GOAL, axis=1)
    stage = records["final_cost"] - terminal
    assert (stage > -1e-6).all() and (stage < 30).all()
    assert (records["cost"] >= records["final_cost"] - 1e-4).all()
    assert (records["length"] == 5).all()


def test_the_same_seed_gives_the_same_frame_and_another_seed_another(tdpg, ppo):
    frames = [evaluate_scenarios({"a": tdpg, "b": ppo}, TWO_ROWS, 7, seed=seed) for seed in (3, 3, 4)]
    pd.testing.assert_frame_equal(frames[0], frames[1], check_exact=True)
    assert not np.array_equal(frames[0]["cost"], frames[2]["cost"])


def test_a_row_does_not_depend_on_which_other_rows_are_evaluated_and_labels_are_columns_in_front(tdpg, records):
    alone = evaluate_scenarios(tdpg, LAVA[3:4], 20, seed=1, labels=dict(train_seed=3))
    among = records[(records["model"] == "TDPG") & (records["scenario"] == LAVA[3].name)].reset_index(drop=True)
    among.insert(0, "train_seed", 3)
    pd.testing.assert_frame_equal(alone, among, check_exact=True)


def test_all_models_start_from_the_same_states_which_are_not_those_of_a_training_with_the_same_seed(tdpg, ppo):
    starts = [rollout_states(model, LAVA[0], 10, seed=5)[0][0, :, 0] for model in (tdpg, ppo)]
    np.testing.assert_array_equal(*starts)
    assert len(np.unique(starts[0])) == 10
    training_env = make_episodes_env("Lava-v0", 10, seed=5)
    training_env.reset()
    assert not np.isin(starts[0], [info["state"][0] for info in training_env.reset_infos]).any()


def test_the_keywords_for_all_scenarios_reach_the_environment_and_a_scenarios_own_win(tdpg):
    as_text = evaluate_scenarios(tdpg, LAVA[:1], 5)
    costly = evaluate_scenarios(tdpg, LAVA[:1], 5, env_kwargs=dict(action_cost=10.0, sensor_noise_std=50.0))
    assert (costly["cost"] > as_text["cost"]).all()
    np.testing.assert_array_equal(costly["final_state_0"], as_text["final_state_0"])


def test_a_scenario_may_have_a_sensor_and_a_number_of_episodes_of_its_own(tdpg):
    class Blind(VecEnvWrapper):
        def reset(self):
            return np.zeros_like(self.venv.reset())

        def step_wait(self):
            observations, *rest = self.venv.step_wait()
            return np.zeros_like(observations), *rest

    rows = [LAVA[0], replace(LAVA[0], name="blind", sensor=Blind, n_episodes=7)]
    records = evaluate_scenarios(tdpg, rows, 20)
    assert records.groupby("scenario")["episode"].count().to_dict() == {"Training": 20, "blind": 7}
    # The same start, and another end: nothing but the observation differs.
    costs = records.set_index(["scenario", "episode"])["cost"]
    assert (costs["Training"][:7] != costs["blind"]).all()
    assert rows[1].with_kwargs(horizon=5).sensor is Blind


@pytest.mark.filterwarnings("ignore:You are trying to run PPO")
@pytest.mark.parametrize(("make", "env_id"), [
    (partial(RecurrentPPO, "MlpLstmPolicy", n_steps=5, batch_size=5), "Lava-v0"),
    (partial(PPO, "MlpPolicy", n_steps=20, batch_size=20, use_sde=True), "Pendulum-v1"),
    (partial(DQN, "MlpPolicy"), "CartPole-v1"),
], ids=["memory", "gSDE", "exploration"])  # fmt: skip
def test_other_algorithms_are_evaluated_reproducibly(make, env_id, tmp_path):
    model = make(env=env_id, seed=0, device="cpu")
    model.exploration_rate = 0.5
    model.save(tmp_path / "model")
    again = type(model).load(tmp_path / "model", device="cpu")
    rows = [Scenario("x", env_id)]
    frames = [evaluate_scenarios(m, rows, 8, seed=seed) for m, seed in ((model, 0), (again, 0), (again, 0), (again, 1))]
    for frame in frames[1:3]:
        pd.testing.assert_frame_equal(frames[0], frame, check_exact=True)
    assert (frames[0]["cost"] != frames[3]["cost"]).any()


def test_images_are_transposed_and_stacks_are_normalised_as_in_training(registry):
    space = spaces.Dict(cam=spaces.Box(0, 255, (36, 36, 3), np.uint8))
    gym.register("Camera-v0", lambda: ToyEnv(space))
    stack = VecNormalize(VecFrameStack(make_vec_env("Pendulum-v1", 2), 2), norm_reward=False)
    for policy, env, env_id in (("MultiInputPolicy", "Camera-v0", "Camera-v0"), ("MlpPolicy", stack, "Pendulum-v1")):
        model = PPO(policy, env, n_steps=6, batch_size=6, device="cpu")
        assert len(evaluate_scenarios(model, [Scenario("x", env_id)], 2)) == 2


def test_what_is_no_array_in_the_last_info_is_left_out():
    assert _final_columns({"contacts": [[1, 2], [3]], "x": 2.0}) == {"final_x": 2.0}


class RaceEnv(gym.Env):
    """Each episode costs its start; whether a high or a low one ends first is a keyword."""

    metadata = {"render_modes": ["rgb_array"]}
    observation_space = spaces.Box(0, 1, (1,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, high_first=False):
        self.high_first = high_first

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x = float(self.np_random.uniform())
        self.left = 1 + int(30 * (1 - self.x if self.high_first else self.x))
        return np.array([self.x], np.float32), {}

    def step(self, action):
        self.left -= 1
        ended = self.left == 0
        return np.array([self.x], np.float32), -self.x if ended else 0.0, ended, False, {"start": self.x}


def test_an_episode_has_the_same_number_whichever_ends_first(registry, monkeypatch):
    gym.register("Race-v0", RaceEnv)
    model = PPO("MlpPolicy", "Race-v0", n_steps=20, batch_size=20, seed=0, device="cpu")
    rows = [Scenario(str(high), "Race-v0", dict(high_first=high)) for high in (False, True)]
    # Fewer environments than episodes: two and three of each.
    monkeypatch.setattr("sb3_tdpg.evaluation.records.MAX_PARALLEL_EPISODES", 4)
    frame = evaluate_scenarios(model, rows, 10)
    np.testing.assert_allclose(frame["cost"], frame["final_start"], atol=1e-5)
    np.testing.assert_array_equal(frame["length"][:10], 1 + (30 * frame["final_start"][:10]).astype(int))
    low, high = (frame.loc[frame["scenario"] == row.name, "cost"].to_numpy() for row in rows)
    np.testing.assert_allclose(low, high)
    assert len(np.unique(low)) == 10


def test_a_model_trained_on_normalised_observations_is_evaluated_on_them():
    env = VecNormalize(make_episodes_env("Lava-v0", 4), norm_reward=False)
    model = PPO("MlpPolicy", env, n_steps=5, batch_size=20, seed=0, device="cpu").learn(100)
    count = env.obs_rms.count
    seen = []
    predict = model.predict
    model.predict = lambda obs, *args, **kwargs: (seen.append(obs), predict(obs, *args, **kwargs))[1]
    evaluate_scenarios(model, LAVA[:1], 200)
    assert abs(seen[0][:, 0].mean()) < 1  # d itself is 2.5 on average
    assert env.obs_rms.count == count


def test_the_last_infos_success_becomes_a_failure_column(tdpg, monkeypatch):
    step = BatchedVecEnv.step_wait

    def step_with_success(self):
        obs, rewards, dones, infos = step(self)
        for i, info in enumerate(infos):
            info["is_success"] = i % 4 != 0
        return obs, rewards, dones, infos

    monkeypatch.setattr(BatchedVecEnv, "step_wait", step_with_success)
    frame = evaluate_scenarios(tdpg, LAVA[:1], 8, deterministic=True)
    assert frame["deterministic"].all()
    assert frame["failure"].tolist() == [True, False, False, False] * 2
    assert summary_table(frame)["failure_share"].tolist() == [0.25]


@pytest.mark.parametrize(("change", "message"), [
    (dict(scenarios=[]), "at least one model and one scenario"),
    (dict(scenarios=[LAVA[0], LAVA[0]]), "names must differ.*'Training', 'Training'"),
    (dict(n_episodes=2.5), "n_episodes=2.5"),
    (dict(seed=-1), "seed=-1"),
    (dict(model="model.zip"), "expected a Stable-Baselines3 model"),
    (dict(env_kwargs=dict(typo=1)), "'Training'.*typo"),
    (dict(scenarios=[*LAVA, Scenario("other", "NoSuch-v0")]), "'other'.*NoSuch"),
    (dict(scenarios=[*LAVA, Scenario("pole", "CartPole-v1")]), "'TDPG'.*'pole'.*observation_space"),
    (dict(scenarios=[*LAVA, Scenario("weak", "Lava-v0", dict(max_action=1.0))]), "'weak'.*action_space"),
    (dict(scenarios=[*LAVA, Scenario("long", "Lava-v0", dict(horizon=6))]), "'long'.*horizon of 5.*has 6"),
])  # fmt: skip
def test_what_does_not_fit_is_an_error_before_any_episode_is_run(change, message, tdpg, monkeypatch):
    monkeypatch.setattr("sb3_tdpg.evaluation.records.rollout", lambda *args, **kwargs: pytest.fail("ran"))
    arguments = dict(model=tdpg, scenarios=LAVA, n_episodes=5) | change
    with pytest.raises(ValueError, match=message):
        evaluate_scenarios(**arguments)


def test_the_rollout_states_begin_at_the_start_and_follow_the_dynamics(tdpg):
    states, costs = rollout_states(tdpg, LAVA[0], 30, seed=2)
    assert states.shape == (6, 30, 2) and costs.shape == (30,)
    assert (states[0, :, 1] == 0).all()
    np.testing.assert_array_equal(states[1, :, 0], states[0, :, 0])  # v_0 = 0
    same = evaluate_scenarios(tdpg, LAVA[:1], 30, seed=2)
    np.testing.assert_allclose(same["cost"], costs)
    np.testing.assert_array_equal(same["final_state_0"], states[-1, :, 0])


def test_the_training_curves_show_an_epoch_that_costs_nothing_and_the_information_of_those_with_a_penalty():
    pytest.importorskip("matplotlib")
    pg = pd.DataFrame({"time/iterations": [1, 2], "rollout/ep_cost_mean": [0.5, 0.0]})
    assert training_curves({"PG": pg}).axes[0].get_yscale() == "linear"
    assert training_curves({"PG": pg.assign(**{"rollout/ep_cost_mean": 0.1})}).axes[0].get_yscale() == "log"
    cost, information = training_curves({"PG": pg, "TDPG": pg.assign(**{"mi/total": [0.5, 0.1]})}).axes
    assert [line.get_label() for line in cost.lines] == ["PG", "TDPG"]
    assert [line.get_label() for line in information.lines] == ["TDPG"]


def test_without_matplotlib_everything_but_the_figures_works(monkeypatch):
    for name in ("matplotlib", "matplotlib.cm", "matplotlib.colors", "matplotlib.figure", "matplotlib.ticker"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ImportError, match=r"pip install sb3_tdpg\[plots\]"):
        training_curves({})


def test_importing_the_package_does_not_import_matplotlib():
    # SB3 2.8 imports it itself.
    code = """if True:
        import sys, stable_baselines3
        before = "matplotlib.figure" in sys.modules
        import sb3_tdpg
        from sb3_tdpg.evaluation import figures
        assert ("matplotlib.figure" in sys.modules) == before"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])
