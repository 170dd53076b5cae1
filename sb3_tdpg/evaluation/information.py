"""
The information in a policy's TRVs, measured alike for every policy: on fresh rollouts, and with no fitted critic.

Dimension key: T horizon, N episodes, X state, Z TRVs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import scenario_env
from sb3_tdpg.evaluation.randomness import evaluation_seeds, isolated_randomness
from sb3_tdpg.information import InformationBatch, LogDet, own_sample_bound
from sb3_tdpg.problem import read_problem


class InformationBounds(NamedTuple):
    """Sums over the time steps of an episode, in nats."""

    upper: float  # on I[x_t; x~_t]: the log-det bound
    lower: float  # on what the encoder's input tells of x~_t, which is I[x_t; x~_t] without memory and sensor noise


def rollout_information(model: Any, scenario: Scenario, n_episodes: int = 1000, *, seed: int = 0) -> InformationBatch:
    """
    Run episodes side by side and keep the true states and the TRVs with their densities.

    :param model: A :class:`~sb3_tdpg.tdpg.TDPG`.
    :param scenario: Where.
    :param n_episodes: N
    :param seed: Seed of the environment and of the policy's sampling.
    """
    seeds = evaluation_seeds(seed)
    env = scenario_env(scenario, model, n_episodes=n_episodes, n_envs=n_episodes)
    policy = model.policy
    policy.set_training_mode(False)
    low, high = getattr(env.action_space, "low", None), getattr(env.action_space, "high", None)
    kept: list[tuple[th.Tensor, ...]] = []
    try:
        with isolated_randomness(seeds.policy, model), th.no_grad():
            env.seed(seeds.env)
            problem = read_problem(env)
            observations: Any = env.reset()
            states = problem.initial_states(env, observations)
            trvs = th.zeros(n_episodes, policy.trv_dim, device=model.device)
            alive = np.ones(n_episodes, dtype=bool)
            for t in range(problem.horizon):
                times = np.full(n_episodes, t, np.int64)
                step = policy.step(th.as_tensor(observations, device=model.device), trvs, times)
                trvs = step.trvs
                here = (th.as_tensor(states, dtype=th.float32), step.trvs.cpu(), step.means.cpu(), step.stds.cpu())
                kept.append((*here, th.as_tensor(alive.copy())))
                actions = step.actions.cpu().numpy().reshape((-1, *(env.action_space.shape or ())))
                observations, _, dones, infos = env.step(actions if low is None else np.clip(actions, low, high))
                states = problem.next_states(env, observations, dones, infos)
                alive &= ~dones  # what follows is another episode
    finally:
        env.close()
    all_states, all_trvs, means, stds, living = (th.stack(parts) for parts in zip(*kept, strict=True))
    return InformationBatch(all_states, all_trvs, means, stds, living)


def information_bounds(batch: InformationBatch) -> InformationBounds:
    """
    Bound the information of a batch, summed over time; a step with too few living episodes counts as 0.

    :param batch: From :func:`rollout_information`, ``(T, N, ...)``.
    """
    log_det = LogDet(1, batch.states.shape[2], batch.trvs.shape[2])
    upper = lower = 0.0
    for t in range(len(batch.trvs)):
        at_t = batch.at(t)
        if at_t.trvs.shape[1] >= batch.trvs.shape[2] + 2:
            upper += log_det(at_t).item()
            lower += own_sample_bound(at_t).item()
    return InformationBounds(upper, lower)
