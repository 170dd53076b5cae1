"""Standardise vectors, and their changes from step to step, with statistics that the training updates."""

from __future__ import annotations

import torch as th
from torch import nn


class RunningNorm(nn.Module):
    """
    Standardise vectors by the mean and the standard deviation of all vectors seen, like SB3's ``VecNormalize``.

    The statistics are saved with the network. They change only in :meth:`update`, so that an epoch's rollouts and its
    gradients see the same inputs.

    :param dim: Number of components.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("mean", th.zeros(dim))
        self.register_buffer("var", th.ones(dim))
        self.register_buffer("count", th.tensor(1e-4))

    mean: th.Tensor
    var: th.Tensor
    count: th.Tensor

    @th.no_grad()
    def update(self, x: th.Tensor) -> None:
        """Update the statistics with a batch, ``(n, dim)``, of at least one vector."""
        n, var, mean = len(x), *th.var_mean(x, dim=0, correction=0)
        total, shift = self.count + n, mean - self.mean
        self.var.copy_((self.count * self.var + n * var + shift.square() * self.count * n / total) / total)
        self.mean.add_(shift * n / total)
        self.count.copy_(total)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Standardise vectors, and clip them to [-10, 10]: ``(..., dim) -> (..., dim)``."""
        return ((x - self.mean) / th.sqrt(self.var + 1e-8)).clamp(-10.0, 10.0)


class Changes(nn.Module):
    """
    Compute the standardised change of each component since the last step, scaled by how well it predicts the next one.

    If the velocities of a system are hidden, the last change helps to predict the next change. If they are observed,
    the last change adds only noise. Two predictions of the next change are compared: the first uses the
    components and their products, the second also uses the last change. Each change is multiplied by a share: the part
    of the next change's variance that only the second prediction explains.

    :param dim: Number of components F.
    """

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.norm = RunningNorm(dim)
        self.register_buffer("share", th.zeros(dim))
        self.register_buffer("n_updates", th.zeros(()))

    share: th.Tensor
    n_updates: th.Tensor

    def forward(self, x: th.Tensor, before: th.Tensor) -> th.Tensor:
        """Return the scaled changes from ``before`` to ``x``, ``(..., F)`` each, clipped to [-10, 10]."""
        return ((x - before) * self.share / th.sqrt(self.norm.var + 1e-8)).clamp(-10.0, 10.0)

    @th.no_grad()
    def update(self, x: th.Tensor, alive: th.Tensor) -> None:
        """
        Update the statistics with an epoch's steps; ``share`` is the mean over the epochs so far with enough steps.

        :param x: the components at each step, ``(T, N, F)``
        :param alive: 1 while an episode runs, then 0, ``(T, N)``
        """
        # Sort the samples by episode, so that the two halves come from different episodes, or different parts of one.
        x, alive = x.transpose(0, 1).double(), alive.transpose(0, 1).bool()
        changes = x[:, 1:] - x[:, :-1]
        if not alive[:, 1:].any():
            return
        self.norm.update(changes[alive[:, 1:]].float())
        now, last, following = (y[alive[:, 2:]] for y in (x[:, 1:-1], changes[:, :-1], changes[:, 1:]))
        half, dim = len(now) // 2, now.shape[1]
        if half > 4 * (dim + dim * (dim + 1) // 2):  # with fewer samples, the prediction is linear
            now = th.cat([now, _products(now)], dim=1)
        if half > 4 * dim:
            alone, together = (_unexplained(inputs, following, half) for inputs in (now, th.cat([now, last], dim=1)))
            variance = following[half:].var(0).clamp(min=1e-12)
            share = ((alone - together) / variance).clamp(0.0, 1.0).float()
            self.n_updates += 1
            self.share += (share - self.share) / self.n_updates


def _products(x: th.Tensor) -> th.Tensor:
    """Multiply the standardised components with each other: ``(n, F) -> (n, F (F + 1) / 2)``."""
    x = (x - x.mean(0)) / x.std(0).clamp(min=1e-6)
    i, j = th.triu_indices(x.shape[1], x.shape[1])
    return x[:, i] * x[:, j]


def _unexplained(inputs: th.Tensor, targets: th.Tensor, half: int) -> th.Tensor:
    """Fit a linear prediction to the first ``half`` samples; return its mean squared error on the rest, ``(F,)``."""
    inputs = (inputs - inputs.mean(0)) / inputs.std(0).clamp(min=1e-6)
    inputs = th.cat([inputs, th.ones_like(inputs[:, :1])], dim=1)
    fit, test = inputs[:half], inputs[half:]
    ridge = 0.1 * th.eye(inputs.shape[1], dtype=inputs.dtype, device=inputs.device)
    coefficients = th.linalg.solve(fit.T @ fit + ridge, fit.T @ targets[:half])
    return (targets[half:] - test @ coefficients).square().mean(0)
