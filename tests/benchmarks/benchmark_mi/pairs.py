"""
Estimate the information between two variables from i.i.d. pairs, by cross-fitting; needs no policy.

Dimension key: M problems, K folds, N pairs, R marginal samples for each pair, X and Z the components of the two
variables, D components of either or both, J = 4 features of each: its normal score and three cosines of its rank.
"""

import copy
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from copula_start import NORMAL, Start, add_up, choose_start, degrees_of_freedom, t_scores
from torch import nn

from sb3_tdpg.common.threads import threads
from sb3_tdpg.information import InfoNCE, InformationBatch, InformationEstimator, Nwj, get_estimator_class
from sb3_tdpg.information.critic import CriticEstimator, Scores
from sb3_tdpg.networks import BatchedMLP, flatten_parameters

STEPS_PER_CHECK = 50
MIN_VARIANCE = 1e-2  # of a direction, before it is scaled to variance 1
MARGINAL_SAMPLES = 16  # R
MIN_PAIRS_PER_FOLD = 10
N_WAVES = 3
AVERAGE_DECAY = 0.98  # weight on the past, after the first steps: averages over about 50 steps
PAIRS_AT_ONCE = 800


class InformationEstimate(NamedTuple):
    """The result of :func:`estimate_information` in nats: floats for one problem, ``(M,)`` arrays for M of them."""

    estimate: Any
    """The mean of the other two."""
    held_out: Any
    """On pairs that the critic was not fitted to; tends to be too low."""
    trained_on: Any
    """On the pairs that the critic was fitted to; tends to be too high."""


@threads(1)
def estimate_information(
    x: npt.ArrayLike,
    z: npt.ArrayLike,
    estimator: str | type[InformationEstimator] = "mine",
    *,
    n_folds: int = 5,
    max_gradient_steps: int = 1000,
    patience: int = 2,
    learning_rate: float = 2e-2,
    batch_size: int | None = None,
    seed: int = 0,
    **kwargs: Any,
) -> InformationEstimate:
    r"""
    Estimate I[x; z] in nats from i.i.d. pairs of two continuous variables, by cross-fitting.

    Only the ranks of each component are used, which does not change the information. The critic is
    :math:`F = F_0 + \text{network}`. The start :math:`F_0` is the logarithmic density ratio of a t-copula (Demarta and
    McNeil, 2005), which models dependent tails. Its scatter matrix is fitted to the training folds, its degrees of
    freedom are the most likely ones for all pairs. A Gaussian copula or :math:`F_0 = 0` replaces it where this is
    better on the held-out pairs of all folds. The inputs of the network are the normal score and three cosines of each
    rank, whitened jointly for x and z: for strongly dependent variables the small differences between x and z matter.
    Estimates use the moving average of the network's weights.

    Each of K folds is held out once. The number of gradient steps for a fold is chosen by the estimates on the *other*
    folds, which avoids a selection bias.

    :param x: ``(N, X)``, or ``(M, N, X)`` for M problems at once; ``(N,)`` counts as ``(N, 1)``.
    :param z: ``(N, Z)`` or ``(M, N, Z)``; row i belongs to row i of ``x``.
    :param estimator: An estimator with a critic: ``"mine"``, ``"nwj"``, ``"smile"``, ``"infonce"``, or a class.
    :param n_folds: Number of folds K.
    :param max_gradient_steps: Maximum number of gradient steps for each critic.
    :param patience: Training ends after this many checks without a better held-out estimate, one every 50 steps.
    :param learning_rate: Adam's learning rate.
    :param batch_size: Minibatch size B. Default: 200, or 32 for InfoNCE, whose estimates cannot exceed ``ln B``.
    :param seed: Seed of folds, weights and minibatches. PyTorch's global random state does not change.
    :param kwargs: Further arguments of the estimator's constructor, such as ``hidden_sizes``.
    :return: the mean of the estimates on training pairs and on held-out pairs, and both of these. In a large sample, a
        critic with p parameters reads about p / 2N too high on the pairs that it was fitted to and p / 2N too low on
        fresh ones (the count of Akaike's criterion). ``held_out`` is the cautious choice: a lower bound in expectation
        where the estimator is one.
    :raises ValueError: if shapes do not match, a value is not finite, there are fewer than ten pairs for each fold or
        too few for the number of components, or the estimator needs the encoder's density.
    """
    estimator_class = get_estimator_class(estimator)
    if not issubclass(estimator_class, CriticEstimator):
        raise ValueError(
            f'estimator={estimator!r} needs the density of an encoder: use an estimator with a critic, such as "mine"'
        )
    x, z, single = _check(x, z, n_folds)
    for name, value in (("max_gradient_steps", max_gradient_steps), ("patience", patience)):
        if value < 1:
            raise ValueError(f"{name}={value} must be at least 1")
    if batch_size is None:
        batch_size = 32 if issubclass(estimator_class, InfoNCE) else 200
    with th.random.fork_rng(devices=[]), th.no_grad():
        # One critic for each problem and fold, whose inputs are places of pairs.
        fitted = estimator_class(len(x) * n_folds, 1, 1, learning_rate=learning_rate, batch_size=batch_size, **kwargs)
        held_out, trained_on = _cross_fit(x, z, fitted, n_folds, max_gradient_steps, patience, seed)
    values = [((held_out + trained_on) / 2).numpy(), held_out.numpy(), trained_on.numpy()]
    return InformationEstimate(*(float(value[0]) if single else value for value in values))


def _check(x: npt.ArrayLike, z: npt.ArrayLike, n_folds: int) -> tuple[th.Tensor, th.Tensor, bool]:
    """Return both as ``(M, N, ...)``, and whether there is only one problem."""
    arrays = []
    for name, value in (("x", x), ("z", z)):
        array = np.asarray(value.detach().cpu() if isinstance(value, th.Tensor) else value, dtype=np.float64)
        array = array[:, None] if array.ndim == 1 else array
        if array.ndim not in (2, 3) or array.shape[-1] == 0:
            raise ValueError(f"{name} has shape {array.shape}: expected (N, components) or (M, N, components)")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} has {(~np.isfinite(array)).sum()} values that are not finite: drop these pairs")
        arrays.append(array)
    if arrays[0].shape[:-1] != arrays[1].shape[:-1]:
        raise ValueError(
            f"x has shape {arrays[0].shape} and z {arrays[1].shape}: all but the last number must agree, since row i "
            "of x belongs to row i of z"
        )
    if n_folds < 2:
        raise ValueError(f"n_folds={n_folds} must be at least 2: one fold is held out while the others are trained on")
    n = arrays[0].shape[-2]
    n_components = sum(array.shape[-1] for array in arrays)
    # The covariance of the components is estimated on all folds but one.
    fewest = max(MIN_PAIRS_PER_FOLD * n_folds, 4 * n_components)
    if n < fewest:
        raise ValueError(
            f"{n} pairs are too few: with n_folds={n_folds} and {n_components} components in all, at least {fewest} "
            "are needed"
        )
    single = arrays[0].ndim == 2
    first, second = (th.as_tensor(array[None] if single else array) for array in arrays)
    return first, second, single


def _ranks(x: th.Tensor) -> th.Tensor:
    """Return the relative rank of every value in its component, in (0, 1), with ties averaged: ``(..., N, D)``."""
    from scipy.stats import rankdata  # its import takes a second

    return th.as_tensor((rankdata(x.numpy(), axis=-2) - 0.5) / x.shape[-2])


def _features(ranks: th.Tensor) -> th.Tensor:
    """Compute normal scores, and cosines that show a small network more detail: ``(M, N, D) -> (M, N, J, D)``."""
    waves = [2**0.5 * th.cos(th.pi * j * ranks) for j in range(1, N_WAVES + 1)]
    return th.stack([th.special.ndtri(ranks), *waves], -2)


def _whiten(features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Find means and matrices that whiten: ``(rows, n, J, D) -> (rows, 1, J, D), (rows, J, D, D)``."""
    mean = features.mean(1, keepdim=True)
    centred = features - mean
    variances, axes = th.linalg.eigh(th.einsum("rnjd,rnje->rjde", centred, centred) / features.shape[1])
    return mean, (axes * variances.clamp(min=MIN_VARIANCE).rsqrt()[..., None, :]) @ axes.mT


def _inputs(features: th.Tensor, train: th.Tensor, n_x: int) -> th.Tensor:
    """
    Compute the terms of x and of z in the network's inputs, whose sum is white on the training pairs ``(K, n)``.

    :return: the terms of every x, then of every z: ``(2 * M * K * N, J * D)``
    """
    mean, axes = (found.unflatten(0, (-1, len(train))) for found in _whiten(features[:, train].flatten(0, 1)))
    centred = features[:, None] - mean  # (M, K, N, J, D)
    terms = [
        th.einsum("mknjd,mkjde->mknje", centred[..., part], axes[..., part, :])
        for part in (slice(n_x), slice(n_x, None))
    ]
    return th.stack(terms).flatten(4).flatten(0, 3).float()


class StartedMLP(BatchedMLP):
    """
    Networks that are added to a fixed critic, and are zero at first.

    Their inputs are pairs of places in a table that holds what each x and each z adds to the inputs and to the start.
    """

    start: Start
    table: th.Tensor  # see `add_up`: what is added to the J * (X + Z) inputs, then to the start

    def forward(self, pairs: th.Tensor) -> th.Tensor:
        """``(rows, n, 2) -> (rows, n, 1)``."""
        # In parts, so that the values of the hidden layers stay in the processor's cache.
        parts = (self.prepare(part) for part in pairs.split(PAIRS_AT_ONCE, dim=1))
        return th.cat([start + super(StartedMLP, self).forward(inputs) for inputs, start in parts], 1)

    def prepare(self, pairs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Inputs of the networks, ``(rows, n, J * (X + Z))``, and what is added to their outputs, ``(rows, n, 1)``."""
        sums = add_up(self.table, pairs)
        n_inputs = sums.shape[-1] - self.start.table.shape[-1]
        return sums[..., :n_inputs], self.start.of_sums(sums[..., n_inputs:])


def _cross_fit(
    x: th.Tensor, z: th.Tensor, estimator: CriticEstimator, n_folds: int, max_steps: int, patience: int, seed: int
) -> tuple[th.Tensor, th.Tensor]:
    """Train the critics of all problems and folds as one network; ``(M,)`` held out and trained on."""
    th.manual_seed(seed)
    n_problems, n, n_x = x.shape
    ranks = th.cat([_ranks(x), _ranks(z)], -1)
    order = th.randperm(n)
    size = n // n_folds
    held_out = order[: size * n_folds].view(n_folds, size)
    train = th.stack([order[~th.isin(order, fold)] for fold in held_out])  # (K, N - N // K)
    # What a critic has seen is read on the pairs of the next fold: over all folds each pair is read once by a critic
    # that was fitted to it, and once by one that was not.
    parts = (train, held_out, held_out.roll(-1, 0))
    # Every row has places of its own for the pairs' x; those of z are `n_places` further on.
    n_places = n_problems * n_folds * n
    places = th.arange(n_places, dtype=th.int32).view(n_problems, n_folds, n)
    on_train, fresh, seen = (places.gather(2, part.expand(n_problems, -1, -1)).flatten(0, 1) for part in parts)

    def read(critic: nn.Module, pairs: th.Tensor) -> th.Tensor:
        """Estimate from pairs of every row: ``(rows, n) -> (M, K)``."""
        return _read(estimator, critic, pairs, pairs + n_places).view(n_problems, n_folds)

    # The held-out pairs of all folds choose the start: a Gaussian copula, a t-copula or none.
    level = 1.0 if isinstance(estimator, Nwj) else 0.0  # no information: the optimal critic of NWJ is 1 + the log ratio
    likely = degrees_of_freedom(ranks)
    normal = th.full_like(likely, NORMAL)
    starts = [Start.fit(t_scores(ranks, nu[:, None])[:, 0], train, n_x, nu, level) for nu in (normal, likely)]
    values = th.stack([read(start, fresh).mean(-1) for start in starts])  # (2, M)
    starts.append(starts[0].flat_like(level))
    best_start = th.where((values > 0).any(0), values.nan_to_num(-th.inf).argmax(0), 2)
    start = choose_start(starts, best_start.repeat_interleave(n_folds))

    th.manual_seed(seed)
    critic = _new_critic(estimator, start, _inputs(_features(ranks), train, n_x), n_folds)
    optimizer = estimator.make_optimizer(critic)
    averaged = _average(critic, optimizer)
    first = read(start, fresh)
    choice = _Choice(estimator.refit_below, estimator.refit_above, first, read(start, seen))
    best = first.mean(-1)
    n_stale, n_done = th.zeros_like(best), 0  # (M,)
    partners = on_train[..., None] + n_places
    samples = InformationBatch(on_train[..., None], partners, partners, partners)
    while n_done < max_steps and (training := n_stale < patience).any():
        n_steps = min(STEPS_PER_CHECK, max_steps - n_done)
        estimator._ascend(critic, optimizer, samples, th.arange(len(on_train)), n_steps)
        n_done += n_steps
        current = read(averaged, fresh)
        choice.consider(current, lambda: read(averaged, seen), training)
        improved = current.mean(-1) > best
        n_stale = th.where(training & improved, 0.0, n_stale + 1)
        best = best.fmax(current.mean(-1))
    return choice.held_out.mean(-1), choice.trained_on.mean(-1)


def _average(critic: StartedMLP, optimizer: th.optim.Adam) -> StartedMLP:
    """
    Return a copy whose weights are the moving average of the critic's (Polyak and Juditsky, 1992).

    It has little of the noise of minibatches, which allows a large learning rate. PyTorch's ``AveragedModel`` is slow.
    """
    averaged = copy.deepcopy(critic)
    average, (weights,) = flatten_parameters(averaged), optimizer.param_groups[0]["params"]

    def update(*_: object) -> None:
        n = optimizer.state[weights]["step"].item()
        average.lerp_(weights, 1 - min(AVERAGE_DECAY, n / (n + 10)))

    optimizer.register_step_post_hook(update)
    return averaged


def _new_critic(estimator: CriticEstimator, start: Start, inputs: th.Tensor, n_folds: int) -> StartedMLP:
    """Make critics that equal ``start``; their networks start with the same weights in every problem."""
    sizes = (inputs.shape[-1], *estimator.sizes[1:])
    networks = BatchedMLP(n_folds, sizes, estimator.activation_fn)
    with th.random.fork_rng(devices=[]):  # these weights are overwritten
        critic = StartedMLP(len(start.factor), sizes, estimator.activation_fn)
    critic.start, critic.table = start, th.cat([inputs, start.table], -1)
    for parameter, fold in zip(critic.parameters(), networks.parameters(), strict=True):
        parameter.copy_(fold.repeat(len(parameter) // n_folds, 1, 1))
    for parameter in critic.layers[-1].parameters():
        parameter.zero_()
    return critic


def _read(estimator: CriticEstimator, critic: nn.Module, x: th.Tensor, z: th.Tensor) -> th.Tensor:
    """Estimate from the places of x and z, ``(rows, n)`` each, pairing each x also with R other z: ``(rows,)``."""
    if isinstance(estimator, InfoNCE):  # it makes its own pairs
        estimator.critic = critic  # type: ignore[assignment]
        states, trvs = x[..., None].double(), z[..., None].double()
        return estimator._estimate(InformationBatch(states, trvs, trvs, trvs), None)
    n = x.shape[1]
    n_marginal = min(MARGINAL_SAMPLES, n - 1)
    others = (th.arange(n)[:, None] + th.arange(n_marginal + 1)) % n  # (n, 1 + R), its own and others
    partners = z[:, others]
    pairs = th.stack([x[..., None].expand_as(partners), partners], -1)
    joint, marginal = pairs[:, :, :1].flatten(1, 2), pairs[:, :, 1:].flatten(1, 2)
    # Double precision: rounding errors of the large scores of a diverged critic must not look like information.
    values = critic(th.cat([joint, marginal], 1)).squeeze(-1).double()
    return estimator._bound(Scores(values[:, :n], values[:, n:].unflatten(1, (n, n_marginal))))


class _Choice:
    """
    Choose the length of training for each fold by the estimates of the other folds, ``(M, K)`` for each critic.

    Critics with an estimate out of bounds in any fold have diverged and are not chosen. Estimates on training pairs are
    computed only where a critic may be chosen.
    """

    def __init__(self, lowest: float, highest: float, held_out: th.Tensor, trained_on: th.Tensor) -> None:
        self._lowest, self._highest = lowest, highest
        self.held_out, self.trained_on = held_out, trained_on
        self._best = self._others(held_out).where(self._counts(held_out) & self._counts(trained_on), -th.inf)

    def consider(self, held_out: th.Tensor, trained_on: Callable[[], th.Tensor], training: th.Tensor) -> None:
        """Choose a critic for the folds where it is better than the earlier ones, in the problems in training."""
        others = self._others(held_out)
        better = (others > self._best) & self._counts(held_out) & training[:, None]
        if better.any():
            seen = trained_on()
            better &= self._counts(seen)
            self._best = others.where(better, self._best)
            self.held_out = held_out.where(better, self.held_out)
            self.trained_on = seen.where(better, self.trained_on)

    def _counts(self, estimates: th.Tensor) -> th.Tensor:
        """Return whether the estimates of all folds of a problem are in bounds: ``(M, K) -> (M, 1)``."""
        return ((estimates >= self._lowest) & (estimates <= self._highest)).all(-1, keepdim=True)  # NaN compares false

    @staticmethod
    def _others(held_out: th.Tensor) -> th.Tensor:
        """Sum the estimates of the other folds: ``(M, K) -> (M, K)``."""
        return held_out @ (1 - th.eye(held_out.shape[-1], dtype=held_out.dtype))
