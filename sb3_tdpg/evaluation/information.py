"""
How much the TRVs of a policy tell of the state, on episodes that it was not trained on.

Dimension key: T horizon, N episodes, X state, Z TRVs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg.evaluation.randomness import evaluation_seeds, isolated_randomness
from sb3_tdpg.information import InformationBatch, LogDet
from sb3_tdpg.problem import read_problem
from sb3_tdpg.tdpg import TDPG


class EncodedEpisodes(NamedTuple):
    """N episodes as the encoder saw them."""

    batch: InformationBatch  # (T, N, ...), on the CPU
    costs: np.ndarray  # (N,), of the whole episode

    @property
    def information(self) -> float:
        """
        The log-det bound on I[x_t; x~_t], summed over time, in nats.

        It needs no critic and knows nothing of how the policy was trained, so that it compares any two.
        """
        horizon, _, state_dim = self.batch.states.shape
        return float(LogDet(horizon, state_dim, self.batch.trvs.shape[2])(self.batch).clamp(min=0).sum())


def encode_episodes(model: TDPG, env: VecEnv, *, seed: int = 0) -> EncodedEpisodes:
    """
    Run one episode in each environment.

    :param model: With the spaces and the horizon of ``env``.
    :param env: N environments, of which one episode each is run. What they do afterwards is left out.
    :param seed: Seed of the environments and of the policy's sampling.
    :return: episodes that end early are marked as such in ``batch.alive``
    """
    seeds, n = evaluation_seeds(seed), env.num_envs
    policy, device = model.policy, model.device
    policy.set_training_mode(False)
    steps: list[tuple[Any, ...]] = []
    with isolated_randomness(seeds.policy, model), th.no_grad():
        env.seed(seeds.env)
        problem = read_problem(env)
        obs: Any = env.reset()
        states = problem.initial_states(env, obs)
        trvs = th.zeros(n, policy.trv_dim, device=device)
        alive, costs = np.ones(n, dtype=bool), np.zeros(n)
        for t in range(problem.horizon):
            step = policy.step(obs_as_tensor(obs, device), trvs, np.full(n, t))
            steps.append(
                (th.as_tensor(states), step.trvs.cpu(), step.means.cpu(), step.stds.cpu(), th.as_tensor(alive))
            )
            actions = step.actions.cpu().numpy().reshape((-1, *model.action_space.shape))  # type: ignore[misc]
            if isinstance(model.action_space, spaces.Box):
                actions = np.clip(actions, model.action_space.low, model.action_space.high)
            obs, rewards, dones, infos = env.step(actions)
            costs -= rewards * alive
            alive = alive & ~dones
            if not alive.any():
                break
            states = problem.next_states(env, obs, dones, infos)
            trvs = step.trvs
    batch = InformationBatch(*(th.stack(values) for values in zip(*steps, strict=True)))
    return EncodedEpisodes(batch._replace(states=batch.states.float()), costs)
