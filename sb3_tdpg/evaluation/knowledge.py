"""
What the TRVs still know, of what matters and of what does not: a regression of each on the TRVs.

Dimension key: T horizon, N episodes, Z TRVs.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.envs.textures import load_texture
from sb3_tdpg.evaluation.environments import scenario_env
from sb3_tdpg.evaluation.randomness import evaluation_seeds, isolated_randomness
from sb3_tdpg.information import InformationBatch

# Walls that no policy was trained or tested on.
FIRST_WALL = 1000
DARKEST = 0.4


def trv_knowledge(
    model: Any, env_kwargs: Mapping[str, Any] | None = None, *, n_walls: int = 64, n_episodes: int = 10, seed: int = 0
) -> dict[str, float]:
    """
    Tell how much of the robot's position, of the brightness and of the wall's colour can be read from the TRVs.

    Episodes run in front of random walls, every one with all its images darkened by a factor of its own. At each time
    step each quantity is regressed linearly on the TRVs before half of the walls, and R^2 taken before the other half:
    on the same walls a regression could learn by heart which wall has which colour.

    :param model: A model of ``BallCatch-v0``.
    :param env_kwargs: Keywords of the environment, such as those of a launch that varies.
    :param n_walls: Random walls, an even number.
    :param n_episodes: Episodes in front of each.
    :param seed: Seed of the episodes and of the darkening.
    :return: R^2, averaged over time and not below 0, of ``"position"`` (d_t), ``"brightness"`` (the factor) and
        ``"wall"`` (its mean colour, averaged over red, green and blue)
    """
    seeds = evaluation_seeds(seed)
    rng = np.random.default_rng(seeds.env)
    trvs, positions, factors, colors = [], [], [], []
    for wall in range(FIRST_WALL, FIRST_WALL + n_walls):
        texture = load_texture(f"random-{wall}")
        scenario = Scenario(str(wall), "BallCatch-v0", {**(env_kwargs or {}), "renderer": "fast", "texture": texture})
        env = scenario_env(scenario, model, n_episodes=n_episodes, n_envs=n_episodes)
        env.seed(int(rng.integers(2**31)))
        factor = rng.uniform(DARKEST, 1.0, n_episodes)
        with isolated_randomness(seeds.policy, model):
            of_wall = _run(model, env, factor)
        trvs.append(of_wall[0])
        positions.append(of_wall[1])
        factors.append(factor)
        colors.append(np.broadcast_to(texture.mean(axis=(0, 1)), (n_episodes, 3)))
        env.close()
    known = np.concatenate(trvs, axis=1)  # (T, N, Z)
    horizon = len(known)

    def constant(values: np.ndarray) -> np.ndarray:
        return np.broadcast_to(values, (horizon, *values.shape))

    position = np.concatenate(positions, axis=1)[..., None]
    brightness = constant(np.concatenate(factors)[:, None])
    color = constant(np.concatenate(colors))
    return {name: _r2(known, y) for name, y in (("position", position), ("brightness", brightness), ("wall", color))}


def encode_mugs(
    model: Any, env_kwargs: Mapping[str, Any] | None = None, *, n_episodes: int = 2000, seed: int = 0
) -> InformationBatch:
    """
    Show a policy of the grasping problem mugs, and return what its TRVs make of them. Nothing is grasped.

    :param model: A model of ``PandaGrasp-v0``.
    :param env_kwargs: Keywords of the environment.
    :param n_episodes: Mugs N.
    :param seed: Seed of the mugs' poses and of the policy.
    :return: poses ``(1, N, 4)`` as states, TRVs, means and standard deviations ``(1, N, Z)``
    """
    seeds = evaluation_seeds(seed)
    env = scenario_env(Scenario("mugs", "PandaGrasp-v0", env_kwargs or {}), model, n_episodes=n_episodes)
    env.seed(seeds.env)
    observations = th.as_tensor(env.reset(), device=model.device)
    states = np.stack([info["state"] for info in env.unwrapped.reset_infos])
    env.close()
    no_memory = th.zeros(n_episodes, model.policy.trv_dim, device=model.device)
    with isolated_randomness(seeds.policy, model), th.no_grad():
        step = model.policy.step(observations, no_memory, np.zeros(n_episodes, np.int64))
    known = (x.cpu()[None] for x in (step.trvs, step.means, step.stds))
    return InformationBatch(th.as_tensor(states, dtype=th.float32)[None], *known)


def grasp_knowledge(batch: InformationBatch) -> dict[str, float]:
    """
    Tell how much of the mug's pose can be read from the TRVs of the grasping problem.

    Each is regressed on the TRVs and their squares and products for half of the mugs; R^2 is that for the other half.

    :param batch: From :func:`encode_mugs`, with an even number of mugs.
    :return: R^2, not below 0, of ``"x"``, ``"y"`` and ``"yaw"`` (its sine and cosine, averaged)
    """
    x, y, _, yaw = batch.states[0].numpy().T
    trvs = batch.trvs[0].numpy()
    row, column = np.triu_indices(trvs.shape[1])
    known = np.concatenate([trvs, trvs[:, row] * trvs[:, column]], axis=1)[None]
    targets = dict(x=x[:, None], y=y[:, None], yaw=np.stack([np.sin(yaw), np.cos(yaw)], axis=1))
    return {name: _r2(known, target[None]) for name, target in targets.items()}


def _run(model: Any, env: Any, factor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Run an episode in each environment: its TRVs ``(T, N, Z)`` and the robot's positions ``(T, N)``."""
    observations = env.reset()
    states = np.stack([info["state"] for info in env.unwrapped.reset_infos])
    memory, start = None, np.ones(len(factor), dtype=bool)
    trvs, positions = [], []
    for _ in range(model.horizon):
        positions.append(states[:, 0])
        darkened = np.rint(observations * factor[:, None, None, None]).astype(np.uint8)
        actions, memory = model.predict(darkened, memory, start, deterministic=False)
        observations, _, start, infos = env.step(actions)
        states = np.stack([info["state"] for info in infos])
        trvs.append(memory[0])
    return np.stack(trvs), np.stack(positions)


def _r2(trvs: np.ndarray, targets: np.ndarray) -> float:
    """R^2 on the second half of the episodes of a linear regression on the first, averaged over time and components."""
    half = trvs.shape[1] // 2
    x = np.concatenate([trvs, np.ones_like(trvs[..., :1])], axis=-1)
    values = []
    for x_t, y_t in zip(x, targets, strict=True):
        coefficients, *_ = np.linalg.lstsq(x_t[:half], y_t[:half], rcond=None)
        residual = y_t[half:] - x_t[half:] @ coefficients
        total = y_t[half:] - y_t[:half].mean(axis=0)
        values.append(1 - (residual**2).sum(axis=0) / (total**2).sum(axis=0))
    return float(np.clip(values, 0, None).mean())
