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

# Above this horizon the steps share their weights by default: one set per step would be slow and get too few samples.
MAX_TIME_VARYING_HORIZON = 50
VECTOR = 64  # a multiple of the vector length of any processor, in floats


class BatchedLinear(nn.Module):
    """
    M affine maps, each with its own weights, applied to M batches in one call.

    Each map is initialised like a :class:`torch.nn.Linear`.

    :param n_maps: Number of maps M: the horizon for weights that vary in time, 1 for weights shared by all steps.
    :param in_features: Number of inputs I of each map.
    :param out_features: Number of outputs O of each map.
    """

    def __init__(self, n_maps: int, in_features: int, out_features: int) -> None:
        super().__init__()
        bound = 1.0 / math.sqrt(in_features)
        self.weight = nn.Parameter(th.empty(n_maps, in_features, out_features).uniform_(-bound, bound))
        self.bias = nn.Parameter(th.empty(n_maps, 1, out_features).uniform_(-bound, bound))

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Apply each map to its batch: ``(M, N, I) -> (M, N, O)``."""
        return th.baddbmm(self.bias, x, self.weight)

    def at(self, x: th.Tensor, index: int) -> th.Tensor:
        """Apply the map with the given index: ``(N, I) -> (N, O)``."""
        return th.addmm(self.bias[index], x, self.weight[index])


class BatchedMLP(nn.Module):
    """
    M multi-layer perceptrons with the same layer sizes, evaluated together.

    :param n_maps: Number of networks M.
    :param sizes: Width of every layer, from the input to the output.
    :param activation_fn: Nonlinearity after each layer but the last.
    """

    def __init__(self, n_maps: int, sizes: Sequence[int], activation_fn: type[nn.Module] = nn.ELU) -> None:
        super().__init__()
        self.layers = nn.ModuleList(BatchedLinear(n_maps, i, o) for i, o in pairwise(sizes))
        self.activation = activation_fn()

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Evaluate all networks: ``(M, N, I) -> (M, N, O)``."""
        return self.through(x, BatchedLinear.forward)

    def at(self, x: th.Tensor, index: int) -> th.Tensor:
        """Evaluate the network with the given index: ``(N, I) -> (N, O)``."""
        return self.through(x, lambda layer, x: layer.at(x, index))

    def through(self, x: th.Tensor, apply: Callable[[Any, th.Tensor], th.Tensor]) -> th.Tensor:
        """Pass inputs through all layers with ``apply(layer, x)``, and through the nonlinearity between the layers."""
        *hidden, last = self.layers
        for layer in hidden:
            x = self.activation(apply(layer, x))
        return apply(last, x)


def flatten_parameters(module: nn.Module) -> nn.Parameter:
    """
    Store all parameters of a module in one vector and all gradients in another; the module keeps views of both.

    An optimiser's step on one vector takes a fraction of the time of a step on many small tensors. Call this function
    again after an operation that may move or replace the parameters (``to``, ``copy.deepcopy``).

    :return: the vector, whose ``grad`` is the vector of all gradients
    """
    parameters = list(module.parameters())
    sizes = [parameter.numel() for parameter in parameters]
    # PyTorch rounds the last few numbers of a vector differently. With padding, a network makes the same optimiser
    # steps alone and inside a larger vector.
    sizes.append(-sum(sizes) % VECTOR)
    vector = nn.Parameter(th.cat([*(x.detach().flatten() for x in parameters), parameters[0].new_zeros(sizes[-1])]))
    vector.grad = th.zeros_like(vector)
    values, gradients = vector.data.split(sizes), vector.grad.split(sizes)
    for parameter, value, gradient in zip(parameters, values, gradients, strict=False):  # all but the padding
        parameter.data, parameter.grad = value.view_as(parameter), gradient.view_as(parameter)
    return vector


def bounded_variance(log_var: th.Tensor, maximum: float, floor: float) -> th.Tensor:
    """Return ``exp(log_var) + floor``, bounded above so that unfamiliar observations cannot drive it to infinity."""
    # A clamp would have a zero gradient above the maximum.
    return maximum * th.sigmoid(log_var - math.log(maximum)) + floor


class TimeMLP(nn.Module):
    """
    An MLP whose weights vary with the time step, or are shared by all steps.

    :param horizon: Number of time steps T.
    :param sizes: Width of every layer, from the input to the output.
    :param activation_fn: Nonlinearity after each layer but the last.
    :param time_varying: Whether each step has its own set of weights, or all steps share one.
    """

    def __init__(
        self, horizon: int, sizes: Sequence[int], activation_fn: type[nn.Module] = nn.ELU, *, time_varying: bool = True
    ) -> None:
        super().__init__()
        self.time_varying = time_varying
        self.mlp = BatchedMLP(horizon if time_varying else 1, sizes, activation_fn)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Evaluate all steps of all episodes: ``(T, N, I) -> (T, N, O)``."""
        if self.time_varying:
            return self.mlp(x)
        return self.mlp(x.flatten(0, 1)[None])[0].unflatten(0, x.shape[:2])

    @th.no_grad()
    def scale_output(self, factor: float) -> None:
        """Multiply the parameters of the last layer by a factor, for instance to make the initial outputs small."""
        for parameter in self.mlp.layers[-1].parameters():
            parameter.mul_(factor)

    def at(self, x: th.Tensor, t: int) -> th.Tensor:
        """Evaluate the same step of all episodes: ``(N, I) -> (N, O)``."""
        return self.mlp.at(x, t if self.time_varying else 0)

    def at_times(self, x: th.Tensor, t: np.ndarray) -> th.Tensor:
        """Evaluate each episode at its own step: ``(N, I)`` and ``(N,) -> (N, O)``."""
        if not self.time_varying or (t == t[0]).all():
            return self.at(x, int(t[0]))
        rows = [np.flatnonzero(t == step) for step in np.unique(t)]
        outputs = [self.at(x[r], int(t[r[0]])) for r in rows]
        return th.cat(outputs)[np.argsort(np.concatenate(rows))]
