"""Every perturbation of observations, as data: a row of the table is a :class:`Perturbation`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from gymnasium import spaces

from sb3_tdpg.robustness import history, images, vectors
from sb3_tdpg.robustness.images import Episode
from sb3_tdpg.robustness.sensor import Sensor, kind_of

KINDS = ("image", "vector")
N_SEVERITIES = 5

Draw = Callable[[np.random.Generator, int, float, Sensor], dict[str, np.ndarray]]
Apply = Callable[[np.ndarray, float, Episode, np.random.Generator], np.ndarray]


@dataclass(frozen=True)
class Perturbation:
    """
    A change to what is observed, in five severities.

    Both functions see a batch of n episodes and the value of the severity. ``apply(observations, value, episode, rng)``
    returns the perturbed batch, a new array. It gets images as ``(n, C, H, W)`` float32 in [0, 1] and vectors as
    ``(n, D)`` float64 in multiples of their scale, and need not respect any bounds. What ``draw(rng, n, value,
    sensor)`` returns is kept for an episode: arrays with a leading dimension of n, drawn anew where an episode begins.
    ``apply`` finds them in ``episode``, beside the time ``episode["t"]``, ``(n,)``, 0 at the first observation.

    :param name: What it is called by.
    :param kind: ``"image"`` or ``"vector"``.
    :param parameter: What the severities are values of, with its unit.
    :param severities: Five values, from the mildest to the strongest.
    :param apply: See above.
    :param draw: See above; ``None``: nothing is drawn for an episode.
    :param summary: What happens, in a few words.
    :param channels: The numbers of channels that an image must have; ``None``: any.
    :param on_depth: Whether it makes sense on depth images: floats of one channel.
    :param later_only: Whether the first observation of an episode stays what it is.
    :param raw: ``apply`` gets observations ``(n, *obs)`` as they are, and must return such.
    :raises ValueError: if the kind is unknown, or there are not five severities.
    """

    name: str
    kind: str
    parameter: str
    severities: tuple[float, ...]
    apply: Apply
    draw: Draw | None = None
    summary: str = ""
    channels: Sequence[int] | None = None
    on_depth: bool = True
    later_only: bool = False
    raw: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind={self.kind!r} of {self.name!r} must be one of {list(KINDS)}")
        if len(self.severities) != N_SEVERITIES:
            raise ValueError(
                f"{self.name!r} has {len(self.severities)} severities {self.severities}, expected {N_SEVERITIES}: "
                "from the mildest to the strongest"
            )

    def value(self, severity: int) -> float:
        """
        Return the parameter at a severity.

        :raises ValueError: if the severity is no integer from 1 to 5.
        """
        is_whole = isinstance(severity, (int, np.integer)) and not isinstance(severity, bool)
        if not (is_whole and 1 <= severity <= N_SEVERITIES):
            raise ValueError(f"severity={severity!r} of {self.name!r} must be an integer from 1 to {N_SEVERITIES}")
        return self.severities[severity - 1]

    def objection(self, space: spaces.Space, horizon: int | None = None) -> str | None:
        """
        Say why this perturbation does not apply to an observation space; ``None``: it does.

        :param space: The observation space.
        :param horizon: Controls in an episode, where it is known.
        """
        kind = kind_of(space)
        if kind is None or not isinstance(space, spaces.Box):
            return f"the observation space {space} is no Box: use gymnasium.wrappers.FlattenObservation first"
        if kind != self.kind:
            needs = "images: a Box of three dimensions with finite bounds" if self.kind == "image" else "vectors"
            return f"it is for {needs}, and the observation space is {space}"
        sensor = Sensor(space)
        if self.channels is not None and sensor.shape[0] not in self.channels:
            wanted = " or ".join(str(channels) for channels in self.channels)
            return f"it needs images of {wanted} channels, and these have {sensor.shape[0]} (shape {space.shape})"
        if sensor.is_depth and not self.on_depth:
            return "it changes colours, and in a depth image (floats of one channel) there are none"
        if self.later_only and horizon == 1:
            return "it leaves the first observation of an episode alone, and with a horizon of 1 there is no other"
        return None

    def applies_to(self, space: spaces.Space, horizon: int | None = None) -> bool:
        """Tell whether this perturbation applies to an observation space; see :meth:`objection`."""
        return self.objection(space, horizon) is None


PERTURBATIONS: dict[str, Perturbation] = {
    row.name: row
    for row in (
        Perturbation(
            "noise", "image", "standard deviation, share of the range", (0.05, 0.10, 0.15, 0.20, 0.25), images.noise,
            summary="noise on every pixel, clipped to the bounds",
        ),
        Perturbation(
            "noise_minmax", "image", "standard deviation, share of the range", (0.05, 0.10, 0.15, 0.20, 0.25),
            images.noise_minmax, summary="noise on every pixel, then each image rescaled to the bounds (the paper's)",
        ),
        Perturbation(
            "brightness", "image", "offset, share of the range", (0.05, 0.10, 0.20, 0.30, 0.40), images.brightness,
            images.draw_sign, summary="brighter or darker, constant in an episode; an offset on depth images",
        ),
        Perturbation(
            "contrast", "image", "factor", (0.8, 0.6, 0.45, 0.3, 0.15), images.contrast,
            summary="contrast reduced towards the image's mean",
        ),
        Perturbation(
            "hue", "image", "angle, degrees", (20.0, 45.0, 80.0, 120.0, 180.0), images.hue, images.draw_turn,
            summary="hues rotated in either direction, constant in an episode",
            channels=(3,), on_depth=False,
        ),
        Perturbation(
            "blur", "image", "standard deviation, share of the height", (0.008, 0.016, 0.025, 0.04, 0.06), images.blur,
            summary="Gaussian blur",
        ),
        Perturbation(
            "occlusion", "image", "side, share of the image's", (0.2, 0.3, 0.4, 0.5, 0.6), images.occlusion,
            images.draw_square, summary="a rectangle of one colour at a random place, constant in an episode",
        ),
        Perturbation(
            "dropped_pixels", "image", "share of the pixels", (0.01, 0.05, 0.1, 0.2, 0.4), images.dropped_pixels,
            summary="random pixels set to the lowest value, drawn anew in every frame",
        ),
        Perturbation(
            "dropped_frames", "image", "share of the frames", (0.2, 0.35, 0.5, 0.65, 0.8), history.dropped_frames,
            history.draw_frames, summary="lost frames replaced by the last frame that arrived",
            later_only=True, raw=True,
        ),
        Perturbation(
            "delay", "image", "steps", (1, 2, 3, 4, 5), history.delay, history.draw_delay,
            summary="frames arrive late; the first frame is repeated until then", later_only=True, raw=True,
        ),
        Perturbation(
            "texture_overlay", "image", "opacity", (0.1, 0.2, 0.35, 0.5, 0.7), images.texture_overlay,
            images.draw_texture, summary="one of 16 textures overlaid on the image, constant in an episode",
            channels=(1, 3), on_depth=False,
        ),
        Perturbation(
            "camera_shift", "image", "distance, share of the height", (0.02, 0.04, 0.07, 0.10, 0.15),
            images.camera_shift, images.draw_shift,
            summary="image shifted in a random direction, as by a rotated camera, constant in an episode",
        ),
        Perturbation(
            "vector_noise", "vector", "standard deviation, scales", (0.05, 0.1, 0.2, 0.4, 0.8), vectors.noise,
            summary="noise on every component",
        ),
        Perturbation(
            "vector_bias", "vector", "offset, scales", (0.05, 0.1, 0.2, 0.4, 0.8), vectors.bias, vectors.draw_signs,
            summary="an offset on every component, constant in an episode",
        ),
        Perturbation(
            "vector_scale", "vector", "factor", (1.05, 1.1, 1.2, 1.5, 2.0), vectors.scale, vectors.draw_signs,
            summary="every component multiplied or divided, constant in an episode",
        ),
        Perturbation(
            "vector_dropout", "vector", "share of the readings", (0.1, 0.2, 0.35, 0.5, 0.7), vectors.dropout,
            vectors.draw_phase, summary="some components set to 0, different ones at every step",
        ),
        Perturbation(
            "vector_delay", "vector", "steps", (1, 2, 3, 4, 5), history.delay, history.draw_delay,
            summary="observations arrive late; the first one is repeated until then", later_only=True, raw=True,
        ),
    )
}  # fmt: skip
"""The perturbations by name."""


def register(perturbation: Perturbation) -> None:
    """
    Add a perturbation to :data:`PERTURBATIONS`.

    :raises ValueError: if the name is taken.
    """
    if perturbation.name in PERTURBATIONS:
        raise ValueError(f"there is a perturbation {perturbation.name!r} already: choose another name")
    PERTURBATIONS[perturbation.name] = perturbation


def find(name: str) -> Perturbation:
    """
    Return a perturbation by its name.

    :raises ValueError: if there is none.
    """
    if name not in PERTURBATIONS:
        raise ValueError(f"perturbation={name!r} is unknown: use one of {list(PERTURBATIONS)}")
    return PERTURBATIONS[name]


def applicable(space: spaces.Space, horizon: int | None = None) -> list[str]:
    """Return the names of the perturbations that apply to an observation space; see :meth:`Perturbation.objection`."""
    return [name for name, row in PERTURBATIONS.items() if row.applies_to(space, horizon)]


def severity_table(kind: str | None = None) -> pd.DataFrame:
    """
    Return the table of the severities: a row for each perturbation, with its parameter and columns 1 to 5.

    :param kind: ``"image"`` or ``"vector"``; ``None``: both.
    """
    rows = [
        dict(perturbation=row.name, kind=row.kind, parameter=row.parameter, **dict(zip("12345", row.severities)))  # noqa: B905
        for row in PERTURBATIONS.values()
        if kind in (None, row.kind)
    ]
    return pd.DataFrame(rows).set_index("perturbation")
