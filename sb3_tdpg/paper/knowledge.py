"""
Measure what the TRVs of the image problems encode, by regression and by bounds on the information.

Dimension key: T horizon, N episodes, Z TRVs.
"""

import contextlib
import math
from collections.abc import Mapping, Sequence
from functools import partial
from itertools import islice
from typing import Any, NamedTuple, cast

import numpy as np
import pandas as pd
import torch as th

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.envs.textures import load_texture
from sb3_tdpg.evaluation.environments import scenario_env
from sb3_tdpg.evaluation.information import rollout_information
from sb3_tdpg.evaluation.randomness import EvaluationSeeds, evaluation_seeds, isolated_randomness
from sb3_tdpg.evaluation.rollout import act, rollout
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.information.logdet import LogDet
from sb3_tdpg.information.loo import LeaveOneOut, own_sample_bound
from sb3_tdpg.information.mine import Mine
from sb3_tdpg.problem import read_problem
from sb3_tdpg.robustness import PerturbedVecEnv
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.vec_env import make_episodes_env

# No policy was trained or tested on walls from this number on.
FIRST_WALL = 1000
DARKEST = 0.4
MUGS_AT_A_TIME = 1000  # limits the memory
N_MUGS = 10_000  # for the regression
N_BOUND = 2_000  # for the bounds, which compare all pairs of mugs
FITTED_MUGS = 400  # for MINE, as many as in an epoch
LAST_EPOCHS = 5
CRITICS: Mapping[str, Mapping[str, Any]] = {
    # The numbers of steps are the paper's. Learning rate, layer sizes and minibatches are the paper's values for the
    # lava problem, because it prints none for grasping. There are no refits, and the optimiser is never reset.
    "MINE at 5e-5, the paper's numbers of steps": dict(
        learning_rate=5e-5, warmup_gradient_steps=500_000, gradient_steps=100_000,
        refit_below=-math.inf, refit_above=math.inf, reset_moments=False,
    ),
    "MINE at 1e-3": dict(warmup_gradient_steps=2000, gradient_steps=1000),
    "MINE at 1e-3, standardised state": dict(warmup_gradient_steps=2000, gradient_steps=1000, standardize=True),
}  # fmt: skip


def trv_knowledge(
    model: Any, env_kwargs: Mapping[str, Any] | None = None, *, n_walls: int = 64, n_episodes: int = 10
) -> dict[str, float]:
    """
    Regress the robot's position, the brightness and the wall's colour on the TRVs of a ball-catching policy.

    Episodes run in front of random walls. All images of an episode are darkened by the same random factor. At each time
    step a linear regression is fitted on half of the walls, and R^2 is computed on the other half, because on the same
    walls the regression could memorise the colours.

    :param n_walls: Number of random walls, which must be even.
    :param n_episodes: Number of episodes in front of each wall.
    :return: R^2, averaged over time and clipped at 0, of ``"position"`` (d_t), ``"brightness"`` (the factor) and
        ``"wall"`` (the wall's mean colour; this R^2 is averaged over red, green and blue)
    """
    seeds = evaluation_seeds(0)
    rng = np.random.default_rng(seeds.env)
    trvs, targets = [], []
    for wall in range(FIRST_WALL, FIRST_WALL + n_walls):
        texture = load_texture(f"random-{wall}")
        scenario = Scenario(str(wall), "BallCatch-v0", {**(env_kwargs or {}), "renderer": "fast", "texture": texture})
        of_wall = EvaluationSeeds(int(rng.integers(2**31)), seeds.policy)
        factor = rng.uniform(DARKEST, 1.0, (n_episodes, 1, 1, 1))
        with contextlib.closing(scenario_env(scenario, model, n_episodes=n_episodes, n_envs=n_episodes)) as env:
            observe = partial(_darkened, factor=factor)
            steps = rollout(model, env, seeds=of_wall, problem=read_problem(env), observe=observe)
            known, states = zip(*((step.memory[0], step.states) for step in islice(steps, model.horizon)), strict=True)
        trvs.append(np.stack(known))
        position, color = np.stack(states)[..., :1], texture.mean(axis=(0, 1))
        values = (position, factor[:, :, 0, 0], color)  # factor and colour are constant over time
        targets.append([np.broadcast_to(each, (*position.shape[:2], np.shape(each)[-1])) for each in values])
    names = ("position", "brightness", "wall")
    all_trvs = np.concatenate(trvs, axis=1)  # (T, N, Z)
    of_all = (np.concatenate(of_walls, axis=1) for of_walls in zip(*targets, strict=True))
    return {name: _r2(all_trvs, target) for name, target in zip(names, of_all, strict=True)}


def pooled_information(model: Any, env_kwargs: Mapping[str, Any] | None = None, *, n_episodes: int = 160) -> float:
    """
    Bound the information of a ball-catching policy on its training images, in nats, as the penalty does.

    The result is the log-det bound for the steps of all times together, times the horizon. Each image has the changes
    that are declared for training.
    """
    sensor = partial(PerturbedVecEnv, perturbation="images")
    scenario = Scenario("training", "BallCatch-v0", {**(env_kwargs or {}), "renderer": "fast"}, sensor=sensor)
    batch = rollout_information(model, scenario, n_episodes)
    pooled = batch.pooled()
    with th.no_grad():
        return model.horizon * LogDet(1, batch.states.shape[2], batch.trvs.shape[2])(pooled).item()


def _darkened(images: np.ndarray, factor: np.ndarray) -> np.ndarray:
    return np.rint(images * factor).astype(np.uint8)


class Mugs(NamedTuple):
    """N mugs of the grasping problem, with their camera images."""

    states: np.ndarray  # (N, 4): x, y, z, yaw; (N, 5) with the camera's height if it varies
    images: np.ndarray  # (N, 1, 128, 128)


def draw_mugs(env_kwargs: Mapping[str, Any] | None = None, *, n_mugs: int, seed: int = 0) -> Mugs:
    """Sample mugs and their images from ``PandaGrasp-v0`` with these keywords, without simulating a grasp."""
    env = make_episodes_env("PandaGrasp-v0", n_episodes=n_mugs, env_kwargs=env_kwargs, use_processes=False)
    env.seed(evaluation_seeds(seed).env)
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

    Each quantity is regressed on the TRVs and their squares and products for half of the mugs. R^2 is computed on the
    other half. R^2 is too low by about the number of regressors (152 for 16 TRVs) divided by half the number of mugs.

    :param batch: From :func:`encode_mugs`, with an even number of mugs.
    :return: R^2, clipped at 0, of ``"x"``, ``"y"`` and ``"yaw"`` (its sine and cosine together), and of the height of
        the ``"camera"`` if it varies
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
    Fit a linear regression to the first half of the episodes, and average its R^2 on the second half over time.

    ``pooled`` weights the components by their variance instead of equally.
    """
    half = trvs.shape[1] // 2
    x = np.concatenate([trvs, np.ones_like(trvs[..., :1])], axis=-1)
    values = []
    for x_t, y_t in zip(x, targets, strict=True):
        coefficients, *_ = np.linalg.lstsq(x_t[:half], y_t[:half], rcond=None)
        residual = y_t[half:] - x_t[half:] @ coefficients
        total = y_t[half:] - y_t[:half].mean(axis=0)
        axis = None if pooled else 0
        values.append(1 - (residual**2).sum(axis) / (total**2).sum(axis))
    return float(np.clip(values, 0, None).mean())


def knowledge_table(models: Mapping[tuple[str, int], TDPG], scenarios: Sequence[Scenario]) -> pd.DataFrame:
    """Measure what the TRVs of each model (by label and seed) encode about mugs, and bound their information."""
    rows = []
    for row in scenarios:
        mugs = draw_mugs(row.env_kwargs, n_mugs=N_MUGS)
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


def estimates_table(models: Mapping[str, TDPG]) -> pd.DataFrame:
    """Compare MINE's estimates of the information with the bounds; critics are fitted to one policy after another."""
    mugs = {f"{FITTED_MUGS} mugs of the fit": draw_mugs(n_mugs=FITTED_MUGS, seed=1)}
    mugs["fresh mugs"] = draw_mugs(n_mugs=min(N_MUGS, N_BOUND), seed=2)
    columns = {}
    with th.random.fork_rng(devices=[]):
        th.manual_seed(0)
        critics: dict[str, Mine] = {}
        for label, model in models.items():
            fitted, fresh = (encode_mugs(model, each) for each in mugs.values())
            for name, settings in CRITICS.items():
                if name not in critics:
                    critics[name] = Mine(1, fitted.states.shape[2], fitted.trvs.shape[2], **settings)
                critics[name].fit(fitted)
            for kind, batch in zip(mugs, (fitted, fresh), strict=True):
                with th.no_grad():
                    estimates = {name: critic(batch).item() for name, critic in critics.items()}
                columns[f"{label}, {kind}"] = {**bounds(batch), **estimates}
    return pd.DataFrame(columns).rename_axis("estimate").reset_index()


def penalty_table(progress: Mapping[int, pd.DataFrame]) -> list[dict[str, Any]]:
    """Summarise the penalty and the information in training, with a row for each seed in ``progress``."""
    rows = []
    for seed, log in progress.items():
        # The weight of an epoch is in the next row, so the first row has no weight.
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
