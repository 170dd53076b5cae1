"""Adapt the weight of the information by dual ascent, for ``beta="auto"``."""

from __future__ import annotations

import math
import warnings

# Smallest slack, since costs scatter: a share of the limit or of the improvement so far, whichever is smaller.
LEAST_SLACK = 0.01
NO_SCALE = 1e-9  # a scale up to this counts as 0, and the weight does not start
RATE = 0.3  # increase of log w per epoch if the cost is one `scale` below `aim` (see update), before clipping
MAX_GROWTH = 1000.0  # largest ratio of w to its start; without it, w grows forever if no information is needed
# The following constants are for a limit that is a share of the improvement.
WINDOW = 5  # number of epochs over which a cost is averaged
LEVEL_EPOCHS = 10  # a cost has levelled off if it falls by less than the slack in this many epochs
LATEST_START = 0.5  # share of the training after which the weight starts in any case, once WINDOW epochs have been run


def share_of(cost_limit: object) -> float | None:
    """Convert a string such as ``"95%"`` to the share 0.95; ``None`` for anything but a share between 0 and 100 %."""
    if not (isinstance(cost_limit, str) and cost_limit.endswith("%")):
        return None
    try:
        share = float(cost_limit[:-1]) / 100
    except ValueError:
        return None
    return share if 0 < share < 1 else None


class AutoWeight:
    """
    Adapt the weight w of the information by dual ascent, to minimise the information subject to E[cost] <= C.

    The weight is 0 until the cost first meets the limit (for a share of the improvement, see below). It starts at the
    value for which the penalty equals the scale in the formula below (information below 1 nat counts as 1 nat). From
    then on it grows while the cost is below the limit and shrinks while the cost is above the limit, as SAC adapts its
    entropy weight with ``ent_coef="auto"``:

        log w += 0.3 * clip((C - cost) / scale, -2, 1)

    The scale is abs(C); if it is 0, the weight does not start. With ``by_slack`` the scale is the slack: the limit
    minus the lowest cost so far. The weight then changes as fast for a limit of 95 % of the attainable return as for a
    limit of 50 %. In the formula, C - slack / 2 then replaces C, because the few episodes of an epoch say little about
    the expected cost. The range of ``clip`` is then -3 to 0.3, so the weight grows more slowly than it shrinks. The
    reason is that a policy loses its return within a few epochs and takes many epochs to recover it.

    If the limit is **a share s of the improvement**, no cost has to be known in advance: C = first - s * (first -
    best). Here ``first`` is the cost of the first epoch, and ``best`` is the lowest mean cost of five successive epochs
    so far. The weight starts when the mean cost of five epochs has fallen by less than C - best in ten epochs, and at
    the latest in the middle of the training (but not before the fifth epoch). An earlier start would change the
    attainable cost. In the second half of the training the weight grows more and more slowly, so that the last policy
    has settled. Costs may have either sign. A share implies ``by_slack``.

    :param cost_limit: Limit C on the expected cost, or a share of the improvement such as ``"95%"``.
    :param by_slack: Whether the scale is the slack, as described above.
    :param first_cost: Mean cost of the first epoch, if the training began without this weight.
    """

    def __init__(
        self,
        cost_limit: float | str,
        by_slack: bool = False,
        first_cost: float | None = None,
    ) -> None:
        self.cost_limit = cost_limit
        self.share = share_of(cost_limit)
        self.by_slack = by_slack or self.share is not None
        self.first_cost = first_cost
        self.limit = math.nan if isinstance(cost_limit, str) else cost_limit
        """C; NaN if a share is given and fewer than five epochs have been run."""
        self.value = 0.0
        """w = 1 / beta, in units of cost per nat."""
        self.information_before: float | None = None
        """Information in nats of the epoch in which the weight started."""
        self._last = (math.nan, math.nan)  # cost and information of the last epoch
        self._start = 0.0
        self._lowest = math.inf
        self._costs: list[float] = []  # costs of the last WINDOW + LEVEL_EPOCHS epochs

    def update(self, cost: float, information: float, progress_remaining: float = 1.0) -> None:
        """
        Update the weight after an epoch.

        :param cost: Mean cost of the epoch's episodes.
        :param information: Estimated information in nats, summed over time.
        :param progress_remaining: 1 at the beginning of the training, 0 at its end.
        """
        self._last = (cost, information)
        is_ready = cost <= self.limit
        if self.share is None:
            self._lowest = min(self._lowest, cost)
        else:
            is_ready = self._update_limit(cost, self.share) or (
                progress_remaining <= LATEST_START and math.isfinite(self.limit)
            )
        scale, aim, low, high = abs(self.limit), self.limit, -2.0, 1.0
        if self.by_slack:
            slack = max(self.limit - self._lowest, 0.0)
            if self.first_cost is not None and self.first_cost != self._lowest:
                # The scale of a share must not depend on the zero point of the costs.
                scale = min(scale, abs(self.first_cost - self._lowest))
            scale = max(slack, LEAST_SLACK * scale, NO_SCALE)
            aim, low, high = self.limit - slack / 2, -3.0, 0.3
        if self.share is not None:
            high *= min(1.0, progress_remaining / LATEST_START)
        if self.value > 0.0:
            self.value *= math.exp(RATE * min(max((aim - cost) / scale, low), high))
            self.value = min(self.value, MAX_GROWTH * self._start)
        elif is_ready and scale > NO_SCALE:
            self.value = self._start = scale / max(information, 1.0)
            self.information_before = information

    def _update_limit(self, cost: float, share: float) -> bool:
        """Update the cost limit that a share implies, and return whether the cost has levelled off."""
        if self.first_cost is None:
            self.first_cost = cost
        self._costs = [*self._costs, cost][-WINDOW - LEVEL_EPOCHS :]
        if len(self._costs) < WINDOW:
            return False
        smoothed = sum(self._costs[-WINDOW:]) / WINDOW
        self._lowest = min(self._lowest, smoothed)
        slack = (1 - share) * (self.first_cost - self._lowest)
        self.limit = self._lowest + slack
        before = sum(self._costs[:WINDOW]) / WINDOW
        return len(self._costs) == WINDOW + LEVEL_EPOCHS and before - smoothed < slack

    def kept(self) -> str | None:
        """Describe the kept information, as in ``"12.1 of 20.3 nats kept, ..."``; ``None`` before the weight starts."""
        if self.information_before is None:
            return None
        cost, information = self._last
        return (
            f"{information:.3g} of {self.information_before:.3g} nats kept, at a cost of {cost:.3g} "
            f"(cost_limit {self.limit:.3g})"
        )

    def warn_if_never_met(self) -> None:
        """Warn at the end of a training in which the weight never started."""
        if self.value > 0.0:
            return
        if self.share is None:
            why = f"no epoch met cost_limit={self.cost_limit:g}"
            mend = "train for longer, or give a higher cost_limit"
        else:
            why = f"the training was too short for cost_limit={self.cost_limit!r}"
            mend = f"train for more than {2 * WINDOW} epochs"
        warnings.warn(f"{why}, so that there was no penalty on the information: {mend}", stacklevel=3)
