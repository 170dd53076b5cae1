"""
The base class of the estimators with a trained critic F^theta.

Dimension key: T time steps, N episodes, B minibatch size, K marginal samples for each state, X state, Z TRVs.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_tdpg.common.networks import BatchedMLP, flatten_parameters
from sb3_tdpg.information.base import InformationBatch, InformationEstimator

MIN_EPISODES = 2  # an estimate pairs a state with the TRVs of another episode
MOMENTS = ("exp_avg", "exp_avg_sq", "step")  # of Adam


class Scores(NamedTuple):
    """The critic's values at samples of p(x, x~) and of p(x) q(x~)."""

    joint: th.Tensor  # (T, B)
    marginal: th.Tensor  # (T, B, K)


def derange(n: int, device: th.device) -> th.Tensor:
    """Draw a permutation of n episodes without fixed points: ``(n,)``."""
    # In a random cycle, no state is paired with its own TRVs.
    order = th.randperm(n, device=device)
    other = th.empty_like(order)
    other[order] = order.roll(1)
    return other


class CriticEstimator(InformationEstimator):
    """
    T critics F^theta_t(x_t, x~_t) in one batched network, fitted to each epoch's rollouts (Algorithm 1).

    A subclass defines the bound (:meth:`_bound`), and the critics' objective (:meth:`_objective`) if it differs from
    the bound.

    :param hidden_sizes: Sizes of the hidden layers of each critic.
    :param activation_fn: Nonlinearity of the critics.
    :param learning_rate: Adam's learning rate.
    :param batch_size: Minibatch size B. It is reduced to at most half of the episodes, because the joint and the
        marginal samples of an optimiser step come from different episodes. If some episodes end before others, it is
        reduced to at most a quarter.
    :param gradient_steps: Number of optimiser steps ("MINE epochs") in each policy epoch after the first.
    :param warmup_gradient_steps: Number of optimiser steps in the first policy epoch, if it exceeds ``gradient_steps``.
    :param refit_below: Lower limit in nats: a critic has diverged if its estimate on the batch is below this limit or
        not finite. A diverged critic is fitted from new weights for ``refit_gradient_steps`` steps. Without this guard
        a policy can exploit a frozen critic, whose bound has no lower limit.
    :param refit_above: Upper limit in nats: a critic has also diverged if its estimate is above this limit.
    :param refit_gradient_steps: Number of optimiser steps of such a refit.
    :param reset_moments: Whether Adam's moments start from zero in each epoch, since the data have changed.
    :param standardize: Whether to standardise each component of the state at each time step.
    :param held_out: Share of the episodes on which the critics are not trained; each fit draws these episodes anew.
        :meth:`fit` reports the estimates on these and on the other episodes, summed over time, as ``"held_out"`` and
        ``"trained_on"``. A large gap between the two estimates means overfitting.
    """

    def __init__(
        self,
        horizon: int,
        state_dim: int,
        trv_dim: int,
        *,
        hidden_sizes: Sequence[int] = (32, 32),
        activation_fn: type[nn.Module] = nn.ELU,
        learning_rate: float = 1e-3,
        batch_size: int = 50,
        gradient_steps: int = 50,
        warmup_gradient_steps: int = 2000,
        refit_below: float = -0.5,
        refit_above: float = 100.0,
        refit_gradient_steps: int = 500,
        reset_moments: bool = True,
        standardize: bool = False,
        held_out: float = 0.0,
    ) -> None:
        super().__init__(horizon, state_dim, trv_dim)
        for name, value in (("learning_rate", learning_rate), ("batch_size", batch_size),
                            ("gradient_steps", gradient_steps)):  # fmt: skip
            if not value > 0:
                raise ValueError(f"mi_kwargs: {name}={value} must be positive")
        if not 0 <= held_out < 1:
            raise ValueError(
                f"mi_kwargs: held_out={held_out} must be in [0, 1): it is the share of the episodes that the critics "
                "are not trained on"
            )
        self.sizes = (state_dim + trv_dim, *hidden_sizes, 1)
        self.activation_fn = activation_fn
        self.learning_rate = learning_rate
        self.batch_size = batch_size
        self.gradient_steps = gradient_steps
        self.warmup_gradient_steps = warmup_gradient_steps
        self.refit_below = refit_below
        self.refit_above = refit_above
        self.refit_gradient_steps = refit_gradient_steps
        self.reset_moments = reset_moments
        self.standardize = standardize
        self.held_out = held_out
        self.critic = BatchedMLP(horizon, self.sizes, activation_fn)
        # The moments of Adam; zeros mean a fresh start.
        shapes = (flatten_parameters(self.critic).shape,) * 2 + (th.Size(),)
        for name, shape in zip(MOMENTS, shapes, strict=True):
            self.register_buffer(name, th.zeros(shape))
        self.register_buffer("is_warm", th.tensor(False))
        # This buffer is not saved, because each epoch fits the critics before it estimates.
        self.register_buffer("is_trained", th.ones(horizon, dtype=th.bool), persistent=False)
        self.register_buffer("state_mean", th.zeros(horizon, 1, state_dim))
        self.register_buffer("state_std", th.ones(horizon, 1, state_dim))

    step: th.Tensor
    is_warm: th.Tensor
    is_trained: th.Tensor  # (T,), whether the last fit had enough living episodes
    state_mean: th.Tensor
    state_std: th.Tensor

    @property
    def recommended_episodes(self) -> int:
        """
        Recommended number of episodes: ten for each input of a critic.

        If the TRVs carry no information, the critics still report 0.5 to 1 nat at each step with this many episodes.
        With 2 episodes, they report 10 to 200 nats at each step.
        """
        return 10 * (self.state_dim + self.trv_dim)

    @abstractmethod
    def _bound(self, scores: Scores) -> th.Tensor:
        """Compute the estimate from the scores: ``(T,)``, nats."""

    def _objective(self, scores: Scores, steps: th.Tensor) -> th.Tensor:
        """
        Compute the critics' objective, which is maximised: ``(T,)``.

        :param scores: scores of a minibatch at the time steps ``steps``
        :param steps: indices of these time steps
        """
        return self._bound(scores)

    def _pair(self, states: th.Tensor, trvs: th.Tensor, other_trvs: th.Tensor) -> th.Tensor:
        """Pair states ``(..., B, X)`` with their TRVs, then with the TRVs of others: ``(..., B + B * K, X + Z)``."""
        return th.cat([th.cat([states, trvs], -1), th.cat([states, other_trvs], -1)], dim=-2)

    def _split(self, values: th.Tensor, n: int) -> Scores:
        """Undo :meth:`_pair` on the critic's outputs ``(T, B + B * K, 1)``."""
        values = values.squeeze(-1)
        return Scores(values[:, :n], values[:, n:].unflatten(1, (n, -1)))

    @th.no_grad()
    def fit(self, batch: InformationBatch) -> dict[str, float]:
        """Train the critics on the epoch's samples (Algorithm 1), and return diagnostics for the log."""
        train, held_out = self._hold_out(batch)
        if self.standardize:
            self._update_scaling(train)
        self.is_trained = train.living.sum(1) >= 2 * self._minibatch_size(train)
        steps = self.is_trained.nonzero()[:, 0]
        broken = steps
        if len(steps) > 0:
            samples = train._replace(states=self._scale(train.states))
            optimizer = self.make_optimizer(self.critic)
            (vector,) = optimizer.param_groups[0]["params"]
            if self.step > 0 and not self.reset_moments:
                optimizer.state[vector] = {name: getattr(self, name) for name in MOMENTS}
            n_steps = self.gradient_steps if self.is_warm else max(self.warmup_gradient_steps, self.gradient_steps)
            self._ascend(self.critic, optimizer, samples, steps, n_steps)
            for name, moment in optimizer.state[vector].items():
                getattr(self, name).copy_(moment)
            self.is_warm.fill_(True)
            estimate = self(batch)[steps]  # on all episodes, like the policy's loss
            broken = steps[~((estimate >= self.refit_below) & (estimate <= self.refit_above))]  # NaN compares false
            if len(broken) > 0:
                self._refit(samples, broken)
        report = {"critic_refits": float(len(broken))}
        if held_out is not None:
            report |= {"trained_on": self._total(train, steps), "held_out": self._total(held_out, steps)}
        return report

    def make_optimizer(self, critic: BatchedMLP) -> th.optim.Adam:
        """Make an Adam optimiser that updates all parameters as one vector, which is much faster than one by one."""
        return th.optim.Adam([flatten_parameters(critic)], lr=self.learning_rate, fused=True)

    def _hold_out(self, batch: InformationBatch) -> tuple[InformationBatch, InformationBatch | None]:
        """Divide the episodes at random into those to train on and those to hold out, if any."""
        if self.held_out == 0:
            return batch, None
        of_column = None if batch.episode is None else batch.episode[0]  # the steps of an episode stay together
        numbers = th.arange(batch.trvs.shape[1]) if of_column is None else of_column.unique()
        n = len(numbers)
        n_held_out = round(self.held_out * n)
        if min(n_held_out, n - n_held_out) < MIN_EPISODES:
            raise ValueError(
                f"mi_kwargs: held_out={self.held_out} of {n} episodes holds out {n_held_out} and trains on "
                f"{n - n_held_out}: each needs at least {MIN_EPISODES}; change the share, or use more episodes"
            )
        order = th.randperm(n, device=batch.trvs.device)
        if of_column is None:
            return batch.select(order[n_held_out:]), batch.select(order[:n_held_out])
        is_held_out = th.isin(of_column, numbers[order[:n_held_out]])
        return batch.select(~is_held_out), batch.select(is_held_out)

    def _total(self, batch: InformationBatch, steps: th.Tensor) -> float:
        """Sum the estimates over the given steps, without the steps that have too few living episodes."""
        living = ((t, batch.at(t)) for t in steps.tolist())
        return float(sum(self._estimate(at, t).item() for t, at in living if at.trvs.shape[1] >= MIN_EPISODES))

    @th.no_grad()
    def _ascend(
        self, critic: BatchedMLP, optimizer: th.optim.Optimizer, batch: InformationBatch, steps: th.Tensor, n_steps: int
    ) -> None:
        """Maximise the objective; ``critic`` has one network for each time step in the batch."""
        n_rows, n = batch.trvs.shape[0], self._minibatch_size(batch)
        # In a refit the batch has only the time steps in `steps`; otherwise `steps` selects rows of the batch.
        rows = slice(None) if len(steps) == n_rows else steps
        for inputs in self._minibatches(batch, n, n_steps):
            optimizer.zero_grad(set_to_none=False)
            with th.enable_grad():
                values = critic(inputs)
            values.backward(self._objective_gradient(values.detach(), n, rows, steps))
            optimizer.step()

    def _minibatches(self, batch: InformationBatch, n: int, n_steps: int) -> Iterator[th.Tensor]:
        """Draw the critics' inputs for each gradient step from n joint samples and the TRVs of n other episodes."""
        (n_rows, n_episodes), device, alive = batch.trvs.shape[:2], batch.trvs.device, batch.alive
        # Draw as many gradient steps at once as memory allows, because a draw takes as long as a gradient step.
        per_step = n_rows * (n_episodes + self._n_pairs(n) * sum(self.sizes[:1]))
        chunk = max(1, min(n_steps, 4_000_000 // per_step))
        for start in range(0, n_steps, chunk):
            size = min(chunk, n_steps - start)
            if alive is None:
                chosen = th.rand(size, 1, n_episodes, device=device).topk(2 * n, dim=2).indices
            else:
                # Episodes that have ended come last. Time steps with fewer than 2n living episodes are not trained.
                priority = th.rand(size, *alive.shape, device=device).masked_fill(~alive, 2.0)
                chosen = priority.topk(2 * n, dim=2, largest=False).indices
            # Selecting rows of (T * N, .) is faster than indexing two dimensions.
            index = (chosen + n_episodes * th.arange(n_rows, device=device)[:, None]).flatten()
            states, trvs = (x.flatten(0, 1).index_select(0, index).view(size, n_rows, 2 * n, -1) for x in batch[:2])
            yield from self._pair(states[..., :n, :], trvs[..., :n, :], trvs[..., n:, :])

    def _n_pairs(self, n: int) -> int:
        """Return the number of inputs that a critic gets for a minibatch of n samples."""
        return 2 * n

    def _objective_gradient(self, values: th.Tensor, n: int, rows: slice | th.Tensor, steps: th.Tensor) -> th.Tensor:
        """Return the gradient of the negative objective at the steps ``steps`` with respect to the critics' outputs."""
        with th.enable_grad():
            values = values.requires_grad_()
            scores = self._split(values, n)
            loss = -self._objective(Scores(scores.joint[rows], scores.marginal[rows]), steps).sum()
            return th.autograd.grad(loss, values)[0]

    def _refit(self, batch: InformationBatch, broken: th.Tensor) -> None:
        """Fit the critics of the steps in ``broken`` from new weights."""
        fresh = BatchedMLP(len(broken), self.sizes, self.activation_fn).to(batch.trvs)
        self._forget(broken)
        for name in MOMENTS:  # the old moments may not be finite, either
            getattr(self, name).zero_()
        alive = None if batch.alive is None else batch.alive[broken]
        rows = InformationBatch(*(x[broken] for x in batch[:4]))._replace(alive=alive)
        self._ascend(fresh, self.make_optimizer(fresh), rows, broken, self.refit_gradient_steps)
        for parameter, fresh_parameter in zip(self.critic.parameters(), fresh.parameters(), strict=True):
            parameter[broken] = fresh_parameter

    def _forget(self, steps: th.Tensor) -> None:
        """Reset the values that a subclass stores for these steps in addition to the weights."""

    def _update_scaling(self, batch: InformationBatch) -> None:
        weight = batch.living[..., None].float()
        total = weight.sum(1, keepdim=True).clamp(min=1)
        self.state_mean = (batch.states * weight).sum(1, keepdim=True) / total
        variance = (weight * (batch.states - self.state_mean) ** 2).sum(1, keepdim=True) / total
        # A constant component carries no information and becomes 0.
        self.state_std = th.where(variance > 1e-12, variance.sqrt(), th.ones_like(variance))

    def _scale(self, states: th.Tensor, t: int | None = None) -> th.Tensor:
        rows = slice(None) if t is None else slice(t, t + 1)
        return (states - self.state_mean[rows]) / self.state_std[rows]

    def _minibatch_size(self, batch: InformationBatch) -> int:
        """Return the minibatch size B, limited so that a gradient step has 2 B living episodes."""
        return max(1, min(self.batch_size, batch.trvs.shape[1] // (2 if batch.alive is None else 4)))

    def min_episodes(self, n_episodes: int) -> int:
        """Return two, because a state is paired with the TRVs of another episode."""
        return MIN_EPISODES

    def has_enough(self, batch: InformationBatch) -> th.Tensor:
        """Return for each step whether the critic was trained and two or more episodes are alive: ``(T,)`` bool."""
        return self.is_trained & super().has_enough(batch)

    def _estimate(self, batch: InformationBatch, t: int | None) -> th.Tensor:
        states, trvs = self._scale(batch.states, t), batch.trvs
        n = trvs.shape[1]
        inputs = self._pair(states, trvs, trvs[:, derange(n, trvs.device)])
        values = self.critic(inputs) if t is None else self.critic.at(inputs[0], t)[None]
        return self._bound(self._split(values, n))
