"""
The true states that a model passes through, for looking at its strategy.

Dimension key: T horizon, N episodes, X state.
"""

from __future__ import annotations

import contextlib
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import check_models_fit, scenario_env
from sb3_tdpg.evaluation.randomness import evaluation_seeds
from sb3_tdpg.evaluation.rollout import rollout
from sb3_tdpg.problem import read_problem


class Trajectories(NamedTuple):
    """N episodes of one model in one scenario."""

    states: np.ndarray  # (T + 1, N, X)
    costs: np.ndarray  # (N,), of the whole episode


def rollout_states(
    model: Any, scenario: Scenario, n_episodes: int = 60, *, seed: int = 0, deterministic: bool = False
) -> Trajectories:
    """
    Run episodes of a fixed horizon side by side and keep the true states ``info["state"]``.

    :param model: An SB3 model.
    :param scenario: Its environment must have a horizon and tell its state.
    :param n_episodes: N
    :param seed: Seed of the environment and of the policy's sampling.
    :param deterministic: Act without noise.
    :raises ValueError: if the model does not fit, or an episode ends before the horizon.
    """
    check_models_fit({type(model).__name__: model}, [scenario])
    env = scenario_env(scenario, model, n_episodes=n_episodes, n_envs=n_episodes)
    with contextlib.closing(env):
        problem = read_problem(env)
        states, costs = [], np.zeros(n_episodes)
        steps = rollout(model, env, seeds=evaluation_seeds(seed), deterministic=deterministic, problem=problem)
        for step in islice(steps, problem.horizon):
            if step.dones.any() and len(states) < problem.horizon - 1:
                raise ValueError(
                    f"an episode ended after {len(states) + 1} of {problem.horizon} steps: rollout_states needs "
                    "episodes of equal length"
                )
            states.append(step.states)
            costs -= step.rewards
        states.append(np.stack([info["state"] for info in step.infos]))
    return Trajectories(np.stack(states), costs)
