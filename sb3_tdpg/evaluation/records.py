"""From scenarios to records: one row for each episode that a model ran."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import check_models_fit, scenario_env
from sb3_tdpg.evaluation.randomness import evaluation_seeds
from sb3_tdpg.evaluation.rollout import is_monitored, rollout

MAX_PARALLEL_EPISODES = 1_000
"""Episodes run side by side; a constant, because results depend on it."""

MAX_FINAL_COMPONENTS = 32
"""Longer arrays in the last info (images, say) are not recorded."""

COLUMNS = ("model", "scenario", "env_id", "episode", "cost", "length", "seed", "deterministic")
"""The columns of every frame of records."""

_BOOKKEEPING = frozenset({"episode", "terminal_observation", "TimeLimit.truncated"})  # of SB3, not of the environment


def evaluate_scenarios(
    model: Any,
    scenarios: Iterable[Scenario],
    n_episodes: int = 1000,
    *,
    seed: int = 0,
    deterministic: bool = False,
    env_kwargs: Mapping[str, Any] | None = None,
    labels: Mapping[str, Any] | None = None,
    progress_bar: bool = False,
) -> pd.DataFrame:
    """
    Run models in scenarios and record every episode.

    The frame has one row for each model, scenario and episode, in this order, with the columns ``model``, ``scenario``,
    ``env_id``, ``episode``, ``cost`` (the negative return), ``length`` (steps), ``final_*`` (every number in the last
    ``info``; the components of an array are ``final_state_0``, ...), ``seed`` and ``deterministic``. If the
    environment reports ``info["is_success"]``, there is a column ``failure``, too.

    The same seed gives the same frame. In a scenario all models start from the same initial states and, as far as the
    environment draws as often whatever the actions, meet the same noise; so do all scenarios of one environment.
    The global random number generators are left as they were.

    :param model: One SB3 model, or several by their label.
    :param scenarios: The rows of the table to be.
    :param n_episodes: Episodes of each model in each scenario.
    :param seed: Seed of the environments and of the policies' sampling.
    :param deterministic: Act without noise. The paper's tables use the stochastic policy, and so does the default here.
    :param env_kwargs: Keywords for the environments of all scenarios; a scenario's own win.
    :param labels: Constant columns to put in front, for instance ``dict(train_seed=3)``.
    :param progress_bar: Show a progress bar.
    :raises ValueError: if something does not fit; no episode has been run by then.
    """
    models = _named_models(model)
    rows = [scenario.with_kwargs(**(env_kwargs or {})) for scenario in scenarios]
    labels = labels or {}
    _check_arguments(rows, n_episodes, seed, labels)
    check_models_fit(models, rows)

    frames = []
    with tqdm(total=len(models) * len(rows) * n_episodes, unit="episode", disable=not progress_bar) as progress:
        for label, each in models.items():
            for scenario in rows:
                progress.set_description(f"{label}, {scenario.name}")
                frame = run_episodes(
                    each, scenario, n_episodes, seed=seed, deterministic=deterministic, at_end=progress.update
                )
                frames.append(frame.assign(model=label, scenario=scenario.name, env_id=scenario.env_id))
    records = pd.concat(frames, ignore_index=True)
    records = records.assign(**labels, seed=seed, deterministic=deterministic)
    final = [name for name in records.columns if name not in {*labels, *COLUMNS}]
    return records[[*labels, *COLUMNS[:6], *final, *COLUMNS[6:]]]


def run_episodes(
    model: Any,
    scenario: Scenario,
    n_episodes: int,
    *,
    seed: int,
    deterministic: bool = False,
    sensor: Callable[[VecEnv], VecEnv] | None = None,
    at_end: Callable[[], Any] | None = None,
) -> pd.DataFrame:
    """
    Run one model in one scenario that it fits, see :func:`evaluate_scenarios`.

    :param model: An SB3 model.
    :param scenario: Where.
    :param n_episodes: How many.
    :param seed: Of the environments and of the policy's sampling.
    :param deterministic: Act without noise.
    :param sensor: Wraps the environments inside the model's own wrappers.
    :param at_end: Called at the end of each episode.
    :return: a row for each episode with ``episode``, ``cost``, ``length``, ``final_*`` and, if known, ``failure``; the
        first episodes of all environments, then the second ones, and so on, whichever ended first
    """
    env = scenario_env(scenario, model, n_episodes=min(n_episodes, MAX_PARALLEL_EPISODES), sensor=sensor)
    returns, monitored = np.zeros(env.num_envs), is_monitored(env)
    ended: dict[tuple[int, int], dict[str, Any]] = {}  # by the episode's number in its environment, and environment
    with contextlib.closing(env):
        steps = rollout(model, env, n_episodes, seeds=evaluation_seeds(seed), deterministic=deterministic)
        for step in steps:
            returns += step.rewards
            for i in np.flatnonzero(step.finished):
                info = step.infos[i]
                of_monitor = info["episode"] if monitored else {}
                cost, length = -of_monitor.get("r", returns[i]), of_monitor.get("l", step.t[i] + 1)
                ended[step.episode[i], i] = dict(cost=cost, length=length, **_final_columns(info))
                if at_end is not None:
                    at_end()
            returns[step.dones] = 0
    # In the order of their ends, a number would stand for another start with every model and perturbation.
    order = sorted(range(n_episodes), key=list(ended).__getitem__)
    records = pd.DataFrame(list(ended.values())).iloc[order].reset_index(drop=True)
    records.insert(0, "episode", np.arange(n_episodes))
    return records


def _final_columns(info: Mapping[str, Any]) -> dict[str, float]:
    """Flatten the numbers of the last info of an episode."""
    columns: dict[str, Any] = {}
    for name, value in info.items():
        array = np.asarray(value)
        if name in _BOOKKEEPING or array.dtype.kind not in "biuf" or array.size > MAX_FINAL_COMPONENTS:
            continue
        if array.ndim == 0:
            columns[f"final_{name}"] = array.item()
        else:
            columns.update({f"final_{name}_{i}": x for i, x in enumerate(array.ravel().tolist())})
    if "is_success" in info:
        columns["failure"] = not info["is_success"]
    return columns


def _named_models(model: Any) -> dict[str, Any]:
    models = dict(model) if isinstance(model, Mapping) else {type(model).__name__: model}
    if not models:
        raise ValueError("model is an empty mapping: give at least one model, for instance {'TDPG': model}")
    for label, each in models.items():
        if isinstance(each, type) or not hasattr(each, "predict") or not hasattr(each, "get_vec_normalize_env"):
            raise ValueError(f"model {label!r} is {each!r}, expected a Stable-Baselines3 model (TDPG.load(...), say)")
        if getattr(each, "policy", None) is None:
            raise ValueError(f"model {label!r} has no policy yet: make it with an environment, or load it")
    return models


def _check_arguments(scenarios: Sequence[Scenario], n_episodes: int, seed: int, labels: Mapping[str, Any]) -> None:
    if not scenarios:
        raise ValueError("scenarios is empty: give at least one, for instance sb3_tdpg.envs.scenarios.LAVA")
    names = [scenario.name for scenario in scenarios]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(
            f"scenario names must differ, and {twice} occur more than once: a table could not tell them apart"
        )
    if not isinstance(n_episodes, (int, np.integer)) or n_episodes < 1:
        raise ValueError(f"n_episodes={n_episodes!r} must be an integer of at least 1: the episodes in each scenario")
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed={seed!r} must be an integer of at least 0")
    taken = [name for name in labels if name in {*COLUMNS, "failure"} or name.startswith("final_")]
    if taken:
        raise ValueError(f"labels={dict(labels)}: {taken} are names of columns already, choose others")
