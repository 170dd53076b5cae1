"""
The information between two variables from i.i.d. pairs of them, with no policy around: fitted and read by folds.

Dimension key: M problems, K folds, N pairs, R marginal samples for each pair, X and Z the components of the two
variables, D components of either or both, J = 4 features of each: its normal score and three cosines of its rank.
"""

from __future__ import annotations

from math import lgamma
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch as th
from scipy.special import stdtrit

from sb3_tdpg.information.base import InformationBatch, InformationEstimator
from sb3_tdpg.information.critic import CriticEstimator, Scores
from sb3_tdpg.information.flat_adam import AveragedAdam
from sb3_tdpg.information.infonce import InfoNCE
from sb3_tdpg.information.nwj import Nwj
from sb3_tdpg.networks import BatchedMLP, ELUGradient

STEPS_PER_CHECK = 50
DEGREES_OF_FREEDOM = tuple(1.5**i for i in range(11))  # 1 to 58
NORMAL = 1e6  # degrees of freedom that are as good as infinitely many
N_SCATTER_STEPS = 5
MIN_VARIANCE = 1e-2  # of what is brought to variance 1
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
    max_gradient_steps: int = 1000,
    patience: int = 2,
    learning_rate: float = 2e-2,
    batch_size: int | None = None,
    seed: int = 0,
    **kwargs: Any,
) -> InformationEstimate:
    r"""
    Estimate I[x; z] in nats from i.i.d. pairs of two continuous variables, held out fold by fold.

    Only the ranks of each component are used, which leaves the information as it is. The critic is
    :math:`F = F_0 + \text{network}`. It starts from the logarithmic density ratio :math:`F_0` of a t-copula (Demarta
    and McNeil, 2005): a multivariate Student's t, which also has tails that come together, of the t quantiles of the
    ranks. Its scatter matrix is that of the training folds, and its degrees of freedom are the most likely ones for all
    pairs. Where that does better on the held-out pairs of all folds, they are infinitely many, which makes a Gaussian,
    or :math:`F_0 = 0`. The network's inputs are the normal scores and three cosines of each rank, those of x and z
    together brought to covariance 1: where x and z depend on each other closely, the little in which they differ is
    what counts. The network is read with the moving average of its weights.

    Each of K folds is held out once. After how many gradient steps a critic is read is decided for a fold by the
    estimates on the *other* folds, so that a fold's own luck is not chosen.

    :param x: ``(N, X)``, or ``(M, N, X)`` for M problems at once; ``(N,)`` counts as ``(N, 1)``.
    :param z: ``(N, Z)`` or ``(M, N, Z)``, row by row the partners of ``x``.
    :param estimator: One with a critic: ``"mine"``, ``"nwj"``, ``"smile"``, ``"infonce"``, or a class of one's own.
    :param n_folds: K
    :param max_gradient_steps: The most steps of gradient ascent for each critic.
    :param patience: Training ends after this many checks, one every 50 steps, with no better held-out estimate: after
        100 steps where the start cannot be bettered.
    :param learning_rate: Adam's learning rate.
    :param batch_size: Minibatch B; None: 200, or 32 for InfoNCE, which cannot tell more than ``ln B``.
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
        batch_size = 32 if issubclass(estimator_class, InfoNCE) else 200
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
    n_components = sum(array.shape[-1] for array in arrays)
    # Their covariance is estimated on all folds but one.
    fewest = max(MIN_PAIRS_PER_FOLD * n_folds, 4 * n_components)
    if n < fewest:
        raise ValueError(
            f"{n} pairs are too few: with n_folds={n_folds} and {n_components} components in all, at least {fewest} "
            "are needed"
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


def _features(ranks: th.Tensor) -> th.Tensor:
    """Normal scores, and cosines with which a small network sees more detail: ``(M, N, D) -> (M, N, J, D)``."""
    waves = [2**0.5 * th.cos(th.pi * j * ranks) for j in range(1, N_WAVES + 1)]
    return th.stack([th.special.ndtri(ranks), *waves], -2)


def _whiten(features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    Find the means and the maps after which the features of each kind are uncorrelated, with variance 1, in all rows.

    Where x and z depend on each other closely, the little in which they differ is what a network has to see.

    :param features: of x and z, ``(rows, n, J, D)``
    :return: ``(rows, 1, J, D)`` and ``(rows, J, D, D)``
    """
    mean = features.mean(1, keepdim=True)
    centred = features - mean
    variances, axes = th.linalg.eigh(th.einsum("rnjd,rnje->rjde", centred, centred) / features.shape[1])
    return mean, (axes * variances.clamp(min=MIN_VARIANCE).rsqrt()[..., None, :]) @ axes.mT


def _t_scores(ranks: th.Tensor, nu: th.Tensor) -> th.Tensor:
    """Quantiles of Student's t at the ranks, for ``(M,)`` degrees of freedom: ``(M, N, D) -> (M, N, D)``."""
    n_ranks = 2 * ranks.shape[1]
    # Of every rank that there may be, since quantiles are dear and ranks few.
    quantiles = th.as_tensor(stdtrit(nu[:, None].numpy(), np.arange(1, n_ranks) / n_ranks))
    return quantiles[th.arange(len(ranks))[:, None, None], (n_ranks * ranks).round().long() - 1]


def _quadratic(y: th.Tensor, matrix: th.Tensor) -> th.Tensor:
    """``y' matrix y`` of every sample: ``(rows, n, D) -> (rows, n, 1)``."""
    return ((y @ matrix) * y).sum(-1, keepdim=True)


def _scatter(y: th.Tensor, nu: th.Tensor) -> th.Tensor:
    """
    Scatter matrix of a multivariate t around 0, by a few EM steps towards its maximum likelihood.

    It is kept invertible where components are constant or copies of each other.

    :param y: ``(rows, n, D)``
    :param nu: degrees of freedom, ``(rows,)``
    :return: ``(rows, D, D)``
    """
    n, dim = y.shape[1:]
    nu = nu[:, None, None]
    scatter = th.eye(dim, dtype=y.dtype).expand(len(y), -1, -1)
    for _ in range(N_SCATTER_STEPS):
        weights = (nu + dim) / (nu + _quadratic(y, th.linalg.inv(scatter)))
        scatter = (weights * y).mT @ y / n + 1e-4 * th.eye(dim, dtype=y.dtype)
    return scatter


def _degrees_of_freedom(ranks: th.Tensor) -> th.Tensor:
    """Those of :data:`DEGREES_OF_FREEDOM` for which the t-copula of all components is the most likely: ``(M,)``."""
    dim = ranks.shape[-1]
    likelihoods = []
    for nu in DEGREES_OF_FREEDOM:
        all_nu = th.full((len(ranks),), nu, dtype=th.double)
        y = _t_scores(ranks, all_nu)
        scatter = _scatter(y, all_nu)
        joint = (nu + dim) / 2 * th.log1p(_quadratic(y, th.linalg.inv(scatter)) / nu).mean((1, 2))
        marginals = (nu + 1) / 2 * th.log1p(y**2 / nu).sum(-1).mean(1)
        constant = lgamma((nu + dim) / 2) + (dim - 1) * lgamma(nu / 2) - dim * lgamma((nu + 1) / 2)
        likelihoods.append(constant + marginals - joint - th.logdet(scatter) / 2)
    return th.tensor(DEGREES_OF_FREEDOM, dtype=th.double)[th.stack(likelihoods).argmax(0)]


class Start(NamedTuple):
    r"""
    What the critics are before they are trained: the logarithmic density ratio of a multivariate t, for each row.

    With A the inverse of the scatter matrix of (x, z), and B and C those of its blocks of x and of z,

    .. math::
        c + \tfrac{\nu + X}{2} \ln(1 + x^\top B x / \nu) + \tfrac{\nu + Z}{2} \ln(1 + z^\top C z / \nu)
        - \tfrac{\nu + X + Z}{2} \ln(1 + (x, z)^\top A (x, z) / \nu).

    Only :math:`2 x^\top A z` takes both: the rest is worked out once for each x and each z, in :meth:`sides`.
    """

    joint: th.Tensor  # A, (rows, X + Z, X + Z)
    of_x: th.Tensor  # B, (rows, X, X)
    of_z: th.Tensor  # C, (rows, Z, Z)
    nu: th.Tensor  # (rows, 1, 1)
    constant: th.Tensor  # (rows, 1, 1)
    weight: th.Tensor  # (rows, 1, 1), 0 where the critic is to start from a constant

    @classmethod
    def fit(cls, y: th.Tensor, n_x: int, nu: th.Tensor, weight: th.Tensor, level: float) -> Start:
        """
        Fit the scatter matrix to t-scores.

        :param y: of x and z, ``(rows, n, X + Z)``
        :param n_x: X
        :param nu: degrees of freedom, ``(rows,)``
        :param weight: ``(rows,)``
        :param level: what is added: the score at which the critic says "no information"
        """
        scatter = _scatter(y, nu)
        blocks = scatter, scatter[:, :n_x, :n_x], scatter[:, n_x:, n_x:]
        signs = (1, -1, -1)
        constant = th.lgamma(nu / 2)
        for block, sign in zip(blocks, signs, strict=True):
            constant = constant + sign * (th.lgamma((nu + block.shape[-1]) / 2) - th.logdet(block) / 2)
        numbers = (number[:, None, None] for number in (nu, level + weight * constant, weight))
        return cls(*(th.linalg.inv(block) for block in blocks), *numbers)

    def sides(self, x: th.Tensor, z: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """What x and z bring to the ratio of any pair: ``(rows, n, X)`` and ``(rows, n, Z) -> (rows, n, Z + 2)``."""
        n_x, n_z = x.shape[-1], z.shape[-1]
        x_marginal = (self.nu + n_x) / 2 * th.log1p(_quadratic(x, self.of_x) / self.nu)
        z_marginal = (self.nu + n_z) / 2 * th.log1p(_quadratic(z, self.of_z) / self.nu)
        x_side = [2 * x @ self.joint[:, :n_x, n_x:], _quadratic(x, self.joint[:, :n_x, :n_x]), x_marginal]
        return th.cat(x_side, -1), th.cat([z, _quadratic(z, self.joint[:, n_x:, n_x:]), z_marginal], -1)

    def __call__(self, v: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Take the critic's inputs apart.

        :param v: for either side what it brings to the network's inputs, then to this ratio, ``(rows, n, V)``
        :return: the network's inputs and the ratio, ``(rows, n, J * (X + Z))`` and ``(rows, n, 1)``
        """
        x_side, z_side = v.chunk(2, -1)
        n_z = self.of_z.shape[-1]
        product = (x_side[..., -n_z - 2 : -2] * z_side[..., -n_z - 2 : -2]).sum(-1, keepdim=True)
        own, marginals = (x_side[..., -2:] + z_side[..., -2:]).split(1, -1)
        # Rounding may take the quadratic form below 0.
        logarithm = th.log1p((own + product).clamp(min=0) / self.nu)
        ratio = marginals - (self.nu + self.joint.shape[-1]) / 2 * logarithm
        return x_side[..., : -n_z - 2] + z_side[..., : -n_z - 2], self.constant + self.weight * ratio


class StartedMLP(BatchedMLP):
    """Networks that are added to a fixed critic, and are zero at first."""

    start: Start

    def forward(self, x: th.Tensor) -> th.Tensor:
        """``(rows, n, V) -> (rows, n, 1)``."""
        inputs, start = self.start(x)
        return start + super().forward(inputs)

    def gradient_by_hand(self) -> ELUGradient:
        """Return the means to evaluate and differentiate this critic; see :class:`ELUGradient`."""
        network = super().gradient_by_hand()
        return _StartedGradient(network, self.start)


class _StartedGradient(ELUGradient):
    def __init__(self, network: ELUGradient, start: Start) -> None:
        self.__dict__.update(network.__dict__)
        self._start = start

    def forward(self, x: th.Tensor) -> th.Tensor:
        inputs, start = self._start(x)
        return start + super().forward(inputs)


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

    def rows(values: th.Tensor, pairs: th.Tensor) -> th.Tensor:
        """Pairs of every fold: ``(M, N, ...) -> (M * K, n, ...)``."""
        return values[:, pairs].flatten(0, 1)

    features = _features(ranks)
    mean, axes = _whiten(rows(features, train))
    n_inputs = features.shape[2] * features.shape[3]
    n_sides = n_inputs + z.shape[-1] + 2
    n_rows = n_problems * n_folds
    estimator = estimator_class(n_rows, n_sides, n_sides, **kwargs)

    def started(nu: th.Tensor, weight: th.Tensor) -> tuple[StartedMLP, list[tuple[th.Tensor, th.Tensor]]]:
        """Critics, and their inputs on all ``parts``, for ``(M,)`` degrees of freedom and weights of the start."""
        th.manual_seed(seed)
        y = _t_scores(ranks, nu)
        nu, weight = (number.repeat_interleave(n_folds) for number in (nu, weight))
        start = Start.fit(rows(y, train), n_x, nu, weight, _level(estimator))
        inputs = []
        for pairs in parts:
            centred, scores = rows(features, pairs) - mean, rows(y, pairs)
            of_network = [
                th.einsum("rnjd,rjde->rnje", centred[..., part], axes[:, :, part]).flatten(2)
                for part in (slice(n_x), slice(n_x, None))
            ]
            of_start = start.sides(scores[..., :n_x], scores[..., n_x:])
            x_side, z_side = (th.cat(both, -1).float() for both in zip(of_network, of_start, strict=True))
            inputs.append((x_side, z_side))
        sizes = (n_inputs, *estimator.sizes[1:])
        return _new_critic(estimator, sizes, Start(*(field.float() for field in start)), n_folds), inputs

    def read(critic: StartedMLP, *inputs: tuple[th.Tensor, th.Tensor]) -> th.Tensor:
        """Estimates from each of the inputs: ``(len(inputs), M, K)``."""
        return th.stack([_read(estimator, critic, *pair).view(n_problems, n_folds) for pair in inputs])

    # The start is what the held-out pairs of all folds say: a t's ratio, a Gaussian's or none.
    ones = th.ones(n_problems, dtype=th.double)
    values = []
    candidates = (NORMAL * ones, _degrees_of_freedom(ranks))
    for nu in candidates:
        critic, inputs = started(nu, ones)
        values.append(read(critic, inputs[1])[0].mean(-1))
    nu = th.where(values[1] > values[0], candidates[1], candidates[0])
    critic, (training, fresh, seen) = started(nu, (th.fmax(*values) > 0).double())

    optimizer = AveragedAdam(estimator.learning_rate)
    optimizer.attach(critic)
    history = [read(critic, fresh, seen)]
    best = history[0][0].mean(-1)
    n_stale, last = th.zeros_like(best), th.full_like(best, th.inf)  # (M,)
    while th.isinf(last).any() and (done := (len(history) - 1) * STEPS_PER_CHECK) < max_gradient_steps:
        n_steps = min(STEPS_PER_CHECK, max_gradient_steps - done)
        estimator._ascend(critic, optimizer, *training, None, th.arange(n_rows), n_steps)
        with optimizer.averaged():
            history.append(read(critic, fresh, seen))
        current = history[-1][0].mean(-1)
        n_stale = th.where(current > best, 0.0, n_stale + 1)
        best = best.fmax(current)
        last = th.where((n_stale >= patience) & th.isinf(last), float(len(history) - 1), last)
    return _choose(th.stack(history), last, estimator.refit_below, estimator.refit_above)


def _level(estimator: CriticEstimator) -> float:
    """The score at which the critic says "no information": the NWJ bound's best critic is 1 + the log ratio."""
    return 1.0 if isinstance(estimator, Nwj) else 0.0


def _new_critic(estimator: CriticEstimator, sizes: tuple[int, ...], start: Start, n_folds: int) -> StartedMLP:
    """Make critics that equal ``start``, whose networks begin alike in every problem: the batch changes no result."""
    networks = BatchedMLP(n_folds, sizes, estimator.activation_fn)
    with th.random.fork_rng(devices=[]):  # what is drawn here is overwritten
        critic = StartedMLP(len(start.nu), sizes, estimator.activation_fn)
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
    Choose the length of training for each fold by what the other folds say of it.

    :param history: ``(checks, 2, M, K)``, held out and trained on
    :param last: ``(M,)``, the last check at which a problem was still in training
    :param lowest: an estimate below it, of any fold, is that of a critic that has diverged, which is not chosen
    :param highest: likewise for one above it
    :return: ``(M,)`` held out and trained on
    """
    counts = th.arange(len(history))[:, None] <= last
    counts &= ((history >= lowest) & (history <= highest)).all(-1).all(1)  # NaN compares false
    held_out = history[:, 0].masked_fill(~counts[..., None], -th.inf)  # (checks, M, K)
    others = th.stack(
        [held_out[..., th.arange(held_out.shape[-1]) != k].sum(-1) for k in range(held_out.shape[-1])], -1
    )
    chosen = others.argmax(0, keepdim=True)  # (1, M, K)
    first, second = (history[:, i].gather(0, chosen)[0].mean(-1) for i in range(2))
    return first, second
