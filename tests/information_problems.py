"""Make samples whose information is known, and sort the registered estimators by kind."""

import math

import numpy as np
import torch as th

from sb3_tdpg.evaluation.density_critic import Encoded
from sb3_tdpg.information import ESTIMATORS, InformationBatch, get_estimator_class
from sb3_tdpg.information.critic import CriticEstimator

CLASSES = {name: get_estimator_class(name) for name in ESTIMATORS}
CRITICS = sorted(name for name, cls in CLASSES.items() if issubclass(cls, CriticEstimator))
CRITIC_FREE = sorted(set(ESTIMATORS) - set(CRITICS))
UPPER = sorted(name for name, cls in CLASSES.items() if cls.bound == "upper")
LOWER = sorted(name for name, cls in CLASSES.items() if cls.bound == "lower")

# The gains a in ``trv = a * state + noise`` for each time step and each of two dimensions.
GAINS = ((0.0, 0.0), (0.8, 0.0), (1.0, 1.0))


def gaussian_batch(n, gains, noise_std=1.0, generator=None):
    """Sample a channel with ``sum log(1 + (a / noise_std)^2) / 2`` nats; there is one time step per row of gains."""
    gains = th.as_tensor(gains)[:, None, :]  # (T, 1, Z)
    states = th.randn(gains.shape[0], n, gains.shape[2], generator=generator)
    means = gains * states
    stds = th.full_like(means, noise_std)
    trvs = means + stds * th.randn(means.shape, generator=generator)
    return InformationBatch(states, trvs, means, stds, prev_trvs=th.randn(means.shape))


def gaussian_channels(nats, dim, n, n_channels, rng):
    """
    Sample random channels x~ = A x + noise, a different one for each time step; each channel carries ``nats`` nats.

    The shares of the information in the directions are uniform on the simplex.
    """
    nats_of_each = nats * rng.dirichlet(np.ones(dim), n_channels)
    left, right = (np.linalg.qr(rng.standard_normal((n_channels, dim, dim)))[0] for _ in range(2))
    gains = left * np.sqrt(np.expm1(2 * nats_of_each))[:, None, :] @ right  # A
    states = rng.standard_normal((n_channels, n, dim))
    means = states @ gains.transpose(0, 2, 1)
    trvs = means + rng.standard_normal(means.shape)
    return InformationBatch(*map(th.as_tensor, (states, trvs, means, np.ones_like(means))))


def batch_of(means, stds):
    """Sample an encoder whose means are the states."""
    return InformationBatch(means, means + stds * th.randn_like(means), means, stds)


def modes_batch(n=4000, distance=10.0):
    """Sample TRVs around four distant modes; they carry only the number of the mode, which is ln 4 nats."""
    modes = distance * th.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    means = modes[th.randint(4, (n,))][None]
    return batch_of(means, th.ones_like(means))


def gaussian_information(gains, noise_std=1.0):
    return 0.5 * np.log1p(np.square(np.asarray(gains) / noise_std)).sum(axis=1)


def build(name, horizon, state_dim, trv_dim, **kwargs):
    kwargs = kwargs if name in CRITICS else {}
    return CLASSES[name](horizon, state_dim, trv_dim, **kwargs)


def random_batch(horizon=4, n=60, alive=None):
    states, means = th.randn(horizon, n, 2), th.randn(horizon, n, 2)
    stds = 0.5 + th.rand(horizon, n, 2)
    return InformationBatch(states, means + stds * th.randn_like(means), means, stds, alive, th.randn_like(means))


def half_dead():
    alive = th.ones(4, 60, dtype=th.bool)
    alive[1:, 50:] = False
    alive[2:, ::2] = False
    alive[3:, 3:] = False  # too few episodes are left at the last step
    return alive


def fresh_estimates(estimator, n_batches=20, n=1000):
    """Return mean and standard error, for each time step, of estimates on samples that the critic has not seen."""
    with th.no_grad():
        values = np.stack([estimator(gaussian_batch(n, GAINS)).numpy() for _ in range(n_batches)])
    return values.mean(0), values.std(0, ddof=1) / math.sqrt(n_batches)


def generator(seed=0):
    return th.Generator().manual_seed(seed)


def channel(states, means, stds, rng):
    """Return a batch with the arrays ``(T, N, ...)`` of a channel."""
    trvs = means + stds * rng.standard_normal(means.shape)
    return InformationBatch(*map(th.as_tensor, (states, trvs, means, np.broadcast_to(stds, means.shape).copy())))


def encoded(batch, n_draws=1):
    states, trvs, means, stds = (x[0].double().numpy() for x in batch[:4])
    noise = np.random.default_rng(0).standard_normal((len(trvs), n_draws - 1, trvs.shape[1]))
    return Encoded(states, means, stds, np.concatenate([trvs[:, None], means[:, None] + stds[:, None] * noise], 1))
