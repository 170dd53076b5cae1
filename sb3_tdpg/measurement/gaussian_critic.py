"""
A critic that is fitted almost instantly: the log-ratio of two Gaussians.

Dimension key: n episodes, X state, Z TRVs, M points.
"""

from __future__ import annotations

import numpy as np

from sb3_tdpg.measurement.density_critic import Encoded, log_gaussians, varies, whiten

CUTOFF = 1e-9  # relative eigenvalue of the states' correlations below which a component is redundant


class GaussianCritic:
    r"""
    The critic :math:`F(x, \tilde x) = \log r(\tilde x \mid x) / a(\tilde x)` of Gaussians with the episodes' moments.

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
