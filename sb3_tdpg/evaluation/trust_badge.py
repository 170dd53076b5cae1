"""
Check an information interval with tests whose outcome is known in advance.

Dimension key: T time steps, N episodes, Z TRVs.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.common.threads import threads
from sb3_tdpg.evaluation.interval import LOWER_BOUNDS, InformationInterval, information_interval, normal_quantile
from sb3_tdpg.information.base import InformationBatch

NEAR_THE_CAP = 0.9  # share of ln N
FALSE_ALARM = 0.01  # probability that a check of a sound interval fails, over all time steps
ADDED_VARIANCE = 3.0  # of the noise added for data processing, relative to the encoder's mean variance


@dataclass(frozen=True)
class TrustCheck:
    """One check: a number that must not exceed a threshold."""

    name: str
    value: float
    threshold: float
    meaning: str  # of the value, with its unit

    @property
    def passed(self) -> bool:
        """Whether the value is within its threshold; NaN is not."""
        return self.value <= self.threshold


@dataclass(frozen=True)
class TrustBadge:
    """The outcome of all checks of an interval: one line as ``str(badge)``, a table as :meth:`markdown`."""

    checks: tuple[TrustCheck, ...]
    capped_steps: tuple[int, ...]
    """Time steps whose lower estimate is at least 90 % of ln N, where the true value can be much higher."""

    @property
    def passed(self) -> bool:
        """Whether every check passed; capped steps are only a warning."""
        return all(check.passed for check in self.checks)

    def __str__(self) -> str:
        outcomes = [f"{check.name} {'ok' if check.passed else 'FAILED'}" for check in self.checks]
        return f"{'trusted' if self.passed else 'NOT TRUSTED'}: {', '.join(outcomes)}{self._warning()}"

    def markdown(self) -> str:
        """Return a Markdown table with a row for each check, and the warning below it."""
        rows = [
            [check.name, "ok" if check.passed else "**failed**", f"{check.value:.3f}", check.threshold, check.meaning]
            for check in self.checks
        ]
        table = markdown_table(rows, ["check", "", "value", "at most", "meaning"], align="l")
        return table + self._warning().replace("; warning", "\n\nWarning")

    def _warning(self) -> str:
        if not self.capped_steps:
            return ""
        # Successive steps are written as "0 to 199".
        breaks = np.flatnonzero(np.diff(self.capped_steps) != 1) + 1
        runs = np.split(np.array(self.capped_steps), breaks)
        steps = ", ".join(f"{run[0]} to {run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)
        return f"; warning: at the ln N cap at t = {steps}: the lower limit can be far too low, use more episodes"


@threads(1)
def trust_checks(batch: InformationBatch, interval: InformationInterval | None = None, *, seed: int = 0) -> TrustBadge:
    r"""
    Run three checks of an information interval.

    - **shuffled pairs**: when every state is paired with the TRVs of another episode, there is no information, and the
      lower bounds must find none;
    - **data processing**: a noisier copy of the TRVs (with four times the encoder's mean variance) has no more
      information about the state. The lower limit of the copy must not exceed the upper limit of the TRVs, and the
      copy's estimate must not exceed that of the TRVs. Negative estimates count as 0;
    - **encoder density**: :math:`(\tilde x - \mu) / \sigma` must have mean square 1. Otherwise the TRVs were not drawn
      from the density that every bound uses, for instance because they have no noise.

    Each check reports its worst time step. A check of a sound interval fails with a probability of about 1 % over all
    time steps together.

    :param batch: The rollouts ``(T, N, ...)`` of the interval.
    :param interval: The result of :func:`~sb3_tdpg.evaluation.information_interval`; computed if not given.
    :param seed: Seed of the shuffling and of the intervals.
    :raises ValueError: if no time step has enough episodes.
    """
    interval = information_interval(batch, seed=seed) if interval is None else interval
    steps = np.flatnonzero(np.isfinite(interval.upper) & np.isfinite(interval.estimates["critic"]))
    if len(steps) == 0:
        raise ValueError(
            f"no time step has an interval to check: at most {interval.n_episodes.max(initial=0)} episodes are alive"
        )
    miss = FALSE_ALARM / len(steps)
    checks = (
        _shuffled_pairs(batch, steps, normal_quantile(miss / len(LOWER_BOUNDS)), seed),
        _data_processing(batch, interval, steps, normal_quantile(miss), seed),
        _encoder_density(batch, steps, miss / 2),  # half of the probability for either sign
    )
    lower = np.maximum(*(interval.estimates[name][steps] for name in LOWER_BOUNDS))
    capped = steps[lower >= NEAR_THE_CAP * np.log(interval.n_episodes[steps])]
    return TrustBadge(checks, tuple(capped.tolist()))


def _shuffled_pairs(batch: InformationBatch, steps: np.ndarray, quantile: float, seed: int) -> TrustCheck:
    rng = np.random.default_rng(seed)
    states = batch.states.clone()
    for t in steps:
        order = rng.permutation(np.flatnonzero(batch.living[t].cpu()))
        states[t, order] = batch.states[t, np.roll(order, 1)]  # one cycle, so no episode keeps its own state
    null = information_interval(batch._replace(states=states), seed=seed)
    found, errors = (np.concatenate([of[name][steps] for name in LOWER_BOUNDS]) for of in (null.estimates, null.errors))
    return _worst("shuffled pairs", found, quantile * errors, "nats that a lower bound finds without any information")


def _data_processing(
    batch: InformationBatch, interval: InformationInterval, steps: np.ndarray, quantile: float, seed: int
) -> TrustCheck:
    # All episodes of a time step get the same variance: noise that depends on the encoder's would carry information.
    living = batch.living[..., None]
    total = batch.stds.square().masked_fill(~living, 0.0).sum(1, keepdim=True)
    stds = (batch.stds.square() + ADDED_VARIANCE * total / living.sum(1, keepdim=True).clamp(min=1)).sqrt()
    noisier = batch._replace(trvs=batch.means + (batch.trvs - batch.means) * stds / batch.stds, stds=stds)
    copy = information_interval(noisier, confidence=interval.confidence, seed=seed)
    crossed = (copy.lower - interval.upper)[steps]
    if not (crossed <= 0).all():
        meaning = "nats by which the lower limit of a noisier copy of the TRVs is above the upper limit"
        return _worst("data processing", crossed, np.zeros(len(steps)), meaning)
    excess = copy.estimates["critic"].clip(min=0) - interval.estimates["critic"].clip(min=0)
    errors = np.hypot(copy.errors["critic"], interval.errors["critic"])
    meaning = "nats by which the critic's bound of a noisier copy of the TRVs is higher"
    return _worst("data processing", excess[steps], quantile * errors[steps], meaning)


def _encoder_density(batch: InformationBatch, steps: np.ndarray, miss: float) -> TrustCheck:
    noises = [((at_t.trvs - at_t.means) / at_t.stds).double() for at_t in map(batch.at, steps.tolist())]
    excess = np.array([noise.square().mean().item() - 1 for noise in noises])
    sizes = np.array([noise.numel() for noise in noises])
    too_small, too_large = 1 - chi2.ppf(miss, sizes) / sizes, chi2.isf(miss, sizes) / sizes - 1
    threshold = np.where(excess > 0, too_large, too_small)
    return _worst("encoder density", np.abs(excess), threshold, "distance of the mean square of the noise from 1")


def _worst(name: str, values: np.ndarray, thresholds: np.ndarray, meaning: str) -> TrustCheck:
    worst = int(np.argmax(values - thresholds))
    return TrustCheck(name, float(values[worst]), float(thresholds[worst]), meaning)
