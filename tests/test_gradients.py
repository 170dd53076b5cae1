"""
Both gradient paths of ``train`` agree with the gradients of hand-written losses and with simulated gradients.

Dimension key: T horizon, N episodes, X state, Z TRVs, U action.
"""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import TINY_CRITIC, AtEveryEpoch, LinearProblem, assert_same_parameters, parameters
from stable_baselines3.common.logger import Logger
from torch.nn.functional import elu

from sb3_tdpg import TDPG, BatchedVecEnv
from sb3_tdpg.buffers import each_part
from sb3_tdpg.envs.lava import LavaEnv

T, N, Z = 3, 6, 2


def make_model(**kwargs):
    """Return a model in double precision with an epoch of random rollouts, in which two episodes end early."""
    estimator = kwargs.pop("mi_estimator", "logdet")
    model = TDPG(
        "TRVPolicy",
        BatchedVecEnv(LavaEnv(horizon=T), N),
        n_episodes=N,
        baseline="mean",
        learning_rate=1e-9,
        mi_estimator=estimator,
        mi_kwargs={} if estimator == "logdet" else TINY_CRITIC,
        policy_kwargs=dict(net_arch=dict(encoder=[5], action_head=[4]), optimizer_class=th.optim.SGD),
        seed=0,
        device="cpu",
        **kwargs,
    )
    model.set_logger(Logger(None, []))
    rng = np.random.default_rng(0)
    buffer = model.rollout_buffer
    buffer.reset()
    for t in range(T):
        alive = np.arange(N) if t < 2 else np.arange(N - 2)
        n = len(alive)
        buffer.add_step(
            np.full(n, t),
            alive,
            **{name: rng.normal(size=(n, 2)) for name in ("observations", "states", "noise", "trvs", "means")},
            stds=rng.uniform(0.5, 1, (n, Z)),
            actions=rng.normal(size=(n, 1)),
            costs=rng.normal(size=n),
        )
    buffer.full = True
    batch = buffer.episode_batch()
    batch = type(batch)(*(each_part(lambda v: v.double(), x) for x in batch))
    buffer.episode_batch = lambda **_: batch
    # SB3's preprocessing makes features single precision, which is exact for these observations.
    model.policy.double()
    model.estimator.double()
    return model, batch


def train_gradient(model):
    """Return the gradient of each parameter that ``train`` uses in its step."""
    model.train()
    return {name: p.grad.clone() for name, p in model.policy.named_parameters()}


def mlp(network, x, t):
    weights = [(layer.weight[t], layer.bias[t, 0]) for layer in network.mlp.layers]
    for weight, bias in weights[:-1]:
        x = elu(x @ weight + bias)
    weight, bias = weights[-1]
    return x @ weight + bias


def gaussian(outputs, floor, log_maximum):
    """Return the mean and the variance, which is an exponential that saturates at a maximum, plus a floor."""
    mean, log_var = outputs.chunk(2, dim=-1)
    return mean, 1 / ((-log_var).exp() + math.exp(-log_maximum)) + floor


def log_density(x, mean, var):
    return (-0.5 * (x - mean) ** 2 / var - 0.5 * (2 * math.pi * var).log()).sum(-1)


def encode(policy, batch, t, prev):
    mean, var = gaussian(mlp(policy.encoder, th.cat([prev, batch.observations[t]], -1), t), 1e-3, 4)
    return mean.tanh(), var


def log_pi(policy, batch, t, trv):
    return log_density(batch.actions[t], *gaussian(mlp(policy.action_head, trv, t), 1e-5, 8))


def advantages(batch):
    episode_cost = batch.costs.sum(0)
    return episode_cost - episode_cost.mean()  # (N,)


def score_objective(model, batch):
    """Return sum_t A (log q + log pi) at the stored samples, averaged over episodes."""
    total = 0.0
    for t in range(T):
        prev = batch.trvs[t - 1] if t > 0 else th.zeros(N, Z).double()
        log_prob = log_density(batch.trvs[t], *encode(model.policy, batch, t, prev))
        log_prob = log_prob + log_pi(model.policy, batch, t, batch.trvs[t])
        total = total + (batch.alive[t] * advantages(batch) * log_prob).sum()
    return total / N


def unrolled(model, batch):
    """Return TRVs, means and variances along the recurrence with fixed noise."""
    trv, out = th.zeros(N, Z).double(), []
    for t in range(T):
        mean, var = encode(model.policy, batch, t, trv)
        trv = mean + var.sqrt() * batch.noise[t]
        out.append((trv, mean, var))
    return out


def pathwise_objective(model, batch):
    """Return sum_t A log pi(u_t | x~_t(noise)), averaged over episodes."""
    total = 0.0
    for t, (trv, _, _) in enumerate(unrolled(model, batch)):
        total = total + (batch.alive[t] * advantages(batch) * log_pi(model.policy, batch, t, trv)).sum()
    return total / N


def logdet_penalty(model, batch):
    total = 0.0
    for t, (_, mean, var) in enumerate(unrolled(model, batch)):
        living = batch.alive[t] > 0
        mean, var = mean[living], var[living]
        covariance = th.cov(mean.T) + th.diag(var.mean(0))
        information = 0.5 * th.logdet(covariance) - 0.5 * var.log().sum(-1).mean()
        total = total + information.clamp(min=0)
    return total


@pytest.mark.parametrize("weight", [0, 75])
@pytest.mark.parametrize(("encoder_gradient", "objective"), [
    ("score", score_objective), ("pathwise", pathwise_objective),
])  # fmt: skip
def test_the_gradient_is_that_of_the_paper_s_objective_with_the_penalty_along_the_recurrence(
    encoder_gradient, objective, weight
):
    model, batch = make_model(beta=1 / weight if weight else math.inf, encoder_gradient=encoder_gradient)
    loss = objective(model, batch) + weight * logdet_penalty(model, batch)
    expected = th.autograd.grad(loss, list(model.policy.parameters()))
    for (name, gradient), value in zip(train_gradient(model).items(), expected, strict=True):
        np.testing.assert_allclose(gradient.numpy(), value.numpy(), rtol=1e-5, atol=1e-7, err_msg=name)
        assert gradient.abs().sum() > 0, name


def without_costs(model, batch):
    batch = batch._replace(costs=th.zeros_like(batch.costs))
    model.rollout_buffer.episode_batch = lambda **_: batch


@pytest.mark.parametrize("encoder_gradient", ["score", "pathwise"])
def test_the_information_moves_the_encoder_and_nothing_in_the_action_head(encoder_gradient):
    model, batch = make_model(beta=1 / 75, encoder_gradient=encoder_gradient)
    without_costs(model, batch)
    for name, gradient in train_gradient(model).items():
        if name.startswith("action_head"):
            assert gradient.abs().sum() == 0, name
        else:
            assert gradient.abs().sum() > 0, name


def test_the_score_of_the_action_does_not_flow_through_the_trvs():
    # If log q is left out of the loss, the encoder's gradient must be zero.
    model, _ = make_model(beta=math.inf, encoder_gradient="score")
    original = model.policy.trv_log_prob
    model.policy.trv_log_prob = lambda *args: original(*args).detach()
    for name, gradient in ((n, p.grad) for n, p in model.policy.named_parameters()):
        assert gradient is None, name
    model.train()
    for name, parameter in model.policy.named_parameters():
        reached = parameter.grad is not None and parameter.grad.abs().sum() > 0
        assert reached == name.startswith("action_head"), name


def test_the_critics_are_frozen_while_the_policy_learns():
    model, _ = make_model(beta=1 / 75, mi_estimator="mine")
    before = parameters(model.estimator)
    train_gradient(model)
    assert_same_parameters(parameters(model.estimator), before)


def test_the_norm_of_the_gradient_is_clipped_as_asked():
    norms = []
    for max_grad_norm in (None, 0.01):
        model, _ = make_model(beta=math.inf, max_grad_norm=max_grad_norm)
        norms.append(th.cat([g.flatten() for g in train_gradient(model).values()]).norm().item())
    assert norms[0] > 0.1
    assert norms[1] == pytest.approx(0.01, rel=1e-3)


def test_the_weight_of_the_penalty_is_one_over_beta():
    penalties = []
    for beta in (1 / 10, 1 / 40):
        model, batch = make_model(beta=beta)
        without_costs(model, batch)
        penalties.append(train_gradient(model)["encoder.mlp.layers.0.weight"])
    np.testing.assert_allclose(4 * penalties[0], penalties[1], rtol=1e-9)


def simulated_costs(policy, noises):
    """
    Return the cost of each episode of LinearProblem as a function of the parameters, in double precision.

    :param noises: x_0, and for each step the noise of the sensor, of the TRVs and of the action.
    """
    x, *steps = noises
    trv = th.zeros(len(x), policy.trv_dim).double()
    cost = 0.0
    for t, (sensor, trv_noise, action_noise) in enumerate(steps):
        y = x + LinearProblem.sensor_noise_std * sensor
        mean, var = gaussian(mlp(policy.encoder, th.cat([trv, y], -1), t), 1e-3, 4)
        trv = mean.tanh() + var.sqrt() * trv_noise
        mean, var = gaussian(mlp(policy.action_head, trv, t), 1e-5, 8)
        u = mean + var.sqrt() * action_noise
        cost = cost + (x[:, 0] - 1) ** 2 + 0.3 * u[:, 0] ** 2
        x = x + u
    return cost + 2 * (x[:, 0] + 0.5) ** 2


def gradients_of_epochs(n_epochs, n, **kwargs):
    """Return gradients of epochs with n episodes of LinearProblem, ``(n_epochs, parameters)``, and the fixed model."""
    gradients = []

    def remember(model):
        if model.epoch > 0:
            gradients.append(th.cat([p.grad.flatten().double() for p in model.policy.parameters()]))

    model = TDPG("TRVPolicy", BatchedVecEnv(LinearProblem(), n), n_episodes=n, beta=math.inf, learning_rate=1e-12,
                 device="cpu", **kwargs)  # fmt: skip
    model.learn((n_epochs + 1) * n * 2, callback=AtEveryEpoch(remember))
    assert len(gradients) == n_epochs
    return th.stack(gradients), model


@pytest.mark.parametrize("baseline", ["mean", "value"])
@pytest.mark.parametrize("encoder_gradient", ["score", "pathwise"])
def test_the_expected_gradient_is_that_of_the_true_expected_cost(encoder_gradient, baseline):
    small = dict(net_arch=dict(encoder=[4], action_head=[]), optimizer_class=th.optim.SGD)
    kwargs = dict(baseline=baseline, gae_lambda=1.0, encoder_gradient=encoder_gradient, policy_kwargs=small, seed=3)
    n_epochs = 12
    gradients, model = gradients_of_epochs(n_epochs, 10_000, **kwargs)
    model.policy.double()
    vector = th.nn.utils.parameters_to_vector(model.policy.parameters()).detach()
    m = 100_000
    noises = [th.randn(m, 1).double()]
    noises += [tuple(th.randn(m, d).double() for d in (1, 2, 1)) for _ in range(2)]
    directions = th.cat([gradients.mean(0)[None], th.randn(4, len(vector)).double()])
    directions /= directions.norm(dim=1, keepdim=True)
    with th.no_grad():
        for i, direction in enumerate(directions):
            sides = []
            for sign in (1, -1):
                th.nn.utils.vector_to_parameters(vector + sign * 1e-4 * direction, model.policy.parameters())
                sides.append(simulated_costs(model.policy, noises))
            differences = (sides[0] - sides[1]) / 2e-4
            truth, truth_error = differences.mean(), differences.std() / math.sqrt(m)
            along = gradients @ direction
            error = th.sqrt(along.var() / n_epochs + truth_error**2)
            assert abs(along.mean() - truth) < 4.5 * error, (i, along.mean(), truth, error)
            if i == 0:
                assert truth > 20 * error  # the test can detect an error of 20 % in the gradient


def test_the_actions_density_is_taken_at_the_unclipped_action():
    # A gradient at clipped actions would be biased if actions are outside the bounds.
    env = LavaEnv(horizon=2)
    env.action_space = spaces.Box(-0.05, 0.05, (1,), np.float32)
    model = TDPG("TRVPolicy", BatchedVecEnv(env, 50), n_episodes=50, beta=math.inf, seed=0, device="cpu").learn(100)
    assert np.abs(model.rollout_buffer.actions).max() > 0.5
