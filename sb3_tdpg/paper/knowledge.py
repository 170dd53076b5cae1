"""
Measure what the TRVs of the image problems encode, by bounds on the information and, for grasping, by regression.

Dimension key: N mugs, Z TRVs.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
import pandas as pd
import torch as th

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.information import rollout_information
from sb3_tdpg.evaluation.randomness import evaluation_seeds, isolated_randomness
from sb3_tdpg.evaluation.rollout import act
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.information.logdet import LogDet
from sb3_tdpg.information.loo import LeaveOneOut, own_sample_bound
from sb3_tdpg.robustness import PerturbedVecEnv
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.vec_env import make_episodes_env

MUGS_AT_A_TIME = 1000  # number of images that are encoded at once; limits the memory
N_MUGS = 10_000  # number of mugs for the regression
N_BOUND = 2_000  # number of mugs for the bounds, which compare all pairs of mugs
LAST_EPOCHS = 5


def pooled_information(model: Any, env_kwargs: Mapping[str, Any], n_episodes: int = 160) -> float:
    """
    Return the bound on a ball-catching policy's information that the penalty uses, in nats.

    This is the log-det bound for the steps of all times together, times the horizon. As in training, each image has
    the declared changes.
    """
    sensor = partial(PerturbedVecEnv, perturbation="images")
    scenario = Scenario("training", "BallCatch-v0", {**env_kwargs, "renderer": "fast"}, sensor=sensor)
    batch = rollout_information(model, scenario, n_episodes)
    pooled = batch.pooled()
    with th.no_grad():
        return model.horizon * LogDet(1, batch.states.shape[2], batch.trvs.shape[2])(pooled).item()


class Mugs(NamedTuple):
    """N mugs of the grasping problem, with their camera images."""

    states: np.ndarray  # (N, 4): x, y, z, yaw; (N, 5) with the camera's height if it varies
    images: np.ndarray  # (N, 1, 128, 128)


def draw_mugs(env_kwargs: Mapping[str, Any], n_mugs: int) -> Mugs:
    """Sample mugs and their images from ``PandaGrasp-v0`` (with ``env_kwargs``), without simulating a grasp."""
    env = make_episodes_env("PandaGrasp-v0", n_episodes=n_mugs, env_kwargs=env_kwargs, use_processes=False)
    env.seed(evaluation_seeds(0).env)
    images = cast(np.ndarray, env.reset())
    states = np.stack([info["state"] for info in env.unwrapped.reset_infos])
    env.close()
    return Mugs(states, images)


def encode_mugs(model: Any, mugs: Mugs) -> InformationBatch:
    """Encode N mugs with a policy; states are ``(1, N, 4 or 5)``, TRVs, means and standard deviations ``(1, N, Z)``."""
    steps = []
    with isolated_randomness(evaluation_seeds(0).policy, model):
        for images in np.array_split(mugs.images, -(-len(mugs.images) // MUGS_AT_A_TIME)):
            no_memory = th.zeros(len(images), model.policy.trv_dim, device=model.device)
            steps.append(act(model, images, no_memory, np.zeros(len(images), np.int64))[0])
    known = (th.cat([getattr(step, name) for step in steps]).cpu()[None] for name in ("trvs", "means", "stds"))
    return InformationBatch(th.as_tensor(mugs.states, dtype=th.float32)[None], *known)


def grasp_knowledge(batch: InformationBatch) -> dict[str, float]:
    """
    Regress the mug's pose on the TRVs of a grasping policy.

    For half of the mugs, each quantity is regressed on the TRVs, their squares and their products. R^2 is computed on
    the other half. R^2 is too low by at most about the number of regressors (152 for 16 TRVs) divided by half the
    number of mugs.

    :param batch: From :func:`encode_mugs`, with an even number of mugs.
    :return: R^2, clipped at 0, of ``"x"``, ``"y"`` and ``"yaw"`` (its sine and cosine together), and of ``"camera"``
        (the height of the camera) if it varies
    """
    x, y, _, yaw, *camera = batch.states[0].numpy().astype(np.float64).T
    trvs = batch.trvs[0].numpy().astype(np.float64)
    row, column = np.triu_indices(trvs.shape[1])
    known = np.concatenate([trvs, trvs[:, row] * trvs[:, column]], axis=1)
    targets = dict(x=x[:, None], y=y[:, None], yaw=np.stack([np.sin(yaw), np.cos(yaw)], axis=1))
    if camera:
        targets["camera"] = camera[0][:, None]
    return {name: _r2(known, target) for name, target in targets.items()}


def _r2(known: np.ndarray, targets: np.ndarray) -> float:
    """Fit a linear regression to the first half of the mugs, and return its R^2 on the second half, clipped at 0."""
    half = len(known) // 2
    x = np.column_stack([known, np.ones(len(known))])
    coefficients, *_ = np.linalg.lstsq(x[:half], targets[:half], rcond=None)
    residual = targets[half:] - x[half:] @ coefficients
    total = targets[half:] - targets[:half].mean(axis=0)
    return max(0.0, float(1 - (residual**2).sum() / (total**2).sum()))


def knowledge_table(models: Mapping[tuple[str, int], TDPG], scenarios: Sequence[Scenario]) -> pd.DataFrame:
    """Regress the pose of mugs on the TRVs of each model (keys: label and seed), and bound their information."""
    rows = []
    for row in scenarios:
        mugs = draw_mugs(row.env_kwargs, N_MUGS)
        for (label, seed), model in models.items():
            batch = encode_mugs(model, mugs)
            few = batch.select(th.arange(min(N_MUGS, N_BOUND)))
            keys = dict(model=label, train_seed=seed, mugs=row.name.lower())
            rows.append({**keys, **grasp_knowledge(batch), **bounds(few)})
    return pd.DataFrame(rows)


def bounds(batch: InformationBatch) -> dict[str, float]:
    """Return a lower bound on the information, and the smaller one of two upper bounds."""
    sizes = (batch.states.shape[2], batch.trvs.shape[2])
    upper = min(cls(1, *sizes)(batch).item() for cls in (LeaveOneOut, LogDet))
    return {"lower bound": own_sample_bound(batch).item(), "upper bound": upper}


def penalty_table(progress: Mapping[int, pd.DataFrame]) -> list[dict[str, Any]]:
    """Summarise penalty and information in training, with a row for each training log in ``progress`` (keys: seeds)."""
    rows = []
    for seed, log in progress.items():
        # The log has the weight of an epoch in the row of the next epoch, so the first row has no weight.
        weights = log["train/mi_coef"].fillna(0.0).to_numpy() if "train/mi_coef" in log else np.zeros(1)
        with_penalty = np.flatnonzero(weights > 0)
        information = log["mi/total"].dropna()
        failures = log["rollout/ep_cost_mean"].iloc[-LAST_EPOCHS:].mean()
        rows.append(
            {
                "seed": seed,
                "first epoch with the penalty": str(with_penalty[0]) if len(with_penalty) else "none",
                "last weight": f"{weights[-1]:.2g}",
                "information in the first epoch": f"{information.iloc[0]:.2f}",
                "information in the last epoch": f"{information.iloc[-1]:.2f}",
                "failed grasps": f"{failures:.3f}",
            }
        )
    return rows
