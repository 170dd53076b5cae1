"""
The information between two variables from i.i.d. pairs of them, with no policy around: fitted and read by folds.

Dimension key: M problems, K folds, S = 2 starts of the critic, N pairs, R marginal samples for each pair, X and Z the
components of the two variables, V = (4 X + 1) + (4 Z + 1) inputs of a critic: normal scores, radius, cosines of ranks.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_tdpg.information.base import InformationBatch, InformationEstimator
from sb3_tdpg.information.critic import CriticEstimator, Scores
from sb3_tdpg.information.flat_adam import FlatAdam
from sb3_tdpg.information.infonce import InfoNCE
from sb3_tdpg.information.nwj import Nwj
from sb3_tdpg.networks import BatchedMLP, ELUGradient

STEPS_PER_CHECK = 50
MARGINAL_SAMPLES = 16  # partners of others that x is also read with
MIN_PAIRS_PER_FOLD = 10
N_WAVES = 3


class InformationEstimate(NamedTuple):
    """What :func:`estimate_information` found, in nats: floats for one problem, ``(M,)`` arrays for M of them."""

    estimate: Any
    """Midway between the other two."""
    held_out: Any
    """On pairs that the critic was not fitted to: tends to be too low."""
    trained_on: Any
    """On the pairs that the critic was fitted to: tends to be too high."""


def estimate_information(
    x: npt.ArrayLike,
    z: npt.ArrayLike,
    estimator: str | type[InformationEstimator] = "mine",
    *,
    n_folds: int = 5,
    max_gradient_steps: int = 500,
    patience: int = 4,
    learning_rate: float = 5e-3,
    batch_size: int | None = None,
    seed: int = 0,
    **kwargs: Any,
) -> InformationEstimate:
    r"""
    Estimate I[x; z] in nats from i.i.d. pairs of two continuous variables, held out fold by fold.

    Every component is first replaced by the normal quantile of its rank, which leaves the information as it is and
    takes away heavy tails. The critic is :math:`F = F_0 + \text{network}`. It starts once from the logarithmic density
    ratio :math:`F_0` of a Gaussian with the training folds' covariance, and once from :math:`F_0 = 0`. The covariance
    is that of x and z or, where that does better on the held-out pairs of all folds, of these and their radii (the
    normal quantile of the rank of the Mahalanobis norm), with which it sees tails that come together. The network's
    inputs are all these and three cosines of each rank.

    Each of K folds is held out once. Which start, and after how many gradient steps, is decided for a fold by the
    estimates on the *other* folds, so that a fold's own luck is not chosen.

    :param x: ``(N, X)``, or ``(M, N, X)`` for M problems at once; ``(N,)`` counts as ``(N, 1)``.
    :param z: ``(N, Z)`` or ``(M, N, Z)``, row by row the partners of ``x``.
    :param estimator: One with a critic: ``"mine"``, ``"nwj"``, ``"smile"``, ``"infonce"``, or a class of one's own.
    :param n_folds: K
    :param max_gradient_steps: The most steps of gradient ascent for each critic.
    :param patience: Training ends after this many checks, one every 50 steps, with no better held-out estimate.
    :param learning_rate: Adam's learning rate.
    :param batch_size: Minibatch B; None: 100, or 32 for InfoNCE, which cannot tell more than ``ln B``.
    :param seed: Of folds, weights and minibatches. PyTorch's global random state is left as it was.
    :param kwargs: Further arguments of the estimator's constructor, such as ``hidden_sizes``.
    :return: the estimate between its lower and its upper guess. For a critic with p parameters in a large sample, the
        pairs that it was fitted to read about p / 2N too high and fresh ones about p / 2N too low (the same count as in
        Akaike's criterion), so that the mean of both is the estimate. ``held_out`` alone is the cautious one, a lower
        bound in expectation where the estimator is one.
    :raises ValueError: if the shapes do not fit, a number is not finite, there are fewer than ten pairs for each fold
        or too few for the number of components, or the estimator needs the encoder's density.
    """
    from sb3_tdpg.information import get_estimator_class  # the registry is made of the modules in this folder

    estimator_class = get_estimator_class(estimator)
    if not issubclass(estimator_class, CriticEstimator):
        raise ValueError(
            f"estimator={estimator!r} needs the encoder's density, and pairs alone have none: use an estimator with a "
            'critic, such as "mine"'
        )
    x, z, single = _check(x, z, n_folds)
    for name, value in (("max_gradient_steps", max_gradient_steps), ("patience", patience)):
        if value < 1:
            raise ValueError(f"{name}={value} must be at least 1")
    if batch_size is None:
        batch_size = 32 if issubclass(estimator_class, InfoNCE) else 100
    kwargs = dict(kwargs, learning_rate=learning_rate, batch_size=batch_size)
    with th.random.fork_rng(devices=[]), th.no_grad():
        held_out, trained_on = _cross_fit(x, z, estimator_class, n_folds, max_gradient_steps, patience, seed, kwargs)
    values = [((held_out + trained_on) / 2).numpy(), held_out.numpy(), trained_on.numpy()]
    return InformationEstimate(*(float(value[0]) if single else value for value in values))


def _check(x: npt.ArrayLike, z: npt.ArrayLike, n_folds: int) -> tuple[th.Tensor, th.Tensor, bool]:
    """Return both as ``(M, N, ...)``, and whether there was only one problem."""
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
    inputs = sum(array.shape[-1] + 1 for array in arrays)
    # The covariance of the inputs is estimated on all folds but one.
    fewest = max(MIN_PAIRS_PER_FOLD * n_folds, 4 * inputs)
    if n < fewest:
        raise ValueError(
            f"{n} pairs are too few: with n_folds={n_folds} and {inputs - 2} components in all, at least {fewest} are "
            "needed"
        )
    single = arrays[0].ndim == 2
    first, second = (th.as_tensor(array[None] if single else array) for array in arrays)
    return first, second, single


# -- inputs of the critics ------------------------------------------------------------------------------------


def _ranks(x: th.Tensor) -> th.Tensor:
    """Relative rank of every value among the N of its component, in (0, 1), equal values alike: ``(..., N, D)``."""
    values = x.mT.contiguous()
    ordered = values.sort(dim=-1).values
    below = th.searchsorted(ordered, values)
    not_above = th.searchsorted(ordered, values, right=True)
    return (below + not_above).mT.double() / (2 * x.shape[-2])


def _normal_scores(x: th.Tensor) -> th.Tensor:
    """The normal quantiles of the ranks: ``(..., N, D)``; a constant component becomes 0."""
    return th.special.ndtri(_ranks(x))


def _with_radius(x: th.Tensor) -> th.Tensor:
    """Append the radius: it is a function of the others, so the information stays: ``(M, N, D) -> (M, N, D + 1)``."""
    covariance = _covariance(x)
    radius = ((x @ th.linalg.inv(covariance)) * x).sum(-1, keepdim=True)
    return th.cat([x, _normal_scores(radius)], -1)


def _waves(scores: th.Tensor) -> th.Tensor:
    """Cosines of the ranks, with which a small network sees more detail: ``(..., N, D) -> (..., N, 3 D)``."""
    ranks = th.special.ndtr(scores)
    return th.cat([2**0.5 * th.cos(th.pi * j * ranks) for j in range(1, N_WAVES + 1)], -1)


def _covariance(x: th.Tensor) -> th.Tensor:
    """Covariance, kept invertible where components are constant or copies of each other: ``(..., D, D)``."""
    centred = x - x.mean(-2, keepdim=True)
    return centred.mT @ centred / x.shape[-2] + 1e-4 * th.eye(x.shape[-1], dtype=x.dtype)


class Quadratic(NamedTuple):
    """A critic ``constant - (v - mean)' matrix (v - mean) / 2`` for each row: a Gaussian's logarithmic ratio."""

    matrix: th.Tensor  # (rows, V, V)
    mean: th.Tensor  # (rows, 1, V)
    constant: th.Tensor  # (rows, 1, 1)

    def __call__(self, v: th.Tensor) -> th.Tensor:
        """``(rows, n, V) -> (rows, n, 1)``."""
        centred = v - self.mean
        return self.constant - 0.5 * ((centred @ self.matrix) * centred).sum(-1, keepdim=True)


def _gaussian_ratio(v: th.Tensor, x_inputs: list[int], z_inputs: list[int]) -> Quadratic:
    """Log p(x, z) / p(x) p(z) of Gaussians with the samples' covariance; other inputs do not count."""
    used = th.tensor(x_inputs + z_inputs)
    joint = _covariance(v[..., used].double())
    product = joint.clone()
    n_x = len(x_inputs)
    product[..., :n_x, n_x:] = 0
    product[..., n_x:, :n_x] = 0
    matrix = v.new_zeros(len(v), v.shape[-1], v.shape[-1])
    matrix[:, used[:, None], used] = (th.linalg.inv(joint) - th.linalg.inv(product)).to(v)
    constant = 0.5 * (th.logdet(product) - th.logdet(joint))
    return Quadratic(matrix, v.mean(1, keepdim=True), constant[:, None, None].to(v))


class StartedMLP(BatchedMLP):
    """Networks that are added to a fixed critic, and are zero at first."""

    start: Quadratic

    def forward(self, x: th.Tensor) -> th.Tensor:
        """``(rows, n, V) -> (rows, n, 1)``."""
        return self.start(x) + super().forward(x)

    def gradient_by_hand(self) -> ELUGradient:
        """Return the means to evaluate and differentiate this critic; see :class:`ELUGradient`."""
        network = super().gradient_by_hand()
        return _StartedGradient(network, self.start)


class _StartedGradient(ELUGradient):
    def __init__(self, network: ELUGradient, start: Quadratic) -> None:
        self.__dict__.update(network.__dict__)
        self._start = start

    def forward(self, x: th.Tensor) -> th.Tensor:
        return self._start(x) + super().forward(x)


# -- folds ----------------------------------------------------------------------------------------------------


def _cross_fit(
    x: th.Tensor,
    z: th.Tensor,
    estimator_class: type[CriticEstimator],
    n_folds: int,
    max_gradient_steps: int,
    patience: int,
    seed: int,
    kwargs: dict[str, Any],
) -> tuple[th.Tensor, th.Tensor]:
    """Train the critics of all problems, starts and folds as one network; ``(M,)`` held out and trained on."""
    th.manual_seed(seed)
    n_problems, n = x.shape[:2]
    x, z = _with_radius(_normal_scores(x)), _with_radius(_normal_scores(z))
    order = th.randperm(n)
    size = n // n_folds
    held_out = order[: size * n_folds].view(n_folds, size)
    train = th.stack([order[~th.isin(order, fold)] for fold in held_out])  # (K, N - N // K)

    def rows(pairs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Pairs of every fold: ``(M * K, n, ...)``."""
        return x[:, pairs].flatten(0, 1), z[:, pairs].flatten(0, 1)

    x, z = (th.cat([variable, _waves(variable[..., :-1])], -1).float() for variable in (x, z))
    # What a critic has seen is read on the pairs of the next fold: over all folds each pair is read once by a critic
    # that was fitted to it, and once by one that was not.
    training, fresh, seen = (rows(pairs) for pairs in (train, held_out, held_out.roll(-1, 0)))
    n_rows = 2 * n_problems * n_folds
    estimator, half = (estimator_class(rows, x.shape[-1], z.shape[-1], **kwargs) for rows in (n_rows, n_rows // 2))
    gaussian = _best_gaussian(half, training, fresh, n_folds)
    zero = Quadratic(th.zeros_like(gaussian.matrix), gaussian.mean, th.full_like(gaussian.constant, _level(estimator)))
    start = Quadratic(*(th.cat(parts) for parts in zip(gaussian, zero, strict=True)))
    th.manual_seed(seed)  # anew: how much was drawn above depends on the number of problems
    critic = _new_critic(estimator, start, n_folds)
    # For either start.
    training, fresh, seen = ((a.repeat(2, 1, 1), b.repeat(2, 1, 1)) for a, b in (training, fresh, seen))

    def check() -> th.Tensor:
        """Estimates held out and trained on: ``(2, S, M, K)``."""
        values = [_read(estimator, critic, *pairs) for pairs in (fresh, seen)]
        return th.stack([value.view(2, n_problems, n_folds) for value in values])

    history = [check()]
    best = history[0][0].mean(-1)
    n_stale, last = th.zeros_like(best), th.full_like(best, th.inf)  # (S, M)
    optimizer = FlatAdam(estimator.learning_rate)
    while th.isinf(last).any() and (done := (len(history) - 1) * STEPS_PER_CHECK) < max_gradient_steps:
        n_steps = min(STEPS_PER_CHECK, max_gradient_steps - done)
        estimator._ascend(critic, optimizer, *training, None, th.arange(n_rows), n_steps)
        history.append(check())
        current = history[-1][0].mean(-1)
        n_stale = th.where(current > best, 0.0, n_stale + 1)
        best = best.fmax(current)
        last = th.where((n_stale >= patience) & th.isinf(last), float(len(history) - 1), last)
    return _choose(th.stack(history), last, estimator.refit_below, estimator.refit_above)


def _level(estimator: CriticEstimator) -> float:
    """The score at which the critic says "no information": the NWJ bound's best critic is 1 + the log ratio."""
    return 1.0 if isinstance(estimator, Nwj) else 0.0


def _best_gaussian(
    estimator: CriticEstimator,
    training: tuple[th.Tensor, th.Tensor],
    fresh: tuple[th.Tensor, th.Tensor],
    n_folds: int,
) -> Quadratic:
    """The Gaussian's log ratio for every problem and fold, with or without the radii, as its held-out pairs decide."""
    v = th.cat(training, -1)
    n_x, n_z = (part.shape[-1] // (1 + N_WAVES) for part in training)  # components, as _waves laid them out
    candidates, values = [], []
    for radius in (0, 1):
        x_inputs, z_inputs = range(n_x + radius), range(training[0].shape[-1], training[0].shape[-1] + n_z + radius)
        ratio = _gaussian_ratio(v, [*x_inputs], [*z_inputs])
        ratio = ratio._replace(constant=ratio.constant + _level(estimator))
        critic = _new_critic(estimator, ratio, n_folds)
        value = _read(estimator, critic, *fresh)
        candidates.append(ratio)
        values.append(value.view(-1, n_folds).mean(1))
    with_radius = (values[1] > values[0]).repeat_interleave(n_folds)[:, None, None]
    return Quadratic(*(th.where(with_radius, b, a) for a, b in zip(*candidates, strict=True)))


def _new_critic(estimator: CriticEstimator, start: Quadratic, n_folds: int) -> StartedMLP:
    """Make critics that equal ``start``, whose networks begin alike in every problem: the batch changes no result."""
    networks = BatchedMLP(n_folds, estimator.sizes, estimator.activation_fn)
    with th.random.fork_rng(devices=[]):  # what is drawn here is overwritten
        critic = StartedMLP(len(start.matrix), estimator.sizes, estimator.activation_fn)
    critic.start = start
    for parameter, fold in zip(critic.parameters(), networks.parameters(), strict=True):
        parameter.copy_(fold.repeat(len(parameter) // n_folds, 1, 1))
    last = critic.layers[-1]
    for parameter in last.parameters():
        parameter.zero_()
    return critic


def _read(estimator: CriticEstimator, critic: BatchedMLP, x: th.Tensor, z: th.Tensor) -> th.Tensor:
    """Estimate from pairs, each also with the partners of R others: ``(rows, n, ...) -> (rows,)``."""
    if isinstance(estimator, InfoNCE):  # it makes pairs of its own
        estimator.critic = critic
        return estimator._estimate(InformationBatch(x, z, z, z), None)
    n = z.shape[1]
    n_marginal = min(MARGINAL_SAMPLES, n - 1)
    others = (th.arange(n)[:, None] + th.arange(1, n_marginal + 1)) % n  # (n, R), never its own
    repeated = x[:, :, None].expand(-1, -1, n_marginal, -1)
    pairs = th.cat([th.cat([x, z], -1), th.cat([repeated, z[:, others]], -1).flatten(1, 2)], 1)
    values = critic(pairs).squeeze(-1)
    return estimator._bound(Scores(values[:, :n], values[:, n:].unflatten(1, (n, n_marginal))))


def _choose(history: th.Tensor, last: th.Tensor, lowest: float, highest: float) -> tuple[th.Tensor, th.Tensor]:
    """
    Choose start and length of training for each fold by what the other folds say of them.

    :param history: ``(checks, 2, S, M, K)``, held out and trained on
    :param last: ``(S, M)``, the last check at which a problem was still in training
    :param lowest: an estimate below it, of any fold, is that of a critic that has diverged, which is not chosen
    :param highest: likewise for one above it
    :return: ``(M,)`` held out and trained on
    """
    n_checks = len(history)
    counts = th.arange(n_checks)[:, None, None] <= last
    counts &= ((history >= lowest) & (history <= highest)).all(-1).all(1)  # NaN compares false
    options = history.transpose(0, 1).flatten(1, 2)  # (2, checks * S, M, K)
    held_out = options[0].masked_fill(~counts.flatten(0, 1)[..., None], -th.inf)
    others = th.stack(
        [held_out[..., th.arange(held_out.shape[-1]) != k].sum(-1) for k in range(held_out.shape[-1])], -1
    )
    chosen = others.argmax(0, keepdim=True)  # (1, M, K)
    first, second = (option.gather(0, chosen)[0].mean(-1) for option in options)
    return first, second
