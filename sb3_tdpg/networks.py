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

# Beyond this horizon one set of weights per step would be slow and would starve: the steps share theirs.
MAX_TIME_VARYING_HORIZON = 50


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

    def gradient_by_hand(self) -> ELUGradient:
        """Return the means to evaluate and differentiate this network without autograd; see :class:`ELUGradient`."""
        assert isinstance(self.activation, nn.ELU), "only the derivative of ELU is written out"
        return ELUGradient([(layer.weight, layer.bias) for layer in cast("list[BatchedLinear]", list(self.layers))])

    def at(self, x: th.Tensor, index: int) -> th.Tensor:
        """Evaluate the network of one index: ``(N, I) -> (N, O)``."""
        last = len(self.layers) - 1
        for i, layer in enumerate(self.layers):
            assert isinstance(layer, BatchedLinear)
            x = layer.at(x, index)
            if i < last:
                x = self.activation(x)
        return x


class ELUGradient:
    """
    A :class:`BatchedMLP` with ELU layers, evaluated and differentiated by hand.

    For so small a network this takes a third of the time that modules and autograd take. To be used under
    ``torch.no_grad()``. The gradients are written into the parameters' ``grad``, which must exist.

    :param layers: weight ``(M, I, O)`` and bias ``(M, 1, O)`` of each layer
    """

    def __init__(self, layers: Sequence[tuple[nn.Parameter, nn.Parameter]]) -> None:
        # Plain tensors on the same memory: calls on parameters are slower.
        self._layers = [(weight.data, bias.data) for weight, bias in layers]
        self._gradients = [(cast(th.Tensor, weight.grad), cast(th.Tensor, bias.grad)) for weight, bias in layers]
        self._inputs: list[th.Tensor] = []

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Evaluate, and keep what :meth:`backward` needs: ``(M, N, I) -> (M, N, O)``."""
        *hidden, (last_weight, last_bias) = self._layers
        self._inputs = [x]
        for weight, bias in hidden:
            x = elu(th.baddbmm(bias, x, weight), inplace=True)
            self._inputs.append(x)
        return th.baddbmm(last_bias, x, last_weight)

    def backward(self, grad: th.Tensor) -> None:
        """
        Set the gradients of the parameters.

        :param grad: derivative of a scalar with respect to the last output, ``(M, N, O)``
        """
        for i in range(len(self._layers) - 1, -1, -1):
            (weight, _), (weight_grad, bias_grad), x = self._layers[i], self._gradients[i], self._inputs[i]
            is_column = grad.shape[2] == 1
            if is_column:  # a product of matrices is slow at this shape
                th.bmm(grad.mT, x, out=weight_grad.mT)
            else:
                th.bmm(x.mT, grad, out=weight_grad)
            th.sum(grad, dim=1, keepdim=True, out=bias_grad)
            if i > 0:
                grad = grad * weight.mT if is_column else th.bmm(grad, weight.mT)
                # d elu(z) / dz in terms of h = elu(z): 1 where h > 0, and exp(z) = h + 1 elsewhere.
                th.ops.aten.elu_backward.grad_input(grad, 1.0, 1.0, 1.0, True, x, grad_input=grad)


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

    def at(self, x: th.Tensor, t: int) -> th.Tensor:
        """One step, the same for all episodes: ``(N, I) -> (N, O)``."""
        return self.mlp.at(x, t if self.time_varying else 0)
