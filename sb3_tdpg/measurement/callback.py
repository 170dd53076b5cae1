"""The callback that writes an interval of the information to the training log."""

from __future__ import annotations

import numpy as np

from sb3_tdpg.callbacks import TDPGCallback
from sb3_tdpg.measurement.interval import (
    InformationInterval,
    component_estimates,
    information_interval,
    min_episodes,
)
from sb3_tdpg.problem import read_problem


class InformationCallback(TDPGCallback):
    """
    Write an interval that holds the information to the log, beside the estimate that the policy is trained with.

    It is made from the epoch's rollouts, which are fresh for it: they were made with the policy as it is, and each
    critic is fitted to other episodes than those that it is evaluated on. It needs no penalty, and changes nothing in
    the training. The keys are ``mi/lower`` and ``mi/upper``, the limits summed over time; for TensorBoard
    ``mi/lower_t00``, ``mi/upper_t00``, ... for each time step; and ``mi/knows_d``, ..., what the TRVs know at least of
    each component of the state, averaged over the time steps at which it varies. A component is called as in the
    environment's ``state_names``, without its unit, or ``x0``, ``x1``, ...

    :param eval_freq: Epochs from one interval to the next, beginning with the first.
    :param confidence: With which the interval of a time step holds the truth.
    :param components: Whether the components of the state are measured, too; it takes as long again for each.
    :raises ValueError: if ``eval_freq`` is below 1; where the training begins, if an epoch has too few episodes.
    """

    def __init__(self, eval_freq: int = 10, *, confidence: float = 0.95, components: bool = True) -> None:
        super().__init__()
        if eval_freq < 1:
            raise ValueError(f"eval_freq={eval_freq} must be at least 1 (epochs)")
        self.eval_freq = eval_freq
        self.confidence = confidence
        self.components = components
        self.interval: InformationInterval | None = None  # the last one

    def _on_training_start(self) -> None:
        n_episodes, trv_dim = self.tdpg.n_episodes, self.tdpg.policy.trv_dim
        if n_episodes < min_episodes(trv_dim):  # it would write limits of 0 and 0: sums over no time step
            raise ValueError(
                f"n_episodes={n_episodes} are too few for an interval of the information in {trv_dim} TRVs: an epoch "
                f"must have at least {min_episodes(trv_dim)}"
            )

    def _on_rollout_end(self) -> None:
        model = self.tdpg
        if model.epoch % self.eval_freq != 0:
            return
        batch = model.rollout_buffer.episode_batch().information_batch()
        self.interval = information_interval(batch, confidence=self.confidence, seed=model.epoch)
        lower, upper = self.interval.total
        self.logger.record("mi/lower", lower)
        self.logger.record("mi/upper", upper)
        for limit in ("lower", "upper"):
            for t, value in enumerate(getattr(self.interval, limit).tolist()):
                if np.isfinite(value):
                    self.logger.record(f"mi/{limit}_t{t:02d}", value, exclude=("stdout", "log", "json", "csv"))
        if self.components:
            estimates, _ = component_estimates(batch, seed=model.epoch)
            names = read_problem(self.training_env).state_names
            for name, values in zip(names, estimates.T, strict=True):
                if np.isfinite(values).any():
                    self.logger.record(f"mi/knows_{name.split(' (')[0]}", float(np.nanmean(values.clip(min=0))))
