"""
Networks with one set of weights per time step, evaluated for all steps at once.

Dimension key: T horizon, N episodes, I inputs, O outputs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import cast

import torch as th
from torch import nn
from torch.nn.functional import elu


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

    def __init__(
        self,
        n_maps: int,
        sizes: Sequence[int],
        activation_fn: type[nn.Module] = nn.ELU,
    ) -> None:
        super().__init__()
        self.n_maps = n_maps
        self.layers = nn.ModuleList(BatchedLinear(n_maps, i, o) for i, o in pairwise(sizes))
        self.activation = activation_fn()

    def forward(self, x: th.Tensor) -> th.Tensor:
        """``(M, N, I) -> (M, N, O)``."""
        last = len(self.layers) - 1
        for i, layer in enumerate(self.layers):
            x = layer(x)
            if i < last:
                x = self.activation(x)
        return x

    def forward_keeping_hidden(self, x: th.Tensor) -> tuple[th.Tensor, list[th.Tensor]]:
        """
        Evaluate for :meth:`set_gradients`; both are to be called under ``torch.no_grad()``.

        :return: the output ``(M, N, O)``, and the input of every layer
        """
        # Direct calls, which are a third of a small network's time less than those through nn.Module.
        *hidden, last = cast("list[BatchedLinear]", list(self.layers))
        inputs = [x]
        for layer in hidden:
            x = elu(th.baddbmm(layer.bias, x, layer.weight))
            inputs.append(x)
        return th.baddbmm(last.bias, x, last.weight), inputs

    def set_gradients(self, inputs: list[th.Tensor], grad_output: th.Tensor) -> None:
        """
        Back-propagate by hand into the parameters' ``grad``: less than half the time that autograd takes for so small a
        network. For ELU hidden layers and a linear output.

        :param inputs: from :meth:`forward_keeping_hidden`
        :param grad_output: derivative of a scalar with respect to the output, ``(M, N, O)``
        """
        grad = grad_output
        for layer, x in zip(reversed(list(self.layers)), reversed(inputs), strict=True):
            assert isinstance(layer, BatchedLinear)
            layer.weight.grad = (grad.mT @ x).mT if grad.shape[2] == 1 else x.mT @ grad
            layer.bias.grad = grad.sum(dim=1, keepdim=True)
            if x is not inputs[0]:
                grad = grad * layer.weight.mT if grad.shape[2] == 1 else grad @ layer.weight.mT
                # d elu(z) / dz in terms of h = elu(z): 1 where h > 0, and exp(z) = h + 1 elsewhere.
                grad = th.ops.aten.elu_backward(grad, 1.0, 1.0, 1.0, True, x)

    def at(self, x: th.Tensor, index: int) -> th.Tensor:
        """Evaluate the network of one index: ``(N, I) -> (N, O)``."""
        last = len(self.layers) - 1
        for i, layer in enumerate(self.layers):
            assert isinstance(layer, BatchedLinear)
            x = layer.at(x, index)
            if i < last:
                x = self.activation(x)
        return x


class TimeMLP(nn.Module):
    """
    An MLP whose weights vary with the time step, or are shared by all steps.

    :param horizon: Number of time steps T.
    :param sizes: Width of every layer, from the input to the output.
    :param activation_fn: Nonlinearity after each layer but the last.
    :param time_varying: One set of weights per step, or one for all.
    """

    def __init__(
        self,
        horizon: int,
        sizes: Sequence[int],
        activation_fn: type[nn.Module] = nn.ELU,
        *,
        time_varying: bool = True,
    ) -> None:
        super().__init__()
        self.time_varying = time_varying
        self.mlp = BatchedMLP(horizon if time_varying else 1, sizes, activation_fn)

    def forward(self, x: th.Tensor) -> th.Tensor:
        """All steps of all episodes: ``(T, N, I) -> (T, N, O)``."""
        if self.time_varying:
            return self.mlp(x)
        return self.mlp(x.flatten(0, 1)[None])[0].unflatten(0, x.shape[:2])

    def at(self, x: th.Tensor, t: int) -> th.Tensor:
        """One step, the same for all episodes: ``(N, I) -> (N, O)``."""
        return self.mlp.at(x, t if self.time_varying else 0)
