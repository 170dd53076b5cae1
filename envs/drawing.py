"""Draw the planar environments with NumPy, as boxes on a light background."""

import math

import numpy as np


def paint_box(
    image: np.ndarray,
    middle: tuple[float, float],
    size: tuple[float, float],
    angle: float,
    colour: tuple[int, int, int],
    span: tuple[float, float, float, float] = (-1.0, 1.0, -1.0, 1.0),
) -> None:
    """
    Paint a rotated box into an image, in place.

    :param image: The image, ``(H, W, 3)`` uint8.
    :param middle: x and y of the box's middle, in the units of ``span``.
    :param size: Length and width of the box, in the units of ``span``.
    :param angle: Angle between the lengthwise axis of the box and the x-axis, in rad.
    :param colour: Red, green and blue, each from 0 to 255.
    :param span: Coordinates of the left, right, lower and upper edges of the image.
    """
    height, width = image.shape[:2]
    left, right, low, high = span
    x = left + (np.arange(width) + 0.5) * (right - left) / width - middle[0]
    y = (high - (np.arange(height) + 0.5) * (high - low) / height - middle[1])[:, None]
    along = x * math.cos(angle) + y * math.sin(angle)
    across = y * math.cos(angle) - x * math.sin(angle)
    image[(np.abs(along) <= size[0] / 2) & (np.abs(across) <= size[1] / 2)] = colour
