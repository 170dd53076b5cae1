"""The critics as one batched network."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch as th
from torch import nn

from sb3_tdpg.information import InformationBatch
from sb3_tdpg.information.mine import Mine
from tests.benchmarks.speed.measure import SEED, Row, Sizes, compare, seconds
from tests.reference_loop import unbatch


def correlated_gaussians(horizon: int, n: int, dim: int = 2) -> InformationBatch:
    """Make states and TRVs that tell of each other."""
    generator = th.Generator().manual_seed(SEED)
    means = th.randn(horizon, n, dim, generator=generator)
    stds = th.full_like(means, 0.5)
    return InformationBatch(means, means + stds * th.randn(means.shape, generator=generator), means, stds)


def fit_one_by_one(
    critics: list[nn.Sequential], optimizers: list[th.optim.Adam], batch: InformationBatch, size: int, n_steps: int
) -> None:
    """Fit critics in a loop: a network, a backward pass and an optimiser for each."""
    for _ in range(n_steps):
        chosen = th.randperm(batch.trvs.shape[1])
        own, other = chosen[:size], chosen[size : 2 * size]
        for t, (critic, optimizer) in enumerate(zip(critics, optimizers, strict=True)):
            states, trvs, others = batch.states[t, own], batch.trvs[t, own], batch.trvs[t, other]
            # One call for both distributions: the fastest loop.
            values = critic(th.cat([th.cat([states, trvs], 1), th.cat([states, others], 1)]))
            joint, marginal = values.chunk(2)
            loss = -(joint.mean() - marginal.exp().mean().log())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


def bench_critics(sizes: Sizes) -> Iterable[Row]:
    """Compare one batched network with a loop over T critics, at the sizes of Lava and of grasping."""
    return [_compare_critics(sizes, *of_problem) for of_problem in ((5, 32, 50), (25, 64, 20))]


def _compare_critics(sizes: Sizes, horizon: int, hidden: int, size: int) -> Row:
    n_steps = 20 * sizes.epochs
    batch = correlated_gaussians(horizon, 500)
    settings: dict[str, Any] = dict(hidden_sizes=(hidden, hidden), batch_size=size)
    mine = Mine(horizon, 2, 2, gradient_steps=n_steps, warmup_gradient_steps=n_steps, **settings)
    critics = unbatch(mine.critic)
    optimizers = [th.optim.Adam(critic.parameters(), lr=mine.learning_rate) for critic in critics]
    return compare(
        f"gradient step of the critics, T={horizon}, hidden {hidden}-{hidden}, B={size}: "
        "batched against a loop over critics",
        lambda: seconds(lambda: mine.fit(batch), n_steps),
        lambda: seconds(lambda: fit_one_by_one(critics, optimizers, batch, size, n_steps), n_steps),
        sizes.repetitions,
        goal=5,
    )
