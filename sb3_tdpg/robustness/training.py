"""
Random changes to the images of a training, so that the bottleneck has something to leave out.

Dimension key: N images or episodes, C channels, H and W rows and columns.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn
from torch.nn.functional import interpolate

PATTERN_SIZES = (2, 4, 8, 16, 32, 64)  # cells a side of the random patterns

PATTERN_GROUP = 16  # images whose patterns have cells of one size

Drawn = dict[str, th.Tensor]  # what was drawn for N images or episodes, with a leading dimension of N


@dataclass(frozen=True)
class ImageMixture:
    r"""
    A mixture of random changes of images, applied in this order to y in [0, 1]:

    1. colour: the channels are mixed, :math:`y \leftarrow M y`, :math:`M = I + \mathtt{color} \cdot` normal, with rows
       divided by their sums (or by 0.3, if that is more);
    2. pattern: :math:`y \leftarrow (1 - a) y + a p` with a random coloured pattern p, of 2 to 64 cells a side, with
       edges or without (the same for 16 images side by side); a is uniform up to ``pattern``, 0 for three images of
       ten, and 1 in a rectangle with sides uniform up to ``patch`` of the image's sides;
    3. contrast: :math:`y \leftarrow s y + o` with s uniform in ``[1 - contrast, 1]`` and an offset o that keeps y in
       [0, 1];
    4. noise: Gaussian at every pixel, with a standard deviation uniform up to ``noise``.

    The random numbers are torch's, so a seed and a checkpoint cover them.

    :param color: Strength of the mixing; 0 leaves the colours unchanged.
    :param pattern: Largest opacity of the pattern, at most 1.
    :param patch: Largest side of the opaque rectangle, at most 1.
    :param contrast: Largest loss of contrast, at most 1.
    :param noise: Largest standard deviation of the noise.
    :raises ValueError: if a strength is out of its range.
    """

    color: float = 0.35
    pattern: float = 0.7
    patch: float = 0.5
    contrast: float = 0.7
    noise: float = 0.1

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            largest = np.inf if name in ("color", "noise") else 1.0
            if not 0 <= value <= largest:
                raise ValueError(f"{name}={value} must be between 0 and {largest:g}")

    def draw(self, n: int, channels: int, height: int, width: int) -> Drawn:
        """Draw N changes of images of a size: everything but the noise at each pixel."""

        def uniform() -> th.Tensor:
            return th.rand(n, 1, 1, 1)

        mixing = th.eye(channels) + self.color * th.randn(n, channels, channels)
        amount = self.pattern * uniform() * (uniform() < 0.7)
        return dict(
            mixing=mixing / mixing.sum(dim=2, keepdim=True).clamp(min=0.3),
            pattern=self._patterns(n, channels, height, width),
            amount=th.maximum(amount, self._patches(n, height, width)),
            scale=1 - self.contrast * uniform(),
            offset=uniform(),
            noise=self.noise * uniform(),
        )

    def _patterns(self, n: int, channels: int, height: int, width: int) -> th.Tensor:
        """Draw random coloured cells: ``(N, C, H, W)``."""
        parts = []
        for start in range(0, n, PATTERN_GROUP):
            size = PATTERN_SIZES[int(th.randint(len(PATTERN_SIZES), ()))]
            mode = ("nearest", "bilinear")[int(th.randint(2, ()))]
            cells = th.rand(min(PATTERN_GROUP, n - start), channels, size, size)
            parts.append(interpolate(cells, size=(height, width), mode=mode))
        return th.cat(parts) if parts else th.empty(0, channels, height, width)

    def _patches(self, n: int, height: int, width: int) -> th.Tensor:
        """Draw rectangles with sides uniform up to ``patch`` of the image's: ``(N, 1, H, W)``, 1 inside."""

        def interval(length: int) -> th.Tensor:
            size = self.patch * th.rand(n, 1)
            start = (1 - size) * th.rand(n, 1)
            at = (th.arange(length) + 0.5) / length
            return (at >= start) & (at < start + size)

        return (interval(height)[:, None, :, None] & interval(width)[:, None, None, :]).float()

    def apply(self, images: np.ndarray, drawn: Drawn) -> np.ndarray:
        """
        Change each image as drawn, with new noise.

        :param images: ``(N, C, H, W)`` uint8
        :return: the same shape and type
        """
        y = th.as_tensor(images) / 255.0
        y = (drawn["mixing"] @ y.flatten(2)).unflatten(2, y.shape[2:])
        y = th.lerp(y, drawn["pattern"], drawn["amount"])
        y = drawn["scale"] * y + (1 - drawn["scale"]) * drawn["offset"]
        y = y + drawn["noise"] * th.randn_like(y)
        return (255 * y.clamp(0, 1)).round().to(th.uint8).numpy()


class VecImagePerturbation(VecEnvWrapper):
    """
    Change every image of a vectorised environment by an :class:`ImageMixture`.

    The true state does not change. The bounds that use the encoder's density (``"logdet"``, ``"loo"``, ``"vib"``) bound
    the information about everything in the image, so what an encoder keeps of these changes counts as information.

    :param venv: Environments with images of bytes, channels first or last.
    :param held: Whether an episode keeps what was drawn at its beginning, but for the noise; else every image has its
        own.
    :param strengths: See :class:`ImageMixture`.
    :raises ValueError: if the observations are not images of bytes, or a strength is out of its range.
    """

    def __init__(self, venv: VecEnv, *, held: bool = False, **strengths: float) -> None:
        super().__init__(venv)
        space = venv.observation_space
        if not (isinstance(space, spaces.Box) and is_image_space(space)):
            raise ValueError(f"VecImagePerturbation takes images of bytes (uint8, 0 to 255), not {space}")
        self.mixture = ImageMixture(**strengths)
        self.held = held
        self._drawn: Drawn = {}  # of the running episodes
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
        return self.perturb(images, dones if self.held else None), rewards, dones, infos

    def perturb(self, images: np.ndarray, begins: np.ndarray | None = None) -> np.ndarray:
        """
        Perturb N images.

        :param images: ``(N, C, H, W)`` or ``(N, H, W, C)``, uint8
        :param begins: Which of them have new random numbers, ``(N,)``; the others keep those of the last call. None:
            all have new ones.
        """
        if self._channels_last:
            images = images.transpose(0, 3, 1, 2)
        which = np.arange(len(images)) if begins is None else np.flatnonzero(begins)
        drawn = self.mixture.draw(len(which), *images.shape[1:])
        if begins is None:
            self._drawn = drawn
        else:
            for name, values in drawn.items():
                self._drawn[name][which] = values
        result = self.mixture.apply(images, self._drawn)
        return result.transpose(0, 2, 3, 1) if self._channels_last else result
