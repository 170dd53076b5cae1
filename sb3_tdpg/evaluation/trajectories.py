"""
The true states that a model passes through, for looking at its strategy.

Dimension key: T horizon, N episodes, X state.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import check_models_fit, scenario_env
from sb3_tdpg.evaluation.randomness import evaluation_seeds, isolated_randomness
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
    seeds = evaluation_seeds(seed)
    env = scenario_env(scenario, model, n_episodes=n_episodes, n_envs=n_episodes)
    try:
        with isolated_randomness(seeds.policy, model):
            env.seed(seeds.env)
            problem = read_problem(env)
            observations: Any = env.reset()
            states = [problem.initial_states(env, observations)]
            costs = np.zeros(n_episodes)
            memory, start = None, np.ones(n_episodes, dtype=bool)
            for t in range(problem.horizon):
                actions, memory = model.predict(observations, memory, start, deterministic)
                observations, rewards, dones, infos = env.step(actions)
                start = dones
                costs -= rewards
                if dones.any() and t < problem.horizon - 1:
                    raise ValueError(
                        f"an episode ended after {t + 1} of {problem.horizon} steps: nothing to draw on one axis"
                    )
                states.append(np.stack([info["state"] for info in infos]))
    finally:
        env.close()
    return Trajectories(np.stack(states), costs)
