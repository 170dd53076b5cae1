"""
The loss of TDPG as pure functions, one per equation.

Dimension key: T horizon, N episodes. ``alive`` is 1 while an episode lasts and 0 after its end.
"""

from __future__ import annotations

import torch as th


def policy_gradient_loss(log_prob: th.Tensor, advantages: th.Tensor, alive: th.Tensor) -> th.Tensor:
    """
    Surrogate whose gradient is that of the expected cost (equation 12, and equation 13).

    The paper multiplies every log-probability with the whole episode's cost. Any ``advantages[t]`` with the same
    conditional expectation up to a function of what precedes the sample at t gives the same expected gradient: the cost
    to come, less a baseline of the state.

    :param log_prob: log-probabilities at the *stored* samples, ``(T, N)``
    :param advantages: costs (not rewards), positive is worse than expected, ``(T, N)``
    :param alive: ``(T, N)``
    :return: scalar
    """
    assert log_prob.shape == advantages.shape == alive.shape, (log_prob.shape, advantages.shape, alive.shape)
    return (alive * advantages.detach() * log_prob).sum(dim=0).mean()


def clipped_policy_loss(
    log_prob: th.Tensor, old_log_prob: th.Tensor, advantages: th.Tensor, alive: th.Tensor, clip_range: float
) -> th.Tensor:
    """
    PPO's surrogate (Schulman et al., 2017) for costs: the larger of the plain and of the clipped one.

    At ``log_prob == old_log_prob`` its gradient is that of :func:`policy_gradient_loss`. It may be descended several
    times on the same rollouts: a sample whose ratio has left ``[1 - clip_range, 1 + clip_range]`` in the direction of
    its advantage has no gradient any more.

    :param log_prob: of the policy that is being trained, ``(T, N)``
    :param old_log_prob: of the policy that made the rollouts, ``(T, N)``
    :param advantages: costs (not rewards), positive is worse than expected, ``(T, N)``
    :param alive: ``(T, N)``
    :param clip_range: How far the ratio of the probabilities may go from 1.
    :return: scalar
    """
    shapes = {log_prob.shape, old_log_prob.shape, advantages.shape, alive.shape}
    assert len(shapes) == 1, shapes
    # What is stored after the end of an episode is no sample of the policy: its ratio may overflow, and 0 * inf is NaN.
    ratio = th.exp(th.where(alive > 0, log_prob - old_log_prob.detach(), 0.0))
    clipped = ratio.clamp(1.0 - clip_range, 1.0 + clip_range)
    cost = advantages.detach()
    return (alive * th.maximum(cost * ratio, cost * clipped)).sum(dim=0).mean()


def normalized(
    advantages: th.Tensor, alive: th.Tensor, negligible: th.Tensor | float = 0.0
) -> tuple[th.Tensor, th.Tensor]:
    """
    Bring advantages to mean 0 and variance 1 over all steps of living episodes.

    :param advantages: ``(T, N)``
    :param alive: ``(T, N)``
    :param negligible: A standard deviation up to this is rounding: the advantages are not scaled up then.
    :return: the advantages ``(T, N)``, and the standard deviation that they were divided by: what is added to their
        loss must be divided by it, too, if its weight is to stay the same
    """
    n = alive.sum()
    mean = (alive * advantages).sum() / n
    std = ((alive * (advantages - mean) ** 2).sum() / n).sqrt()
    std = th.where(std > negligible, std, th.ones_like(std))
    return (advantages - mean) / std, std


def information_loss(information: th.Tensor) -> th.Tensor:
    """
    The penalty of equation 3: the sum over time of I[x_t; x~_t], none below zero.

    Mutual information is never negative, but the bound of a frozen critic is unbounded below. Without the clamp the
    policy would descend there.

    :param information: estimates in nats, ``(T,)``
    :return: scalar
    """
    assert information.dim() == 1, information.shape
    return information.clamp(min=0.0).sum()


def cost_to_go(costs: th.Tensor, gamma: float = 1.0) -> th.Tensor:
    """
    Discounted sum of the costs from each step to the end.

    :param costs: ``(T, N)``, zero after the end of an episode
    :return: ``(T, N)``
    """
    result = th.empty_like(costs)
    running = th.zeros_like(costs[0])
    for t in range(costs.shape[0] - 1, -1, -1):
        running = costs[t] + gamma * running
        result[t] = running
    return result
