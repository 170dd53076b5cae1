"""The weight of the information that keeps the expected cost at a limit: ``beta="auto"``."""

from __future__ import annotations

import math


class AutoWeight:
    """
    Dual ascent on the weight w of "minimise the information, subject to an expected cost of at most C".

    The weight is 0 until the cost first meets the limit: before that there is nothing to trade. It starts where the
    penalty is as large as the limit. From then on it grows while the cost is below the limit and shrinks while it is
    above, as SAC's ``ent_coef="auto"`` does for the entropy:

        log w += rate * clip((C - cost) / abs(C), -2, 1)

    :param cost_limit: C
    :param rate: Change of log w for an epoch whose cost is abs(C) below the limit, the largest there is.
    :param max_growth: The weight stops at this multiple of its start: where the limit can be kept without any
        information, nothing else would hold it.
    """

    def __init__(self, cost_limit: float, rate: float = 0.3, max_growth: float = 1000.0) -> None:
        self.cost_limit = cost_limit
        self.rate = rate
        self.max_growth = max_growth
        self._start = 0.0
        self.value = 0.0
        """w = 1 / beta, in units of cost per nat."""

    def update(self, cost: float, information: float) -> None:
        """
        Move the weight after an epoch.

        :param cost: Expected cost of its episodes.
        :param information: Of its TRVs, in nats, summed over time.
        """
        scale = abs(self.cost_limit)
        if self.value > 0.0:
            self.value *= math.exp(self.rate * min(max((self.cost_limit - cost) / scale, -2.0), 1.0))
            self.value = min(self.value, self.max_growth * self._start)
        elif cost <= self.cost_limit:
            self.value = self._start = scale / max(information, 1.0)
