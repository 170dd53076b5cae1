"""
Run models in scenarios, and record one row for each episode, or the true states.

Dimension key: T horizon, N episodes, X state.
"""

import contextlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import check_models_fit, scenario_env
from sb3_tdpg.evaluation.randomness import evaluation_seeds
from sb3_tdpg.evaluation.rollout import is_monitored, rollout
from sb3_tdpg.problem import read_problem

MAX_PARALLEL_EPISODES = 1_000  # run side by side; a constant, because results depend on it
MAX_FINAL_COMPONENTS = 32  # longer arrays in the last info, such as images, are not recorded
COLUMNS = ("model", "scenario", "env_id", "episode", "cost", "length", "seed", "deterministic")
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

    The frame has one row for each model, scenario and episode, in this order. The columns are ``model``, ``scenario``,
    ``env_id``, ``episode``, ``cost`` (the negative return), ``length`` (steps), ``final_*``, ``seed`` and
    ``deterministic``. Every number in the last ``info`` has a column ``final_*``; the components of an array of
    at most 32 numbers are ``final_state_0``, ... If the environment reports ``info["is_success"]``, there is also a
    column ``failure``.

    The same seed gives the same frame. In a scenario the first episode in each of the parallel environments has the
    same initial state for all models. If the number of random numbers that the environment draws does not depend on the
    actions, all models meet the same initial states and noise, and all scenarios of one environment share them. The
    global random generators are restored at the end.

    :param model: One SB3 model, or a mapping from labels to models.
    :param scenarios: The scenarios to run, in the order of the rows.
    :param n_episodes: Number of episodes of each model in each scenario without an ``n_episodes`` of its own.
    :param seed: Seed of the environments and of the policies' sampling.
    :param deterministic: Act without noise. The default is the stochastic policy, which the paper's tables use.
    :param env_kwargs: Keywords for the environments of all scenarios; a scenario's own keywords take precedence.
    :param labels: Names and values of constant columns to add in front, for instance ``dict(train_seed=3)``.
    :param progress_bar: Show a progress bar.
    :raises ValueError: if an argument is invalid; no episode has been run then.
    """
    models = dict(model) if isinstance(model, Mapping) else {type(model).__name__: model}
    rows = [scenario.with_kwargs(**(env_kwargs or {})) for scenario in scenarios]
    labels = labels or {}
    _check_arguments(models, rows, n_episodes)
    check_models_fit(models, rows)

    frames = []
    total = len(models) * sum(row.n_episodes or n_episodes for row in rows)
    with tqdm(total=total, unit="episode", disable=not progress_bar) as progress:
        for label, each in models.items():
            for scenario in rows:
                progress.set_description(f"{label}, {scenario.name}")
                how: dict[str, Any] = dict(seed=seed, deterministic=deterministic, at_end=progress.update)
                frame = run_episodes(each, scenario, n_episodes, **how)
                frames.append(frame.assign(model=label, scenario=scenario.name, env_id=scenario.env_id))
    records = pd.concat(frames, ignore_index=True).assign(**labels, seed=seed, deterministic=deterministic)
    final = [name for name in records.columns if name not in {*labels, *COLUMNS}]
    return records[[*labels, *COLUMNS[:6], *final, *COLUMNS[6:]]]


def run_episodes(
    model: Any,
    scenario: Scenario,
    n_episodes: int,
    *,
    seed: int,
    deterministic: bool = False,
    at_end: Callable[[], Any] = lambda: None,
) -> pd.DataFrame:
    """
    Run one model in one scenario that it fits; see :func:`evaluate_scenarios`.

    :param n_episodes: Number of episodes, unless the scenario has its own.
    :param at_end: Called at the end of each episode.
    :return: a row for each episode with ``episode``, ``cost``, ``length``, ``final_*`` and, if known, ``failure``; the
        first episodes of all environments come first, then the second episodes, and so on
    """
    n_episodes = scenario.n_episodes or n_episodes
    env = scenario_env(scenario, model, n_episodes=min(n_episodes, MAX_PARALLEL_EPISODES))
    returns, monitored = np.zeros(env.num_envs), is_monitored(env)
    ended: dict[tuple[int, int], dict[str, Any]] = {}  # by the episode's number in its environment, and the environment
    with contextlib.closing(env):
        for step in rollout(model, env, n_episodes, seeds=evaluation_seeds(seed), deterministic=deterministic):
            returns += step.rewards
            for i in np.flatnonzero(step.finished):
                info = step.infos[i]
                of_monitor = info["episode"] if monitored else {}
                cost, length = -of_monitor.get("r", returns[i]), of_monitor.get("l", step.t[i] + 1)
                ended[int(step.episode[i]), int(i)] = dict(cost=cost, length=length, **_final_columns(info))
                at_end()
            returns[step.dones] = 0
    # If episodes were numbered in the order of their ends, a number would mean another start for each model.
    order = sorted(range(n_episodes), key=list(ended).__getitem__)
    records = pd.DataFrame(list(ended.values())).iloc[order]
    return records.reset_index(drop=True).rename_axis("episode").reset_index()


def rollout_states(
    model: Any, scenario: Scenario, n_episodes: int = 60, *, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """
    Run episodes of a fixed horizon side by side and keep the true states ``info["state"]``.

    :param scenario: A scenario whose environment reports its state and ends each episode at the horizon.
    :return: the states, ``(T + 1, N, X)``, and the costs of the whole episodes, ``(N,)``
    """
    states: list[Any] = []
    costs = np.zeros(n_episodes)
    with contextlib.closing(scenario_env(scenario, model, n_episodes=n_episodes, n_envs=n_episodes)) as env:
        problem = read_problem(env)
        steps = rollout(model, env, seeds=evaluation_seeds(seed), problem=problem)
        for step in islice(steps, problem.horizon):
            states.append(step.states)
            costs -= step.rewards
        states.append(np.stack([np.ravel(info["state"]) for info in step.infos]))
    return np.stack(states), costs


def _final_columns(info: Mapping[str, Any]) -> dict[str, float]:
    """Flatten the numbers in an episode's last info to columns."""
    columns: dict[str, Any] = {}
    for name, value in info.items():
        try:
            array = np.asarray(value)
        except ValueError:  # a list of lists of different lengths
            continue
        if name in _BOOKKEEPING or array.dtype.kind not in "biuf" or array.size > MAX_FINAL_COMPONENTS:
            continue
        names = [f"final_{name}_{i}" for i in range(array.size)] if array.ndim else [f"final_{name}"]
        columns.update(zip(names, array.ravel().tolist(), strict=True))
    if "is_success" in info:
        columns["failure"] = not info["is_success"]
    return columns


def _check_arguments(models: Mapping[str, Any], scenarios: Sequence[Scenario], n_episodes: int) -> None:
    if not (models and scenarios):
        raise ValueError("give at least one model and one scenario, for instance sb3_tdpg.envs.scenarios.LAVA")
    for label, model in models.items():
        if getattr(model, "policy", None) is None:
            raise ValueError(f"model {label!r} is {model!r}, expected a Stable-Baselines3 model with a policy")
    names = [scenario.name for scenario in scenarios]
    if len(set(names)) < len(names):
        raise ValueError(f"scenario names must differ, not {names}")
    if not isinstance(n_episodes, (int, np.integer)) or n_episodes < 1:
        raise ValueError(f"n_episodes={n_episodes!r} must be an integer of at least 1: the episodes per scenario")
