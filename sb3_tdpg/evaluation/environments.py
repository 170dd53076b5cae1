"""Make the environment of a scenario, wrapped for a model, and check that the two fit together."""

import contextlib
import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_pkl
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecNormalize, is_vecenv_wrapped

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.problem import read_problem
from sb3_tdpg.vec_env import make_episodes_env


def scenario_env(scenario: Scenario, model: Any, *, n_episodes: int, n_envs: int | None = None) -> VecEnv:
    """
    Make a new environment of a scenario (see ``make_episodes_env``), wrapped as an SB3 model needs it.

    If the model's own environment normalises observations (``VecNormalize``), the new environment normalises them with
    the same, frozen statistics. If the model's observations are stacked (``VecFrameStack``), the new observations are
    stacked, too. The scenario's ``sensor`` wraps the environment, inside the wrappers of the model.

    :raises ValueError: if a model of TDPG was trained on normalised observations, and their statistics are missing.
    """
    env = make_episodes_env(
        scenario.env_id, n_envs, n_episodes=n_episodes, env_kwargs=scenario.env_kwargs, use_processes=False
    )
    return wrapped_for(model, env if scenario.sensor is None else scenario.sensor(env))


def wrapped_for(model: Any, env: VecEnv) -> VecEnv:
    """Wrap a new environment as an SB3 model needs it; see :func:`scenario_env`."""
    normalize = model.get_vec_normalize_env()
    check_statistics(model, normalize)
    if normalize is not None:
        if spaces.flatdim(normalize.observation_space) == spaces.flatdim(model.observation_space):
            env = stacked_for(model, env)  # below the normalisation
        normalize = copy.copy(normalize)  # without an environment
        normalize.set_venv(env)
        normalize.training = normalize.norm_reward = False
        env = normalize
    return BaseAlgorithm._wrap_env(stacked_for(model, env), verbose=0)  # transposes images as for the training


def check_statistics(model: Any, normalize: VecNormalize | None) -> None:
    """Raise a ``ValueError`` if the statistics of the normalised observations of a TDPG model are missing."""
    if normalize is None and getattr(model, "normalizes", False):
        raise ValueError(
            "the policy was trained on normalised observations, and there are no statistics of VecNormalize: load the "
            "model with env=VecNormalize.load(file, env), or put the file vecnormalize.pkl beside its file"
        )


def stacked_for(model: Any, env: VecEnv) -> VecEnv:
    """Stack observations (``VecFrameStack``) if the model was trained on stacked observations."""
    if (trained := getattr(model, "env", None)) is not None and not is_vecenv_wrapped(trained, VecFrameStack):
        return env
    own, single = model.observation_space, env.observation_space
    if type(own) is type(single) and isinstance(own, (spaces.Box, spaces.Dict)):
        n_stack, rest = divmod(spaces.flatdim(own), spaces.flatdim(single))
        if n_stack > 1 and not rest:
            return VecFrameStack(env, n_stack)
    return env


def load_statistics(path: Path, env: VecEnv, model: Any = None) -> VecNormalize:
    """
    Normalise an environment as in training, with the statistics that ``VecNormalize.save`` wrote.

    :param model: Model with stacked observations. They are stacked before the normalisation if the statistics have the
        shape of the stacked observations.
    :raises ValueError: if the file cannot be loaded or does not fit the environment.
    """
    try:
        normalize: VecNormalize = load_from_pkl(path)
        if model is not None and spaces.flatdim(normalize.observation_space) == spaces.flatdim(model.observation_space):
            env = stacked_for(model, env)
        normalize.set_venv(env)
        return normalize
    except Exception as e:  # a damaged file can raise any error
        reason = " ".join(str(e).split())[:200]
        raise ValueError(f"{path} cannot be loaded ({reason}): it must be what VecNormalize.save() wrote") from e


def check_models_fit(models: Mapping[str, Any], scenarios: Sequence[Scenario]) -> None:
    """Raise a ``ValueError`` if an environment cannot be made, or its spaces or horizon differ from a model's."""
    for scenario in scenarios:
        name = f"scenario {scenario.name!r} ({scenario.env_id})"
        for label, model in models.items():
            try:
                env = scenario_env(scenario, model, n_episodes=1, n_envs=1)
            except Exception as e:
                raise ValueError(f"{name} cannot be made: {e}") from e
            with contextlib.closing(env):
                check_env_fits(model, env, f"model {label!r}", name)


def check_env_fits(model: Any, env: VecEnv, model_name: str = "the model", env_name: str = "the environment") -> None:
    """Raise a ``ValueError`` unless an environment has the spaces and the horizon that a model was trained with."""
    where = f"{model_name} does not fit {env_name}"
    for name in ("observation_space", "action_space"):
        expected, given = getattr(model, name, None), getattr(env, name)
        if expected != given:
            raise ValueError(f"{where}: the model's {name} is {expected}, the environment's is {given}")
    horizon = getattr(model, "horizon", None)
    if horizon is not None and (given := read_problem(env).horizon) != horizon:
        raise ValueError(
            f"{where}: the model was trained for a horizon of {horizon} steps, the environment has {given}"
        )
