"""Reports where observations are a Dict or stacked, and where there is a plant to perturb."""

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium import spaces
from small_problems import ToyEnv
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.report import robustness_report
from sb3_tdpg.robustness import PerturbedVecEnv

pytest.importorskip("matplotlib")
pytest.importorskip("rliable")
pytest.importorskip("markdown_it")

PARTS = spaces.Dict(place=spaces.Box(-1, 1, (2,), np.float32), camera=spaces.Box(0, 255, (3, 36, 36), np.uint8))


def test_a_dict_and_a_plant_are_perturbed(tmp_path, registry):
    gym.register("Toy-v0", ToyEnv, kwargs=dict(observation_space=PARTS, horizon=6))
    model = PPO("MultiInputPolicy", gym.make("Toy-v0"), n_steps=6, batch_size=6, seed=0, device="cpu")
    names = ["noise", "vector_bias", "freeze", "group_failure", "actuator_gain", "actuator_delay"]
    text = robustness_report(
        {"A": model}, "Toy-v0", out=tmp_path, perturbations=names, severities=[5], n_episodes=4, progress_bar=False
    )
    levels = pd.read_csv(tmp_path / "levels.csv").set_index("perturbation")
    assert levels["kind"].to_dict() == {
        "unperturbed": "unperturbed",
        **dict.fromkeys(names[:4], "sensor"),
        **dict.fromkeys(names[4:], "plant"),
    }
    assert (levels.loc[names, "iqm"] != levels.loc["unperturbed", "iqm"]).any()
    assert "| actuator_delay | Apply the action of some steps ago, and 0 until then | steps | 5 |" in text
    assert "figures/examples.png" in text


def test_models_of_stacked_observations_are_perturbed_before_the_stack(tmp_path):
    env = VecFrameStack(make_vec_env("Pendulum-v1", 1, env_kwargs=dict(max_episode_steps=5)), 3)
    model = PPO("MlpPolicy", env, n_steps=10, batch_size=10, seed=0, device="cpu")
    robustness_report(
        {"A": model}, "Pendulum-v1", out=tmp_path, perturbations=["vector_bias", "freeze"], severities=[5],
        env_kwargs=dict(max_episode_steps=5), n_episodes=3, deterministic=True, progress_bar=False,
    )  # fmt: skip
    records = pd.read_csv(tmp_path / "episodes.csv.xz").set_index("perturbation")["cost"]

    def sensor(env):
        return PerturbedVecEnv(env, "vector_bias", 5, seed=0)

    scenario = Scenario("biased", "Pendulum-v1", dict(max_episode_steps=5), sensor=sensor)
    expected = evaluate_scenarios(model, [scenario], 3, deterministic=True)
    np.testing.assert_allclose(records["vector_bias"], expected["cost"])
    assert (records["vector_bias"].to_numpy() != records["unperturbed"].to_numpy()).all()
