"""
Estimate the bounds that give the limits of an information interval at one time step, with their standard errors.

Dimension key: n episodes, X state, Z TRVs, K draws of the TRVs for each episode, C control variates.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp, softmax

from sb3_tdpg.evaluation.density_critic import LOG_2_PI, DensityCritic, Encoded, GaussianCritic, log_gaussians
from sb3_tdpg.information.base import InformationBatch

MAX_DRAWS = 12  # largest number of draws of the TRVs for each episode
GROUPS = (8, 5)  # groups of episodes; two evaluate a Gaussian critic; five groups above MAX_REDIVIDED episodes
MAX_VALUES = 1_000_000  # densities of all draws under all episodes; bounds the memory
MAX_TRAINING = 500  # episodes that a critic is fitted to; bounds the time
DIVISIONS = (((0, 1), (2, 3)), ((0, 2), (1, 3)), ((0, 3), (1, 2)))  # of quarters of the episodes into halves
MAX_REDIVIDED = 300  # more episodes are divided only once, since they gain little from further divisions
MIN_HITS = 10  # least number of clipped pairs (a state and another episode's TRVs) that the denominator counts


class Estimate(NamedTuple):
    """The estimate of a bound at one time step."""

    value: float  # nats
    parts: np.ndarray  # (n,): each episode's contribution to the mean, up to a constant
    least_variance: float = 0.0  # lower bound on the variance of the value

    @property
    def error(self) -> float:
        """Standard error, nats."""
        return math.sqrt(max(self.parts.var(ddof=1) / len(self.parts), self.least_variance))

    def correlation(self, other: Estimate) -> float:
        """Return the correlation of the errors of two bounds on the same episodes, 0 where one has no error."""
        own, others = self.parts - self.parts.mean(), other.parts - other.parts.mean()
        return float(own @ others / max(len(own) * own.std() * others.std(), 1e-300))

    def less_noise(self, controls: np.ndarray) -> Estimate:
        """Remove sampling noise of the encoder with control variates of expectation 0, ``(n, C)``."""
        mean = controls.mean(axis=0)
        coefficients = np.linalg.lstsq(controls - mean, self.parts - self.parts.mean(), rcond=None)[0]
        return self._replace(value=float(self.value - mean @ coefficients), parts=self.parts - controls @ coefficients)


def draw_trvs(batch: InformationBatch, rng: np.random.Generator) -> Encoded:
    """Draw the encoder's noise again at one time step, ``(1, n, ...)``; the first draw is that of the rollout."""
    states, trvs, means, stds = (x[0].detach().cpu().numpy().astype(np.float64) for x in batch[:4])
    n, dim = means.shape
    # Each noise is used with both signs, which cancels linear terms.
    n_pairs = int(np.clip(MAX_VALUES // (2 * n**2), 1, MAX_DRAWS // 2))
    noise = rng.standard_normal((n, n_pairs, dim))
    noise[:, 0] = (trvs - means) / stds
    draws = means[:, None] + stds[:, None] * np.concatenate([noise, -noise], axis=1)
    return Encoded(states, means, stds, draws)


def noise_controls(step: Encoded) -> np.ndarray:
    r"""
    Return two control variates, ``(n, 2)``, which measure by how much each episode's noise exceeds its expected size.

    Log-densities are approximately quadratic in the noise. The units are the standard deviations for the encoder's
    density, and the TRVs' covariance S for the marginal density. The control variates are
    :math:`\sum_i (\nu_i^2 / \sigma_i^2 - 1)` and :math:`\nu^\top S^{-1} \nu - \sum_i S^{-1}_{ii} \sigma_i^2` with
    :math:`\nu = \tilde x - \mu`, averaged over the draws. Their expectations are 0 for every distribution of the means
    and any S that is independent of the noise.
    """
    scale = np.sqrt(np.square(step.stds).mean(axis=0))
    stds, centred = step.stds / scale, (step.means - step.means.mean(axis=0)) / scale
    noise = (step.trvs - step.means[:, None]) / scale  # (n, K, Z)
    precision = np.linalg.inv(centred.T @ centred / len(centred) + np.diag(np.square(stds).mean(axis=0)))
    own = (np.square(noise / stds[:, None]) - 1).sum(axis=2)
    of_all = (noise @ precision * noise).sum(axis=2) - (np.square(stds) @ np.diag(precision))[:, None]
    return np.stack([own.mean(axis=1), of_all.mean(axis=1)], axis=1)


class FreshPairs:
    """
    Collect the scores F of frozen critics on fresh episodes and on all pairs of these, for n episodes in total.

    Scores are clipped from above so that single pairs do not dominate the mean of e^F. A clipped critic is a valid
    critic, too.
    """

    def __init__(self, n: int) -> None:
        self.log_clip = 1 + math.log(n)
        self._joint, self._times = np.zeros((2, n))
        self._ratios, self._pair_times = np.zeros((2, n, n))

    def add(self, fresh: np.ndarray, scores: np.ndarray) -> None:
        """Add a critic's scores of K draws of each of m ``fresh`` episodes with all their states, ``(m K, m)``."""
        m = len(fresh)
        each, pairs = np.arange(m), np.ix_(fresh, fresh)
        scores = np.minimum(scores, self.log_clip).reshape(m, -1, m)
        self._joint[fresh] += scores[each, :, each].mean(axis=1)
        self._times[fresh] += 1
        self._ratios[pairs] += np.exp(scores, out=scores).mean(axis=1)
        self._pair_times[pairs] += 1

    def bound(self) -> Estimate:
        """Bound the information from below; each episode must have been fresh equally often, at least once."""
        times = np.where(np.eye(len(self._times)), 0, self._pair_times)  # no episode is paired with itself
        ratios = np.divide(self._ratios, times, out=np.zeros_like(times), where=times > 0)
        return donsker_varadhan(self._joint / self._times, ratios, int((times > 0).sum()), self.log_clip)


def critic_bounds(step: Encoded, rng: np.random.Generator) -> tuple[Estimate, Estimate]:
    """
    Fit critics to halves of the episodes and evaluate them on the other halves, averaged over one or three divisions.

    One division into halves misses all pairs of episodes from different halves. Three divisions, each of which combines
    quarters of the episodes to halves, cover all pairs. More than 300 episodes are divided only once.

    :return: the lower bound of the critic and the upper bound of its marginal density
    """
    n, n_mirrored = len(step.states), step.trvs.shape[1] // 2
    quarters = np.array_split(rng.permutation(n), 4)
    divisions = DIVISIONS if n <= MAX_REDIVIDED else DIVISIONS[:1]
    pairs, gaps = FreshPairs(n), np.zeros(n)
    for i, division in enumerate(divisions):
        halves = [np.concatenate([quarters[q] for q in half]) for half in division]
        # Each division gets its share of the draws, with both signs.
        mine = np.arange(i % n_mirrored, n_mirrored, len(divisions))
        draws = step._replace(trvs=step.trvs[:, np.concatenate([mine, mine + n_mirrored])])
        for train, fresh in (halves[::-1], halves):
            critic, evaluated = DensityCritic(step.select(train[:MAX_TRAINING])), draws.select(fresh)
            points = evaluated.trvs.reshape(-1, evaluated.trvs.shape[2])
            log_marginal = critic.log_marginal(points)
            pairs.add(fresh, critic.scores(evaluated.states, points, log_marginal))
            gaps[fresh] += _marginal_gaps(evaluated, log_marginal) / len(divisions)
    controls = noise_controls(step)
    return pairs.bound().less_noise(controls), Estimate(float(gaps.mean()), gaps).less_noise(controls)


def gaussian_bound(step: Encoded, rng: np.random.Generator) -> Estimate:
    """Fit Gaussian critics to all but two of several groups of episodes and evaluate each on the two left out."""
    n, n_mirrored = len(step.states), step.trvs.shape[1] // 2
    some = np.arange(max(1, 2 * n_mirrored // 3))  # fewer draws, since there are many critics
    draws = step._replace(trvs=step.trvs[:, np.concatenate([some, some + n_mirrored])])
    groups = np.array_split(rng.permutation(n), GROUPS[n > MAX_REDIVIDED])
    pairs = FreshPairs(n)
    for left_out in combinations(range(len(groups)), 2):
        fresh = np.concatenate([groups[g] for g in left_out])
        train = np.concatenate([group for g, group in enumerate(groups) if g not in left_out])
        evaluated = draws.select(fresh)
        critic = GaussianCritic(draws.select(train))
        pairs.add(fresh, critic.scores(evaluated.states, evaluated.trvs.reshape(-1, evaluated.trvs.shape[2])))
    return pairs.bound().less_noise(noise_controls(draws))


def donsker_varadhan(joint: np.ndarray, ratios: np.ndarray, n_pairs: int, log_clip: float) -> Estimate:
    r"""
    Compute the Donsker-Varadhan bound from the scores.

    With several critics, e^F is averaged over all of them before the logarithm. By Jensen's inequality the result is
    still a lower bound, and the mean of e^F is estimated from more pairs. This mean is at least that of ``MIN_HITS``
    clipped pairs, so that the bound stays finite if no episode's TRVs fit the state of another.

    :param joint: F of the TRVs of each episode with its own state, ``(n,)``.
    :param ratios: e^F of the TRVs of each episode with each state, ``(n, n)``; 0 where they are not paired.
    :param n_pairs: Number of pairs over all episodes; each episode is in about equally many pairs.
    :param log_clip: Upper bound of F.
    """
    n = len(joint)
    mean = ratios.sum() / n_pairs
    floor = MIN_HITS * math.exp(log_clip) / n_pairs
    if mean < floor:
        mean, relative_variance = floor, 1 / MIN_HITS  # the number of clipped pairs is about Poisson
        parts, least_variance = joint, joint.var(ddof=1) / n + relative_variance
    else:
        # An episode contributes through its state and through its TRVs (Hoeffding's projection).
        influence = (ratios.sum(axis=0) + ratios.sum(axis=1)) * n / n_pairs / mean
        relative_variance = influence.var(ddof=1) / n
        # The projection can be almost constant by chance, but the variance is at least that of independent pairs.
        parts = joint - influence
        least_variance = float(np.square(ratios).sum() / n_pairs / mean**2 - 1) / n_pairs
    # The logarithm of a mean is biased downward by half its relative variance.
    return Estimate(float(joint.mean() - math.log(mean) - relative_variance / 2), parts, least_variance)


def _marginal_gaps(step: Encoded, log_marginal: np.ndarray) -> np.ndarray:
    """Average log q(x~ | e) - log a(x~) over the draws of an episode, given log a(x~): ``(n K,) -> (n,)``."""
    n, _, dim = step.trvs.shape
    noise = (step.trvs - step.means[:, None]) / step.stds[:, None]
    log_own = -0.5 * (np.square(noise).sum(axis=2) + dim * LOG_2_PI) - np.log(step.stds).sum(axis=1)[:, None]
    return (log_own - log_marginal.reshape(n, -1)).mean(axis=1)


def log_det_bound(step: Encoded) -> Estimate:
    """Compute the log-det bound from a Gaussian with the covariance of the TRVs; the jackknife removes the 1/n bias."""
    n, dim = step.means.shape
    variances, log_stds = np.square(step.stds), np.log(step.stds).sum(axis=1)
    scale = np.sqrt(variances.mean(axis=0))
    centred, noise = (step.means - step.means.mean(axis=0)) / scale, variances / scale**2
    scatter = centred.T @ centred

    def bound(covariance: np.ndarray, log_std: np.ndarray) -> np.ndarray:
        sign, log_determinant = np.linalg.slogdet(covariance)
        return np.where(sign > 0, 0.5 * log_determinant, np.nan) + np.log(scale).sum() - log_std

    whole = bound(scatter / (n - 1) + np.diag(noise.mean(axis=0)), log_stds.mean())
    # Without an episode, the scatter around the new mean is smaller by n / (n - 1) times the episode's square.
    covariances = (scatter - n / (n - 1) * centred[:, :, None] * centred[:, None, :]) / (n - 2)  # (n, Z, Z)
    diagonal = np.arange(dim)
    covariances[:, diagonal, diagonal] += (noise.sum(axis=0) - noise) / (n - 1)
    without = bound(covariances, (log_stds.sum() - log_stds) / (n - 1))  # (n,)
    value = n * whole - (n - 1) * without.mean()
    return Estimate(float(value), -(n - 1) * without)


def leave_one_out_bound(step: Encoded) -> Estimate:
    """Compute the leave-one-out bound, from the mixture of the densities of all other episodes."""
    n, n_draws, dim = step.trvs.shape
    log_density = log_gaussians(step.trvs.reshape(-1, dim), step.means, np.square(step.stds))  # (n K, n)
    draws, own = np.arange(n * n_draws), np.repeat(np.arange(n), n_draws)
    log_own = log_density[draws, own]
    log_density[draws, own] = -np.inf
    gaps = (log_own - logsumexp(log_density, axis=1) + math.log(n - 1)).reshape(n, n_draws).mean(axis=1)
    shares = softmax(log_density, axis=1).sum(axis=0) / n_draws  # mean 1
    return Estimate(float(gaps.mean()), gaps - shares).less_noise(noise_controls(step))
