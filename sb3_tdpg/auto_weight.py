"""Dual ascent on the weight of the information: ``beta="auto"``."""

from __future__ import annotations

import math
import warnings

LEAST_SLACK = 0.01  # of the limit


class AutoWeight:
    """
    Adapt the weight w of "minimise the information subject to E[cost] <= C" by dual ascent.

    The weight is 0 until the cost first meets the limit. It then starts where the penalty equals the limit, grows while
    the cost is below the limit and shrinks while it is above, as SAC's ``ent_coef="auto"`` does for the entropy:

        log w += rate * clip((C - cost) / scale, -2, 1)

    The scale is abs(C). With ``by_slack`` it is how far the lowest cost so far is below the limit: a limit of 95 % of
    the attainable return then has as strong an effect as one of 50 %. The aim is then the middle of this slack instead
    of C, since the few episodes of an epoch say little about the cost, and the weight grows more slowly than it
    shrinks, ``clip(., -3, 0.3)``: a policy loses the return within a few epochs, and takes many to find it again.

    :param cost_limit: C
    :param by_slack: See above.
    :param rate: Largest increase of log w per epoch, reached at a cost of one scale below the limit.
    :param max_growth: Largest multiple of the starting weight. Without it the weight would grow forever where the task
        needs no information.
    """

    # Those of models that early versions saved.
    by_slack = False
    _lowest = math.inf

    def __init__(
        self, cost_limit: float, by_slack: bool = False, rate: float = 0.3, max_growth: float = 1000.0
    ) -> None:
        self.cost_limit = cost_limit
        self.by_slack = by_slack
        self.rate = rate
        self.max_growth = max_growth
        self._start = 0.0
        self._lowest = math.inf
        self.value = 0.0
        """w = 1 / beta, in units of cost per nat."""

    def update(self, cost: float, information: float) -> None:
        """
        Update the weight after an epoch.

        :param cost: Mean cost of the epoch's episodes.
        :param information: Estimated information in nats, summed over time.
        """
        self._lowest = min(self._lowest, cost)
        scale, aim, low, high = abs(self.cost_limit), self.cost_limit, -2.0, 1.0
        if self.by_slack:
            scale = max(self.cost_limit - self._lowest, LEAST_SLACK * scale)
            aim, low, high = self.cost_limit - scale / 2, -3.0, 0.3
        if self.value > 0.0:
            self.value *= math.exp(self.rate * min(max((aim - cost) / scale, low), high))
            self.value = min(self.value, self.max_growth * self._start)
        elif cost <= self.cost_limit:
            self.value = self._start = scale / max(information, 1.0)

    def warn_if_never_met(self, origin: str) -> None:
        """Warn at the end of a training that never met the limit; ``origin`` says where it comes from."""
        if self.value == 0.0:
            warnings.warn(
                f"no epoch met cost_limit={self.cost_limit:g}{origin}, so that there was no penalty on the "
                "information: train for longer, or give a higher cost_limit",
                stacklevel=3,
            )
