"""
Advantages: costs minus a baseline, which weight the log-probabilities in the policy gradient.

Dimension key: T horizon, N episodes, X state, F features.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch as th

from sb3_tdpg.losses import cost_to_go
from sb3_tdpg.networks import MAX_TIME_VARYING_HORIZON

N_CENTRES = 20
# For a regression that all time steps share: it has more samples, and they are further apart.
N_SHARED_CENTRES = 100

AdvantageFunction = Callable[..., th.Tensor]
"""``(costs, states, alive, gamma, gae_lambda) -> advantages``, see the functions below."""


def episode_mean_advantages(
    costs: th.Tensor, states: th.Tensor, alive: th.Tensor, gamma: float = 1.0, gae_lambda: float = 1.0
) -> th.Tensor:
    """
    Subtract the batch mean from the cost of the whole episode, as in the paper.

    :param costs: ``(T, N)``
    :param states: ``(T, N, X)``, unused
    :param alive: ``(T, N)``
    :param gamma: discount
    :param gae_lambda: unused: there is no value function
    :return: ``(T, N)``
    """
    episode_cost = cost_to_go(costs, gamma)[0]
    return (episode_cost - episode_cost.mean()).expand_as(costs)


def value_advantages(
    costs: th.Tensor, states: th.Tensor, alive: th.Tensor, gamma: float = 1.0, gae_lambda: float = 1.0
) -> th.Tensor:
    """
    Estimate advantages (GAE, Schulman et al., 2016) with a value V_t(x_t) of the true state, one regression per step.

    Beyond a horizon of 50 all time steps share one regression on the state and the remaining horizon: a few long
    episodes have many samples, but few at each step.

    With ``gae_lambda=1`` this is the cost-to-go minus its regression on the state. Only the baseline uses the true
    state, and x_t precedes the noise of step t, so that the gradient stays unbiased. Each half of the episodes is
    predicted from the other half: no episode's own cost enters its baseline. A smaller ``gae_lambda`` replaces later
    costs by V, which has less noise but ignores the policy's memory: it credits the TRVs too little for what they carry
    from step to step.

    :param costs: ``(T, N)``
    :param states: x_t, ``(T, N, X)``
    :param alive: ``(T, N)``
    :param gamma: discount
    :param gae_lambda: 1: the observed costs; 0: the value of the next state instead of all later costs
    :return: ``(T, N)``
    """
    targets = cost_to_go(costs, gamma)
    fold = (th.arange(costs.shape[1], device=costs.device) % 2).expand_as(costs)
    if len(costs) <= MAX_TIME_VARYING_HORIZON:
        values = _held_out_predictions(_state_features(states, alive), targets, alive, fold)
    else:
        values = _shared_values(states, targets, alive, fold, gamma)
    next_values = th.cat([values[1:], th.zeros_like(values[:1])])
    residuals = costs + gamma * next_values - values
    return cost_to_go(residuals, gamma * gae_lambda)


def _shared_values(states: th.Tensor, targets: th.Tensor, alive: th.Tensor, fold: th.Tensor, gamma: float) -> th.Tensor:
    """Regress on the state and the remaining horizon, for all time steps at once: ``(T, N)``."""
    # With a discount this distinguishes only the last steps.
    to_go = cost_to_go(th.ones_like(targets), gamma) / len(targets)
    living = alive.flatten().nonzero()[:, 0]
    # An order without a period, because the centres are taken at regular intervals.
    golden = (math.sqrt(5) - 1) / 2
    order = living[th.argsort(th.arange(len(living), dtype=th.float64, device=living.device) * golden % 1)]
    inputs = th.cat([states, to_go[..., None]], dim=-1)
    inputs, outputs, fold = (x.flatten(0, 1)[order][None] for x in (inputs, targets, fold))  # (1, S, ...)
    weight = th.ones_like(outputs)
    features = _state_features(inputs, weight, N_SHARED_CENTRES)
    values = th.zeros_like(targets).flatten()
    values[order] = _held_out_predictions(features, outputs, weight, fold)[0]
    return values.view_as(targets)


def _held_out_predictions(features: th.Tensor, targets: th.Tensor, weight: th.Tensor, fold: th.Tensor) -> th.Tensor:
    """Predict each of two folds from the other: ``(T, N)``."""
    predictions = th.zeros_like(targets)
    for held_out in (0, 1):
        predictions += (fold == held_out) * weight * _ridge(features, targets, weight * (fold != held_out))
    return predictions


def _ridge(features: th.Tensor, targets: th.Tensor, weight: th.Tensor, penalty: float = 0.5) -> th.Tensor:
    """Predict by a weighted ridge regression with an intercept at each time step: ``(T, N)``."""
    total = weight.sum(1, keepdim=True).clamp(min=1.0)  # (T, 1)
    mean = (weight * targets).sum(1, keepdim=True) / total
    feature_mean = (weight[..., None] * features).sum(1, keepdim=True) / total[..., None]
    x = features - feature_mean
    weighted = weight[..., None] * x
    gram = weighted.mT @ x + penalty * th.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    coefficients = th.linalg.solve(gram, weighted.mT @ (targets - mean)[..., None])
    prediction = mean + (x @ coefficients)[..., 0]
    # Do not extrapolate to outliers (the only robot outside the lava, say).
    seen = weight > 0
    low = targets.masked_fill(~seen, math.inf).amin(dim=1, keepdim=True)
    high = targets.masked_fill(~seen, -math.inf).amax(dim=1, keepdim=True)
    return th.where(seen.any(dim=1, keepdim=True), prediction.clamp(low, high), th.zeros_like(prediction))


def _state_features(states: th.Tensor, alive: th.Tensor, n_centres: int = N_CENTRES) -> th.Tensor:
    """Compute features of each time step: standardised state, its squares, Gaussian bumps at states of the batch."""
    weight = alive[..., None]
    total = weight.sum(1, keepdim=True).clamp(min=1.0)
    mean = (weight * states).sum(1, keepdim=True) / total
    std = ((weight * (states - mean) ** 2).sum(1, keepdim=True) / total).sqrt()
    x = (states - mean) / th.where(std > 1e-6, std, th.ones_like(std))
    step = max(1, states.shape[1] // n_centres)
    centres = x[:, ::step]
    squared_distance = th.cdist(x, centres).square()  # (T, N, centres)
    return th.cat([x, x.square(), th.exp(-squared_distance / 2)], dim=-1)


BASELINES: dict[str, AdvantageFunction] = {"mean": episode_mean_advantages, "value": value_advantages}


def get_baseline(name: str) -> AdvantageFunction:
    """
    Look up a baseline.

    :raises ValueError: if there is none of this name.
    """
    if name not in BASELINES:
        raise ValueError(f"baseline={name!r} is unknown: use one of {sorted(BASELINES)}")
    return BASELINES[name]
