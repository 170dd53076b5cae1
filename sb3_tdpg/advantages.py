"""
Compute advantages (costs minus a baseline), which weight the log-probabilities in the policy gradient.

Dimension key: T horizon, N episodes, X state, F features.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch as th
from stable_baselines3.common.torch_layers import create_mlp
from torch import nn

from sb3_tdpg.common.networks import MAX_TIME_VARYING_HORIZON
from sb3_tdpg.common.running_norms import Changes, RunningNorm
from sb3_tdpg.losses import cost_to_go

N_CENTRES = 20  # of the radial basis functions of a regression
# Number of centres if all time steps share one regression, whose samples are more numerous and lie further apart.
N_SHARED_CENTRES = 100
N_PASSES, BATCH_SIZE = 10, 64  # of the value network: passes over an epoch's steps, and minibatch size in steps

AdvantageFunction = Callable[..., th.Tensor]
"""``(costs, states, alive, gamma, gae_lambda) -> advantages``; see the functions below."""


def episode_mean_advantages(
    costs: th.Tensor, states: th.Tensor, alive: th.Tensor, gamma: float = 1.0, gae_lambda: float = 1.0
) -> th.Tensor:
    """
    Return the cost of each episode minus the mean cost of all episodes, as in the paper: ``(T, N)``.

    The arguments are those of :func:`regression_advantages`; ``states``, ``alive`` and ``gae_lambda`` are unused.
    """
    episode_cost = cost_to_go(costs, gamma)[0]
    return (episode_cost - episode_cost.mean()).expand_as(costs)


def regression_advantages(
    costs: th.Tensor, states: th.Tensor, alive: th.Tensor, gamma: float = 1.0, gae_lambda: float = 1.0
) -> th.Tensor:
    """
    Estimate advantages (GAE, Schulman et al., 2016) with regressions of the cost-to-go on the true state.

    Up to a horizon of 50 steps, each time step has its own regression. For longer horizons, all time steps share one
    regression on the state and the remaining horizon. The reason is that a few long episodes have many samples in total
    but few at each step.

    With ``gae_lambda=1`` an advantage is the cost-to-go minus the regression's prediction V_t(x_t), the baseline. The
    gradient stays unbiased, because x_t does not depend on the noise of step t. Each half of the episodes gets its
    baseline from a regression on the other half, so the cost of an episode does not enter its own baseline. A smaller
    ``gae_lambda`` replaces a part of the later costs by predictions at later states. These predictions have less noise
    than the costs but ignore the policy's memory. The TRVs (task-relevant variables) then get too little credit for
    the information that they carry from step to step.

    :param costs: cost of each step, ``(T, N)``
    :param states: true state x_t, ``(T, N, X)``
    :param alive: 1 while an episode runs, then 0, ``(T, N)``
    :param gamma: discount factor
    :param gae_lambda: 1: observed costs; 0: predicted cost-to-go of the next state instead of all later costs
    :return: advantages, ``(T, N)``
    """
    targets = cost_to_go(costs, gamma)
    fold = (th.arange(costs.shape[1], device=costs.device) % 2).expand_as(costs)
    if len(costs) <= MAX_TIME_VARYING_HORIZON:
        values = _held_out_predictions(_state_features(states, alive), targets, alive, fold)
    else:
        values = _shared_values(states, targets, alive, fold, gamma)
    return generalised_advantages(costs, values, gamma, gae_lambda)


def generalised_advantages(costs: th.Tensor, values: th.Tensor, gamma: float, gae_lambda: float) -> th.Tensor:
    """
    Estimate advantages from predicted costs-to-go (GAE, Schulman et al., 2016).

    :param costs: cost of each step, ``(T, N)``, zero after the end of an episode
    :param values: predicted costs-to-go V_t(x_t), ``(T, N)``, zero after the end of an episode
    :return: advantages, ``(T, N)``
    """
    next_values = th.cat([values[1:], th.zeros_like(values[:1])])
    return cost_to_go(costs + gamma * next_values - values, gamma * gae_lambda)


class ValueFunction(nn.Module):
    """
    A network that predicts the cost-to-go V_t(x_t) from the true state and the remaining time.

    The network is fitted to each epoch's rollouts. Unlike the regressions, it keeps what it has learnt in earlier
    epochs, so a few long episodes per epoch suffice. Only the training uses the network. The robot therefore need not
    know the true state (asymmetric critic, Pinto et al., 2018).

    :param state_dim: Number of components X of the state.
    :param horizon: Number of time steps T.
    :param with_changes: Whether the network also gets the change of the state since the last step, as scaled by
        :class:`~sb3_tdpg.common.running_norms.Changes`. This option is meant for observations that stand in for the
        state.
    """

    def __init__(self, state_dim: int, horizon: int, with_changes: bool = False) -> None:
        super().__init__()
        self.horizon = horizon
        self.norm = RunningNorm(state_dim)
        self.changes = Changes(state_dim) if with_changes else None
        n_inputs = state_dim * (1 + with_changes) + 1
        self.network = nn.Sequential(*create_mlp(n_inputs, 1, [64, 64], nn.Tanh))
        self.register_buffer("offset", th.zeros(()))
        self.register_buffer("scale", th.ones(()))
        self.optimizer = th.optim.Adam(self.network.parameters(), lr=1e-3, fused=True)

    offset: th.Tensor
    scale: th.Tensor
    explained = math.nan
    """Share of the variance of the latest targets that the network explained before it was fitted to them."""

    def advantages(
        self, costs: th.Tensor, states: th.Tensor, alive: th.Tensor, gamma: float = 1.0, gae_lambda: float = 1.0
    ) -> th.Tensor:
        """
        Fit the network to an epoch's rollouts, then estimate the epoch's advantages (GAE) with the new values.

        The fit comes first, because the values from before it belong to an older policy. The new values, however, were
        fitted to the same costs from which they are subtracted. The resulting bias is small if an epoch has many
        episodes. The arguments are those of :func:`regression_advantages`.

        :return: advantages, ``(T, N)``
        """
        with th.no_grad():
            values = alive * self(states, gamma)
            targets = generalised_advantages(costs, values, gamma, gae_lambda) + values
        self.explained = self.fit(states, targets, alive, gamma)
        with th.no_grad():
            return generalised_advantages(costs, alive * self(states, gamma), gamma, gae_lambda)

    def forward(self, states: th.Tensor, gamma: float) -> th.Tensor:
        """
        Predict the discounted cost from each step to the end.

        :param states: x_0 to x_{T-1}, ``(T, N, X)``
        :return: predicted costs-to-go, ``(T, N)``
        """
        return self.offset + self.scale * self.network(self._inputs(states, gamma))[..., 0]

    def _inputs(self, states: th.Tensor, gamma: float) -> th.Tensor:
        left = self.horizon - th.arange(len(states), device=states.device)
        # The discounted number of remaining steps, relative to its value at the start.
        share = left / self.horizon if gamma == 1 else (1 - gamma**left) / (1 - gamma**self.horizon)
        states = self.norm(states)
        inputs = [states, share[:, None, None].expand(*states.shape[:2], 1)]
        if self.changes is not None:
            inputs.append(self.changes(states, th.cat([states[:1], states[:-1]])))
        return th.cat(inputs, dim=-1)

    def fit(self, states: th.Tensor, targets: th.Tensor, alive: th.Tensor, gamma: float) -> float:
        """
        Fit the network to the costs-to-go of an epoch, ``(T, N)``.

        :return: share of the variance of the targets that the network explained before this fit
        """
        living = alive.bool()
        y = targets[living]
        with th.no_grad():
            residual = y - self(states, gamma)[living]
            explained = 1 - (residual.var() / y.var().clamp(min=1e-12)).item()
            self.norm.update(states[living])
            if self.changes is not None:
                self.changes.update(self.norm(states), alive)
            self._rescale(y)
            x, z = self._inputs(states, gamma)[living], (y - self.offset) / self.scale
        for _ in range(N_PASSES):
            for part in th.randperm(len(x), device=x.device).split(BATCH_SIZE):
                loss = (self.network(x[part])[:, 0] - z[part]).square().mean()
                self.optimizer.zero_grad()
                loss.backward()
                self.optimizer.step()
        return explained

    @th.no_grad()
    def _rescale(self, targets: th.Tensor) -> None:
        """Standardise the targets by new statistics without changing the predictions (van Hasselt et al., 2016)."""
        # After the first fit the change is slow, because the last layer has to adapt.
        rate = 1.0 if self.norm.count < 1.5 * len(targets) else 0.1
        offset = self.offset + rate * (targets.mean() - self.offset)
        scale = self.scale + rate * (targets.std().clamp(min=1e-6) - self.scale)
        last = self.network[-1]
        assert isinstance(last, nn.Linear)
        last.weight.mul_(self.scale / scale)
        last.bias.copy_((self.scale * last.bias + self.offset - offset) / scale)
        self.offset.copy_(offset)
        self.scale.copy_(scale)


def _shared_values(states: th.Tensor, targets: th.Tensor, alive: th.Tensor, fold: th.Tensor, gamma: float) -> th.Tensor:
    """Predict the targets with one regression on the state and the remaining horizon: ``(T, N)``."""
    # With a discount, to_go differs noticeably only among the last steps.
    to_go = cost_to_go(th.ones_like(targets), gamma) / len(targets)
    living = alive.flatten().nonzero()[:, 0]
    # The order of the samples must not be periodic, because the centres are taken at regular intervals.
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
    """Predict the targets of each of two folds with a regression on the other fold: ``(T, N)``."""
    predictions = th.zeros_like(targets)
    for held_out in (0, 1):
        predictions += (fold == held_out) * weight * _ridge(features, targets, weight * (fold != held_out))
    return predictions


def _ridge(features: th.Tensor, targets: th.Tensor, weight: th.Tensor, penalty: float = 0.5) -> th.Tensor:
    """Predict the targets with a weighted ridge regression with an intercept at each time step: ``(T, N)``."""
    total = weight.sum(1, keepdim=True).clamp(min=1.0)  # (T, 1)
    mean = (weight * targets).sum(1, keepdim=True) / total
    feature_mean = (weight[..., None] * features).sum(1, keepdim=True) / total[..., None]
    x = features - feature_mean
    weighted = weight[..., None] * x
    gram = weighted.mT @ x + penalty * th.eye(x.shape[-1], dtype=x.dtype, device=x.device)
    coefficients = th.linalg.solve(gram, weighted.mT @ (targets - mean)[..., None])
    prediction = mean + (x @ coefficients)[..., 0]
    # Do not extrapolate to outliers, for instance to the only robot outside the lava.
    seen = weight > 0
    low = targets.masked_fill(~seen, math.inf).amin(dim=1, keepdim=True)
    high = targets.masked_fill(~seen, -math.inf).amax(dim=1, keepdim=True)
    return th.where(seen.any(dim=1, keepdim=True), prediction.clamp(low, high), th.zeros_like(prediction))


def _state_features(states: th.Tensor, alive: th.Tensor, n_centres: int = N_CENTRES) -> th.Tensor:
    """Compute features at each time step: the standardised state, its squares, and Gaussian radial basis functions."""
    weight = alive[..., None]
    total = weight.sum(1, keepdim=True).clamp(min=1.0)
    mean = (weight * states).sum(1, keepdim=True) / total
    std = ((weight * (states - mean) ** 2).sum(1, keepdim=True) / total).sqrt()
    x = (states - mean) / th.where(std > 1e-6, std, th.ones_like(std))
    step = max(1, states.shape[1] // n_centres)
    centres = x[:, ::step]
    squared_distance = th.cdist(x, centres).square()  # (T, N, centres)
    return th.cat([x, x.square(), th.exp(-squared_distance / 2)], dim=-1)


BASELINES: dict[str, AdvantageFunction | None] = {
    "mean": episode_mean_advantages,
    "regression": regression_advantages,
    "value": None,  # the algorithm uses the method of its own ValueFunction
}
