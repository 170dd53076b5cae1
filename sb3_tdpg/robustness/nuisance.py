"""Wrap TDPG's environment in the perturbations that the argument ``nuisance`` declares."""

from typing import Any

import gymnasium as gym
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg.robustness.families import Family
from sb3_tdpg.robustness.sensor import Sensor, parts_of
from sb3_tdpg.robustness.wrappers import PerturbedVecEnv

OF_DEPTH = [None, ("noise", 1), ("dropped_pixels", (1, 2))]
"""The automatic nuisance of depth images, which is mild: a quarter of the episodes is not perturbed."""


class NuisanceVecEnv(PerturbedVecEnv):
    """Perturb the environment of TDPG, which adds this wrapper itself and can remove it again."""


def with_nuisance(env: VecEnv, declared: Any) -> VecEnv:
    """
    Wrap an environment in a declared nuisance, which replaces an earlier one.

    :param declared: ``None`` for no nuisance, ``"auto"`` for the nuisance that :func:`automatic` returns, or a
        declaration of a :class:`~sb3_tdpg.robustness.families.Family`. A name alone stands for all its severities.
    :raises ValueError: if a perturbation does not exist or does not apply.
    """
    while isinstance(env, NuisanceVecEnv):
        env = env.venv
    family = automatic(declared, env.observation_space)
    if family is None:
        return env
    try:
        return NuisanceVecEnv(env, family, None)
    except ValueError as e:
        raise ValueError(f"nuisance={declared!r}: {e} (or turn it off: nuisance=None)") from e


def held_family(declared: Any, env: gym.Env | VecEnv) -> Family:
    """
    Return the family of a declared nuisance of the sensor.

    With ``"auto"`` for images of bytes, each episode keeps its changes, except for the noise.

    :raises ValueError: if there is no nuisance, or it changes the actions.
    """
    found = automatic(declared, env.observation_space, held=True)
    if found is None:
        raise ValueError(f"nuisance={declared!r} is none for {env.observation_space}: name the perturbations")
    family = Family(found, env)
    if family.is_plant:
        raise ValueError(f"nuisance={declared!r} changes the actions: name one of the sensor")
    return family


def automatic(declared: Any, space: spaces.Space, **keywords: Any) -> Any:
    """
    Replace ``"auto"`` by random changes for images of bytes, or by noise and dropped pixels for depth images.

    For all other observations, such as vectors, the result is ``None``. Any other declaration is returned as it is.

    :param keywords: Keywords of :func:`~sb3_tdpg.robustness.training.images`.
    """
    if not (isinstance(declared, str) and declared == "auto"):
        return declared
    boxes = [part for part in parts_of(space).values() if isinstance(part, spaces.Box)]
    if any(map(is_image_space, boxes)):
        return {"images": keywords}
    return OF_DEPTH if any(Sensor(box).is_depth for box in boxes) else None
