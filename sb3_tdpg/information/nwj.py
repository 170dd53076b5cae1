"""The bound of Nguyen, Wainwright and Jordan (2010), also known as the f-divergence bound or MINE-f."""

from __future__ import annotations

import torch as th

from sb3_tdpg.information.critic import CriticEstimator, Scores


class Nwj(CriticEstimator):
    r"""
    The bound :math:`E_p[F] - e^{-1} E_{p \times q}[e^F]`.

    For a fixed critic and fresh samples the estimate is a lower bound. Unlike MINE, it has no logarithm of a mean. It
    therefore has no bias on minibatches, but more variance than MINE.
    """

    bound = "lower"

    def _bound(self, scores: Scores) -> th.Tensor:
        return scores.joint.mean(dim=1) - th.exp(scores.marginal - 1.0).mean(dim=(1, 2))
