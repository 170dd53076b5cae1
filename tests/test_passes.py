"""Updates make several passes over an epoch's rollouts, and missing arguments get their defaults."""

import math
from itertools import permutations
from unittest.mock import Mock

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import parameters, tiny_tdpg, toy_vec_env, train_epochs

from sb3_tdpg import TDPG

IMAGE = spaces.Box(0, 255, (3, 20, 16), np.uint8)
PASSES = dict(n_epochs=3, batch_size=40, clip_range=0.2)  # a minibatch has 8 of 20 episodes


@pytest.mark.parametrize("encoder_gradient", ["score", "pathwise"])
def test_an_epoch_makes_so_many_passes_over_minibatches_of_whole_episodes(encoder_gradient, monkeypatch):
    model = tiny_tdpg(**PASSES, encoder_gradient=encoder_gradient)
    evaluate = Mock(wraps=model.policy.evaluate_episodes)
    monkeypatch.setattr(model.policy, "evaluate_episodes", evaluate)
    train_epochs(model, 1)
    assert [call.args[0].costs.shape[1] for call in evaluate.call_args_list] == [7, 7, 6] * 3
    assert model.epoch == 1
    assert model._n_updates == 3


def test_every_episode_is_in_one_minibatch_of_a_pass_and_none_is_left_alone():
    model = train_epochs(tiny_tdpg(n_episodes=17, batch_size=40, clip_range=0.2), 1)
    parts = model._minibatches(model.rollout_buffer.episode_batch())
    assert sorted(len(part) for part in parts) == [5, 6, 6]
    columns = th.cat(list(parts)).tolist()
    assert sorted(columns) == list(range(17)) != columns


@pytest.mark.parametrize(("env", "settings"), [
    (dict(n_envs=2, horizon=100), dict(epoch_steps=200, bptt_steps=100)),
    (dict(n_envs=2, horizon=40, observation_space=IMAGE), dict(n_episodes=4, batch_size=32)),
    (dict(n_envs=1, horizon=3), dict(n_episodes=5, batch_size=6, clip_range=0.2)),
])  # fmt: skip
def test_a_minibatch_has_two_columns_at_least(env, settings):
    model = TDPG(env=toy_vec_env(**env), device="cpu", seed=0, **settings)
    assert model.learn(model.epoch_size).epoch == 1


@pytest.mark.parametrize("beta", [math.inf, 1 / 75])
def test_one_pass_without_clipping_and_one_with_it_are_the_same_step(beta):
    trained = []
    for clip_range in (math.inf, 0.2):
        model = train_epochs(tiny_tdpg(beta=beta, clip_range=clip_range), 1)
        trained.append(parameters(model.policy))
    for name, value in trained[0].items():
        th.testing.assert_close(value, trained[1][name], msg=name)


@pytest.mark.parametrize("beta", [math.inf, 1 / 75])
def test_normalising_the_advantages_scales_the_gradient_of_the_whole_objective(beta):
    """The penalty is divided by the same number as the advantages, so that beta keeps its meaning."""
    gradients = []
    for normalize in (False, True):
        model = train_epochs(tiny_tdpg(beta=beta, normalize_advantage=normalize), 1)
        gradients.append(th.cat([p.grad.flatten() for p in model.policy.parameters()]))
    cosine = th.nn.functional.cosine_similarity(*gradients, dim=0)
    # The cosine is not 1, because subtracting the mean of the advantages changes the noise of the gradient.
    assert cosine.item() > 0.98
    assert gradients[0].norm() > 2 * gradients[1].norm()


def test_passes_stop_where_the_clipping_says():
    """With clipping, the policy stays near the one that made the rollouts, even after many passes over them."""
    distances = []
    for clip_range in (0.05, 1e9):
        model = tiny_tdpg(beta=math.inf, n_epochs=60, clip_range=clip_range, learning_rate=1e-2)
        _, callback = model._setup_learn(1)
        model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
        batch = model.rollout_buffer.episode_batch()
        with th.no_grad():
            before = model.policy.evaluate_episodes(batch, "score")[0]
        model.train()
        with th.no_grad():
            distances.append((model.policy.evaluate_episodes(batch, "score")[0] - before).abs().mean().item())
    assert distances[0] < 0.3 * distances[1]


def test_the_clip_range_may_follow_the_progress():
    asked = []
    model = tiny_tdpg(clip_range=lambda progress: asked.append(progress) or 0.1 + 0.1 * progress)
    asked.clear()
    train_epochs(model, 4)
    assert len(asked) == 4
    assert 0 <= asked[-1] < asked[0] < 1
    assert asked == sorted(asked, reverse=True)


# In single precision the sums of the permutations differ in the last digit.
SAME_SUM = [(0.0, *costs) for costs in permutations([1 / 3, 7 / 3, 11 / 3])]


@pytest.mark.parametrize(("costs", "baseline"), [(np.ones((6, 4)), "regression"), (np.array(SAME_SUM), "mean")])
def test_equal_costs_do_not_blow_up_the_penalty(costs, baseline):
    settings = dict(beta=1.0, normalize_advantage=True, baseline=baseline)
    model = tiny_tdpg(toy_vec_env(n_envs=6, horizon=4), n_episodes=6, **settings)
    _, callback = model._setup_learn(1)
    model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    model.rollout_buffer.costs[:] = costs.T
    model.train()
    assert model.logger.name_to_value["train/grad_norm"] < 100


def test_an_epoch_logs_what_it_did():
    model = tiny_tdpg(n_episodes=40, beta=1 / 75, n_epochs=2, batch_size=100, clip_range=0.2, mi_estimator="logdet")
    modes = []
    step = model.policy.optimizer.step
    model.policy.optimizer.step = lambda *_: (modes.append(model.policy.training), step())[1]
    train_epochs(model, 1)
    logged = model.logger.name_to_value
    cost = model.rollout_buffer.episode_costs.mean()
    assert logged["train/objective"] == pytest.approx(cost + 75 * model.information.sum(), rel=1e-5)
    assert logged["train/n_updates"] == 2
    assert logged["train/trv_std"] == pytest.approx(model.rollout_buffer.stds.mean(), rel=1e-5)
    # The minimised loss is the sum of both parts; the penalty is divided in the same way as the advantages.
    assert logged["train/loss"] > logged["train/policy_loss"]
    assert {f"train/{name}" for name in ("mi_loss", "mi_coef", "grad_norm")} <= set(logged)
    # The distance of the policy from the policy of the rollouts.
    assert 0 < logged["train/approx_kl"] < 1
    assert 0 <= logged["train/clip_fraction"] < 1
    assert "tensorboard" in model.logger.name_to_excluded["train/n_updates"]
    assert modes == [True] * 4


@pytest.mark.parametrize(("target_kl", "n_steps"), [(1e-9, 1), (math.inf, 8)])
def test_the_passes_end_when_the_policy_has_moved_far(target_kl, n_steps):
    model = tiny_tdpg(
        n_episodes=40, n_epochs=4, batch_size=100, clip_range=0.2, learning_rate=1e-2, target_kl=target_kl
    )
    steps = []
    step = model.policy.optimizer.step
    model.policy.optimizer.step = lambda *_: (steps.append(1), step())[1]
    train_epochs(model, 1)
    assert len(steps) == n_steps


def test_a_small_weight_is_a_penalty_too():
    model = train_epochs(tiny_tdpg(n_episodes=40, beta=10.0, mi_estimator="logdet"), 1)
    assert model.logger.name_to_value["train/mi_loss"] == pytest.approx(0.1 * model.information.sum(), rel=1e-4)
