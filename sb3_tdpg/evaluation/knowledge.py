"""What the TRVs know of each component of the state."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from sb3_tdpg.common.threads import threads
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.measurement.density_critic import Regression
from sb3_tdpg.measurement.interval import component_estimates
from sb3_tdpg.measurement.interval_bounds import MAX_TRAINING


@threads(1)
def state_knowledge(
    batch: InformationBatch, names: Sequence[str] | None = None, *, confidence: float = 0.95, seed: int = 0
) -> pd.DataFrame:
    """
    Tell what the TRVs know of each component of the state at each time step: what the policy looks at, and when.

    Components that carry the same information count with it each, so their sum says nothing of the whole.

    :param batch: Rollouts ``(T, N, ...)``, for instance of :func:`~sb3_tdpg.evaluation.information.encode_episodes`.
    :param names: Of the X components; default: ``x0``, ``x1``, ...
    :param confidence: Of the lower limit, which is one-sided.
    :param seed: Of the division into halves and of the encoder's noise.
    :return: A row for each time step and component, with the columns ``t``, ``component``, ``nats`` (a lower bound on
        I[x^k_t; x~_t], not below 0), ``nats_lower`` (its confidence limit, not below 0) and ``r2`` (of a regression of
        the component on the TRVs, leaving out the episode that is predicted, not below 0). NaN where a component is
        constant, which can be known without a look, and where too few episodes are alive. Components that are constant
        at all time steps are left out.
    :raises ValueError: if there is not a name for each component, or the batch is not fit for an interval.
    """
    horizon, _, n_components = batch.states.shape
    names = [f"x{k}" for k in range(n_components)] if names is None else list(names)
    if len(names) != n_components:
        raise ValueError(f"names={names} must have a name for each of the {n_components} components of the state")
    nats, limits = component_estimates(batch, confidence=confidence, seed=seed)
    r2 = np.full_like(nats, np.nan)
    for t in range(horizon):
        known = np.isfinite(nats[t])
        if known.any():
            at_t = batch.at(t)
            trvs, states = (x[0, :MAX_TRAINING].cpu().numpy().astype(np.float64) for x in (at_t.trvs, at_t.states))
            targets = states[:, known] - states[:, known].mean(axis=0)
            residuals = Regression(trvs, targets).residuals
            r2[t, known] = 1 - np.square(residuals).sum(axis=0) / np.square(targets).sum(axis=0)
    shown = np.flatnonzero(np.isfinite(nats).any(axis=0))
    return pd.DataFrame(
        dict(
            t=np.repeat(np.arange(horizon), len(shown)),
            component=[names[k] for k in shown] * horizon,
            nats=nats[:, shown].clip(min=0).ravel(),
            nats_lower=limits[:, shown].clip(min=0).ravel(),
            r2=r2[:, shown].clip(min=0).ravel(),
        )
    )
