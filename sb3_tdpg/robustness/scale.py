"""
In which unit a vector is perturbed: by how much each of its components varies.

Dimension key: N environments; scales have the shape of the observation space.
"""

from __future__ import annotations

import copy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_tdpg.robustness.sensor import finite_range, kind_of

MAX_STEPS = 200
_SEED = 0xCA1  # of every calibration: the same environment has the same scale


def observation_scale(
    env: VecEnv | gym.Env, model: Any = None, *, n_observations: int = 500, max_steps: int = MAX_STEPS
) -> np.ndarray:
    """
    Measure the standard deviation of each component of the observations, over time and episodes, in a short roll-out.

    The roll-out lasts until every environment has ended an episode and ``n_observations`` have been seen, at most
    ``max_steps`` steps. Afterwards the environments must be reset. Their generators, and a seed that waits for the
    first reset, are as they were before: the next reset starts what it would have without the roll-out. (A ``Monitor``
    inside does record its episodes.)

    :param env: One environment or several, unperturbed.
    :param model: An SB3 model that acts, so that the observations are those of its training. ``None``: normal actions
        with a standard deviation of 1, cut off at the bounds, as those of an untrained policy; actions that are no
        ``Box`` are drawn from their space.
    :param n_observations: How many at least.
    :param max_steps: How many steps at most.
    :return: in the shape of the observation space, float64
    """
    if not isinstance(env, VecEnv):
        single = env
        return observation_scale(
            DummyVecEnv([lambda: single]), model, n_observations=n_observations, max_steps=max_steps
        )
    inner = env.unwrapped
    waiting_seeds, waiting_options = list(inner._seeds), list(inner._options)
    generators = copy.deepcopy(env.get_attr("np_random"))
    try:
        env.seed(_SEED)
        return _rolled_out(env, model, n_observations, max_steps).std(axis=0)
    finally:
        for i, generator in enumerate(generators):
            env.set_attr("np_random", generator, indices=i)
        inner._seeds, inner._options = waiting_seeds, waiting_options


def _rolled_out(env: VecEnv, model: Any, n_observations: int, max_steps: int) -> np.ndarray:
    """Return the observations of a roll-out, ``(T * N, *obs)``."""
    rng = np.random.default_rng(_SEED)
    action_space = copy.deepcopy(env.action_space)
    action_space.seed(_SEED)
    normalize = None if model is None else model.get_vec_normalize_env()
    observations = np.asarray(env.reset())
    seen, state, starts = [observations], None, np.ones(env.num_envs, dtype=bool)
    has_ended = np.zeros(env.num_envs, dtype=bool)
    while len(seen) <= max_steps and not (has_ended.all() and len(seen) * env.num_envs >= n_observations):
        if model is not None:
            normal = observations if normalize is None else normalize.normalize_obs(observations)
            actions, state = model.predict(normal, state, starts, deterministic=False)
        elif isinstance(action_space, spaces.Box):
            actions = rng.standard_normal((env.num_envs, *action_space.shape))
            actions = np.clip(actions, action_space.low, action_space.high).astype(action_space.dtype)
        else:
            actions = np.stack([action_space.sample() for _ in range(env.num_envs)])
        shown, _, starts, _ = env.step(actions)
        observations = np.asarray(shown)
        has_ended |= starts
        seen.append(observations)
    return np.concatenate(seen, dtype=np.float64)


def default_scale(space: spaces.Space, env: VecEnv | gym.Env, scale: Any = None) -> np.ndarray | None:
    r"""
    Return the scale of a vector's components; ``None`` for an image.

    A component with finite bounds has the standard deviation of a uniform distribution between them,
    :math:`(\mathrm{high} - \mathrm{low}) / \sqrt{12}`. If there are components without,
    :func:`observation_scale` measures these.

    :param space: The observation space.
    :param env: The environment, for the measurement.
    :param scale: What the user gave: a number, or one for each component; it wins.
    :raises ValueError: if it has another shape, or is negative, or nothing varies.
    """
    if not isinstance(space, spaces.Box) or kind_of(space) != "vector":
        if scale is not None:
            raise ValueError(f"scale={scale} is for vectors, and the observation space is {space}: leave it out")
        return None
    if scale is not None:
        result = np.asarray(scale, dtype=np.float64)
        if result.shape not in ((), space.shape) or not (np.isfinite(result).all() and (result >= 0).all()):
            raise ValueError(
                f"scale={scale} must be a number, or an array of shape {space.shape}, finite and not negative"
            )
        result = np.broadcast_to(result, space.shape)
    else:
        bounded = finite_range(space) / np.sqrt(12)
        result = bounded if np.isfinite(bounded).all() else np.where(
            np.isfinite(bounded), bounded, observation_scale(env)
        )  # fmt: skip
    if not result.any():
        raise ValueError("no component of the observations varied in the calibration: give `scale`")
    return result
