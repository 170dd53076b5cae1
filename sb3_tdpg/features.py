"""Classify observations, and extract features for the encoder: the CNN and the running norms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, NatureCNN
from torch import nn
from torch.nn.functional import avg_pool2d

from sb3_tdpg.common.running_norms import RunningNorm

MIN_SIDE = 12  # pixels: floats with a shorter side are no depth image (the paper's two convolutions need 10)
LEAST_MAP = 3  # pixels, side of the smallest feature map in which a position is meaningful


def observation_kind(space: spaces.Space | None, *, normalize_images: bool = True) -> str:
    """
    Return the kind of an observation, on which the defaults depend.

    :param space: The observation space.
    :param normalize_images: Whether the policy divides bytes by 255; if not, images of floats in [0, 1] are also
        accepted.
    :return: ``"image"``: uint8, channels first or last; ``"depth"``: a ``Box`` of floats, ``(1, H, W)`` with at least
        12 pixels a side; ``"vector"``: anything else. A ``Dict`` with images has the kind of its images.
    """
    if isinstance(space, spaces.Dict):
        kinds = {observation_kind(part, normalize_images=normalize_images) for part in space.values()}
        return next((kind for kind in ("image", "depth") if kind in kinds), "vector")
    if isinstance(space, spaces.Box) and np.issubdtype(space.dtype, np.floating):
        channels, *sides = space.shape if len(space.shape) == 3 else (0,)
        if channels == 1 and min(sides) >= MIN_SIDE:
            return "depth"
    if space is not None and is_image_space(space, check_channels=False, normalized_image=not normalize_images):
        return "image"
    return "vector"


def of_images(policy_kwargs: Any) -> dict[str, bool]:
    """Return those keywords of the policy that affect the kind of an observation."""
    given = policy_kwargs if isinstance(policy_kwargs, dict) else {}
    return {name: value for name, value in given.items() if name == "normalize_images"}


def flat_action_space(space: spaces.Space) -> spaces.Space:
    """Flatten a ``MultiDiscrete`` or ``MultiBinary`` space of several dimensions; SB3 supports only one dimension."""
    if isinstance(space, spaces.MultiDiscrete):
        return spaces.MultiDiscrete(space.nvec.flatten())
    if isinstance(space, spaces.MultiBinary):
        return spaces.MultiBinary(int(np.prod(space.shape)))
    return space


def least_side(layers: Sequence[tuple[int, int, int]], keypoints: bool = False) -> int:
    """Return the smallest side of an image, in pixels, that the layers of a :class:`TRVCnn` can process."""
    side = LEAST_MAP if keypoints else 1
    for _, kernel_size, stride in reversed(layers):
        side = stride * (side - 1) + kernel_size
    return side


class SpatialSoftmax(nn.Module):
    r"""
    Compute a *keypoint* for each channel: the mean position of its pixels, weighted by a softmax of their activations.

    .. math::
        p_c = \sum_i \mathrm{softmax}_i(\alpha_c z_{ci}) \, (x_i, y_i)

    The sum is over the pixels i, with positions from -1 to 1. The activations :math:`z_{ci}` are standardised over the
    image, and the factor :math:`\alpha_c` is learned. If an object moves in the image, its keypoint moves in
    proportion, also to places that were not seen in training. The layer follows Levine et al. (2016, "End-to-end
    training of deep visuomotor policies"), who do not standardise the activations.

    :param channels: Number of channels C.
    :param height: Height H of a feature map in pixels.
    :param width: Width W of a feature map in pixels.
    """

    def __init__(self, channels: int, height: int, width: int) -> None:
        super().__init__()
        self.log_factor = nn.Parameter(th.full((channels, 1), math.log(2.0)))
        self.norm = nn.LayerNorm(height * width, elementwise_affine=False)
        y, x = th.meshgrid(th.linspace(-1, 1, height), th.linspace(-1, 1, width), indexing="ij")
        self.positions: th.Tensor
        self.register_buffer("positions", th.stack([x.flatten(), y.flatten()], dim=1), persistent=False)

    def forward(self, maps: th.Tensor) -> th.Tensor:
        """Return x and y of each channel's keypoint, channel after channel: ``(N, C, H, W) -> (N, 2 C)``."""
        weights = th.softmax(self.norm(maps.flatten(2)) * self.log_factor.exp(), dim=2)
        return (weights @ self.positions).flatten(1)


class TRVCnn(BaseFeaturesExtractor):
    """
    Convolutional network in front of the encoder.

    By default, it has the paper's two layers (6 channels, stride 2, ELU), and its output is flattened.

    With ``pool``, every square of ``pool x pool`` pixels is first replaced by its mean. Otherwise a layer of stride 2
    would turn fine textures into coarse ones (aliasing). Unseen textures would then have a large effect on the
    features.

    With ``keypoints``, a :class:`~sb3_tdpg.features.SpatialSoftmax` replaces the nonlinearity of the last layer. The
    features are then the positions at which that layer's maps are active. They describe where an object is and not how
    it looks.

    Images of floats, such as depth in m, are first scaled from the bounds of their space to [-1, 1] if the bounds are
    finite.

    :param observation_space: An image space with channels first.
    :param layers: Number of output channels, kernel size and stride of each layer; the last two in pixels.
    :param activation_fn: Nonlinearity after each layer.
    :param features_dim: Number of outputs of a last linear layer, as in SB3's ``NatureCNN``; None: no such layer.
    :param layer_norm: Whether the outputs of the linear layer are standardised for each image before the nonlinearity.
        The features are then less sensitive to the contrast.
    :param pool: Side of the squares in pixels; 1: no pooling, as in the paper. Images that would become too small for
        the layers are not pooled.
    :param keypoints: Whether the features are positions, with two coordinates for each channel of the last layer.
    :raises ValueError: if the images are too small for the layers.
    """

    def __init__(
        self,
        observation_space: spaces.Box,
        layers: Sequence[tuple[int, int, int]] = ((6, 4, 2), (6, 4, 2)),
        activation_fn: type[nn.Module] = nn.ELU,
        features_dim: int | None = None,
        layer_norm: bool = False,
        pool: int = 1,
        keypoints: bool = False,
    ) -> None:
        super().__init__(observation_space, features_dim=1)
        needed = least_side(layers, keypoints)
        self.image_size = observation_space.shape[1:]
        if min(self.image_size) < needed:
            raise ValueError(f"images of {self.image_size} pixels are too small for layers={layers}, {needed} a side")
        self.pool = pool if min(self.image_size) // pool >= needed else 1
        low, high = float(observation_space.low.min()), float(observation_space.high.max())
        is_scaled = np.issubdtype(observation_space.dtype, np.floating) and -np.inf < low < high < np.inf
        self.offset, self.scale = ((low + high) / 2, (high - low) / 2) if is_scaled else (0.0, 1.0)
        modules: list[nn.Module] = []
        channels = observation_space.shape[0]
        for n_channels, kernel_size, stride in layers:
            modules += [nn.Conv2d(channels, n_channels, kernel_size, stride=stride), activation_fn()]
            channels = n_channels
        with th.no_grad():
            maps = nn.Sequential(*modules)(self.pooled(th.zeros(1, *observation_space.shape)))
        if keypoints:
            modules[-1] = SpatialSoftmax(*maps.shape[1:])
        self.cnn = nn.Sequential(*modules, nn.Flatten())
        self._features_dim = 2 * channels if keypoints else maps[0].numel()
        if features_dim is not None:
            norm = [nn.LayerNorm(features_dim)] if layer_norm else []
            self.cnn.extend([nn.Linear(self._features_dim, features_dim), *norm, activation_fn()])
            self._features_dim = features_dim

    def pooled(self, images: th.Tensor) -> th.Tensor:
        """Average images over squares, unless already pooled: ``(N, C, H, W) -> (N, C, H / pool, W / pool)``."""
        if self.pool == 1 or images.shape[2:] != self.image_size:
            return images
        if self.pool == 2 and images.dtype == th.uint8 and images.is_contiguous() and images.shape[3] % 2 == 0:
            # Summing neighbouring bytes as integers takes a fifth of the time of avg_pool2d, which needs floats.
            pairs = images[:, :, : images.shape[2] // 2 * 2].contiguous().view(th.int16)
            sums = (pairs & 255) + ((pairs >> 8) & 255)
            return (sums[:, :, ::2] + sums[:, :, 1::2]).float() / 4
        return avg_pool2d(images.float(), self.pool)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """Extract the features: ``(N, C, H, W) -> (N, features_dim)``; the images may be pooled already."""
        # With so few channels, convolutions are faster in this layout.
        images = self.pooled(observations).contiguous(memory_format=th.channels_last)
        is_scaled = (self.offset, self.scale) != (0.0, 1.0)
        return self.cnn((images - self.offset) / self.scale if is_scaled else images)


def pooled_steps(extractor: nn.Module, observations: th.Tensor | dict[str, th.Tensor]) -> Any:
    """Pool the images of an epoch, ``(T, N, *obs)``, once for all passes; a dict of observations stays unchanged."""
    if not isinstance(extractor, TRVCnn) or extractor.pool == 1 or isinstance(observations, dict):
        return observations
    return extractor.pooled(observations.flatten(0, 1)).unflatten(0, observations.shape[:2])


def flat_steps(extractor: nn.Module, x: th.Tensor) -> th.Tensor:
    """Flatten the steps of episodes for a feature extractor: ``(T, N, *obs) -> (T * N, *obs)``."""
    x = x.flatten(0, 1)
    # Change the layout while the pixels are still bytes, which is faster. Other extractors may need the usual layout
    # (``view``).
    is_faster = isinstance(extractor, NatureCNN) or (isinstance(extractor, TRVCnn) and extractor.pool == 1)
    return x.contiguous(memory_format=th.channels_last) if x.dim() == 4 and is_faster else x


class ObservationNorm(nn.Module):
    """
    Standardise each vector of an observation by a :class:`RunningNorm`; images and one-hot inputs stay unchanged.

    :param space: The observation space, which may be a ``Dict``.
    """

    def __init__(self, space: spaces.Space) -> None:
        super().__init__()
        parts = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
        vectors = {k: x for k, x in parts.items() if isinstance(x, spaces.Box) and observation_kind(x) == "vector"}
        self.norms = nn.ModuleDict({key: RunningNorm(math.prod(x.shape)) for key, x in vectors.items()})

    def forward(self, observation: Any) -> Any:
        """Standardise the vectors: ``(n, *obs) -> (n, *obs)``, or a dict of such tensors."""
        if isinstance(observation, dict):
            return {key: self._standardized(x, key) for key, x in observation.items()}
        return self._standardized(observation, "observation")

    def _standardized(self, x: th.Tensor, key: str) -> th.Tensor:
        return self.norms[key](x.flatten(1).float()).view(x.shape) if key in self.norms else x

    def update(self, observations: Any, alive: th.Tensor) -> None:
        """
        Update the statistics with an epoch's observations.

        :param observations: ``(T, N, *obs)``, or a dict of such tensors
        :param alive: 1 while an episode runs, then 0, ``(T, N)``
        """
        for key, norm in self.norms.items():
            x = observations[key] if isinstance(observations, dict) else observations
            cast(RunningNorm, norm).update(x[alive.bool()].flatten(1).float())
