"""Each kind of problem has its defaults, and some arguments determine others."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import lava_env, tiny_tdpg, toy_vec_env, words

from sb3_tdpg import TDPG, TRVPolicy
from sb3_tdpg.envs.scenarios import BALL_CATCH
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.presets import DEFAULTS, discount_of, implied, preset_of

IMAGE = spaces.Box(0, 255, (3, 20, 16), np.uint8)


def test_the_default_discount_looks_ahead_for_a_share_of_the_horizon():
    assert [discount_of(horizon) for horizon in (50, 200, 500, 1000, 27_000)] == [0.9, 0.96, 0.984, 0.992, 0.995]
    assert TDPG("TRVPolicy", "Pendulum-v1").gamma == 0.96
    assert TDPG("TRVPolicy", "Pendulum-v1", gamma=0.8).gamma == 0.8


def test_the_kind_of_problem_decides_the_defaults():
    vector, image = spaces.Box(-1, 1, (3,)), spaces.Box(0, 255, (3, 64, 64), np.uint8)
    assert [preset_of(vector, t) for t in (None, 49, 50)] == ["vector", "vector", "long"]
    assert preset_of(image, 1000) == "image"
    model = TDPG("TRVPolicy", "Pendulum-v1")
    for name in ("epoch_steps", "batch_size", "n_epochs", "gae_lambda", "baseline", "bptt_steps"):
        assert getattr(model, name) == getattr(DEFAULTS["long"], name), name
    assert model.beta == math.inf


def test_vectors_are_learnt_from_with_one_update_an_epoch():
    model = TDPG(env="Lava-v0", device="cpu").learn(2500)
    assert model.epoch == 1
    assert isinstance(model.policy, TRVPolicy)
    assert (model.beta, model.n_episodes, model.n_epochs, model.batch_size) == (1 / 75, 500, 1, None)
    assert (model.clip_range(1.0), model.encoder_gradient, model.mi_estimator) == (math.inf, "score", "logdet")
    assert not model.normalize_advantage
    assert [model.lr_schedule(progress) for progress in (1.0, 0.0)] == pytest.approx([2e-3, 2e-5])
    assert model.rollout_buffer.n_envs == model.env.num_envs == 500


def test_images_are_learnt_from_with_ppos_passes_a_nuisance_and_a_bottleneck():
    model = TDPG("TRVPolicy", "BallCatch-v0", device="cpu")
    assert (model.beta, model.cost_limit, model.mi_estimator) == ("auto", "99.8%", "logdet")
    assert (model.nuisance, type(model.env).__name__) == ("auto", "NuisanceVecEnv")
    assert (model.n_episodes, model.n_epochs, model.batch_size, model.clip_range(1.0)) == (160, 4, 40 * 25, 0.2)
    assert (model.encoder_gradient, model.normalize_advantage, model.baseline) == ("pathwise", True, "value")
    policy = model.policy
    assert (policy.features_dim, policy.trv_dim, policy.gate, policy.time_varying) == (256, 32, True, False)
    assert any(isinstance(layer, th.nn.LayerNorm) for layer in policy.features_extractor.cnn)
    assert model.env.num_envs == 160


def test_learning_without_a_number_of_steps_takes_the_default(monkeypatch):
    asked = []
    monkeypatch.setattr(
        "stable_baselines3.common.on_policy_algorithm.OnPolicyAlgorithm.learn", lambda _, n, *__: asked.append(n)
    )
    TDPG("TRVPolicy", "Lava-v0", device="cpu").learn()
    TDPG("TRVPolicy", "BallCatch-v0", device="cpu").learn()
    assert asked == [1_000_000, 300_000]


def test_the_one_line_training_in_miniature():
    """Train two epochs on PyBullet's images with the line from the documentation, and check two rows of the table."""
    model = TDPG("TRVPolicy", "BallCatch-v0", n_episodes=8, device="cpu").learn(2 * 8 * 25)
    assert model.epoch == 2
    records = evaluate_scenarios(model, BALL_CATCH[:2], 4)
    assert np.isfinite(records["cost"]).all()


def test_depth_images_are_learnt_from_with_larger_epochs_and_the_papers_grasping_network():
    """Train two epochs of simulated grasps with the line from the documentation."""
    model = TDPG("TRVPolicy", "PandaGrasp-v0", n_episodes=16, device="cpu").learn(2 * 16)
    assert model.epoch == 2
    assert (model.beta, model.cost_limit, model.mi_estimator) == ("auto", "95%", "logdet")
    assert (model.n_epochs, model.batch_size, model.clip_range(1.0), model.policy.trv_dim) == (4, 16, 0.2, 16)
    model.env.close()
    model = TDPG("TRVPolicy", "PandaGrasp-v0", device="cpu")
    assert (model.n_episodes, model.batch_size, model.env.num_envs) == (400, 200, 400)


@pytest.mark.parametrize(("given", "others"), [
    ({}, {}),
    (dict(cost_limit=3.0), dict(beta="auto")),
    (dict(cost_limit="90%", beta=0.5), {}),  # this is not allowed
    (dict(beta=0.5), dict(cost_limit=None)),
    (dict(beta="auto", cost_limit=None), {}),
    (dict(cost_limit=3.0, beta=None), dict(beta="auto")),
    (dict(n_episodes=20, epoch_steps=None), dict(epoch_steps=None)),
    (dict(epoch_steps=100), dict(n_episodes=None)),
    (dict(epoch_steps=100, n_episodes=20), {}),  # this is not allowed either
], ids=words)  # fmt: skip
def test_a_limit_means_auto_and_episodes_exclude_steps(given, others):
    assert implied(given) == others


@pytest.mark.parametrize(("before", "change", "after"), [
    (dict(max_grad_norm=0.5), dict(max_grad_norm=None), dict(max_grad_norm=math.inf)),  # no clipping
    (dict(learning_rate=1e-3), dict(custom_objects={"learning_rate": 3e-5}), dict(learning_rate=3e-5)),
    (dict(n_episodes=20), dict(n_episodes=40), dict(n_episodes=40, batch_size=None)),
    (dict(n_episodes=20), dict(epoch_steps=100), dict(n_episodes=None, epoch_steps=100)),
    (dict(n_episodes=None, epoch_steps=100), dict(n_episodes=20), dict(n_episodes=20, epoch_steps=None)),
], ids=words)  # fmt: skip
def test_a_setting_may_be_changed_when_a_model_is_loaded(before, change, after, tmp_path):
    tiny_tdpg(**before).save(tmp_path / "model")
    model = TDPG.load(tmp_path / "model", env=lava_env(), **change, device="cpu")
    assert {name: getattr(model, name) for name in after} == after
    assert model.learn(100).epoch == 1
    assert model._minibatches(model.rollout_buffer.episode_batch()) == [slice(None)]  # the whole epoch


def test_a_default_size_of_a_minibatch_follows_the_epoch_and_a_given_one_is_checked(tmp_path):
    env = toy_vec_env(4, horizon=3, observation_space=spaces.Box(0, 255, (3, 16, 16), np.uint8))
    small = TDPG(env=env, n_episodes=4, device="cpu")
    small.save(tmp_path / "small")
    assert small.batch_size == 4 * 3
    assert TDPG.load(tmp_path / "small", env=env, n_episodes=160, device="cpu").batch_size == 40 * 3
    with pytest.raises(ValueError, match="batch_size=5000 must be between"):
        TDPG.load(tmp_path / "small", env=env, batch_size=5000, device="cpu")
