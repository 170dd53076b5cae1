"""Analyse the grasping policies: what their TRVs know, and what the penalty did."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch as th

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.information import InformationBatch, LeaveOneOut, LogDet, Mine, own_sample_bound
from sb3_tdpg.paper.knowledge import draw_mugs, encode_mugs, grasp_knowledge
from sb3_tdpg.tdpg import TDPG

N_MUGS = 10_000  # for the regression
N_BOUND = 2_000  # for the bounds, which compare every mug with every other
FITTED_MUGS = 400  # for MINE, as in an epoch
LAST_EPOCHS = 5
CRITICS: Mapping[str, Mapping[str, Any]] = {
    # The numbers of steps are the paper's; rate, sizes and minibatches are those that it prints for the lava problem,
    # since it prints none for this one. Without guards, and with one optimiser from beginning to end.
    "MINE at 5e-5, the paper's numbers of steps": dict(
        learning_rate=5e-5, warmup_gradient_steps=500_000, gradient_steps=100_000,
        refit_below=-math.inf, refit_above=math.inf, reset_moments=False,
    ),
    "MINE at 1e-3": dict(warmup_gradient_steps=2000, gradient_steps=1000),
    "MINE at 1e-3, standardised state": dict(warmup_gradient_steps=2000, gradient_steps=1000, standardize=True),
}  # fmt: skip

KNOWLEDGE = (
    "On mugs of two rows of the table: the share of the variance of the mug's position and yaw (its sine and cosine) "
    "that a regression on the TRVs, their squares and products explains (R^2 on mugs that it has not seen, mean over "
    "seeds), and bounds on the information in nats. I[x; x~] itself lies between the bounds, since the image is a "
    f"function of the state and there is no memory. The lower bound cannot exceed ln {N_BOUND} = "
    f"{math.log(N_BOUND):.1f}."
)
ESTIMATES = (
    "Policies of the first seed, in nats; both columns of a policy estimate the same quantity. On fresh mugs the "
    "estimate of a fitted critic is a lower bound except for the bias of the logarithm of a mean; on the mugs that it "
    f"was fitted to it is no bound. The lower bound cannot exceed ln {FITTED_MUGS} = {math.log(FITTED_MUGS):.1f} on "
    f"{FITTED_MUGS} mugs. The critics are fitted to PG first (the paper's in 500,000 steps, ours in 2,000), then to "
    "TDPG (in 100,000 and 1,000 steps)."
)
PENALTY = (
    "Each seed of TDPG: the first epoch with a penalty (none if no epoch met the limit on the failures: then TDPG is "
    "its own ablation), the last weight 1/beta in failures per nat, the bound on the information in the first and the "
    f"last epoch, and the share of failed grasps in the last {LAST_EPOCHS} epochs of training."
)


def knowledge_table(models: Mapping[tuple[str, int], TDPG], scenarios: Sequence[Scenario]) -> pd.DataFrame:
    """Measure what the TRVs of each model (by label and seed) know of mugs, and bound their information."""
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
    """Bound the information from below and from above, by the smaller one of two upper bounds."""
    sizes = (batch.states.shape[2], batch.trvs.shape[2])
    upper = min(cls(1, *sizes)(batch).item() for cls in (LeaveOneOut, LogDet))
    return {"lower bound": own_sample_bound(batch).item(), "upper bound": upper}


def estimates_table(models: Mapping[str, TDPG]) -> pd.DataFrame:
    """Compare MINE's estimates of the information in several policies, fitted one after the other, with the bounds."""
    mugs = {
        f"{FITTED_MUGS} mugs of the fit": draw_mugs(n_mugs=FITTED_MUGS, seed=1),
        "fresh mugs": draw_mugs(n_mugs=min(N_MUGS, N_BOUND), seed=2),
    }
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
    """Summarise what the penalty did in training, with a row for each seed; ``progress`` has the logs by seed."""
    rows = []
    for seed, log in progress.items():
        # The weight of an epoch stands in the row after it, so that the first row has no weight.
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
