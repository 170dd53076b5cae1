"""
Where critics of i.i.d. pairs start from: the density ratio of the t-copula that fits the pairs best.

Dimension key: M problems, K folds, N pairs, X and Z components of the two variables, D components of either or both.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from scipy.special import stdtrit
from torch import nn

DEGREES_OF_FREEDOM = tuple(1.5**i for i in range(11))  # 1 to 58
NORMAL = 1e6  # degrees of freedom that are as good as infinitely many
N_SCATTER_STEPS = 5


def t_scores(ranks: th.Tensor, nu: th.Tensor) -> th.Tensor:
    """Quantiles of Student's t at the ranks, for some degrees of freedom: ``(M, N, D), (M, L) -> (M, L, N, D)``."""
    n = ranks.shape[1]
    position = (2 * n * ranks).round().long()
    # Of every rank that there is, and from one half alone: quantiles are dear, ranks few and the density symmetric.
    folded = th.minimum(position, 2 * n - position)
    there = folded.unique()
    quantiles = nu.new_zeros(*nu.shape, n + 1)
    quantiles[..., there] = th.as_tensor(stdtrit(nu[..., None].numpy(), there.numpy() / (2 * n)))
    scores = quantiles.gather(2, folded.flatten(1)[:, None].expand(-1, nu.shape[1], -1))
    return scores.unflatten(2, ranks.shape[1:]) * (1 - 2 * (position > n).double())[:, None]


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


def degrees_of_freedom(ranks: th.Tensor) -> th.Tensor:
    """Those of :data:`DEGREES_OF_FREEDOM` for which the t-copula of all components is the most likely: ``(M,)``."""
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


class Start(nn.Module):
    r"""
    What the critics are before they are trained: the logarithmic density ratio of a multivariate t, for each row.

    With A the inverse of the scatter matrix of (x, z), and B and C those of its blocks of x and of z,

    .. math::
        c + \tfrac{\nu + X}{2} \ln(1 + x^\top B x / \nu) + \tfrac{\nu + Z}{2} \ln(1 + z^\top C z / \nu)
        - \tfrac{\nu + X + Z}{2} \ln(1 + (x, z)^\top A (x, z) / \nu).

    What each x and each z bring to it is worked out once: the last quadratic form is then the inner product of two
    vectors, and so cheap for any pair of them.

    :param of_x: ``(rows * N, Z + 3)``: :math:`(2 x^\top A / \nu, x^\top A x / \nu, 1)`, then c and the logarithm of x
    :param of_z: ``(rows * N, Z + 3)``: :math:`(z, 1, z^\top A z / \nu)`, then the logarithm of z
    :param factor: of the last logarithm, ``(rows, 1, 1)``
    """

    def __init__(self, of_x: th.Tensor, of_z: th.Tensor, factor: th.Tensor) -> None:
        super().__init__()
        self.of_x, self.of_z, self.factor = of_x.float(), of_z.float(), factor.float()
        self._all_but_last = th.ones(of_x.shape[-1])
        self._all_but_last[-1] = 0

    @classmethod
    def fit(cls, y: th.Tensor, train: th.Tensor, n_x: int, nu: th.Tensor, level: float) -> Start:
        """
        Fit the scatter matrix of each fold to the t-scores of its training pairs.

        :param y: of x and z, ``(M, N, X + Z)``
        :param train: pairs that each fold trains on, ``(K, n)``
        :param n_x: X
        :param nu: degrees of freedom, ``(M,)``
        :param level: what is added: the score at which the critic says "no information"
        """
        n_problems, n_folds, dim, n_z = len(y), len(train), y.shape[-1], y.shape[-1] - n_x
        scatter = _scatter(y[:, train].flatten(0, 1), nu.repeat_interleave(n_folds)).unflatten(0, (-1, n_folds))
        nu = nu[:, None]
        parts = slice(None), slice(n_x), slice(n_x, None)
        blocks = [scatter[..., part, part] for part in parts]
        constant = level + th.lgamma(nu / 2)
        for block, sign in zip(blocks, (1, -1, -1), strict=True):
            constant = constant + sign * (th.lgamma((nu + block.shape[-1]) / 2) - th.logdet(block) / 2)
        inverse, inverse_x, inverse_z = (th.linalg.inv(block) for block in blocks)
        constant, nu = constant[..., None, None], nu[..., None, None]
        x, z = (y[:, None, :, part] for part in parts[1:])  # (M, 1, N, .): the same for all folds
        one = y.new_ones(n_problems, n_folds, y.shape[1], 1)
        of_x = [
            2 / nu * x @ inverse[..., :n_x, n_x:],
            _quadratic(x, inverse[..., :n_x, :n_x]) / nu,
            one,
            constant + (nu + n_x) / 2 * th.log1p(_quadratic(x, inverse_x) / nu),
        ]
        of_z = [
            z.expand(-1, n_folds, -1, -1),
            one,
            _quadratic(z, inverse[..., n_x:, n_x:]) / nu,
            (nu + n_z) / 2 * th.log1p(_quadratic(z, inverse_z) / nu),
        ]
        factor = ((nu + dim) / 2).expand(-1, n_folds, -1, -1)
        return cls(th.cat(of_x, -1).flatten(0, 2), th.cat(of_z, -1).flatten(0, 2), factor.flatten(0, 1))

    def flat_like(self, level: float) -> Start:
        """Return a start of the same shape that is ``level`` everywhere."""
        of_x = th.zeros_like(self.of_x)
        of_x[..., -1] = level
        return Start(of_x, th.zeros_like(self.of_z), th.zeros_like(self.factor))

    def forward(self, pairs: th.Tensor) -> th.Tensor:
        """Evaluate at pairs of the numbers of x and of z, ``row * N + i``: ``(rows, n, 2) -> (rows, n, 1)``."""
        return self.at(*numbers_of(pairs))

    def at(self, numbers_x: th.Tensor, numbers_z: th.Tensor) -> th.Tensor:
        """The same for ``(rows * n,)`` numbers each."""
        of_x, of_z = self.of_x.index_select(0, numbers_x), self.of_z.index_select(0, numbers_z)
        marginals = of_x[:, -1] + of_z[:, -1]
        # Rounding may take the quadratic form below 0.
        quadratic = of_x.mul_(of_z).mv(self._all_but_last).clamp_(min=0)
        shape = len(self.factor), -1, 1
        return marginals.view(shape).addcmul_(self.factor, quadratic.log1p_().view(shape), value=-1)


def choose_start(starts: Sequence[Start], chosen: th.Tensor) -> Start:
    """Take for each row the start whose number ``chosen`` ``(rows,)`` gives."""
    n_rows = len(chosen)
    fields = zip(*((start.of_x, start.of_z, start.factor) for start in starts), strict=True)
    of_rows = (th.stack([values.view(n_rows, -1, values.shape[-1]) for values in field]) for field in fields)
    of_x, of_z, factor = (values[chosen, th.arange(n_rows)] for values in of_rows)
    return Start(of_x.flatten(0, 1), of_z.flatten(0, 1), factor)


def numbers_of(pairs: th.Tensor) -> tuple[th.Tensor, ...]:
    """Of the x and of the z, whole: ``(rows, n, 2) -> (rows * n,), (rows * n,)``."""
    return pairs.reshape(-1, 2).T.long().contiguous().unbind()
