"""SMILE: MINE with a clipped density ratio (Song and Ermon, 2020)."""

from __future__ import annotations

from typing import Any

import torch as th
from torch.nn.functional import softplus

from sb3_tdpg.information.critic import CriticEstimator, Scores
from sb3_tdpg.information.mine import log_mean_exp


class Smile(CriticEstimator):
    r"""
    The Donsker-Varadhan estimate, with the scores of the marginal samples clipped to ``[-clip, clip]``.

    The critic is trained on the stable Jensen-Shannon objective, whose optimum is the log density ratio. Clipping
    reduces the variance; the result is neither a lower nor an upper bound.

    :param clip: Largest absolute score, tau in the SMILE paper. A larger value reduces the bias and increases the
        variance.
    :param kwargs: See :class:`~sb3_tdpg.information.critic.CriticEstimator`.
    """

    bound = "neither"

    def __init__(self, horizon: int, state_dim: int, trv_dim: int, *, clip: float = 5.0, **kwargs: Any) -> None:
        super().__init__(horizon, state_dim, trv_dim, **kwargs)
        if not clip > 0:
            raise ValueError(f"mi_kwargs: clip={clip} must be positive")
        self.clip = clip

    def _bound(self, scores: Scores) -> th.Tensor:
        return scores.joint.mean(dim=1) - log_mean_exp(scores.marginal.clamp(-self.clip, self.clip))

    def _objective(self, scores: Scores, steps: th.Tensor) -> th.Tensor:
        return -softplus(-scores.joint).mean(dim=1) - softplus(scores.marginal).mean(dim=(1, 2))
