"""Noise on the pixels of images, in the two modes of the ball-catching problem."""

import numpy as np

NOISE_MODES = ("minmax", "clip")


def noisy_pixels(images: np.ndarray, std: float, mode: str, rng: np.random.Generator) -> np.ndarray:
    """
    Add Gaussian noise to every pixel, and bring the images back to [0, 1].

    :param images: ``(N, C, H, W)`` float32 in [0, 1]
    :param std: Standard deviation of the noise.
    :param mode: ``"minmax"``, as in the paper: subtract the minimum of each image, then divide by its maximum.
        ``"clip"``: clip the values to [0, 1].
    :param rng: Source of the noise.
    :return: a new array of the same shape, float32
    """
    noisy: np.ndarray = std * rng.standard_normal(images.shape, dtype=np.float32) + images
    if mode == "minmax":
        noisy -= noisy.min(axis=(1, 2, 3), keepdims=True)
        noisy /= noisy.max(axis=(1, 2, 3), keepdims=True)
    else:
        np.clip(noisy, 0, 1, out=noisy)
    return noisy
