"""The loss functions agree with values that are computed by hand."""

import math

import pytest
import torch as th

from sb3_tdpg.losses import (
    clipped_policy_loss,
    cost_to_go,
    information_loss,
    normalized,
    policy_distance,
    policy_gradient_loss,
)


@pytest.mark.parametrize(("alive", "total"), [
    ([[1.0, 1.0], [1.0, 1.0]], 10 + 40 + 90 + 160),
    ([[1.0, 1.0], [0.0, 1.0]], 10 + 40 + 160),  # a dead step does not count, but its episode does
])  # fmt: skip
def test_the_policy_gradient_loss_sums_over_time_and_averages_over_episodes(alive, total):
    log_prob = th.tensor([[1.0, 2.0], [3.0, 4.0]], requires_grad=True)
    loss = policy_gradient_loss(log_prob, 10 * log_prob, th.tensor(alive))
    assert loss.item() == total / 2
    loss.backward()  # none of it flows into the advantages
    th.testing.assert_close(log_prob.grad, 10 * log_prob.detach() * th.tensor(alive) / 2)


def test_a_negative_estimate_of_the_information_is_neither_rewarded_nor_followed():
    information = th.tensor([0.5, -3.0, 0.25], requires_grad=True)
    loss = information_loss(information)
    loss.backward()
    assert loss.item() == 0.75
    assert information.grad.tolist() == [1.0, 0.0, 1.0]


def test_the_cost_to_go_sums_from_each_step_to_the_end_with_the_discount():
    costs = th.tensor([[1.0, 10.0], [2.0, 20.0], [4.0, 40.0]])
    assert cost_to_go(costs).tolist() == [[7, 70], [6, 60], [4, 40]]
    assert cost_to_go(costs, 0.5).tolist() == [[3, 30], [4, 40], [4, 40]]


def test_a_ratio_that_overflows_after_the_end_of_an_episode_leaves_the_clipped_loss_and_its_gradient_finite():
    alive = th.tensor([[1.0, 1.0], [1.0, 0.0]])
    log_prob = th.tensor([[0.1, 0.0], [0.0, 200.0]], requires_grad=True)
    for advantage in (-1.0, 1.0):
        loss = clipped_policy_loss(log_prob, th.zeros(2, 2), advantage * th.ones(2, 2), alive, 0.2)
        (gradient,) = th.autograd.grad(loss, log_prob)
        assert th.isfinite(loss)
        assert th.isfinite(gradient).all()
        assert gradient[1, 1] == 0


def test_the_clipped_loss_begins_with_the_policy_gradient():
    th.manual_seed(0)
    old, advantages, alive = th.randn(3, 4), th.randn(3, 4), (th.rand(3, 4) < 0.7).float()
    gradients = []
    for loss in (policy_gradient_loss, lambda log_prob, *rest: clipped_policy_loss(log_prob, old, *rest, 0.2)):
        log_prob = old.clone().requires_grad_()
        loss(log_prob, advantages, alive).backward()
        gradients.append(log_prob.grad)
    th.testing.assert_close(gradients[0], gradients[1])


@pytest.mark.parametrize(("ratio", "advantage", "moves"), [
    (1.5, 1.0, True),  # too likely and too expensive: the update makes it less likely
    (0.5, 1.0, False),  # too expensive, and already much less likely
    (1.5, -1.0, False),  # cheap, and already much more likely
    (0.5, -1.0, True),  # cheap, and too unlikely
    (1.1, -1.0, True),  # within the range
])  # fmt: skip
def test_a_sample_that_has_moved_far_enough_has_no_gradient(ratio, advantage, moves):
    log_prob = th.tensor([[ratio]]).log().requires_grad_()
    loss = clipped_policy_loss(log_prob, th.zeros(1, 1), th.tensor([[advantage]]), th.ones(1, 1), 0.2)
    loss.backward()
    assert (log_prob.grad.abs().item() > 0) == moves
    if moves:
        assert loss.item() == pytest.approx(ratio * advantage)


def test_normalised_advantages_count_living_steps_only():
    advantages = th.tensor([[1.0, 2.0], [6.0, 100.0]])
    alive = th.tensor([[1.0, 1.0], [1.0, 0.0]])
    result, std = normalized(advantages, alive)
    living = result[alive.bool()]
    assert living.mean().item() == pytest.approx(0, abs=1e-6)
    assert living.std(correction=0).item() == pytest.approx(1)
    assert std.item() == pytest.approx(th.tensor([1.0, 2.0, 6.0]).std(correction=0).item())


def test_the_distance_of_two_policies_is_that_of_the_new_one_from_the_old():
    log_ratio, alive = th.tensor([[1.0, -0.5, 0.0]]), th.tensor([[1.0, 1.0, 0.0]])
    kl, clipped = policy_distance(log_ratio - 3.0, th.full((1, 3), -3.0), alive, 0.5)
    assert kl.item() == pytest.approx(((math.e - 2) + (math.exp(-0.5) - 0.5)) / 2)
    assert clipped.item() == 0.5  # e - 1 is outside the range, 1 - e^-0.5 is inside
