"""
Random changes to the images that a policy sees in training, so that the bottleneck has something to leave out.

For the evaluation, by one perturbation at a time in five severities, see :mod:`sb3_tdpg.robustness`.

Dimension key: N environments, C channels, H and W rows and columns.
"""

from __future__ import annotations

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from torch.nn.functional import interpolate

PATTERN_SIZES = (2, 4, 8, 16, 32, 64)
"""Cells a side of the random patterns: from two halves of the image to single pixels of 64 x 64."""


class VecImagePerturbation(VecEnvWrapper):
    r"""
    Perturb every image of a vectorised environment at random.

    In the order in which it is done, with y in [0, 1] and fresh random numbers for every image:

    1. colour: the channels are mixed, :math:`y \leftarrow M y`, :math:`M = I + \mathtt{color} \cdot` normal, rows
       divided by their sums (or by 0.3, if that is more);
    2. pattern: :math:`y \leftarrow (1 - a) y + a p` with a random coloured pattern p (the size of its cells, and
       whether they have edges, are drawn once for all images of a step); a is uniform up to ``pattern``, 0 for three
       images of ten, and 1 in a rectangle with sides uniform up to ``patch`` of the image's;
    3. contrast: :math:`y \leftarrow s y + o` with s uniform in ``[1 - contrast, 1]`` and an offset o that keeps y in
       [0, 1];
    4. noise: normal at every pixel, with a standard deviation uniform up to ``noise``.

    The true state is left alone. What an encoder tells of such a change is of no use to the task and counts as
    information with the bounds that see the encoder's density (``"logdet"``, ``"loo"``, ``"vib"``): they bound what the
    TRVs carry of all that is in the image. Random numbers are torch's, so that a seed and a checkpoint cover them.

    :param venv: Environments with images of bytes, channels first or last.
    :param color: See above; 0 leaves the colours alone.
    :param pattern: Likewise, at most 1.
    :param patch: Likewise, at most 1.
    :param contrast: Likewise, at most 1.
    :param noise: Likewise.
    :raises ValueError: if the observations are no images of bytes, or a strength is out of its range.
    """

    def __init__(
        self,
        venv: VecEnv,
        color: float = 0.35,
        pattern: float = 0.7,
        patch: float = 0.5,
        contrast: float = 0.7,
        noise: float = 0.1,
    ) -> None:
        super().__init__(venv)
        space = venv.observation_space
        if not (isinstance(space, spaces.Box) and is_image_space(space)):
            raise ValueError(f"VecImagePerturbation takes images of bytes (uint8, 0 to 255), and not {space}")
        for name, value, largest in (
            ("color", color, np.inf), ("pattern", pattern, 1.0), ("patch", patch, 1.0),
            ("contrast", contrast, 1.0), ("noise", noise, np.inf),
        ):  # fmt: skip
            if not 0 <= value <= largest:
                raise ValueError(f"{name}={value} must be between 0 and {largest:g}")
        self.color = color
        self.pattern = pattern
        self.patch = patch
        self.contrast = contrast
        self.noise = noise
        self._channels_last = space.shape[0] > space.shape[2]

    def reset(self) -> np.ndarray:
        """Reset, and perturb the first images."""
        images = self.venv.reset()
        assert isinstance(images, np.ndarray)
        return self.perturb(images)

    def step_wait(self) -> VecEnvStepReturn:
        """Step, and perturb the images."""
        images, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(images, np.ndarray)
        return self.perturb(images), rewards, dones, infos

    def _patches(self, n: int, height: int, width: int) -> th.Tensor:
        """Draw rectangles with sides uniform up to ``patch`` of the image's: ``(N, 1, H, W)``, 1 inside."""

        def interval(length: int) -> th.Tensor:
            size = self.patch * th.rand(n, 1)
            start = (1 - size) * th.rand(n, 1)
            at = (th.arange(length) + 0.5) / length
            return (at >= start) & (at < start + size)

        return (interval(height)[:, None, :, None] & interval(width)[:, None, None, :]).float()

    def perturb(self, images: np.ndarray) -> np.ndarray:
        """
        Perturb each image anew.

        :param images: ``(N, C, H, W)`` or ``(N, H, W, C)``, uint8
        :return: the same shape and type
        """
        y = th.as_tensor(images.transpose(0, 3, 1, 2) if self._channels_last else images) / 255.0
        n, channels, height, width = y.shape

        def uniform() -> th.Tensor:
            return th.rand(n, 1, 1, 1)

        mixing = th.eye(channels) + self.color * th.randn(n, channels, channels)
        mixing = mixing / mixing.sum(dim=2, keepdim=True).clamp(min=0.3)
        y = (mixing @ y.flatten(2)).unflatten(2, (height, width))

        amount = self.pattern * uniform() * (uniform() < 0.7)
        size = PATTERN_SIZES[int(th.randint(len(PATTERN_SIZES), ()))]
        mode = ("nearest", "bilinear")[int(th.randint(2, ()))]
        pattern = interpolate(th.rand(n, channels, size, size), size=(height, width), mode=mode)
        amount = th.maximum(amount, self._patches(n, height, width))
        y = (1 - amount) * y + amount * pattern

        scale = 1 - self.contrast * uniform()
        y = scale * y + (1 - scale) * uniform()

        y = y + self.noise * uniform() * th.randn_like(y)
        result = (255 * y.clamp(0, 1)).round().to(th.uint8).numpy()
        return result.transpose(0, 2, 3, 1) if self._channels_last else result
