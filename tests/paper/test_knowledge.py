"""What the TRVs know, by regression."""

import numpy as np
import pytest
import torch as th

from sb3_tdpg import TDPG, make_episodes_env
from sb3_tdpg.paper import knowledge


def test_the_regression_on_the_trvs_finds_what_is_in_them_and_nothing_else():
    rng = np.random.default_rng(0)
    trvs = rng.standard_normal((3, 800, 2))
    told = trvs @ np.array([[1.0], [-2.0]]) + 4.0
    noisy = told + np.sqrt(5.0) * rng.standard_normal(told.shape)  # as much noise as there is signal
    assert knowledge._r2(trvs, told) == pytest.approx(1.0)
    assert knowledge._r2(trvs, noisy) == pytest.approx(0.5, abs=0.05)
    assert knowledge._r2(trvs, rng.standard_normal(told.shape)) < 0.05
    few, many = rng.standard_normal((3, 40, 15)), rng.standard_normal((3, 40, 1))
    assert knowledge._r2(few, many) < 0.1, "15 coefficients fit 20 episodes by chance, and must not count"


class Photometer:
    """A model whose first TRV is the mean brightness of the image, and whose others are a random code of the wall."""

    horizon = 25
    device = "cpu"

    def __init__(self):
        env = make_episodes_env("BallCatch-v0", 1, env_kwargs=dict(renderer="fast"))
        self.action_space, self.observation_space = env.action_space, env.observation_space

    def get_vec_normalize_env(self):
        return None

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        brightness = observation.mean(axis=(1, 2, 3))[:, None]
        hue = (observation[:, 0, 20:40].mean(axis=(1, 2)) / (1 + observation[:, 2, 20:40].mean(axis=(1, 2)))).round(1)
        code = np.stack([np.random.default_rng(int(10 * h)).standard_normal(7) for h in hue])
        return np.zeros((len(observation), 1), np.float32), (np.concatenate([brightness, code], axis=1),)


def test_the_knowledge_is_what_a_model_shows_and_a_code_of_the_wall_is_no_colour():
    known = knowledge.trv_knowledge(Photometer())
    assert known["brightness"] > 0.5
    assert known["position"] < 0.2


def test_the_knowledge_of_a_ball_catching_policy_is_measured_without_a_trace():
    model = TDPG("TRVPolicy", "BallCatch-v0", n_episodes=4, seed=0, device="cpu")
    th.manual_seed(3)
    first = knowledge.trv_knowledge(model, n_walls=2, n_episodes=10)
    after = th.rand(1)
    assert set(first) == {"position", "brightness", "wall"}
    assert all(0 <= value <= 1 for value in first.values())
    assert knowledge.trv_knowledge(model, n_walls=2, n_episodes=10) == first
    th.manual_seed(3)
    assert th.rand(1) == after


def test_the_information_of_faint_trvs_is_less_and_nearly_none_behind_much_noise():
    nats = []
    for log_var in (-3.0, 0.0, 12.0):
        # Without a gate, which keeps the noise of the last TRVs.
        kwargs = dict(encoder_log_var_init=log_var, trv_dim=4, gate=False)
        model = TDPG("TRVPolicy", "BallCatch-v0", n_episodes=4, policy_kwargs=kwargs, seed=0, device="cpu")
        nats.append(knowledge.pooled_information(model, n_episodes=20))
    assert nats[0] > nats[1] > nats[2] > 0
    assert nats[2] < 1
