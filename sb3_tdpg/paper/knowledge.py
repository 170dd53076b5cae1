"""
What the TRVs of the image problems know: quantities that matter and quantities that do not, regressed on the TRVs.

Dimension key: T horizon, N episodes, Z TRVs.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from itertools import islice
from typing import Any, NamedTuple, cast

import numpy as np
import torch as th

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.envs.textures import load_texture
from sb3_tdpg.evaluation.environments import scenario_env
from sb3_tdpg.evaluation.randomness import EvaluationSeeds, evaluation_seeds, isolated_randomness
from sb3_tdpg.evaluation.rollout import act, rollout
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.problem import read_problem
from sb3_tdpg.vec_env import make_episodes_env

# Walls that no policy was trained or tested on.
FIRST_WALL = 1000
DARKEST = 0.4
MUGS_AT_A_TIME = 1000  # bounds the memory


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
        of_wall = EvaluationSeeds(int(rng.integers(2**31)), seeds.policy)
        factor = rng.uniform(DARKEST, 1.0, (n_episodes, 1, 1, 1))
        with contextlib.closing(scenario_env(scenario, model, n_episodes=n_episodes, n_envs=n_episodes)) as env:
            steps = rollout(
                model,
                env,
                seeds=of_wall,
                problem=read_problem(env),
                observe=lambda images, factor=factor: np.rint(images * factor).astype(np.uint8),
            )
            known, states = zip(*((step.memory[0], step.states) for step in islice(steps, model.horizon)), strict=True)
        trvs.append(np.stack(known))
        positions.append(np.stack(states)[..., :1])
        factors.append(factor[:, :, 0, 0])
        colors.append(np.broadcast_to(texture.mean(axis=(0, 1)), (n_episodes, 3)))
    all_trvs = np.concatenate(trvs, axis=1)  # (T, N, Z)
    targets = dict(position=np.concatenate(positions, axis=1))
    for name, values in (("brightness", factors), ("wall", colors)):  # constant over time
        targets[name] = np.broadcast_to(np.concatenate(values), (len(all_trvs), all_trvs.shape[1], values[0].shape[1]))
    return {name: _r2(all_trvs, target) for name, target in targets.items()}


class Mugs(NamedTuple):
    """N mugs of the grasping problem, and what the camera shows of them."""

    states: np.ndarray  # (N, 4): x, y, z, yaw; (N, 5) with the camera's height where it varies
    images: np.ndarray  # (N, 1, 128, 128)


def draw_mugs(env_kwargs: Mapping[str, Any] | None = None, *, n_mugs: int = 10_000, seed: int = 0) -> Mugs:
    """
    Draw mugs; nothing is grasped.

    :param env_kwargs: Keywords of ``PandaGrasp-v0``.
    :param n_mugs: N
    :param seed: Seed of their poses.
    """
    env = make_episodes_env("PandaGrasp-v0", n_episodes=n_mugs, env_kwargs=env_kwargs, use_processes=False)
    env.seed(evaluation_seeds(seed).env)
    images = cast(np.ndarray, env.reset())
    states = np.stack([info["state"] for info in env.unwrapped.reset_infos])
    env.close()
    return Mugs(states, images)


def encode_mugs(model: Any, mugs: Mugs, *, seed: int = 0) -> InformationBatch:
    """
    Show mugs to a policy of the grasping problem.

    :param model: A model of ``PandaGrasp-v0``.
    :param mugs: N of them.
    :param seed: Seed of the policy's sampling.
    :return: what is in :class:`Mugs` as states, ``(1, N, 4 or 5)``; TRVs, means and standard deviations ``(1, N, Z)``
    """
    steps = []
    with isolated_randomness(evaluation_seeds(seed).policy, model):
        for images in np.array_split(mugs.images, -(-len(mugs.images) // MUGS_AT_A_TIME)):
            no_memory = th.zeros(len(images), model.policy.trv_dim, device=model.device)
            steps.append(act(model, images, no_memory, np.zeros(len(images), np.int64))[0])
    known = (th.cat([getattr(step, name) for step in steps]).cpu()[None] for name in ("trvs", "means", "stds"))
    return InformationBatch(th.as_tensor(mugs.states, dtype=th.float32)[None], *known)


def grasp_knowledge(batch: InformationBatch) -> dict[str, float]:
    """
    Probe how much of the mug's pose can be read from the TRVs of the grasping problem.

    Each is regressed on the TRVs and their squares and products for half of the mugs; R^2 is that for the other half.
    It is too low by about the number of these (152 for 16 TRVs) over half the number of mugs.

    :param batch: From :func:`encode_mugs`, with an even number of mugs.
    :return: R^2, not below 0, of ``"x"``, ``"y"`` and ``"yaw"`` (of its sine and cosine together), and of the
        ``"camera"``'s height where it varies
    """
    x, y, _, yaw, *camera = batch.states[0].numpy().astype(np.float64).T
    trvs = batch.trvs[0].numpy().astype(np.float64)
    row, column = np.triu_indices(trvs.shape[1])
    known = np.concatenate([trvs, trvs[:, row] * trvs[:, column]], axis=1)[None]
    targets = dict(x=x[:, None], y=y[:, None], yaw=np.stack([np.sin(yaw), np.cos(yaw)], axis=1))
    if camera:
        targets["camera"] = camera[0][:, None]
    return {name: _r2(known, target[None], pooled=True) for name, target in targets.items()}


def _r2(trvs: np.ndarray, targets: np.ndarray, *, pooled: bool = False) -> float:
    """
    R^2 on the second half of the episodes of a linear regression on the first, averaged over time and components.

    :param pooled: Components count by their variance, and not alike.
    """
    half = trvs.shape[1] // 2
    x = np.concatenate([trvs, np.ones_like(trvs[..., :1])], axis=-1)
    values = []
    for x_t, y_t in zip(x, targets, strict=True):
        coefficients, *_ = np.linalg.lstsq(x_t[:half], y_t[:half], rcond=None)
        residual = y_t[half:] - x_t[half:] @ coefficients
        total = y_t[half:] - y_t[:half].mean(axis=0)
        axis = None if pooled else 0
        values.append(1 - (residual**2).sum(axis=axis) / (total**2).sum(axis=axis))
    return float(np.clip(values, 0, None).mean())
