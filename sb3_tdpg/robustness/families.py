"""
Declare families of perturbations. Each episode has one perturbation of the family, its *member*.

Dimension key: N episodes side by side, n of them at a time, X state.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_tdpg.buffers import each_part
from sb3_tdpg.envs.base import POMDPEnv
from sb3_tdpg.problem import attribute_of, horizon_of
from sb3_tdpg.robustness.core import Drawn, Members, Observations, Perturber, States, put, take
from sb3_tdpg.robustness.registry import N_SEVERITIES, Perturbation, find_applicable
from sb3_tdpg.robustness.scale import default_scale
from sb3_tdpg.robustness.sensor import UNKNOWN_HORIZON, Sensor
from sb3_tdpg.robustness.training import WITH_KEYWORDS


class Family:
    """
    A declared family of perturbations; :meth:`members` draws a member for each episode.

    A declaration is one of the following:

    - a name in :data:`~sb3_tdpg.robustness.PERTURBATIONS`, or a :class:`~sb3_tdpg.robustness.Perturbation`;
    - a dict with the keys below;
    - a list of entries, each ``(name, value)`` with a value as in a dict, ``(name, value, factor)`` with a factor for
      the scale, or ``None`` for no perturbation;
    - a function ``(observations (n, *obs), rng) -> changed observations``, which is called at each step.

    A dict can have these keys:

    - names of perturbations, each with a severity or a range of severities, such as ``(1, 3)``;
    - ``"images"`` with keywords of :func:`~sb3_tdpg.robustness.training.images`;
    - ``"noise_range"`` with keywords of :func:`~sb3_tdpg.robustness.training.noise_range`;
    - ``"env_kwargs"`` with a list of keywords for other scenes of the environment. Their sensors observe the same
      state;
    - ``"redraw"`` in addition to ``"env_kwargs"``: a list of components of the state. The scenes draw these components
      anew for each episode.

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
            entries = [entry for entry in declared.items() if entry[0] != "redraw"]
            if declared and not entries:
                raise ValueError("'redraw' needs 'env_kwargs', the scenes that draw something anew")
        if not isinstance(entries, (list, tuple)) or not entries:
            raise ValueError(
                f"{declared!r} is no perturbation: expected the name of a perturbation, a dict of names and severities "
                "such as {'noise': (1, 3), 'contrast': 2}, a list such as [None, ('vector_noise', 3)], or a function "
                "of the observations and a random generator"
            )
        redraw = declared.get("redraw", ()) if isinstance(declared, Mapping) else ()
        self._makers = [maker for entry in entries for maker in self._makers_of(entry, redraw)]
        if len(self._kinds) > 1:
            raise ValueError(f"{declared!r} perturbs actions and observations: wrap the environment once for each")

    @property
    def is_plant(self) -> bool:
        """Whether the actions are perturbed instead of the observations."""
        return self._kinds == {True}

    def members(self, n: int, seed: int | None = None) -> Members:
        """Draw a member for each of N episodes."""
        if seed is not None and (isinstance(seed, bool) or seed < 0):
            raise ValueError(f"seed={seed} must be None or an integer of at least 0")
        if len(self._makers) == 1:
            return self._makers[0](n, seed=seed)
        return OneOf([make(n, seed=seed, part=str(i)) for i, make in enumerate(self._makers)], n, seed)

    def one(self, seed: int, n: int) -> Members:
        """Give N episodes the same member, which the seed identifies."""
        return self.members(1, seed).repeat(n)

    def _makers_of(self, entry: Any, redraw: Any) -> list[Callable[..., Members]]:
        if entry is None:
            return [lambda n, seed, part="": Members(n, part, seed=seed)]
        if not (isinstance(entry, (list, tuple)) and len(entry) in (2, 3)):
            raise ValueError(f"{entry!r} is no entry of a list: expected None or (name, severity)")
        name, value, *factor = entry
        if name != "env_kwargs" and not callable(value):
            return self._named(name, value, *factor)
        self._kinds.add(False)
        return [partial(FunctionMembers, value) if callable(value) else self._scenes(value, redraw)]

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
        sensor = Sensor(space, scale, horizon or UNKNOWN_HORIZON, attribute_of(env, "observation_groups"))
        return [partial(Perturber, found, severity, sensor) for severity in range(low, high + 1)]

    def _scenes(self, env_kwargs: Any, redraw: Any) -> Callable[..., Members]:
        inner: Any = attribute_of(self._env, "unwrapped")
        inner = getattr(inner, "unwrapped", inner)
        if not isinstance(inner, POMDPEnv):
            raise ValueError(
                f"'env_kwargs' needs an environment that can observe a given state, a POMDPEnv, not "
                f"{type(inner).__name__}: give a function of the observations instead"
            )
        names = list(getattr(inner, "state_names", ()))
        if not (isinstance(redraw, (list, tuple)) and all(name in names for name in redraw)):
            raise ValueError(f"redraw={redraw!r} must be a list of components of the state, some of {names}")
        own = {} if inner.spec is None else inner.spec.kwargs
        given = [env_kwargs] if isinstance(env_kwargs, Mapping) else env_kwargs
        if not (isinstance(given, Sequence) and given and all(isinstance(kwargs, Mapping) for kwargs in given)):
            raise ValueError(
                f"{{'env_kwargs': {env_kwargs!r}}} must hold keywords of the environment, or a list of such"
            )
        try:
            scenes = [type(inner)(**{**own, **kwargs}) for kwargs in given]
        except TypeError as e:  # an unknown keyword
            raise ValueError(f"{{'env_kwargs': {env_kwargs!r}}}: {e}") from e
        for scene in scenes:
            if scene.observation_space != inner.observation_space:
                raise ValueError(f"a scene of 'env_kwargs' has the observation space {scene.observation_space}")
        return partial(SceneMembers, scenes, [names.index(name) for name in redraw])


def _has_keywords(name: Any) -> bool:
    return isinstance(name, str) and name in WITH_KEYWORDS


class OneOf(Members):
    """Give each episode one of several perturbations, at random."""

    def __init__(self, members: Sequence[Members], n: int, seed: int | None = None) -> None:
        super().__init__(n, "one of", seed=seed, children=members)
        self.uses_states = any(each.uses_states for each in members)
        self.begin(np.arange(n))

    def _draw(self, n: int) -> Drawn:
        return dict(choice=self._rng.integers(len(self.children), size=n))

    def _show(self, observations: Observations, which: np.ndarray, states: States, episode: Drawn) -> Observations:
        result = each_part(np.copy, observations)
        for i, each in enumerate(self.children):
            mine = np.flatnonzero(episode["choice"] == i)
            if len(mine):
                of_mine = None if states is None else states[mine]
                put(result, mine, each(take(observations, mine), which[mine], of_mine))
        return result


class FunctionMembers(Members):
    """Replace the observations by the result of a user's function of observations and random generator."""

    def __init__(
        self, function: Callable[[Any, np.random.Generator], Any], n: int, *, seed: int | None = None, part: str = ""
    ) -> None:
        super().__init__(n, part, seed=seed)
        self.function = function

    def _show(self, observations: Observations, which: np.ndarray, states: States, episode: Drawn) -> Observations:
        changed = self.function(each_part(np.copy, observations), self._rng)  # the function may change them in place
        if not isinstance(observations, dict):
            changed = np.asarray(changed)
            if changed.shape != observations.shape or changed.dtype != observations.dtype:
                raise ValueError(
                    f"the perturbation returned observations of shape {changed.shape} and type {changed.dtype}, "
                    f"expected those it was given: {observations.shape}, {observations.dtype}"
                )
            if not np.isfinite(changed).all():
                raise ValueError("the perturbation returned observations that are NaN or infinite")
        return changed


class SceneMembers(Members):
    """
    Observe the same state in other scenes, for an environment of this package.

    :param scenes: Copies of the environment with other keywords.
    :param redraw: Indices of the state's components that are drawn anew for each episode, from the scenes'
        distributions of the initial state.
    """

    uses_states = True

    def __init__(
        self, scenes: Sequence[POMDPEnv], redraw: Sequence[int], n: int, *, seed: int | None = None, part: str = ""
    ) -> None:
        super().__init__(n, part, seed=seed)
        self.scenes, self.redraw = scenes, redraw
        self.begin(np.arange(n))

    def _draw(self, n: int) -> Drawn:
        number, redrawn = self._rng.integers(len(self.scenes), size=n), np.zeros((n, len(self.redraw)))
        for scene, chosen in self._by_scene(number) if self.redraw else ():
            redrawn[chosen] = scene.initial_state(len(chosen))[:, self.redraw]
        return dict(number=number, redrawn=redrawn)

    def _by_scene(self, number: np.ndarray) -> list[tuple[POMDPEnv, np.ndarray]]:
        """Return each scene with the indices of its episodes, given the number of the scene of each episode."""
        for each in self.scenes:
            each.np_random = self._rng
        return [(self.scenes[i], np.flatnonzero(number == i)) for i in np.unique(number)]

    def _show(self, observations: Observations, which: np.ndarray, states: States, episode: Drawn) -> Observations:
        if states is None:
            raise ValueError("other scenes need the true state of each episode: pass it with the observations")
        seen = np.array(states, dtype=np.float64)
        seen[:, self.redraw] = episode["redrawn"]
        changed = observations.copy()
        for scene, chosen in self._by_scene(episode["number"]):
            changed[chosen] = scene.sensor(seen[chosen])
        return changed
