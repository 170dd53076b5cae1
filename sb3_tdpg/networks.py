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
        last = len(self.layers) - 1
        for i, layer in enumerate(self.layers):
            x = layer(x)
            if i < last:
                x = self.activation(x)
        return x

    def gradient_by_hand(self) -> ELUGradient:
        """Return a faster way than autograd to evaluate and differentiate this network; see :class:`ELUGradient`."""
        return ELUGradient(self)

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
    Evaluate and differentiate a :class:`BatchedMLP` with ELU layers without autograd.

    With autograd a whole training with MINE takes 1.3 to 1.5 times as long. Use it under ``torch.no_grad()``; the
    parameters must have a ``grad``, which :meth:`backward` overwrites.

    :param network: The network.
    """

    def __init__(self, network: BatchedMLP) -> None:
        assert isinstance(network.activation, nn.ELU), "only the derivative of ELU is written out"
        layers = cast("list[BatchedLinear]", list(network.layers))
        # Plain tensors on the same memory: calls on parameters are slower.
        self._layers = [(layer.weight.data, layer.bias.data) for layer in layers]
        self._gradients = [(cast(th.Tensor, layer.weight.grad), cast(th.Tensor, layer.bias.grad)) for layer in layers]
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
        for i in reversed(range(len(self._layers))):
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
                grad.mul_((x + 1).clamp_(max=1))


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

    def at(self, x: th.Tensor, t: int) -> th.Tensor:
        """One step, the same for all episodes: ``(N, I) -> (N, O)``."""
        return self.mlp.at(x, t if self.time_varying else 0)
