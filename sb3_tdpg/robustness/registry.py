"""Register the perturbations of sensor and actuators."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_tdpg.robustness.sensor import Sensor

N_SEVERITIES = 5
KINDS = ("image", "vector", "any", "action")
KEEP, NOTHING = -1, -2  # in place of an age: the observation shown last, and a blank observation

Episode = Mapping[str, np.ndarray]  # the values drawn for the episodes of a batch, and their time
Draw = Callable[[np.random.Generator, int, float, Sensor], dict[str, np.ndarray]]
Apply = Callable[[np.ndarray, float, Episode, np.random.Generator], np.ndarray]


@dataclass(frozen=True)
class Perturbation:
    """
    A change to the observations or the actions, in five severities.

    ``apply`` and ``draw`` work on n episodes and get the value of the severity.
    ``apply(observations, value, episode, rng)`` returns the perturbed batch as a new array, which may exceed the
    bounds. It gets images as ``(n, C, H, W)`` float32 in [0, 1], vectors as ``(n, D)`` float64 in multiples of their
    scale, and actions without a scale. ``draw(rng, n, value, sensor)`` is called when n episodes begin, and returns
    arrays with a leading dimension of n. ``apply`` finds these arrays in ``episode``, together with the time
    ``episode["t"]``, ``(n,)``, which is 0 at the first observation.

    A perturbation of the *timing* gets ``episode["t"]`` in place of observations. It returns ``(n,)`` integers that
    determine which observation is shown:

    - the age of an observation in steps, from 0 for the present one to the value of the severity;
    - ``KEEP`` for the observation that was shown last;
    - ``NOTHING`` for a blank observation.

    The perturbation can also return ``(n, G)`` integers, 0 or ``NOTHING`` for each of the G groups ``sensor.groups``.

    :param kind: ``"image"``, ``"vector"``, ``"any"`` (timing of images, vectors and ``Dict``) or ``"action"``.
    :param parameter: Name of the quantity whose values are the severities, with its unit.
    :param severities: Five values, from the mildest to the strongest.
    :param summary: The effect in a few words.
    :param channels: Permitted numbers of image channels. ``None`` permits any number.
    :param on_depth: Whether the perturbation makes sense on depth images, which have one channel of floats.
    :param timing: Whether ``apply`` decides which observation is shown, or which action is applied. It must show the
        first observation of an episode.
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
    timing: bool = False

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"kind={self.kind!r} of {self.name!r} must be one of {list(KINDS)}")
        if (n := len(self.severities)) != N_SEVERITIES:
            raise ValueError(f"{self.name!r} has {n} severities, expected 5: from the mildest to the strongest")

    def value(self, severity: int) -> float:
        """Return the value of the parameter at a severity, an integer from 1 to 5."""
        is_whole = isinstance(severity, (int, np.integer)) and not isinstance(severity, bool)
        if not (is_whole and 1 <= severity <= N_SEVERITIES):
            raise ValueError(f"severity={severity!r} of {self.name!r} must be an integer from 1 to {N_SEVERITIES}")
        return self.severities[severity - 1]

    def objection(
        self, space: spaces.Space, horizon: int | None = None, action_space: spaces.Space | None = None
    ) -> str | None:
        """
        Return the reason why this perturbation does not apply, or ``None`` if it applies.

        :param space: The observation space. In a ``Dict``, only the parts to which the perturbation applies are
            perturbed.
        :param horizon: Largest number of steps of an episode, if there is a limit.
        :param action_space: The action space, which only perturbations of the actions need.
        """
        if self.timing and self.kind != "action" and horizon == 1:
            return "it leaves the first observation of an episode unchanged, and with a horizon of 1 there is no other"
        if self.kind == "action":
            is_box = isinstance(action_space, spaces.Box)
            return None if is_box else f"it changes the actions of a Box, and the action space is {action_space}"
        if isinstance(space, spaces.Dict):
            objections = [self.objection(part, horizon) for part in space.values()]
            return objections[0] if objections and all(objections) else None
        if not isinstance(space, spaces.Box):
            return f"the observation space {space} is not a Box: use gymnasium.wrappers.FlattenObservation first"
        sensor = Sensor(space)
        if self.kind != "any" and (self.kind == "image") != sensor.is_image:
            needs = "images: a Box of three dimensions with finite bounds" if self.kind == "image" else "vectors"
            return f"it is for {needs}, and the observation space is {space}"
        if self.channels is not None and sensor.shape[0] not in self.channels:
            wanted = " or ".join(str(channels) for channels in self.channels)
            return f"it needs images of {wanted} channels, and these have {sensor.shape[0]} (shape {space.shape})"
        if sensor.is_depth and not self.on_depth:
            return "it changes colours, and in a depth image (floats of one channel) there are none"
        return None


PERTURBATIONS: dict[str, Perturbation] = {}  # by name, filled by :mod:`sb3_tdpg.robustness.effects`


def register(perturbation: Perturbation) -> None:
    """Add a perturbation with a new name to :data:`PERTURBATIONS`."""
    if perturbation.name in PERTURBATIONS:
        raise ValueError(f"a perturbation {perturbation.name!r} exists already: choose another name")
    PERTURBATIONS[perturbation.name] = perturbation


def perturbation(
    kind: str, parameter: str, severities: tuple[float, ...], *, name: str | None = None, **settings: Any
) -> Callable[[Apply], Apply]:
    """Register a function as a :class:`Perturbation`. The first line of the function's docstring is the summary."""

    def add(apply: Apply) -> Apply:
        summary = (apply.__doc__ or "").strip().split("\n")[0].rstrip(".")
        own_name = getattr(apply, "__name__", "")
        register(Perturbation(name or own_name, kind, parameter, severities, apply, summary=summary, **settings))
        return apply

    return add


def find_applicable(
    perturbation: str | Perturbation,
    space: spaces.Space,
    horizon: int | None = None,
    action_space: spaces.Space | None = None,
) -> Perturbation:
    """Return a perturbation, given itself or its name; raise an error if it is unknown or does not apply."""
    if isinstance(perturbation, str) and perturbation not in PERTURBATIONS:
        raise ValueError(f"perturbation={perturbation!r} is unknown: use one of {list(PERTURBATIONS)}")
    found = PERTURBATIONS[perturbation] if isinstance(perturbation, str) else perturbation
    if (objection := found.objection(space, horizon, action_space)) is not None:
        raise ValueError(f"the perturbation {found.name!r} does not apply: {objection}")
    return found


def applicable(space: spaces.Space, horizon: int | None = None, action_space: spaces.Space | None = None) -> list[str]:
    """Return the names of the perturbations that apply to an environment; see :meth:`Perturbation.objection`."""
    return [name for name, row in PERTURBATIONS.items() if row.objection(space, horizon, action_space) is None]
