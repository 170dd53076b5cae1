"""Baselines lower the variance of the gradient but do not change its expectation."""

import pytest
import torch as th

from sb3_tdpg.advantages import (
    BASELINES,
    ValueFunction,
    _ridge,
    episode_mean_advantages,
    get_baseline,
    regression_advantages,
)
from sb3_tdpg.losses import cost_to_go

T, N = 3, 400


@pytest.fixture
def rollouts():
    states = th.randn(T, N, 2)
    costs = 10 * states[..., 0] ** 2 + 5 * (states[..., 1] > 0) + th.randn(T, N)
    return costs, states, th.ones(T, N)


def test_the_papers_baseline_is_the_whole_episodes_cost_less_the_mean_at_every_step():
    costs = th.tensor([[1.0, 2.0], [3.0, 8.0]])
    advantages = episode_mean_advantages(costs, th.zeros(2, 2, 1), th.ones(2, 2), 1.0)
    assert advantages.tolist() == [[-3, 3], [-3, 3]]


def test_the_value_baseline_uses_the_cost_to_come_only(rollouts):
    costs, states, alive = rollouts
    expensive_start = costs.clone()
    expensive_start[0] += 1000 * th.rand(N)
    first = regression_advantages(costs, states, alive, 1.0)
    second = regression_advantages(expensive_start, states, alive, 1.0)
    th.testing.assert_close(first[1:], second[1:])
    assert not th.allclose(first[0], second[0])


def test_the_value_baseline_explains_what_the_state_tells_of_the_cost(rollouts):
    costs, states, alive = rollouts
    last = regression_advantages(costs, states, alive, 1.0)[-1]
    assert last.var() < 0.35 * costs[-1].var()
    assert abs(last.mean()) < 0.3


@pytest.fixture
def long_rollouts():
    """Return six episodes of a random walk, of which half end early; the state determines the cost exactly."""
    states = 0.95 ** th.arange(200.0)[:, None, None] * th.randn(6, 1) + 0.3 * th.randn(200, 6, 1)
    alive = th.ones(200, 6)
    alive[120:, ::2] = 0.0
    return alive * states[..., 0] ** 2, states, alive


def test_a_long_horizon_with_few_episodes_has_enough_for_one_regression_that_all_steps_share(long_rollouts):
    costs, states, alive = long_rollouts
    living = alive > 0
    advantages = regression_advantages(costs, states, alive, 0.5, 0.0)[living]
    targets = cost_to_go(costs, 0.5)[living]
    assert advantages.var() < 0.3 * targets.var()
    # With a separate fit for each step, three episodes would have to predict the costs of three other episodes.
    per_step = [regression_advantages(*(x[t : t + 2] for x in (costs, states, alive)), 0.5, 0.0)[0] for t in range(198)]
    assert advantages.var() < 0.5 * th.stack(per_step)[living[:198]].var()


def test_the_end_of_a_long_horizon_is_told_from_its_middle():
    costs, alive = th.ones(200, 6), th.ones(200, 6)
    advantages = regression_advantages(costs, th.randn(200, 6, 1), alive, 0.9)
    assert advantages.abs().max() < 1.0  # the future cost falls from 10 to 1 over the last steps


@pytest.mark.parametrize(("fixture", "more"), [("rollouts", 1e4), ("long_rollouts", 50.0)])
def test_an_episodes_own_cost_never_enters_its_own_baseline(fixture, more, request):
    costs, states, alive = request.getfixturevalue(fixture)
    baseline = cost_to_go(costs) - regression_advantages(costs, states, alive)
    changed = costs.clone()
    changed[:100, 2] += more
    new_baseline = cost_to_go(changed) - regression_advantages(changed, states, alive)
    th.testing.assert_close(new_baseline[:, 2], baseline[:, 2], rtol=0, atol=0.02)
    assert (new_baseline[:, 3] - baseline[:, 3]).abs().max() > 1  # but it changes the baselines of the other half


def test_with_lambda_zero_the_advantage_is_the_residual_of_one_step():
    # The state predicts the last cost exactly, so this cost must not change the advantage of the first step.
    states = th.randn(2, N, 1)
    states[1] = states[0]
    costs = th.stack([th.zeros(N), 50 * states[1, :, 0]])
    advantages = regression_advantages(costs, states, th.ones(2, N), gae_lambda=0.0)
    assert advantages.abs().median() < 1
    assert costs[1].abs().median() > 10


@pytest.mark.parametrize("name", ["mean", "regression"])
def test_the_discount_weights_later_costs(name, rollouts):
    costs, states, alive = rollouts
    late = costs.clone()
    late[-1] += 100 * th.rand(N)
    differences = [
        (BASELINES[name](late, states, alive, gamma) - BASELINES[name](costs, states, alive, gamma))[0].abs().max()
        for gamma in (1.0, 0.1)
    ]
    assert differences[1] < 0.1 * differences[0]


def test_dead_episodes_do_not_enter_the_regression(rollouts):
    costs, states, alive = rollouts
    alive[1:, ::3] = 0.0
    costs = costs * alive
    garbage = th.where(alive[..., None] > 0, states, 50 * th.randn_like(states))
    zeros = th.where(alive[..., None] > 0, states, th.zeros_like(states))
    living = alive > 0
    first, second = (regression_advantages(costs, x, alive, 1.0)[living] for x in (garbage, zeros))
    assert th.isfinite(first).all()
    # Dead states may change the positions of the basis functions, but not the quality of the fit.
    assert first.var().item() == pytest.approx(second.var().item(), rel=0.1)


@pytest.mark.parametrize("n_episodes", [2, 3])
def test_few_episodes_with_a_constant_state_of_which_nobody_is_left_give_finite_advantages(n_episodes):
    costs, alive = th.rand(T, n_episodes), th.ones(T, n_episodes)
    alive[2] = 0.0
    for name in ("mean", "regression"):
        advantages = get_baseline(name)(costs * alive, th.zeros(T, n_episodes, 2), alive, 1.0)
        assert advantages.shape == (T, n_episodes)
        assert th.isfinite(advantages).all()


def test_the_value_of_a_state_far_from_all_others_is_not_extrapolated():
    n = 400
    states = th.linspace(-1, 1, n)[None, :, None].clone()
    costs = 10 * states[..., 0]
    states[0, 0] = 5.0  # the other fold predicts it with states within [-1, 1]; extrapolated linearly, it would be 40
    baseline = costs - regression_advantages(costs, states, th.ones(1, n), 1.0, 1.0)
    assert baseline[0, 0] == pytest.approx(10.0)
    assert baseline.abs().max() <= 10.0


def test_the_ridge_regression_is_that_of_its_penalty_and_weights():
    features, targets = th.tensor([[[2.0], [4.0], [3.5]]]), th.tensor([[1.0, 5.0, 100.0]])
    weight = th.tensor([[1.0, 1.0, 0.0]])  # the third sample is only predicted
    # The deviations from the means 3 and 3 are (-1, 1) and (-2, 2), which gives a slope of 4 / (2 + 0.5).
    expected = [3 - 1.6, 3 + 1.6, 3 + 0.5 * 1.6]
    assert _ridge(features, targets, weight)[0].tolist() == pytest.approx(expected)


@pytest.mark.parametrize("gamma", [0.8, 0.99, 1.0])
def test_the_value_network_is_told_the_discounted_time_that_is_left(gamma):
    value = ValueFunction(2, 20)
    value.network.forward = lambda inputs: inputs[..., -1:]
    left = cost_to_go(th.ones(20, 3), gamma)
    th.testing.assert_close(value(th.randn(20, 3, 2), gamma), left / left[0])
    # If all episodes have ended early, the time left is still counted up to the horizon.
    th.testing.assert_close(value(th.randn(5, 3, 2), gamma), (left / left[0])[:5])
