"""What TDPG's argument ``nuisance`` puts around the environment."""

from typing import Any

from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg.robustness.wrappers import PerturbedVecEnv


class NuisanceVecEnv(PerturbedVecEnv):
    """The wrapper that TDPG puts around its environment, and takes off again."""


def with_nuisance(env: VecEnv, declared: Any) -> VecEnv:
    """
    Put a declared nuisance around an environment, in the place of another one.

    :param declared: ``None``: there is none. ``"auto"``: see :func:`automatic`. Else a declaration of a
        :class:`~sb3_tdpg.robustness.families.Family`; a name alone stands for all its severities.
    :raises ValueError: if nothing of this name exists or applies.
    """
    while isinstance(env, NuisanceVecEnv):
        env = env.venv
    family = automatic(declared, env.observation_space)
    if family is None:
        return env
    try:
        return NuisanceVecEnv(env, family, None)
    except ValueError as e:
        raise ValueError(f"nuisance={declared!r}: {e}") from e


def automatic(declared: Any, space: spaces.Space, **keywords: Any) -> Any:
    """
    Replace ``"auto"``: random changes for images of bytes, ``None`` for vectors and depth images.

    :param keywords: Of :func:`~sb3_tdpg.robustness.training.images`.
    """
    if not (isinstance(declared, str) and declared == "auto"):
        return declared
    parts = space.spaces.values() if isinstance(space, spaces.Dict) else [space]
    has_images = any(isinstance(part, spaces.Box) and is_image_space(part) for part in parts)
    return {"images": keywords} if has_images else None
