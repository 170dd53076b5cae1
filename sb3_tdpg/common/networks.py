"""
Networks with one set of weights per time step, evaluated for all steps at once.

Dimension key: T horizon, N episodes, I inputs, O outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import torch as th
from torch import nn

# Beyond this horizon one set of weights per step would be slow and would starve: the steps share theirs.
MAX_TIME_VARYING_HORIZON = 50
VECTOR = 64  # a multiple of the numbers that any processor handles at a time


class BatchedLinear(nn.Module):
    """
    M affine maps with weights of their own, applied to M batches in one call.

    The initialisation is that of :class:`torch.nn.Linear`, for each map.

    :param n_maps: Number of maps M: the horizon for weights that vary in time, 1 for weights shared by all steps.
    :param in_features: I
    :param out_features: O
    """

    def __init__(self, n_maps: int, in_features: int, out_features: int) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(in_features)
        self.weight = nn.Parameter(th.empty(n_maps, in_features, out_features).uniform_(-bound, bound))
        self.bias = nn.Parameter(th.empty(n_maps, 1, out_features).uniform_(-bound, bound))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """``(M, N, I) -> (M, N, O)``."""
        return th.baddbmm(self.bias, x, self.weight)

    def at(self, x: th.Tensor, index: int) -> th.Tensor:
        """Apply the map of one index: ``(N, I) -> (N, O)``."""
        return th.addmm(self.bias[index], x, self.weight[index])


class BatchedMLP(nn.Module):
    """
    M multi-layer perceptrons of the same shape as one network.

    :param n_maps: Number of networks M.
    :param sizes: Width of every layer, from the input to the output.
    :param activation_fn: Nonlinearity after each layer but the last.
    """

    def __init__(self, n_maps: int, sizes: Sequence[int], activation_fn: type[nn.Module] = nn.ELU) -> None:
        super().__init__()
        self.n_maps = n_maps
        self.layers = nn.ModuleList(BatchedLinear(n_maps, i, o) for i, o in pairwise(sizes))
        self.activation = activation_fn()

    def forward(self, x: th.Tensor) -> th.Tensor:
        """``(M, N, I) -> (M, N, O)``."""
        return self.through(x, BatchedLinear.forward)

    def at(self, x: th.Tensor, index: int) -> th.Tensor:
        """Evaluate the network of one index: ``(N, I) -> (N, O)``."""
        return self.through(x, lambda layer, x: layer.at(x, index))

    def through(self, x: th.Tensor, apply: Callable[[Any, th.Tensor], th.Tensor]) -> th.Tensor:
        """Send inputs through all layers by ``apply(layer, x)``, with the nonlinearity in between."""
        *hidden, last = self.layers
        for layer in hidden:
            x = self.activation(apply(layer, x))
        return apply(last, x)


def flatten_parameters(module: nn.Module) -> nn.Parameter:
    """
    Lay out the parameters of a module, and their gradients, as views of one vector each.

    An optimiser's step on one vector takes a fraction of the time of a step on many small tensors. Call it again after
    the parameters may have been moved or replaced (``to``, ``copy.deepcopy``).

    :return: the vector, whose ``grad`` is the vector of all gradients
    """
    parameters = list(module.parameters())
    sizes = [parameter.numel() for parameter in parameters]
    # PyTorch rounds the last few numbers of a vector differently. With the padding a network makes the same steps
    # alone as in a larger vector.
    sizes.append(-sum(sizes) % VECTOR)
    vector = nn.Parameter(th.cat([*(x.detach().flatten() for x in parameters), parameters[0].new_zeros(sizes[-1])]))
    vector.grad = th.zeros_like(vector)
    values, gradients = vector.data.split(sizes), vector.grad.split(sizes)
    for parameter, value, gradient in zip(parameters, values, gradients, strict=False):  # all but the padding
        parameter.data, parameter.grad = value.view_as(parameter), gradient.view_as(parameter)
    return vector


def bounded_variance(log_var: th.Tensor, maximum: float, floor: float) -> th.Tensor:
    """Return ``exp(log_var) + floor``, bounded above: unfamiliar observations would drive it to inf."""
    # A clamp would stop the gradient there.
    return maximum * th.sigmoid(log_var - math.log(maximum)) + floor


class TimeMLP(nn.Module):
    """
    An MLP whose weights vary with the time step, or are shared by all steps.

    :param horizon: Number of time steps T.
    :param sizes: Width of every layer, from the input to the output.
    :param activation_fn: Nonlinearity after each layer but the last.
    :param time_varying: One set of weights per step, or one for all.
    """

    def __init__(
        self, horizon: int, sizes: Sequence[int], activation_fn: type[nn.Module] = nn.ELU, *, time_varying: bool = True
    ) -> None:
        super().__init__()
        self.horizon = horizon
        self.sizes = tuple(sizes)
        self.activation_fn = activation_fn
        self.time_varying = time_varying
        self.mlp = BatchedMLP(horizon if time_varying else 1, sizes, activation_fn)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """All steps of all episodes: ``(T, N, I) -> (T, N, O)``."""
        if self.time_varying:
            return self.mlp(x)
        return self.mlp(x.flatten(0, 1)[None])[0].unflatten(0, x.shape[:2])

    @th.no_grad()
    def scale_output(self, factor: float) -> None:
        """Scale the weights of the last layer, for a start with small outputs."""
        for parameter in self.mlp.layers[-1].parameters():
            parameter.mul_(factor)

    def at(self, x: th.Tensor, t: int) -> th.Tensor:
        """One step, the same for all episodes: ``(N, I) -> (N, O)``."""
        return self.mlp.at(x, t if self.time_varying else 0)

    def at_times(self, x: th.Tensor, t: np.ndarray) -> th.Tensor:
        """Each episode at a step of its own: ``(N, I)`` and ``(N,) -> (N, O)``."""
        if not self.time_varying or (t == t[0]).all():
            return self.at(x, int(t[0]))
        rows = [np.flatnonzero(t == step) for step in np.unique(t)]
        outputs = [self.at(x[r], int(t[r[0]])) for r in rows]
        return th.cat(outputs)[np.argsort(np.concatenate(rows))]
