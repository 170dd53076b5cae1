"""Add noise to the pixels of images, in the two modes of the ball-catching problem."""

import numpy as np

NOISE_MODES = ("minmax", "clip")


def noisy_pixels(images: np.ndarray, std: float, mode: str, rng: np.random.Generator) -> np.ndarray:
    """
    Add Gaussian noise to every pixel of images in [0, 1], ``(N, C, H, W)`` float32, and map them back to [0, 1].

    ``"minmax"``, as in the paper, subtracts each image's minimum and then divides by the new maximum. ``"clip"`` clips
    each pixel to [0, 1].
    """
    noisy: np.ndarray = std * rng.standard_normal(images.shape, dtype=np.float32) + images
    if mode == "minmax":
        noisy -= noisy.min(axis=(1, 2, 3), keepdims=True)
        noisy /= noisy.max(axis=(1, 2, 3), keepdims=True)
    else:
        np.clip(noisy, 0, 1, out=noisy)
    return noisy
