"""Adam on a whole network as one vector: for small networks a step costs a quarter of that of ``torch.optim.Adam``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import accumulate
from typing import Any

import torch as th
from torch import nn

VECTOR = 64  # a multiple of what any processor computes at a time


class FlatAdam:
    """
    Adam (Kingma and Ba, 2015) on the parameters of a module laid out in one vector.

    ``torch.optim.Adam`` makes the same numbers, but at the size of the critics most of its time is spent on keeping
    account of parameters and hooks.

    :param learning_rate: Learning rate; the other constants are those of ``torch.optim.Adam``.
    """

    def __init__(self, learning_rate: float) -> None:
        self.learning_rate = learning_rate
        self._moments: tuple[th.Tensor, th.Tensor, th.Tensor] | None = None  # mean, mean of squares, number of steps

    def attach(self, module: nn.Module) -> None:
        """
        Make the parameters of the module, and their gradients, views of one vector each.

        To be called again whenever the parameters may have been moved or replaced (``to``, a loaded file).
        """
        parameters = list(module.parameters())
        # Filled up: torch computes the last few numbers of a vector in another way than the others, and which these are
        # must not depend on the module being alone or part of a larger one.
        padding = parameters[0].new_zeros(-sum(parameter.numel() for parameter in parameters) % VECTOR)
        self._vector = th.cat([*(parameter.detach().flatten() for parameter in parameters), padding])
        self._gradient = th.zeros_like(self._vector)
        ends = list(accumulate(parameter.numel() for parameter in parameters))
        for parameter, end in zip(parameters, ends, strict=True):
            part = slice(end - parameter.numel(), end)
            parameter.data = self._vector[part].view_as(parameter)
            parameter.grad = self._gradient[part].view_as(parameter)
        if self._moments is None:
            count = th.zeros((), device=self._vector.device)
            self._moments = (th.zeros_like(self._vector), th.zeros_like(self._vector), count)
        else:
            mean, square, count = (moment.to(self._vector.device) for moment in self._moments)
            self._moments = (mean, square, count)

    def zero_grad(self) -> None:
        """Set the gradients to zero, where they are."""
        self._gradient.zero_()

    def step(self) -> None:
        """Descend along the gradients that the parameters hold."""
        assert self._moments is not None, "attach() first"
        mean, square, count = self._moments
        count.add_(1)
        # The kernel of torch.optim.Adam(fused=True): what that does before it takes four times as long.
        th._fused_adam_(
            [self._vector],
            [self._gradient],
            [mean],
            [square],
            [],
            [count],
            lr=self.learning_rate,
            beta1=0.9,
            beta2=0.999,
            weight_decay=0.0,
            eps=1e-8,
            amsgrad=False,
            maximize=False,
        )

    def forget(self) -> None:
        """Start anew with the moments."""
        self._moments = None

    def state_dict(self) -> dict[str, Any]:
        """Return the moments, for :meth:`load_state_dict`."""
        return {"moments": self._moments}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        moments = state["moments"]
        # Copies, as torch.optim makes them: the steps are made in place.
        self._moments = None if moments is None else (moments[0].clone(), moments[1].clone(), moments[2].clone())


class AveragedAdam(FlatAdam):
    """
    :class:`FlatAdam` that also keeps an exponential moving average of the parameters (Polyak and Juditsky, 1992).

    The average is free of most of the noise of minibatches, so that the learning rate may be large.

    :param learning_rate: See :class:`FlatAdam`.
    :param decay: The weight **on the past** of the average: 0.98 averages over about 50 steps. The first steps have
        less: after t of them it is t / (t + 10).
    """

    def __init__(self, learning_rate: float, decay: float = 0.98) -> None:
        super().__init__(learning_rate)
        self.decay = decay
        self._average: th.Tensor | None = None
        self._n_steps = 0

    def attach(self, module: nn.Module) -> None:
        """See :meth:`FlatAdam.attach`; the average begins with the parameters that are attached first."""
        super().attach(module)
        if self._average is None:
            self._average = self._vector.clone()

    def step(self) -> None:
        """Descend along the gradients that the parameters hold, and move the average."""
        assert self._average is not None, "attach() first"
        super().step()
        self._n_steps += 1
        self._average.lerp_(self._vector, 1 - min(self.decay, self._n_steps / (self._n_steps + 10)))

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Give the module the average of its parameters, for as long as the context lasts."""
        assert self._average is not None, "attach() first"
        own = self._vector.clone()
        self._vector.copy_(self._average)
        try:
            yield
        finally:
            self._vector.copy_(own)

    def forget(self) -> None:
        """Start anew with the moments and the average."""
        super().forget()
        self._average, self._n_steps = None, 0
