"""
Critics in closed form: the logarithm of the ratio of a fitted conditional density to a fitted marginal density.

Dimension key: n episodes, X state, Z TRVs, K draws of the TRVs for each episode, M points.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import logsumexp

LOG_FLOOR = math.log(0.01)  # lower bound of the critic, against outliers
LENGTHS = (0.3, 1.0)  # widths of the kernel, relative to the median distance
RIDGES = (1e-9, 1e-3, 1e-2, 1e-1, 1.0)  # ridge penalties of the regressions, per episode
SMOOTHINGS = (0.0, 0.01, 0.03, 0.1, 0.3, 1.0)  # of the marginal: 0 is the encoder's mixture, 1 a common mean
CONSTANT = 1e-9  # a component that varies by less than this, relative to its size, is constant
CUTOFF = 1e-9  # relative eigenvalue of the states' correlations below which a component is redundant
LOG_2_PI = math.log(2 * math.pi)


class Encoded(NamedTuple):
    """Episodes at one time step, in float64."""

    states: np.ndarray  # (n, X)
    means: np.ndarray  # (n, Z) of q(x~ | e)
    stds: np.ndarray  # (n, Z)
    trvs: np.ndarray  # (n, K, Z): draws from q(x~ | e); the second half has the noise of the first with opposite sign

    def select(self, episodes: np.ndarray) -> Encoded:
        """Select episodes by their indices."""
        return Encoded(*(x[episodes] for x in self))


class DensityCritic:
    r"""
    The critic :math:`F(x, \tilde x) = \log [r(\tilde x \mid x) / a(\tilde x) + 0.01]`, fitted without an optimiser.

    Apart from the 0.01, the optimal critic has this form for a Gaussian channel from the state to the TRVs.

    - r is a Gaussian around a regression of the encoder's means on the state: a ridge regression plus a kernel ridge
      regression of its residuals. The covariance of r is that of the residuals plus the encoder's variance. The same
      kind of regression predicts the logarithm of the encoder's standard deviation.
    - a is a smoothed mixture of the encoder's densities: every mean is moved towards the mean of all of them, and each
      density is widened so that the covariance of the mixture stays the same. A smoothing of 0 gives the mixture
      itself. A smoothing of 1 gives all densities the same mean; if the encoder's variance is constant, the result is a
      Gaussian.

    The ridges minimise the leave-one-out error of the regressions on these episodes, and the smoothing maximises the
    leave-one-out log-density of their TRVs.

    :param train: The episodes to fit, with ``K >= 1`` draws each.
    """

    def __init__(self, train: Encoded) -> None:
        noise, log_stds = np.square(train.stds).mean(axis=0), np.log(train.stds)
        self._log_std_range = log_stds.min(axis=0), log_stds.max(axis=0)
        self._regression = Regression(train.states, np.concatenate([train.means, log_stds], axis=1))
        residuals = self._regression.residuals[:, : train.means.shape[1]]
        # Coordinates in which both the encoder's variance and the covariance of the residuals are diagonal.
        covariance = residuals.T @ residuals / len(residuals)
        self._noise_rotation, self._residual_variance, self._noise_log_volume = whiten(noise, covariance)

        n, n_draws, dim = train.trvs.shape
        self._centre = train.means.mean(axis=0)
        centred = train.means - self._centre
        self._rotation, self._spread, self._log_volume = whiten(noise, centred.T @ centred / (n - 1))
        self._components = centred @ self._rotation.T  # (n, Z)
        self._variances = np.square(train.stds) @ self._rotation.T**2
        n_draws = min(n_draws, 2)
        points = ((train.trvs[:, :n_draws] - self._centre) @ self._rotation.T).reshape(-1, dim)
        own = np.repeat(np.arange(n), n_draws)
        scores = [self._log_mixture(points, smoothing, own).mean() for smoothing in SMOOTHINGS]
        self._smoothing = SMOOTHINGS[int(np.argmax(scores))]

    def log_marginal(self, trvs: np.ndarray) -> np.ndarray:
        """Return log a(x~), a normalised density: ``(M, Z) -> (M,)``."""
        return self._log_mixture((trvs - self._centre) @ self._rotation.T, self._smoothing) + self._log_volume

    def scores(self, states: np.ndarray, trvs: np.ndarray, log_marginal: np.ndarray) -> np.ndarray:
        """Evaluate F for every x~ with every x, given log a(x~): ``(n, X), (M, Z), (M,) -> (M, n)``."""
        return np.logaddexp(self._log_conditional(states, trvs) - log_marginal[:, None], LOG_FLOOR)

    def _log_conditional(self, states: np.ndarray, trvs: np.ndarray) -> np.ndarray:
        """Return log r(x~ | x) of every x~ for every x: ``(n, X), (M, Z) -> (M, n)``."""
        means, log_stds = np.split(self._regression.predict(states), 2, axis=1)  # (n, Z) each
        log_stds = np.clip(log_stds, *self._log_std_range)  # no extrapolation
        variances = np.exp(2 * log_stds) @ self._noise_rotation.T**2 + self._residual_variance
        log_density = log_gaussians(trvs @ self._noise_rotation.T, means @ self._noise_rotation.T, variances)
        return log_density + self._noise_log_volume

    def _log_mixture(self, points: np.ndarray, smoothing: float, own: np.ndarray | None = None) -> np.ndarray:
        """Return the log-density of the smoothed mixture at rotated points, for each without its ``own`` component."""
        variances = self._variances + smoothing * self._spread
        log_density = log_gaussians(points, math.sqrt(1 - smoothing) * self._components, variances)
        if own is not None:
            log_density[np.arange(len(points)), own] = -np.inf
        return logsumexp(log_density, axis=1) - math.log(log_density.shape[1] - (own is not None))


class GaussianCritic:
    r"""
    The critic :math:`F(x, \tilde x) = \log r(\tilde x \mid x) / a(\tilde x)` with Gaussian densities.

    r is a Gaussian around the linear regression of the encoder's means on the state, and a is a Gaussian with the mean
    and covariance of the TRVs. The encoder's variance is known in both. This is the optimal critic for jointly Gaussian
    states and TRVs. It has few parameters, so it can be fitted many times, each time to most of the episodes.

    :param train: The episodes to fit; their draws of the TRVs are not used.
    """

    def __init__(self, train: Encoded) -> None:
        n, noise = len(train.states), np.square(train.stds).mean(axis=0)
        self._centre, self._mean = train.states.mean(axis=0), train.means.mean(axis=0)
        self._scale = np.where(varies(train.states), train.states.std(axis=0), np.inf)
        states, means = (train.states - self._centre) / self._scale, train.means - self._mean
        self._coefficients = np.linalg.pinv(states.T @ states, rcond=CUTOFF, hermitian=True) @ (states.T @ means)
        residuals = means - states @ self._coefficients
        n_free = max(n - 1 - np.isfinite(self._scale).sum(), 1)
        self._conditional = whiten(noise, residuals.T @ residuals / n_free)
        self._marginal = whiten(noise, means.T @ means / (n - 1))

    def scores(self, states: np.ndarray, trvs: np.ndarray) -> np.ndarray:
        """Evaluate F for every x~ with every x: ``(n, X), (M, Z) -> (M, n)``."""
        means = (states - self._centre) / self._scale @ self._coefficients
        centred = trvs - self._mean
        (rotation, spread, log_volume), (rotation_a, spread_a, log_volume_a) = self._conditional, self._marginal
        log_conditional = log_gaussians(centred @ rotation.T, means @ rotation.T, 1 + spread[None]) + log_volume
        log_marginal = log_gaussians(centred @ rotation_a.T, np.zeros_like(spread_a)[None], 1 + spread_a[None])
        return log_conditional - (log_marginal + log_volume_a)


def varies(inputs: np.ndarray) -> np.ndarray:
    """Return which columns are not constant up to rounding errors: ``(n, X) -> (X,)``, bool."""
    return inputs.std(axis=0) > CONSTANT * (1 + np.abs(inputs.mean(axis=0)))


class Regression:
    """
    Fit a ridge regression and a kernel ridge regression of its residuals, separately for each target, ``(n, Y)``.

    Constant components of the inputs, ``(n, X)``, are ignored.
    """

    def __init__(self, inputs: np.ndarray, targets: np.ndarray) -> None:
        self._centre = inputs.mean(axis=0)
        self._scale = np.where(varies(inputs), inputs.std(axis=0), np.inf)
        self._inputs = self._standardize(inputs)
        self._intercept = targets.mean(axis=0)
        n, centred = len(inputs), targets - self._intercept
        u, s, vt = np.linalg.svd(self._inputs, full_matrices=False)
        keep = s > 1e-7 * max(s.max(initial=0.0), 1e-300)
        u, s, vt = u[:, keep], s[keep], vt[keep]
        shrinkage, left = _choose_ridge(u, s**2, centred, otherwise=centred * n / (n - 1), leverage=1 / n)
        self._coefficients = vt.T @ (shrinkage * (u.T @ centred) / s[:, None])

        linear = centred - self._inputs @ self._coefficients
        # The residuals of fitted episodes are smaller than those of unseen episodes.
        spare = np.maximum(1 - 1 / n - np.square(u) @ shrinkage, 1e-12)  # (n, Y)
        square = self._distances(self._inputs)
        self._widths = np.square(LENGTHS) * (np.median(square) or 1.0)
        self._weights = np.zeros((len(LENGTHS), *targets.shape))  # at most one kernel for each target
        for i, width in enumerate(self._widths):
            values, vectors = np.linalg.eigh(np.exp(-square / width))
            values = np.maximum(values, 1e-12)
            shrinkage, residuals = _choose_ridge(vectors, values, linear, otherwise=left, spare_before=spare)
            better = np.any(shrinkage > 0, axis=0)
            self._weights[:, :, better] = 0
            self._weights[i] += vectors @ (shrinkage * (vectors.T @ linear) / values[:, None])
            left = np.where(better, residuals, left)
        self.residuals = left  # (n, Y), leave-one-out

    def predict(self, inputs: np.ndarray) -> np.ndarray:
        """Predict the targets: ``(n, Y)``."""
        inputs = self._standardize(inputs)
        predicted = self._intercept + inputs @ self._coefficients
        for width, weights in zip(self._widths, self._weights, strict=True):
            if weights.any():
                predicted += np.exp(-self._distances(inputs) / width) @ weights
        return predicted

    def _standardize(self, inputs: np.ndarray) -> np.ndarray:
        return (inputs - self._centre) / self._scale

    def _distances(self, inputs: np.ndarray) -> np.ndarray:
        """Return the squared distances to the episodes of the fit: ``(M, n)``."""
        square = (inputs**2).sum(axis=1)[:, None] - 2 * inputs @ self._inputs.T + (self._inputs**2).sum(axis=1)
        return np.maximum(square, 0.0)


def _choose_ridge(
    basis: np.ndarray,
    values: np.ndarray,
    targets: np.ndarray,
    otherwise: np.ndarray,
    leverage: float = 0.0,
    spare_before: np.ndarray | float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Choose a ridge for each target by the leave-one-out error, which has a closed form.

    :param basis: Orthonormal columns ``(n, R)``.
    :param values: Squared singular values of the inputs, or eigenvalues of the kernel matrix, ``(R,)``.
    :param otherwise: Leave-one-out residuals ``(n, Y)`` without this regression, which is one of the choices.
    :param leverage: Leverage of each episode in the fit of the mean that was subtracted from the targets.
    :param spare_before: If the targets are residuals of an earlier regression: ``1 - h``, ``(n, Y)``, with the leverage
        h of each episode in that regression.
    :return: the shrinkage factors of the projections, ``(R, Y)``, and the leave-one-out residuals, ``(n, Y)``
    """
    n = len(targets)
    projections, leverages = basis.T @ targets, np.square(basis)
    # This is the part outside the basis. It uses complements, since 1 - h loses digits where a kernel interpolates.
    beyond, spare = targets - basis @ projections, np.maximum(1 - leverage - leverages.sum(axis=1), 1e-12)
    choices, residuals = [np.zeros_like(values)], [otherwise]
    for ridge in RIDGES:
        complement = ridge * n / (values + ridge * n)  # (R,)
        left = beyond + basis @ (complement[:, None] * projections)
        choices.append(1 - complement)
        residuals.append(left / (spare + leverages @ complement)[:, None] / spare_before)
    best = np.argmin([np.square(r).sum(axis=0) for r in residuals], axis=0)  # (Y,)
    columns = np.arange(targets.shape[1])
    return np.stack(choices)[best].T, np.stack(residuals)[best, :, columns].T


def whiten(noise: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return a map that whitens the noise and diagonalises the covariance, the diagonal, and the map's log-det."""
    scale = 1 / np.sqrt(noise)
    values, vectors = np.linalg.eigh(covariance * scale[:, None] * scale)
    return vectors.T * scale, np.maximum(values, 0.0), float(np.log(scale).sum())


def log_gaussians(points: np.ndarray, means: np.ndarray, variances: np.ndarray) -> np.ndarray:
    """Return the log-density of every point under every diagonal Gaussian: ``(M, Z), (n, Z), (n, Z) -> (M, n)``."""
    centre = means.mean(axis=0)  # the expansion of the square loses digits far from the origin
    points, means, precision = points - centre, means - centre, 1 / variances
    quadratic = points**2 @ precision.T - 2 * points @ (means * precision).T + (means**2 * precision).sum(axis=1)
    return -0.5 * (quadratic + np.log(variances).sum(axis=1) + points.shape[1] * LOG_2_PI)
