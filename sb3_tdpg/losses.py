"""
The terms of TDPG's loss, and what they are computed from, as pure functions.

Dimension key: T horizon, N episodes. ``alive`` is 1 while an episode runs and 0 after its end.
"""

from __future__ import annotations

import torch as th


def policy_gradient_loss(log_prob: th.Tensor, advantages: th.Tensor, alive: th.Tensor) -> th.Tensor:
    """
    Return a surrogate loss whose gradient is the gradient of the expected cost (Equations 12 and 13).

    The paper multiplies every log-probability by the cost of the whole episode. Subtracting a term that does not depend
    on the sample at t, such as past costs or a baseline of the state, leaves the expected gradient unchanged.

    :param log_prob: log-probabilities at the *stored* samples, ``(T, N)``
    :param advantages: advantages of costs, not of rewards; a positive value means a higher cost than expected,
        ``(T, N)``
    :param alive: 1 while an episode runs, then 0, ``(T, N)``
    :return: the loss, a scalar
    """
    assert log_prob.shape == advantages.shape == alive.shape, (log_prob.shape, advantages.shape, alive.shape)
    return (alive * advantages.detach() * log_prob).sum(dim=0).mean()


def clipped_policy_loss(
    log_prob: th.Tensor, old_log_prob: th.Tensor, advantages: th.Tensor, alive: th.Tensor, clip_range: float
) -> th.Tensor:
    """
    Return PPO's surrogate loss (Schulman et al., 2017) for costs: the maximum of its unclipped and its clipped term.

    At ``log_prob == old_log_prob`` its gradient is that of :func:`policy_gradient_loss`. It allows several updates on
    the same rollouts: a sample has no gradient once its probability ratio has left the clip range in the direction that
    lowers the loss. The clip range is ``[1 - clip_range, 1 + clip_range]``.

    The other arguments are those of :func:`policy_gradient_loss`.

    :param old_log_prob: log-probabilities under the policy of the rollouts, ``(T, N)``
    :param clip_range: Largest change of the probability ratio from 1.
    :return: the loss, a scalar
    """
    shapes = {log_prob.shape, old_log_prob.shape, advantages.shape, alive.shape}
    assert len(shapes) == 1, shapes
    # After the end of an episode the ratio may overflow, and 0 * inf is NaN.
    ratio = th.exp(th.where(alive > 0, log_prob - old_log_prob.detach(), 0.0))
    clipped = ratio.clamp(1.0 - clip_range, 1.0 + clip_range)
    cost = advantages.detach()
    return (alive * th.maximum(cost * ratio, cost * clipped)).sum(dim=0).mean()


def policy_distance(
    log_prob: th.Tensor, old_log_prob: th.Tensor, alive: th.Tensor, clip_range: float
) -> tuple[th.Tensor, th.Tensor]:
    """
    Measure the distance of the policy from the policy of the rollouts, as SB3's PPO does.

    The arguments are those of :func:`clipped_policy_loss`.

    :return: approximate Kullback-Leibler divergence in nats (http://joschu.net/blog/kl-approx.html), and share of
        clipped samples; both are scalars
    """
    log_ratio = th.where(alive > 0, log_prob - old_log_prob, 0.0)
    n = alive.sum()
    kl = (th.exp(log_ratio) - 1.0 - log_ratio).sum() / n
    return kl, ((th.exp(log_ratio) - 1.0).abs() > clip_range).sum() / n


def normalized(
    advantages: th.Tensor, alive: th.Tensor, negligible: th.Tensor | float = 0.0
) -> tuple[th.Tensor, th.Tensor]:
    """
    Normalise advantages to mean 0 and variance 1 over all steps of running episodes.

    :param advantages: advantages of costs, ``(T, N)``
    :param alive: 1 while an episode runs, then 0, ``(T, N)``
    :param negligible: Largest standard deviation that counts as a rounding error; the advantages are then not divided
        by it.
    :return: the normalised advantages, ``(T, N)``, and their divisor; divide the other terms of the loss by it, too, so
        that they keep their weight
    """
    n = alive.sum()
    mean = (alive * advantages).sum() / n
    std = ((alive * (advantages - mean) ** 2).sum() / n).sqrt()
    std = th.where(std > negligible, std, th.ones_like(std))
    return (advantages - mean) / std, std


def information_loss(information: th.Tensor) -> th.Tensor:
    """
    Return the penalty of Equation 3: the sum over time of I[x_t; x~_t], with each term clamped at zero.

    Mutual information is never negative, but the bound of a frozen critic has no lower limit. Without the clamp, the
    policy would exploit such a critic.

    :param information: estimates in nats, ``(T,)``
    :return: the loss, a scalar
    """
    assert information.dim() == 1, information.shape
    return information.clamp(min=0.0).sum()


def cost_to_go(costs: th.Tensor, gamma: float = 1.0) -> th.Tensor:
    """
    Sum the discounted costs from each step to the end.

    :param costs: cost of each step, ``(T, N)``, zero after the end of an episode
    :return: costs-to-go, ``(T, N)``
    """
    result = th.empty_like(costs)
    running = th.zeros_like(costs[0])
    for t in range(costs.shape[0] - 1, -1, -1):
        running = costs[t] + gamma * running
        result[t] = running
    return result
