"""
Measure the unit of vector perturbations: how much each component of the observation varies.

Dimension key: E environments; scales have the shape of the observation space.
"""

import copy
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_tdpg.buffers import each_part
from sb3_tdpg.evaluation.rollout import rollout
from sb3_tdpg.robustness.sensor import finite_range, kind_of, parts_of

N_OBSERVATIONS = 500
MAX_STEPS = 200
_SEED = 0xCA1  # of every calibration, so that the same environment has the same scale


def observation_scale(env: VecEnv | gym.Env, model: Any = None) -> Any:
    """
    Measure the standard deviation of each observation component, over time and episodes, in a short rollout.

    The rollout lasts until every environment has ended an episode and all environments together have returned 500
    observations, but at most 200 steps. The environments must be reset afterwards. Their random generators, and a seed
    that waits for the first reset, are restored, so the next episodes are the same as without the rollout.

    :param model: SB3 model that acts. With ``None``, the actions are clipped standard Gaussian, like those of an
        untrained policy; in a space that is not a ``Box`` they are its samples.
    :return: The standard deviations in the shape of the observation space, float64. For a ``Dict``, a dict of the
        standard deviations of each vector.
    """
    vec_env = env if isinstance(env, VecEnv) else DummyVecEnv([lambda: env])
    normalize = None if model is None else model.get_vec_normalize_env()
    actor = model or SimpleNamespace(predict=_untrained(vec_env))
    keys = _vectors(vec_env.observation_space)
    inner = vec_env.unwrapped
    waiting_seeds, waiting_options = list(inner._seeds), list(inner._options)
    generators = copy.deepcopy(vec_env.get_attr("np_random"))
    seen: list[Any] = []
    has_ended = np.zeros(vec_env.num_envs, dtype=bool)

    def see(observations: Any) -> None:
        seen.append({key: observations[key] for key in keys} if isinstance(observations, dict) else observations)

    try:
        vec_env.seed(_SEED)
        for step in rollout(actor, vec_env, observe=normalize and normalize.normalize_obs):
            see(step.observations)
            has_ended |= step.dones
            if len(seen) >= MAX_STEPS or (has_ended.all() and (len(seen) + 1) * vec_env.num_envs >= N_OBSERVATIONS):
                break
        see(step.next_observations)
    finally:
        for i, generator in enumerate(generators):
            vec_env.set_attr("np_random", generator, indices=i)
        inner._seeds, inner._options = waiting_seeds, waiting_options
    return each_part(lambda *steps: np.concatenate(steps, dtype=np.float64).std(axis=0), *seen)


def _vectors(space: spaces.Space) -> dict[str, spaces.Space]:
    return {key: part for key, part in parts_of(space).items() if kind_of(part) == "vector"}


def _untrained(env: VecEnv) -> Callable[..., tuple[np.ndarray, None]]:
    """Return a ``predict`` that draws clipped standard Gaussian actions, or samples a space that is not a ``Box``."""
    n, rng, space = env.num_envs, np.random.default_rng(_SEED), copy.deepcopy(env.action_space)
    space.seed(_SEED)

    def predict(*args: Any, **kwargs: Any) -> tuple[np.ndarray, None]:
        if not isinstance(space, spaces.Box):
            return np.stack([space.sample() for _ in range(n)]), None
        return np.clip(rng.standard_normal((n, *space.shape)), space.low, space.high).astype(space.dtype), None

    return predict


def default_scale(space: spaces.Space, env: VecEnv | gym.Env, scale: Any = None) -> Any:
    r"""
    Return the scale of a vector's components, or of the vectors in a ``Dict`` by key; ``None`` if there is no vector.

    The scale of a component with finite bounds is the standard deviation of a uniform distribution between them,
    :math:`(\mathrm{high} - \mathrm{low}) / \sqrt{12}`. The other components are measured by :func:`observation_scale`.

    :param scale: The user's scale, which is used instead: a number, or an array with a number for each component. For a
        ``Dict``, it can also be a dict of these.
    """
    vectors = _vectors(space)
    if not vectors:
        if scale is not None:
            raise ValueError(f"scale={scale} is for vectors, and the observation space is {space}: leave it out")
        return None
    given = scale if isinstance(scale, Mapping) else dict.fromkeys(vectors, scale)
    if unknown := [key for key in given if key not in vectors]:
        raise ValueError(f"scale={scale} has {unknown}: use keys of the vectors in the observation, {list(vectors)}")
    result = {key: _given_or_bounds(part, given.get(key)) for key, part in vectors.items()}
    if not all(np.isfinite(values).all() for values in result.values()):
        measured = observation_scale(env)
        measured = measured if isinstance(space, spaces.Dict) else {"": measured}
        result = {key: np.where(np.isfinite(values), values, measured[key]) for key, values in result.items()}
    if not any(values.any() for values in result.values()):
        raise ValueError("no component of the observations varied in the calibration: give `scale`")
    return result if isinstance(space, spaces.Dict) else result[""]


def _given_or_bounds(space: Any, scale: Any) -> np.ndarray:
    """Return the given scale of a vector, or the scale from its bounds, which is infinite where bounds are missing."""
    if scale is None:
        return finite_range(space) / np.sqrt(12)
    result = np.asarray(scale, dtype=np.float64)
    if result.shape not in ((), space.shape) or not (np.isfinite(result) & (result >= 0)).all():
        raise ValueError(f"scale={scale} must be a number, or an array of shape {space.shape}, and not negative")
    return np.broadcast_to(result, space.shape)
