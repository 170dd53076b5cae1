"""
The density ratio of the t-copula that fits i.i.d. pairs best, from which their critics start.

Dimension key: M problems, K folds, N pairs, X and Z components of the two variables, D components of either or both.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from scipy.special import stdtrit
from torch import nn
from torch.nn.functional import embedding_bag

DEGREES_OF_FREEDOM = tuple(1.5**i for i in range(11))  # 1 to 58
NORMAL = 1e6  # degrees of freedom that are as good as infinitely many
N_SCATTER_STEPS = 5


def t_scores(ranks: th.Tensor, nu: th.Tensor) -> th.Tensor:
    """Return the quantiles of Student's t at the ranks, for L degrees of freedom: ``(M, N, D) -> (M, L, N, D)``."""
    # Quantiles are expensive, and many ranks are equal.
    values, place = ranks.unique(return_inverse=True)
    quantiles = th.as_tensor(stdtrit(nu[..., None].numpy(), values.numpy()))  # (M, L, distinct ranks)
    scores = quantiles.gather(2, place.flatten(1)[:, None].expand(-1, nu.shape[1], -1))
    return scores.unflatten(2, ranks.shape[1:])


def _quadratic(y: th.Tensor, matrix: th.Tensor) -> th.Tensor:
    """Return ``y' matrix y`` of every sample: ``(rows, n, D) -> (rows, n, 1)``."""
    return ((y @ matrix) * y).sum(-1, keepdim=True)


def _scatter(y: th.Tensor, nu: th.Tensor) -> th.Tensor:
    """Fit the scatter matrix of a multivariate t around 0 by expectation-maximisation: ``(rows, D, D)``."""
    n, dim = y.shape[1:]
    nu = nu[:, None, None]
    scatter = th.eye(dim, dtype=y.dtype).expand(len(y), -1, -1)
    for _ in range(N_SCATTER_STEPS):
        weights = (nu + dim) / (nu + _quadratic(y, th.linalg.inv(scatter)))
        scatter = (weights * y).mT @ y / n + 1e-4 * th.eye(dim, dtype=y.dtype)  # invertible if components are copies
    return scatter


def degrees_of_freedom(ranks: th.Tensor) -> th.Tensor:
    """Choose from :data:`DEGREES_OF_FREEDOM` those of the most likely t-copula of all components: ``(M,)``."""
    dim = ranks.shape[-1]
    choices = th.tensor(DEGREES_OF_FREEDOM, dtype=th.double)
    y = t_scores(ranks, choices.expand(len(ranks), -1)).flatten(0, 1)
    nu = choices.repeat(len(ranks))
    scatter = _scatter(y, nu)
    constant = th.lgamma((nu + dim) / 2) + (dim - 1) * th.lgamma(nu / 2) - dim * th.lgamma((nu + 1) / 2)
    joint = (nu + dim) / 2 * th.log1p(_quadratic(y, th.linalg.inv(scatter)) / nu[:, None, None]).mean((1, 2))
    marginals = (nu + 1) / 2 * th.log1p(y**2 / nu[:, None, None]).sum(-1).mean(1)
    likelihoods = constant + marginals - joint - th.logdet(scatter) / 2
    return choices[likelihoods.view(len(ranks), -1).argmax(1)]


def add_up(table: th.Tensor, pairs: th.Tensor) -> th.Tensor:
    """
    Add the table's entries of the x and of the z of every pair: ``(rows, n, C)``.

    :param table: ``(2 * rows * N, C)``: the entries of every x, then those of every z, row by row
    :param pairs: their places, ``row * N + i`` and ``rows * N + row * N + j``: ``(rows, n, 2)``, integers
    """
    return embedding_bag(pairs.flatten(0, 1).int(), table, mode="sum").view(*pairs.shape[:2], -1)


class Start(nn.Module):
    r"""
    The critics before their training: for each row the logarithmic density ratio of a multivariate t.

    With A the inverse of the scatter matrix of (x, z), and B and C the inverses of its blocks of x and of z,

    .. math::
        c + \tfrac{\nu + X}{2} \ln(1 + x^\top B x / \nu) + \tfrac{\nu + Z}{2} \ln(1 + z^\top C z / \nu)
        - \tfrac{\nu + X + Z}{2} \ln(1 + (x, z)^\top A (x, z) / \nu).

    The terms of each x and of each z are computed once and added for a pair. The last quadratic form is the squared
    length of :math:`(x, z) W` with :math:`W W^\top = A / \nu`, which is a sum of a term of x and a term of z.

    :param table: see :func:`add_up`, ``(2 * rows * N, X + Z + 1)``: the term of x or z in :math:`(x, z) W`, then the
        one in the sum of c and the logarithms of x and of z
    :param factor: factor of the last logarithm, ``(rows, 1, 1)``
    """

    def __init__(self, table: th.Tensor, factor: th.Tensor) -> None:
        super().__init__()
        self.table, self.factor = table.float(), factor.float()

    @classmethod
    def fit(cls, y: th.Tensor, train: th.Tensor, n_x: int, nu: th.Tensor, level: float) -> Start:
        """
        Fit the scatter matrix of each fold to the t-scores of its training pairs.

        :param y: t-scores of x and z with ``nu`` degrees of freedom, ``(M, N, X + Z)`` and ``(M,)``
        :param train: the training pairs of each fold, ``(K, n)``
        :param level: the critic's score that means "no information"; it is added
        """
        n_folds, dim = len(train), y.shape[-1]
        scatter = _scatter(y[:, train].flatten(0, 1), nu.repeat_interleave(n_folds)).unflatten(0, (-1, n_folds))
        nu = nu[:, None, None, None]
        root = th.linalg.inv(th.linalg.cholesky(scatter)).mT / nu.sqrt()  # W
        constant = level + th.lgamma(nu / 2) + th.lgamma((nu + dim) / 2) - th.logdet(scatter)[..., None, None] / 2
        terms = []
        for part in (slice(n_x), slice(n_x, None)):
            block, own = scatter[..., part, part], y[:, None, :, part]  # (M, 1, N, .): the same for all folds
            half = (nu + block.shape[-1]) / 2
            constant = constant - th.lgamma(half) + th.logdet(block)[..., None, None] / 2
            logarithm = half * th.log1p(_quadratic(own, th.linalg.inv(block)) / nu)
            terms.append(th.cat([own @ root[..., part, :], logarithm], -1))
        terms[0][..., -1:] += constant
        return cls(th.stack(terms).flatten(0, 3), ((nu + dim) / 2).expand(-1, n_folds, -1, -1).flatten(0, 1))

    def flat_like(self, level: float) -> Start:
        """Return a start of the same shape that is ``level`` everywhere."""
        table = th.zeros_like(self.table)
        table[: len(table) // 2, -1] = level
        return Start(table, th.zeros_like(self.factor))

    def forward(self, pairs: th.Tensor) -> th.Tensor:
        """Evaluate pairs of places in the table: ``(rows, n, 2) -> (rows, n, 1)``."""
        return self.of_sums(add_up(self.table, pairs))

    def of_sums(self, sums: th.Tensor) -> th.Tensor:
        """Evaluate the sums of the terms of x and z: ``(rows, n, X + Z + 1) -> (rows, n, 1)``."""
        quadratic = th.linalg.vector_norm(sums[..., :-1], dim=-1, keepdim=True).square_()
        return sums[..., -1:].addcmul(self.factor, quadratic.log1p_(), value=-1)


def choose_start(starts: Sequence[Start], chosen: th.Tensor) -> Start:
    """Take for each row the start with the index ``chosen``, ``(rows,)``."""
    rows = th.arange(len(chosen))
    tables = th.stack([start.table.unflatten(0, (2, len(rows), -1)) for start in starts], 2)
    factors = th.stack([start.factor for start in starts])
    return Start(tables[:, rows, chosen].flatten(0, 2), factors[chosen, rows])
