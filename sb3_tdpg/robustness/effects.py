"""
Define the perturbations with severities. Each is a function of a batch of observations, actions or times.

The decorator ``@perturbation`` adds them to the registry. Two perturbations reuse the function of another one, and are
added by a direct call.

Images are ``(n, C, H, W)`` float32 in [0, 1]. Vectors are ``(n, D)`` float64 in multiples of their scale. Perturbations
of the timing get the time of each episode, ``(n,)``, and return which observation is shown.

Dimension key: n episodes side by side, C channels, H and W rows and columns, D components, G groups of components.
"""

import functools

import numpy as np

from sb3_tdpg.envs.noise import noisy_pixels
from sb3_tdpg.envs.textures import random_texture
from sb3_tdpg.robustness.registry import KEEP, NOTHING, Episode, perturbation
from sb3_tdpg.robustness.sensor import Sensor

MIN_BLUR = 0.35  # pixels: a narrower Gaussian changes nothing
N_TEXTURES = 16
FIRST_TEXTURE = 1000  # seed of the first texture; the seeds of users start at 0


@perturbation("image", "standard deviation, share of the range", (0.05, 0.10, 0.15, 0.20, 0.25))
def noise(images: np.ndarray, std: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Add noise to every pixel, and clip to [0, 1]."""
    return noisy_pixels(images, std, "clip", rng)


@perturbation("image", "standard deviation, share of the range", (0.05, 0.10, 0.15, 0.20, 0.25))
def noise_minmax(images: np.ndarray, std: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Add noise to every pixel, and stretch each image to [0, 1], as the paper does."""
    return noisy_pixels(images, std, "minmax", rng)


def draw_signs(rng: np.random.Generator, n: int, value: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw for each episode one sign for all its images, or one sign for each component of its vectors."""
    return dict(sign=rng.choice([-1.0, 1.0], (n, *((1, 1, 1) if sensor.is_image else sensor.shape))))


@perturbation("image", "offset, share of the range", (0.05, 0.10, 0.20, 0.30, 0.40), draw=draw_signs)
def brightness(images: np.ndarray, amount: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Make all images of an episode brighter or darker; on depth images, add an offset."""
    return images + np.float32(amount) * episode["sign"].astype(np.float32)


@perturbation("image", "factor", (0.8, 0.6, 0.45, 0.3, 0.15))
def contrast(images: np.ndarray, factor: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Move all pixels towards the mean of their image."""
    mean = images.mean(axis=(1, 2, 3), keepdims=True)
    return mean + np.float32(factor) * (images - mean)


def draw_turn(rng: np.random.Generator, n: int, degrees: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw for each episode the direction in which its colours rotate about the grey axis."""
    from scipy.spatial.transform import Rotation

    angle = np.deg2rad(degrees) * rng.choice([-1.0, 1.0], n)
    turn = Rotation.from_rotvec(angle[:, None] * np.ones(3) / np.sqrt(3))
    return dict(turn=turn.as_matrix().astype(np.float32))  # (n, 3, 3)


@perturbation(
    "image", "angle, degrees", (20.0, 45.0, 80.0, 120.0, 180.0), draw=draw_turn, channels=(3,), on_depth=False
)
def hue(images: np.ndarray, degrees: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Rotate the colours about the grey axis, in the same direction for a whole episode."""
    return (episode["turn"] @ images.reshape(*images.shape[:2], -1)).reshape(images.shape)


@perturbation("image", "standard deviation, share of the height", (0.008, 0.016, 0.025, 0.04, 0.06))
def blur(images: np.ndarray, width: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Blur with a Gaussian."""
    from scipy.ndimage import gaussian_filter

    std = max(MIN_BLUR, width * images.shape[2])
    return np.asarray(gaussian_filter(images, std, axes=(2, 3), mode="nearest"))


def draw_square(rng: np.random.Generator, n: int, side: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw the place and the colour of each episode's occluder."""
    channels, *lengths = sensor.shape
    inside = []
    for length in lengths:
        size = max(1, round(side * length))
        place = np.arange(length) - rng.integers(0, length - size + 1, (n, 1))
        inside.append((place >= 0) & (place < size))
    return dict(rows=inside[0], columns=inside[1], color=rng.random((n, channels, 1, 1), dtype=np.float32))


@perturbation("image", "side, share of the image's", (0.2, 0.3, 0.4, 0.5, 0.6), draw=draw_square)
def occlusion(images: np.ndarray, side: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Cover a rectangle with one colour, the same in all images of an episode."""
    inside = episode["rows"][:, None, :, None] & episode["columns"][:, None, None, :]
    return np.where(inside, episode["color"], images)


@perturbation("image", "share of the pixels", (0.01, 0.05, 0.1, 0.2, 0.4))
def dropped_pixels(images: np.ndarray, share: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Set random pixels to the lowest value, new ones in every frame."""
    is_dead = rng.random(images[:, :1].shape, dtype=np.float32) < share
    return np.where(is_dead, np.float32(0), images)


def evenly(number: np.ndarray, share: float, phase: np.ndarray) -> np.ndarray:
    """Choose a share of the numbers 0, 1, ..., evenly spaced. Independent choices could leave out a short episode."""
    return np.floor(share * (number + 1) + phase) > np.floor(share * number + phase)


def draw_phase(rng: np.random.Generator, n: int, share: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw the argument ``phase`` of :func:`evenly` for each episode."""
    return dict(phase=rng.random(n))


@perturbation("image", "share of the frames", (0.2, 0.35, 0.5, 0.65, 0.8), draw=draw_phase, timing=True)
def dropped_frames(t: np.ndarray, share: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Replace lost frames with the last frame that arrived."""
    return np.where((t > 0) & evenly(t - 1, share, episode["phase"]), KEEP, 0)


@perturbation("image", "steps", (1, 2, 3, 4, 5), timing=True)
def delay(t: np.ndarray, steps: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Delay the observations by a number of steps; during these steps, show the first one."""
    return np.full_like(t, int(steps))


@functools.cache
def _textures(channels: int, height: int, width: int) -> np.ndarray:
    """Return the textures in the size of an image: ``(16, C, H, W)``, read-only."""
    bank = np.stack([random_texture(FIRST_TEXTURE + i) for i in range(N_TEXTURES)]) / np.float32(255)
    rows, columns = (np.arange(length) * bank.shape[1] // length for length in (height, width))
    sized = bank[:, rows][:, :, columns].transpose(0, 3, 1, 2)
    sized = sized if channels == 3 else sized.mean(axis=1, keepdims=True)
    sized.flags.writeable = False
    return sized


@perturbation(
    "image", "opacity", (0.1, 0.2, 0.35, 0.5, 0.7), channels=(1, 3), on_depth=False,
    draw=lambda rng, n, opacity, sensor: dict(texture=rng.integers(0, N_TEXTURES, n)),
)  # fmt: skip
def texture_overlay(images: np.ndarray, opacity: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Blend one of 16 textures into all images of an episode."""
    texture = _textures(*images.shape[1:])[episode["texture"]]
    return np.float32(1 - opacity) * images + np.float32(opacity) * texture


def draw_shift(rng: np.random.Generator, n: int, distance: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw the shift of each episode's images, in a random direction and in whole pixels."""
    _, *lengths = sensor.shape
    angle = rng.uniform(0, 2 * np.pi, n)
    shift = max(1.0, distance * lengths[0]) * np.stack([np.sin(angle), np.cos(angle)])
    shifts = np.rint(shift).astype(int)[..., None]  # (2, n, 1), down and right
    rows, columns = (np.clip(np.arange(m) + by, 0, m - 1) for m, by in zip(lengths, shifts, strict=True))
    return dict(rows=rows, columns=columns)


@perturbation("image", "distance, share of the height", (0.02, 0.04, 0.07, 0.10, 0.15), draw=draw_shift)
def camera_shift(images: np.ndarray, distance: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Shift all images of an episode in one direction, as if the camera were turned a little."""
    shifted = np.take_along_axis(images, episode["rows"][:, None, :, None], axis=2)
    return np.take_along_axis(shifted, episode["columns"][:, None, None, :], axis=3)


@perturbation("vector", "standard deviation, scales", (0.05, 0.1, 0.2, 0.4, 0.8))
def vector_noise(vectors: np.ndarray, std: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Add noise to every component."""
    return vectors + std * rng.standard_normal(vectors.shape)


@perturbation("vector", "offset, scales", (0.05, 0.1, 0.2, 0.4, 0.8), draw=draw_signs)
def vector_bias(vectors: np.ndarray, offset: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Add an offset to every component, constant for an episode."""
    return vectors + offset * episode["sign"]


@perturbation("vector", "factor", (1.05, 1.1, 1.2, 1.5, 2.0), draw=draw_signs)
def vector_scale(vectors: np.ndarray, factor: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Multiply or divide every component by a factor, in the same way for a whole episode."""
    return vectors * factor ** episode["sign"]


@perturbation("vector", "share of the readings", (0.1, 0.2, 0.35, 0.5, 0.7), draw=draw_phase)
def vector_dropout(vectors: np.ndarray, share: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Set some components to 0, different ones at every step."""
    n, size = vectors.shape  # the same share of the readings in every episode
    rank = rng.permuted(np.tile(np.arange(size), (n, 1)), axis=1)
    reading = episode["t"][:, None] * size + rank
    return np.where(evenly(reading, share, episode["phase"][:, None]), 0.0, vectors)


perturbation("vector", "steps", (1, 2, 3, 4, 5), name="vector_delay", timing=True)(delay)


@perturbation("any", "probability", (0.1, 0.25, 0.4, 0.6, 0.8), timing=True)
def hold(t: np.ndarray, probability: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """At each step, repeat the last observation with the given probability."""
    return np.where((t > 0) & (rng.random(len(t)) < probability), KEEP, 0)


@perturbation(
    "any", "longest delay, steps", (1, 2, 4, 6, 8), timing=True,
    draw=lambda rng, n, longest, sensor: dict(delay=rng.integers(1, int(longest) + 1, n), age=np.zeros(n, np.int64)),
)  # fmt: skip
def lag(t: np.ndarray, longest: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Delay the observations by a random number of steps per episode, with a jitter of one step."""
    due = (episode["delay"] + rng.integers(-1, 2, len(t))).clip(0, int(longest))
    age = episode["age"]
    age[:] = np.where(t == 0, 0, np.minimum(due, age + 1))  # an observation older than the last one is not shown
    return age.copy()


@perturbation(
    "any", "steps", (1, 2, 4, 8, 16), timing=True,
    # The blackout ends before the horizon if it is short enough.
    draw=lambda rng, n, steps, sensor: dict(start=rng.integers(1, max(1, sensor.horizon - int(steps)) + 1, n)),
)  # fmt: skip
def blackout(t: np.ndarray, steps: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Once per episode, show 0 or a black image for several steps."""
    since = t - episode["start"]
    return np.where((since >= 0) & (since < steps), NOTHING, 0)


LATEST = ("latest start, share of the episode", (1.0, 0.8, 0.6, 0.4, 0.2))


def draw_start(rng: np.random.Generator, n: int, latest: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw the step of each episode at which a failure begins, the second step at the earliest."""
    # The same random numbers give an earlier start at a higher severity.
    return dict(start=1 + (rng.random(n) * max(1, int(latest * (sensor.horizon - 1)))).astype(np.int64))


@perturbation("any", *LATEST, draw=draw_start, timing=True)
def freeze(t: np.ndarray, latest: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Show the last observation for the rest of the episode, from a random step on."""
    return np.where(t >= episode["start"], KEEP, 0)


def draw_group(rng: np.random.Generator, n: int, latest: float, sensor: Sensor) -> dict[str, np.ndarray]:
    """Draw the group that fails in each episode, and return the step at which each group fails: ``(n, G)``."""
    which = rng.integers(len(sensor.groups), size=n)
    start = draw_start(rng, n, latest, sensor)["start"]
    never = np.iinfo(np.int64).max
    return dict(start=np.where(which[:, None] == np.arange(len(sensor.groups)), start[:, None], never))


@perturbation("any", *LATEST, draw=draw_group, timing=True)
def group_failure(t: np.ndarray, latest: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """From a random step on, show one group of components as 0 or black."""
    return np.where(t[:, None] >= episode["start"], NOTHING, 0)


perturbation("action", "factor", (1.05, 1.1, 1.2, 1.5, 2.0), name="actuator_gain", draw=draw_signs)(vector_scale)


@perturbation("action", "steps", (1, 2, 3, 4, 5), timing=True)
def actuator_delay(t: np.ndarray, steps: float, episode: Episode, rng: np.random.Generator) -> np.ndarray:
    """Apply the action of some steps ago, and 0 until then."""
    return np.where(t < steps, NOTHING, int(steps))
