"""
Declare families of perturbations. Each episode has one perturbation of the family, its *member*.

Dimension key: N episodes side by side, n of them at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_tdpg.buffers import each_part
from sb3_tdpg.problem import horizon_of
from sb3_tdpg.robustness.core import Drawn, Members, Observations, Perturber, put, take
from sb3_tdpg.robustness.registry import N_SEVERITIES, Perturbation, find_applicable
from sb3_tdpg.robustness.scale import default_scale
from sb3_tdpg.robustness.sensor import UNKNOWN_HORIZON, Sensor
from sb3_tdpg.robustness.training import WITH_KEYWORDS


class Family:
    """
    A declared family of perturbations; :meth:`members` draws a member for each episode.

    A declaration is one of the following:

    - a name in :data:`~sb3_tdpg.robustness.PERTURBATIONS`, or a :class:`~sb3_tdpg.robustness.Perturbation`;
    - ``"images"`` or ``"noise_range"``, with the default keywords;
    - a dict with the keys below;
    - a list of entries, each ``(name, value)`` with a value as in a dict, ``(name, value, factor)`` with a factor for
      the scale, or ``None`` for no perturbation;
    - a function ``(observations (n, *obs), rng) -> changed observations``, which is called at each step.

    A dict can have these keys:

    - names of perturbations, each with a severity or a range of severities, such as ``(1, 3)``;
    - ``"images"`` with keywords of :func:`~sb3_tdpg.robustness.training.images`;
    - ``"noise_range"`` with keywords of :func:`~sb3_tdpg.robustness.training.noise_range`.

    With a dict or a list, each episode has one of the entries at random. A range of severities counts as one entry for
    each severity.

    :param declared: The declaration, see above.
    :param env: The environment. Reset it afterwards.
    :param severity: Severity for a declaration that is only a name. With ``None``, each episode has a random severity.
    :param scale: See :class:`~sb3_tdpg.robustness.PerturbedVecEnv`.
    :raises ValueError: if a perturbation does not exist or does not apply.
    """

    def __init__(self, declared: Any, env: gym.Env | VecEnv, severity: int | None = None, scale: Any = None) -> None:
        self._env, self._given_scale = env, scale
        self._kinds: set[bool] = set()  # whether actions are perturbed
        entries: Any = declared
        if isinstance(declared, (str, Perturbation)):
            every = (1, N_SEVERITIES) if severity is None else severity
            entries = [(declared, {} if _has_keywords(declared) else every)]
        elif callable(declared):
            entries = [("", declared)]
        elif isinstance(declared, Mapping):
            entries = list(declared.items())
        if not isinstance(entries, (list, tuple)) or not entries:
            raise ValueError(
                f"{declared!r} is no perturbation: expected the name of a perturbation, a dict of names and severities "
                "such as {'noise': (1, 3), 'contrast': 2}, a list such as [None, ('vector_noise', 3)], or a function "
                "of the observations and a random generator"
            )
        self._makers = [maker for entry in entries for maker in self._makers_of(entry)]
        if len(self._kinds) > 1:
            raise ValueError(f"{declared!r} perturbs actions and observations: wrap the environment once for each")

    @property
    def is_plant(self) -> bool:
        """Whether the actions are perturbed instead of the observations."""
        return self._kinds == {True}

    def members(self, n: int, seed: int | None = None) -> Members:
        """Draw a member for each of N episodes."""
        if len(self._makers) == 1:
            return self._makers[0](n, seed=seed)
        return OneOf([make(n, seed=seed, part=str(i)) for i, make in enumerate(self._makers)], n, seed)

    def one(self, seed: int, n: int) -> Members:
        """Give N episodes the same member, which the seed identifies."""
        return self.members(1, seed).repeat(n)

    def _makers_of(self, entry: Any) -> list[Callable[..., Members]]:
        if entry is None:
            return [lambda n, seed, part="": Members(n, part, seed=seed)]
        if not (isinstance(entry, (list, tuple)) and len(entry) in (2, 3)):
            raise ValueError(f"{entry!r} is no entry of a list: expected None or (name, severity)")
        name, value, *factor = entry
        if callable(value):
            self._kinds.add(False)
            return [partial(FunctionMembers, value)]
        return self._named(name, value, *factor)

    @cached_property
    def _measured_scale(self) -> Any:
        env = self._env
        while isinstance(env, VecEnvWrapper) and "unperturbed" in vars(env):  # the unit is that of the plain sensor
            env = env.venv
        return default_scale(env.observation_space, env, self._given_scale)

    def _named(self, name: Any, value: Any, factor: float = 1.0) -> list[Callable[..., Members]]:
        """Return, for each severity, a function that makes the members of a perturbation."""
        env, horizon = self._env, horizon_of(self._env)
        if _has_keywords(name):
            try:
                name = WITH_KEYWORDS[name](**value)
            except TypeError as e:
                raise ValueError(f"{{{name!r}: {value!r}}} must hold keywords of {name}(): {e}") from e
            value = 1
        found = find_applicable(name, env.observation_space, horizon, env.action_space)
        low, *others = value if isinstance(value, (tuple, list)) and value else (value,)
        high = others[0] if others else low
        for severity in (low, high):
            found.value(severity)
        if len(others) > 1 or low > high:
            raise ValueError(f"{{{name!r}: {value!r}}} must be a severity, or the lowest and the highest one")
        self._kinds.add(found.kind == "action")
        space, scale = env.observation_space, None
        if found.kind == "action":
            space, scale = env.action_space, np.ones(env.action_space.shape or ())
        elif not found.timing and (found.kind != "image" or self._given_scale is not None):
            of_parts = self._measured_scale  # not needed for images alone; measuring takes steps of the environment
            scale = None if of_parts is None else each_part(lambda part: factor * part, of_parts)
        sensor = Sensor(space, scale, horizon or UNKNOWN_HORIZON)
        return [partial(Perturber, found, severity, sensor) for severity in range(low, high + 1)]


def _has_keywords(name: Any) -> bool:
    return isinstance(name, str) and name in WITH_KEYWORDS


class OneOf(Members):
    """Give each episode one of several perturbations, at random."""

    def __init__(self, members: Sequence[Members], n: int, seed: int | None = None) -> None:
        super().__init__(n, "one of", seed=seed, children=members)
        self.begin(np.arange(n))

    def _draw(self, n: int) -> Drawn:
        return dict(choice=self._rng.integers(len(self.children), size=n))

    def _show(self, observations: Observations, which: np.ndarray, episode: Drawn) -> Observations:
        result = each_part(np.copy, observations)
        for i, each in enumerate(self.children):
            mine = np.flatnonzero(episode["choice"] == i)
            if len(mine):
                put(result, mine, each(take(observations, mine), which[mine]))
        return result


class FunctionMembers(Members):
    """Replace the observations by the result of a user's function of observations and random generator."""

    def __init__(
        self, function: Callable[[Any, np.random.Generator], Any], n: int, *, seed: int | None = None, part: str = ""
    ) -> None:
        super().__init__(n, part, seed=seed)
        self.function = function

    def _show(self, observations: Observations, which: np.ndarray, episode: Drawn) -> Observations:
        changed = self.function(each_part(np.copy, observations), self._rng)  # the function may change them in place
        if not isinstance(observations, dict):
            changed = np.asarray(changed)
            expected, given = ((x.shape, x.dtype.name) for x in (observations, changed))
            if given != expected or not np.isfinite(changed).all():
                raise ValueError(f"the perturbation returned {given}, expected finite observations {expected}")
        return changed
