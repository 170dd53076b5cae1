"""The environment of a scenario, made for a model: the checks that they fit, and the model's own wrappers."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first
from stable_baselines3.common.vec_env import VecEnv, VecTransposeImage

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.problem import read_problem
from sb3_tdpg.vec_env import make_episodes_env


def scenario_env(
    scenario: Scenario,
    model: Any,
    *,
    n_episodes: int,
    n_envs: int | None = None,
    sensor: Callable[[VecEnv], VecEnv] | None = None,
) -> VecEnv:
    """
    Make a fresh environment of a scenario, wrapped as the model needs it.

    :param scenario: The row.
    :param model: An SB3 model. If its own environment normalises observations (``VecNormalize``), this one does so with
        the same statistics, frozen.
    :param n_episodes: Episodes that are to be run at a time.
    :param n_envs: Number of environments; default: see :func:`~sb3_tdpg.vec_env.make_episodes_env`.
    :param sensor: Wraps the environment inside the model's own wrappers: perturbs what is observed, say.
    """
    env = make_episodes_env(
        scenario.env_id, n_envs, n_episodes=n_episodes, env_kwargs=scenario.env_kwargs, use_processes=False
    )
    if sensor is not None:
        env = sensor(env)
    normalize = model.get_vec_normalize_env()
    if normalize is not None:
        normalize = copy.copy(normalize)  # its copy comes without an environment
        normalize.set_venv(env)
        normalize.training = False
        normalize.norm_reward = False
        env = normalize
    space = env.observation_space
    if isinstance(space, spaces.Box) and is_image_space(space) and not is_image_space_channels_first(space):
        env = VecTransposeImage(env)  # as SB3 wraps the environment that it trains on
    return env


def check_models_fit(models: Mapping[str, Any], scenarios: Sequence[Scenario]) -> None:
    """
    Make one environment of each scenario and compare it with every model, before any episode is run.

    :raises ValueError: if a scenario's environment cannot be made, or a space or the horizon differ from the model's.
    """
    for scenario in scenarios:
        for label, model in models.items():
            try:
                env = scenario_env(scenario, model, n_episodes=1, n_envs=1)
            except Exception as e:
                raise ValueError(f"scenario {scenario.name!r} ({scenario.env_id}) cannot be made: {e}") from e
            try:
                check_env_fits(model, env, f"model {label!r}", f"scenario {scenario.name!r} ({scenario.env_id})")
            finally:
                env.close()


def check_env_fits(model: Any, env: VecEnv, model_name: str = "the model", env_name: str = "the environment") -> None:
    """
    Compare spaces and horizon of an environment with those that a model was trained with.

    :raises ValueError: if they differ.
    """
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
