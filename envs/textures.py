"""
Draw the procedural wall textures of the ball-catching problem, and load textures from image files.

Dimension key: S texels per side of a procedural texture; H rows and W columns of any texture. A texture is an array
``(H, W, 3)`` uint8 as in an image file. One copy covers 8 m x 8 m of the wall. PyBullet's plane rotates the texture: on
the wall its columns run upwards and its rows to the right. So procedural textures are drawn upright and rotated at the
end.
"""

import colorsys
import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image

SIZE = 128  # S: a texel covers 6.25 cm of the wall; seen from 10 m away, a camera pixel covers five times that

Pattern = Callable[[np.random.Generator], np.ndarray]  # draws a tileable picture (S, S), values in [0, 1]

# Row and column of each texel, as fractions of a side.
ROWS, COLUMNS = np.meshgrid(*[(np.arange(SIZE) + 0.5) / SIZE] * 2, indexing="ij")


def _noise(rng: np.random.Generator, waves: float) -> np.ndarray:
    """Draw tileable smooth noise with about ``waves`` blobs per side and values spread evenly over [0, 1]."""
    frequency = np.fft.fftfreq(SIZE, 1 / SIZE)
    envelope = np.exp(-((frequency[:, None] ** 2 + frequency**2) / (2 * waves**2)))
    field = np.fft.ifft2(np.fft.fft2(rng.standard_normal((SIZE, SIZE))) * envelope).real
    return np.argsort(np.argsort(field, axis=None)).reshape(SIZE, SIZE) / SIZE**2


def bricks(rng: np.random.Generator) -> np.ndarray:
    """Draw a brick wall: 8 rows of 4 bricks (1 m x 2 m each), each with its own shade, and light mortar."""
    courses, per_course, mortar = 8, 4, 2 * 8 / SIZE  # the joint as a fraction of a course
    course = (ROWS * courses).astype(int)
    along = COLUMNS * per_course + 0.5 * (course % 2)
    brick = along.astype(int) % per_course
    shade = 0.55 * rng.random((courses, per_course))[course, brick]
    joint = (ROWS * courses % 1 < mortar) | (along % 1 < mortar * per_course / courses)
    return np.where(joint, 1.0, shade)


def tiles(rng: np.random.Generator) -> np.ndarray:
    """Draw a chequerboard of squares with unequal shades."""
    per_side = 2 * int(rng.integers(2, 5))
    rows, columns = ((axis * per_side).astype(int) for axis in (ROWS, COLUMNS))
    return 0.3 * rng.random((per_side, per_side))[rows, columns] + 0.7 * ((rows + columns) % 2)


def stripes(rng: np.random.Generator) -> np.ndarray:
    """Draw straight stripes: vertical, horizontal or slanted."""
    number, slant = int(rng.integers(3, 7)), int(rng.integers(-2, 3))
    rows, columns = (COLUMNS, ROWS) if rng.random() < 0.5 else (ROWS, COLUMNS)
    return 0.5 + 0.5 * np.sin(2 * np.pi * (number * columns + slant * rows))


def dots(rng: np.random.Generator) -> np.ndarray:
    """Draw round dots; every second row is shifted by half the distance between two dots."""
    per_side = 2 * int(rng.integers(2, 4))
    rows, columns = ROWS * per_side, COLUMNS * per_side
    columns = columns + 0.5 * (rows.astype(int) % 2)
    radius = 0.28 + 0.1 * rng.random()
    return (np.hypot(rows % 1 - 0.5, columns % 1 - 0.5) < radius).astype(float)


def planks(rng: np.random.Generator) -> np.ndarray:
    """Draw vertical boards of unequal shades with a grain and dark gaps."""
    number = int(rng.integers(6, 11))
    board = (COLUMNS * number).astype(int)
    grain = np.roll(_noise(rng, 6.0), rng.integers(SIZE), axis=0)
    shade = 0.35 + 0.45 * rng.random(number)[board] + 0.2 * grain
    return np.where(COLUMNS * number % 1 < 0.12, 0.0, shade)


def blobs(rng: np.random.Generator) -> np.ndarray:
    """Draw patches like leaves or camouflage, in four shades."""
    return np.floor(4 * _noise(rng, 4.0)) / 3


def waves(rng: np.random.Generator) -> np.ndarray:
    """Draw horizontal bands that are bent by smooth noise, as in marble."""
    return 0.5 + 0.5 * np.sin(2 * np.pi * (int(rng.integers(3, 6)) * ROWS + 1.2 * _noise(rng, 2.0)))


def speckles(rng: np.random.Generator) -> np.ndarray:
    """Draw fine and coarse noise, as in rough plaster."""
    return 0.5 * _noise(rng, 3.0) + 0.5 * _noise(rng, 24.0)


PATTERNS: tuple[Pattern, ...] = (bricks, tiles, stripes, dots, planks, blobs, waves, speckles)

Colour = tuple[float, float, float]  # hue, saturation, value, each in [0, 1]


def _paint(pattern: Pattern, seed: int, dark: Colour, light: Colour) -> np.ndarray:
    """Blend two colours by a pattern, add weak noise, and rotate the picture for the wall."""
    rng = np.random.default_rng(seed)
    ends = np.array([colorsys.hsv_to_rgb(*dark), colorsys.hsv_to_rgb(*light)])
    amount = pattern(rng)[..., None]  # (S, S, 1)
    picture = (1 - amount) * ends[0] + amount * ends[1] + 0.02 * rng.standard_normal((SIZE, SIZE, 1))
    upright = np.rint(255 * np.clip(picture, 0, 1)).astype(np.uint8)
    return np.ascontiguousarray(np.rot90(upright, -1))


# name: pattern, seed, and the colours for the pattern's values 0 and 1
_BUILT_IN: dict[str, tuple[Pattern, int, Colour, Colour]] = {
    "brick": (bricks, 0, (0.02, 0.80, 0.50), (0.05, 0.18, 0.80)),
    "blue_tiles": (tiles, 1, (0.61, 0.85, 0.45), (0.57, 0.35, 0.95)),
    "green_leaves": (blobs, 2, (0.36, 0.90, 0.20), (0.24, 0.65, 0.75)),
    "yellow_stripes": (stripes, 3, (0.12, 0.85, 0.55), (0.15, 0.55, 1.00)),
    "grey_plaster": (speckles, 4, (0.60, 0.04, 0.30), (0.10, 0.06, 0.85)),
    "violet_dots": (dots, 5, (0.76, 0.60, 0.40), (0.83, 0.25, 0.95)),
    "turquoise_waves": (waves, 6, (0.52, 0.90, 0.40), (0.46, 0.35, 0.90)),
    "red_planks": (planks, 7, (0.98, 0.75, 0.15), (0.03, 0.70, 0.75)),
}

TRAINING_TEXTURE = "brick"
TEST_TEXTURES = tuple(name for name in _BUILT_IN if name != TRAINING_TEXTURE)
"""The seven test backgrounds, in the order of Table II; the seventh has nearly the hue of the training texture."""


def floor_texture() -> np.ndarray:
    """Draw the chequerboard of PyBullet's floor, ``(512, 512, 3)``: squares of 1 m, pale blue and white."""
    side = np.arange(512) // 256
    is_blue = side[:, None] == side
    return np.where(is_blue[..., None], (173, 199, 239), (255, 255, 255)).astype(np.uint8)


def random_texture(seed: int) -> np.ndarray:
    """Draw a texture ``(S, S, 3)`` of random pattern and hue; the same seed gives the same texture."""
    rng = np.random.default_rng([seed, 8])  # a different random stream from the built-in textures
    pattern = PATTERNS[rng.integers(len(PATTERNS))]
    hue, shift = rng.random(), 0.1 * rng.standard_normal()
    dark = (hue, rng.uniform(0.3, 0.95), rng.uniform(0.2, 0.55))
    light = ((hue + shift) % 1, rng.uniform(0.1, 0.8), rng.uniform(0.65, 1.0))
    return _paint(pattern, int(rng.integers(2**31)), dark, light)


def load_texture(texture: str | os.PathLike[str] | np.ndarray) -> np.ndarray:
    """
    Load a texture from a name, a path or an array.

    :param texture: A built-in name (``"brick"`` or one of ``TEST_TEXTURES``), ``"random-<seed>"`` for
        :func:`random_texture`, the path of an image file, or an array ``(H, W, 3)`` uint8. ``"<percent>%-<name>"``
        draws a built-in or random texture over the brick with this opacity, as in ``"40%-violet_dots"``.
    :return: The texture, ``(H, W, 3)`` uint8.
    :raises ValueError: if a name is unknown, an array is not an image, or a file has grey values of more than 8 bits.
    :raises OSError: if Pillow cannot read the file.
    """
    if isinstance(texture, np.ndarray):
        if texture.dtype != np.uint8 or texture.ndim != 3 or texture.shape[2] != 3 or texture.size == 0:
            raise ValueError(
                f"texture is an array of shape {texture.shape} and dtype {texture.dtype}; expected (height, width, 3) "
                "of uint8 in 0..255"
            )
        return texture.copy()
    name = os.fspath(texture)
    if match := re.fullmatch(rf"(?:(\d?\d|100)%-)?({'|'.join(_BUILT_IN)}|random-(\d+))", name):
        percent, upper, seed = match.groups()
        picture = _paint(*_BUILT_IN[upper]) if seed is None else random_texture(int(seed))
        if percent is None:
            return picture
        share = int(percent) / 100
        blend = (1 - share) * load_texture(TRAINING_TEXTURE) + share * picture
        return np.rint(blend).astype(np.uint8)
    path = Path(name).expanduser()
    if not path.is_file():
        raise ValueError(
            f"texture={name!r} is no file and no known name: use one of {list(_BUILT_IN)}, 'random-<seed>', "
            "'<0 to 100>%-<name>' with one of these names, or the path of an image file"
        )
    with Image.open(path) as image:
        if image.mode.startswith("I"):  # Pillow would clip values above 255
            raise ValueError(f"texture={name!r} has grey values of more than 8 bits: convert it to 8 bits")
        return np.array(image.convert("RGB"))
