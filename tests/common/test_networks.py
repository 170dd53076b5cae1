"""The batched networks are what a list of ordinary ones would be."""

import pytest
import torch as th
from torch import nn

from sb3_tdpg.common.networks import BatchedLinear, BatchedMLP, TimeMLP, flatten_parameters

T, N = 3, 5


def plain_mlp(network, index):
    """The same network as torch modules."""
    layers = []
    for i, layer in enumerate(network.layers):
        linear = nn.Linear(layer.weight.shape[1], layer.weight.shape[2])
        linear.weight.data = layer.weight[index].T.clone()
        linear.bias.data = layer.bias[index, 0].clone()
        layers.append(linear)
        if i < len(network.layers) - 1:
            layers.append(network.activation)
    return nn.Sequential(*layers)


@pytest.mark.parametrize(("sizes", "activation_fn"), [([4, 6, 6, 2], nn.ELU), ([4, 6, 2], nn.Tanh), ([4, 2], nn.ELU)])
def test_a_batched_mlp_is_a_list_of_ordinary_ones(sizes, activation_fn):
    network = BatchedMLP(T, sizes, activation_fn)
    x = th.randn(T, N, 4)
    expected = th.stack([plain_mlp(network, t)(x[t]) for t in range(T)])
    th.testing.assert_close(network(x), expected)
    th.testing.assert_close(th.stack([network.at(x[t], t) for t in range(T)]), expected)


@pytest.mark.parametrize("time_varying", [True, False])
def test_all_steps_at_once_equal_one_step_at_a_time(time_varying):
    network = TimeMLP(T, [4, 6, 2], time_varying=time_varying)
    x = th.randn(T, N, 4)
    th.testing.assert_close(network(x), th.stack([network.at(x[t], t) for t in range(T)]))


def test_weights_vary_in_time_or_are_shared_as_asked():
    x = th.randn(1, N, 4).expand(T, N, 4)
    varying, shared = (TimeMLP(T, [4, 6, 2], time_varying=flag)(x) for flag in (True, False))
    assert not th.allclose(varying[0], varying[1])
    th.testing.assert_close(shared[0], shared[1])
    sizes = [sum(p.numel() for p in TimeMLP(T, [4, 6, 2], time_varying=flag).parameters()) for flag in (True, False)]
    assert sizes[0] == T * sizes[1]


def test_the_initialisation_has_the_range_of_torchs_linear():
    layer = BatchedLinear(50, 16, 40)
    for parameter in (layer.weight, layer.bias):
        assert parameter.abs().max() <= 0.25
        assert parameter.abs().max() > 0.24
        assert abs(parameter.mean()) < 0.01


def test_one_flat_parameter_makes_the_steps_of_many():
    th.manual_seed(0)
    ours, theirs = BatchedMLP(T, (2, 8, 4, 1)), BatchedMLP(T, (2, 8, 4, 1))
    theirs.load_state_dict(ours.state_dict())
    adam = th.optim.Adam(theirs.parameters(), lr=0.01)
    flat = th.optim.Adam([flatten_parameters(ours)], lr=0.01, fused=True)
    target = th.randn(T, N, 1)
    for _ in range(20):
        x = th.randn(T, N, 2)
        flat.zero_grad(set_to_none=False)
        (ours(x) - target).square().sum().backward()
        flat.step()
        adam.zero_grad()
        (theirs(x) - target).square().sum().backward()
        adam.step()
    for one, other in zip(ours.parameters(), theirs.parameters(), strict=True):
        th.testing.assert_close(one, other)
