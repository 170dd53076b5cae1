"""
Nuisances: declared families of changes of the sensor, of which every episode has one member.

:mod:`sb3_tdpg.information.nuisance` removes from a policy what it knows of them.

Dimension key: N episodes side by side, n of them at a time, X state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg.envs.base import POMDPEnv
from sb3_tdpg.robustness.core import Perturber
from sb3_tdpg.robustness.registry import N_SEVERITIES, find
from sb3_tdpg.robustness.scale import default_scale
from sb3_tdpg.robustness.sensor import finite_range
from sb3_tdpg.robustness.training import Drawn, ImageMixture

Observations = Any
"""An array ``(n, *obs)``, or a dict of such."""

LEVELS = ("auto", "rollouts", "action")
IMAGES = "images"  # the name of ImageMixture in a declaration


class Members(ABC):
    """The members of a family that N episodes have."""

    @abstractmethod
    def begin(self, which: np.ndarray) -> None:
        """Draw new members for the episodes with the indices ``which``, ``(n,)``, which begin."""

    @abstractmethod
    def __call__(self, observations: Observations, states: np.ndarray, which: np.ndarray) -> Observations:
        """
        Return what the changed sensor shows at the next step of some episodes.

        :param observations: what the sensor shows, ``(n, *obs)``
        :param states: x_t, ``(n, X)``
        :param which: indices of the episodes, ``(n,)``
        """


class Nuisance(ABC):
    """A declared family of changes of the sensor; the states, the cost and the dynamics stay as they are."""

    @abstractmethod
    def members(self, n: int) -> Members:
        """Draw a member for each of N episodes. All random numbers derive from torch's generator."""


def random_seed() -> int:
    """Draw a seed for NumPy from torch's generator, which a checkpoint covers."""
    return int(th.randint(2**31, ()))


class MixtureNuisance(Nuisance):
    """
    An :class:`~sb3_tdpg.robustness.training.ImageMixture` of images of bytes.

    :param held: Whether an episode keeps what was drawn at its beginning, but for the noise; else every image has its
        own.
    """

    def __init__(self, space: spaces.Space, *, held: bool = True, **strengths: float) -> None:
        if not (isinstance(space, spaces.Box) and is_image_space(space)):
            raise ValueError(f"nuisance={IMAGES!r} is for images of bytes (uint8, 0 to 255), not {space}")
        self.shape, self.held, self.mixture = space.shape, held, ImageMixture(**strengths)

    def members(self, n: int) -> Members:
        """See :meth:`Nuisance.members`."""
        return _MixtureMembers(self, n)


class _MixtureMembers(Members):
    def __init__(self, nuisance: MixtureNuisance, n: int) -> None:
        self.nuisance = nuisance
        self.held = self._draw(n) if nuisance.held else None

    def _draw(self, n: int) -> Drawn:
        return self.nuisance.mixture.draw(n, *self.nuisance.shape)

    def begin(self, which: np.ndarray) -> None:
        if self.held is not None:
            for name, values in self._draw(len(which)).items():
                self.held[name][which] = values

    def __call__(self, observations: Observations, states: np.ndarray, which: np.ndarray) -> Observations:
        if self.held is None:
            drawn = self._draw(len(which))
        else:
            drawn = {name: values[which] for name, values in self.held.items()}
        return self.nuisance.mixture.apply(observations, drawn)


class PerturbationNuisance(Nuisance):
    """One of :data:`~sb3_tdpg.robustness.PERTURBATIONS`, in one severity."""

    def __init__(self, name: str, severity: int, space: spaces.Space, scale: np.ndarray | None) -> None:
        self.arguments = (find(name), severity, space)
        self.scale = scale

    def members(self, n: int) -> Members:
        """See :meth:`Nuisance.members`."""
        return _PerturbationMembers(Perturber(*self.arguments, n, seed=random_seed(), scale=self.scale))


class _PerturbationMembers(Members):
    def __init__(self, perturber: Perturber) -> None:
        self.perturber = perturber

    def begin(self, which: np.ndarray) -> None:
        self.perturber.begin(which)

    def __call__(self, observations: Observations, states: np.ndarray, which: np.ndarray) -> Observations:
        return self.perturber(observations, which)


class FunctionNuisance(Nuisance):
    """A function ``(observations (n, *obs), rng) -> changed observations``, called at each step."""

    def __init__(self, function: Callable[[Observations, np.random.Generator], Observations]) -> None:
        self.function = function

    def members(self, n: int) -> Members:
        """See :meth:`Nuisance.members`."""
        return _FunctionMembers(self.function)


class _FunctionMembers(Members):
    def __init__(self, function: Callable[[Observations, np.random.Generator], Observations]) -> None:
        self.function, self.rng = function, np.random.default_rng(random_seed())

    def begin(self, which: np.ndarray) -> None:
        pass

    def __call__(self, observations: Observations, states: np.ndarray, which: np.ndarray) -> Observations:
        changed = self.function(observations, self.rng)
        if not isinstance(observations, dict):
            changed = np.asarray(changed)
            if changed.shape != observations.shape or changed.dtype != observations.dtype:
                raise ValueError(
                    f"the nuisance returned observations of shape {changed.shape} and type {changed.dtype}, expected "
                    f"those it was given: {observations.shape}, {observations.dtype}"
                )
            if not np.isfinite(changed).all():
                raise ValueError("the nuisance returned observations that are NaN or infinite")
        return changed


class SceneNuisance(Nuisance):
    """
    Other scenes of an environment of this package: its sensor, in the same state.

    :param scenes: Copies of the environment with other keywords.
    :param redraw: Components of the state that the scenes draw anew for each episode, as at their start.
    """

    def __init__(self, scenes: Sequence[POMDPEnv], redraw: Sequence[int] = ()) -> None:
        self.scenes, self.redraw = scenes, list(redraw)

    def members(self, n: int) -> Members:
        """See :meth:`Nuisance.members`."""
        return _SceneMembers(self, n)


class _SceneMembers(Members):
    def __init__(self, nuisance: SceneNuisance, n: int) -> None:
        self.nuisance = nuisance
        self.scene = np.zeros(n, dtype=np.int64)
        self.redrawn = np.zeros((n, len(nuisance.redraw)))
        self.begin(np.arange(n))

    def begin(self, which: np.ndarray) -> None:
        rng = np.random.default_rng(random_seed())
        self.scene[which] = rng.integers(len(self.nuisance.scenes), size=len(which))
        for scene, chosen in self._by_scene(which):
            scene.np_random = rng
            if self.nuisance.redraw:
                start = scene.initial_state(len(chosen))
                self.redrawn[which[chosen]] = start[:, self.nuisance.redraw]

    def _by_scene(self, which: np.ndarray) -> list[tuple[POMDPEnv, np.ndarray]]:
        """Group the places in ``which`` by scene."""
        scene = self.scene[which]
        return [(self.nuisance.scenes[i], np.flatnonzero(scene == i)) for i in np.unique(scene)]

    def __call__(self, observations: Observations, states: np.ndarray, which: np.ndarray) -> Observations:
        seen = np.array(states, dtype=np.float64)
        seen[:, self.nuisance.redraw] = self.redrawn[which]
        changed = observations.copy()
        for scene, chosen in self._by_scene(which):
            changed[chosen] = scene.sensor(seen[chosen])
        return changed


class PartsNuisance(Nuisance):
    """Nuisances of some parts of a ``Dict`` observation, by key."""

    def __init__(self, parts: Mapping[str, Nuisance]) -> None:
        self.parts = parts

    def members(self, n: int) -> Members:
        """See :meth:`Nuisance.members`."""
        return _PartsMembers({key: part.members(n) for key, part in self.parts.items()})


class _PartsMembers(Members):
    def __init__(self, parts: Mapping[str, Members]) -> None:
        self.parts = parts

    def begin(self, which: np.ndarray) -> None:
        for part in self.parts.values():
            part.begin(which)

    def __call__(self, observations: Observations, states: np.ndarray, which: np.ndarray) -> Observations:
        return {**observations, **{key: part(observations[key], states, which) for key, part in self.parts.items()}}


class UnionNuisance(Nuisance):
    """Several families; each episode has one of them, at random."""

    def __init__(self, families: Sequence[Nuisance]) -> None:
        self.families = families

    def members(self, n: int) -> Members:
        """See :meth:`Nuisance.members`."""
        return _UnionMembers([family.members(n) for family in self.families], n)


class _UnionMembers(Members):
    def __init__(self, families: Sequence[Members], n: int) -> None:
        self.families = families
        self.family = th.randint(len(families), (n,)).numpy()

    def begin(self, which: np.ndarray) -> None:
        self.family[which] = th.randint(len(self.families), (len(which),)).numpy()
        for family in self.families:
            family.begin(which)

    def __call__(self, observations: Observations, states: np.ndarray, which: np.ndarray) -> Observations:
        is_dict = isinstance(observations, dict)
        changed = {key: part.copy() for key, part in observations.items()} if is_dict else observations.copy()
        for i in np.unique(self.family[which]):
            chosen = np.flatnonzero(self.family[which] == i)
            part = {key: x[chosen] for key, x in observations.items()} if is_dict else observations[chosen]
            result = self.families[i](part, states[chosen], which[chosen])
            for key in observations if is_dict else (None,):
                target, source = (changed, result) if key is None else (changed[key], result[key])
                target[chosen] = source
        return changed


class OneMember(Nuisance):
    """
    A single member of a family, the same for all episodes.

    :param seed: It names the member.
    """

    def __init__(self, family: Nuisance, seed: int) -> None:
        self.family, self.seed = family, seed

    def members(self, n: int) -> Members:
        """See :meth:`Nuisance.members`."""
        with th.random.fork_rng(devices=[]):
            th.manual_seed(self.seed)
            return _OneMember(self.family.members(1))


class _OneMember(Members):
    def __init__(self, member: Members) -> None:
        self.member = member

    def begin(self, which: np.ndarray) -> None:
        pass

    def __call__(self, observations: Observations, states: np.ndarray, which: np.ndarray) -> Observations:
        return self.member(observations, states, np.zeros_like(which))


# -- declarations -----------------------------------------------------------------------------------------------


def make_nuisance(declared: Any, space: spaces.Space, env: VecEnv) -> Nuisance | None:
    """
    Make a nuisance from TDPG's argument ``nuisance``.

    :param declared: ``None``: there is none. ``"auto"``: :class:`~sb3_tdpg.robustness.training.ImageMixture` for images
        of bytes, held for the episode; none for vectors and depth images. A dict: each episode has one of its entries,
        at random. Its keys are names of perturbations, with a severity or a range ``(1, 3)`` of them; ``"images"``,
        with keywords of :class:`MixtureNuisance`; and ``"env_kwargs"``, with a list of keywords for other scenes of the
        environment (and ``"redraw"``: names of the components of the state that these draw anew). A name alone stands
        for all its severities. A function ``(observations, rng)``, or a :class:`Nuisance`, is used as it is.
    :param space: The policy's observation space.
    :param env: The training environment.
    :raises ValueError: if nothing of this name exists or applies.
    """
    declared = declaration(declared, space)
    if declared is None or isinstance(declared, Nuisance):
        return declared
    if callable(declared):
        return FunctionNuisance(declared)
    if not isinstance(declared, Mapping) or not declared:
        raise ValueError(
            f"nuisance={declared!r} must be None, 'auto', the name of a perturbation, a dict of names and severities "
            "such as {'noise': (1, 3), 'contrast': 2}, or a function of the observations and a random generator"
        )
    if set(declared) == {"redraw"}:
        raise ValueError(f"nuisance={declared!r}: 'redraw' needs 'env_kwargs', the scenes that draw something anew")
    families: list[Nuisance] = []
    for name, value in declared.items():
        if name == "redraw":
            continue
        if name == "env_kwargs":
            families.append(_scenes(value, declared.get("redraw", ()), env))
        else:
            families += _named(name, value, space, env)
    return families[0] if len(families) == 1 else UnionNuisance(families)


def resolved(declared: Any, level: str, space: spaces.Space) -> tuple[Any, str]:
    """
    Replace ``"auto"`` in TDPG's arguments ``nuisance`` and ``nuisance_level``.

    In rollouts every image then has a change of its own, as in docs/results/ball_catch.md; in the phase a change is
    held for the episode.
    """
    if level not in LEVELS:
        raise ValueError(f"nuisance_level={level!r} is unknown: use one of {list(LEVELS)}")
    if level == "auto":
        level = "rollouts" if declared == "auto" else "action"
    return declaration(declared, space, held=level != "rollouts"), level


def declaration(declared: Any, space: spaces.Space, **images: Any) -> Any:
    """
    Replace ``"auto"`` and the name of a perturbation by the dict that it stands for.

    :param images: Keywords of :class:`MixtureNuisance` for ``"auto"``.
    """
    if not isinstance(declared, str):
        return declared
    if declared != "auto":
        return {declared: {} if declared == IMAGES else (1, N_SEVERITIES)}
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    return {IMAGES: images} if any(_applies(IMAGES, part) for part in parts) else None


def _named(name: str, value: Any, space: spaces.Space, env: VecEnv | None) -> list[Nuisance]:
    """Return one family for each severity, or the mixture; a part of a ``Dict`` has no environment of its own."""
    if isinstance(space, spaces.Dict):
        by_key = {key: _named(name, value, part, None) for key, part in space.items() if _applies(name, part)}
        if not by_key:
            raise ValueError(f"nuisance={name!r} applies to no part of the observation space {space}")
        return [PartsNuisance(dict(zip(by_key, row, strict=True))) for row in zip(*by_key.values(), strict=True)]
    if name == IMAGES:
        try:
            return [MixtureNuisance(space, **value)]
        except TypeError as e:
            raise ValueError(f"nuisance={{{IMAGES!r}: {value!r}}} must hold keywords of MixtureNuisance: {e}") from e
    if (objection := find(name).objection(space)) is not None:
        raise ValueError(f"the nuisance {name!r} does not apply: {objection}")
    low, *others = value if isinstance(value, (tuple, list)) and value else (value,)
    high = others[0] if others else low
    if len(others) > 1:
        raise ValueError(f"nuisance={{{name!r}: {value!r}}} must be a severity, or the lowest and the highest one")
    for severity in (low, high):
        find(name).value(severity)
    if low > high:
        raise ValueError(f"nuisance={{{name!r}: {value!r}}} must be a severity, or the lowest and the highest one")
    scale = None
    if find(name).kind == "vector":
        if env is None and not np.isfinite(finite_range(space)).all():  # type: ignore[arg-type]
            raise ValueError(
                f"the nuisance {name!r} needs finite bounds of {space}, a part of the observation, as its unit: give "
                "the space such bounds, or a function as the nuisance"
            )
        scale = default_scale(space, env)  # type: ignore[arg-type]
    return [PerturbationNuisance(name, severity, space, scale) for severity in range(low, high + 1)]


def _applies(name: str, space: spaces.Space) -> bool:
    if name == IMAGES:
        return isinstance(space, spaces.Box) and is_image_space(space)
    return find(name).applies_to(space)


def _scenes(env_kwargs: Any, redraw: Sequence[str], env: VecEnv) -> Nuisance:
    (inner, *_) = [e.unwrapped if hasattr(e, "unwrapped") else e for e in env.get_attr("unwrapped")]
    if not isinstance(inner, POMDPEnv):
        raise ValueError(
            f"nuisance={{'env_kwargs': ...}} needs an environment that can observe a given state, a POMDPEnv, not "
            f"{type(inner).__name__}: give a function of the observations instead"
        )
    names = list(getattr(inner, "state_names", ()))
    if not isinstance(redraw, (list, tuple)):
        raise ValueError(f"redraw={redraw!r} must be a list of components of the state, some of {names}")
    if unknown := [name for name in redraw if name not in names]:
        raise ValueError(f"redraw={unknown} are no components of the state: use some of {names}")
    own = {} if inner.spec is None else inner.spec.kwargs
    given = [env_kwargs] if isinstance(env_kwargs, Mapping) else env_kwargs
    if not (isinstance(given, Sequence) and given and all(isinstance(kwargs, Mapping) for kwargs in given)):
        raise ValueError(
            f"nuisance={{'env_kwargs': {env_kwargs!r}}} must hold keywords of the environment, or a list of such"
        )
    try:
        scenes = [type(inner)(**{**own, **kwargs}) for kwargs in given]
    except TypeError as e:  # an unknown keyword
        raise ValueError(f"nuisance={{'env_kwargs': {env_kwargs!r}}}: {e}") from e
    for scene in scenes:
        if scene.observation_space != inner.observation_space:
            raise ValueError(f"a scene of the nuisance has the observation space {scene.observation_space}")
    return SceneNuisance(scenes, [names.index(name) for name in redraw])
