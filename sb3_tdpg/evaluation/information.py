"""
The information in a policy's TRVs, measured alike for every policy: on fresh episodes, and with no fitted critic.

Dimension key: T horizon, N episodes, X state, Z TRVs.
"""

from __future__ import annotations

import contextlib
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import scenario_env
from sb3_tdpg.evaluation.randomness import evaluation_seeds, isolated_randomness
from sb3_tdpg.information import InformationBatch, LogDet, own_sample_bound
from sb3_tdpg.problem import read_problem


class EncodedEpisodes(NamedTuple):
    """N episodes as the encoder saw them."""

    batch: InformationBatch  # (T, N, ...), on the CPU; episodes that ended early are not alive afterwards
    costs: np.ndarray  # (N,), of the whole episode


class InformationBounds(NamedTuple):
    """Sums over the time steps of an episode, in nats."""

    upper: float  # on I[x_t; x~_t]: the log-det bound
    lower: float  # on what the encoder's input tells of x~_t, which is I[x_t; x~_t] without memory and sensor noise


def encode_episodes(model: Any, env: VecEnv, *, seed: int = 0) -> EncodedEpisodes:
    """
    Run one episode in each environment, and keep the true states and the TRVs with their densities.

    :param model: A :class:`~sb3_tdpg.tdpg.TDPG` with the spaces and the horizon of ``env``.
    :param env: N environments, of which one episode each counts.
    :param seed: Seed of the environments and of the policy's sampling.
    """
    seeds, n = evaluation_seeds(seed), env.num_envs
    policy, device, action_space = model.policy, model.device, model.action_space
    policy.set_training_mode(False)
    steps: list[tuple[th.Tensor, ...]] = []
    with isolated_randomness(seeds.policy, model), th.no_grad():
        env.seed(seeds.env)
        problem = read_problem(env)
        observations: Any = env.reset()
        states = problem.initial_states(env, observations)
        trvs = th.zeros(n, policy.trv_dim, device=device)
        alive, costs = np.ones(n, dtype=bool), np.zeros(n)
        for t in range(problem.horizon):
            step = policy.step(obs_as_tensor(observations, device), trvs, np.full(n, t))
            trvs = step.trvs
            here = (th.as_tensor(states, dtype=th.float32), trvs.cpu(), step.means.cpu(), step.stds.cpu())
            steps.append((*here, th.as_tensor(alive)))
            actions = step.actions.cpu().numpy().reshape((-1, *action_space.shape))
            if isinstance(action_space, spaces.Box):
                actions = np.clip(actions, action_space.low, action_space.high)
            observations, rewards, dones, infos = env.step(actions)
            states = problem.next_states(env, observations, dones, infos)
            costs -= rewards * alive
            alive = alive & ~dones  # what follows is another episode
    return EncodedEpisodes(InformationBatch(*(th.stack(parts) for parts in zip(*steps, strict=True))), costs)


def rollout_information(model: Any, scenario: Scenario, n_episodes: int = 1000, *, seed: int = 0) -> InformationBatch:
    """
    Run :func:`encode_episodes` where a scenario says.

    :param model: A :class:`~sb3_tdpg.tdpg.TDPG`.
    :param scenario: Where.
    :param n_episodes: N, side by side.
    :param seed: Seed of the environment and of the policy's sampling.
    """
    with contextlib.closing(scenario_env(scenario, model, n_episodes=n_episodes, n_envs=n_episodes)) as env:
        return encode_episodes(model, env, seed=seed).batch


def information_bounds(batch: InformationBatch) -> InformationBounds:
    """
    Bound the information of a batch, summed over time; a step with too few living episodes counts as 0.

    :param batch: From :func:`encode_episodes`, ``(T, N, ...)``.
    """
    log_det = LogDet(1, batch.states.shape[2], batch.trvs.shape[2])
    upper = lower = 0.0
    for t in range(len(batch.trvs)):
        at_t = batch.at(t)
        if at_t.trvs.shape[1] >= batch.trvs.shape[2] + 2:
            upper += log_det(at_t).item()
            lower += own_sample_bound(at_t).item()
    return InformationBounds(upper, lower)
