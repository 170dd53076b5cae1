"""Feature extractors that stand in front of the encoder."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn


class TRVCnn(BaseFeaturesExtractor):
    """
    The paper's convolutional layers: two of 6 channels, stride 2, ELU, then flattened.

    :param observation_space: An image space with channels first.
    :param kernel_sizes: Kernel of each of the two layers (4 and 4 for ball catching, 6 and 4 for grasping).
    :param n_channels: Output channels of each layer.
    """

    def __init__(
        self, observation_space: spaces.Box, kernel_sizes: Sequence[int] = (4, 4), n_channels: int = 6
    ) -> None:
        super().__init__(observation_space, features_dim=1)
        layers: list[nn.Module] = []
        channels = observation_space.shape[0]
        for kernel_size in kernel_sizes:
            layers += [nn.Conv2d(channels, n_channels, kernel_size, stride=2), nn.ELU(inplace=True)]
            channels = n_channels
        # With so few channels the convolutions are faster with the channels innermost in memory.
        self.cnn = nn.Sequential(*layers, nn.Flatten()).to(memory_format=th.channels_last)  # type: ignore[call-overload]
        with th.no_grad():
            self._features_dim = self.cnn(th.zeros(1, *observation_space.shape)).shape[1]

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """``(N, C, H, W) -> (N, features_dim)``."""
        return self.cnn(observations.contiguous(memory_format=th.channels_last))
