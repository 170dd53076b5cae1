"""
A critic that takes next to no time to fit: the log-ratio of two Gaussians.

Dimension key: n episodes, X state, Z TRVs, M points.
"""

from __future__ import annotations

import numpy as np

from sb3_tdpg.measurement.density_critic import Encoded, log_gaussians, varies, whiten

CUTOFF = 1e-9  # of the states' correlations' eigenvalues, relative to the largest: below, a component is told by others


class GaussianCritic:
    r"""
    The critic :math:`F(x, \tilde x) = \log r(\tilde x \mid x) / a(\tilde x)` of Gaussians with the episodes' moments.

    r is a Gaussian about the linear regression of the encoder's means on the state, a one with the TRVs' mean and
    covariance; in both, the encoder's own variance is known. It is the best critic there is where states and TRVs are
    Gaussian together. With so few numbers to be fitted it can be fitted often, each time to most of the episodes.

    :param train: The episodes; their draws of the TRVs are not used.
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
        """
        F of every x~ with every x: ``(M, n)``.

        :param states: ``(n, X)``
        :param trvs: ``(M, Z)``
        """
        means = (states - self._centre) / self._scale @ self._coefficients
        centred = trvs - self._mean
        (rotation, spread, log_volume), (rotation_a, spread_a, log_volume_a) = self._conditional, self._marginal
        log_conditional = log_gaussians(centred @ rotation.T, means @ rotation.T, 1 + spread[None]) + log_volume
        log_marginal = log_gaussians(centred @ rotation_a.T, np.zeros_like(spread_a)[None], 1 + spread_a[None])
        return log_conditional - (log_marginal + log_volume_a)
