"""
Several policies of the same shape, and their information estimators, evaluated as one.

Everything comes out bit for bit as it does one by one, random numbers included.

Dimension key: K policies, T horizon, N episodes, Z task-relevant variables (TRVs), U action. What is ``(T, N, ...)``
for one policy is ``(K * T, N, ...)`` for all of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch as th

from sb3_tdpg.information import InformationBatch, InformationEstimator
from sb3_tdpg.information.critic import CriticEstimator, Pairing
from sb3_tdpg.networks import StackedTimeMLP
from sb3_tdpg.policies import PolicyStep, RebuiltTRVs, TRVPolicy


class RandomStreams:
    """
    A state of torch's global CPU generator for each of K trainings, which would otherwise share it.

    :param states: What ``torch.get_rng_state`` returned for each.
    """

    def __init__(self, states: Sequence[th.Tensor]) -> None:
        self._states = list(states)

    @contextmanager
    def of(self, k: int) -> Iterator[None]:
        """Draw from the stream of one training."""
        th.set_rng_state(self._states[k])
        try:
            yield
        finally:
            self._states[k] = th.get_rng_state()

    def each(self, draw: Callable[[], th.Tensor]) -> list[th.Tensor]:
        """Draw once from every stream."""
        drawn = []
        for k in range(len(self._states)):
            with self.of(k):
                drawn.append(draw())
        return drawn


class StackedPolicy(TRVPolicy):
    """
    K policies as one. Its parameters are copies; see :meth:`read` and :meth:`hand_out_gradients`.

    :param policies: They have the same shape, and no parameters but those of encoder and action head.
    """

    def __init__(self, policies: Sequence[TRVPolicy]) -> None:
        with th.random.fork_rng(devices=[]):  # the initial weights are replaced at once
            super().__init__(**policies[0]._get_constructor_parameters())
            self.encoder: StackedTimeMLP = StackedTimeMLP(len(policies), policies[0].encoder)  # type: ignore[assignment]
            self.action_head: StackedTimeMLP = StackedTimeMLP(len(policies), policies[0].action_head)  # type: ignore[assignment]
        self.policies = list(policies)

    def _parameters_and_parts(self) -> Iterator[tuple[th.nn.Parameter, tuple[th.nn.Parameter, ...]]]:
        """Each parameter with those that it is made of."""
        stacked, *parts = (
            [*policy.encoder.parameters(), *policy.action_head.parameters()] for policy in (self, *self.policies)
        )
        yield from zip(stacked, zip(*parts, strict=True), strict=True)

    @th.no_grad()
    def read(self) -> None:
        """Copy the parameters of the policies."""
        for stacked, parts in self._parameters_and_parts():
            th.cat(parts, out=stacked)

    def hand_out_gradients(self) -> None:
        """Give each policy its share of the gradients."""
        for stacked, parts in self._parameters_and_parts():
            assert stacked.grad is not None
            for part, gradient in zip(parts, stacked.grad.chunk(len(parts)), strict=True):
                part.grad = gradient

    def step_together(
        self, observations: th.Tensor, prev_trvs: th.Tensor, t: int, streams: RandomStreams
    ) -> PolicyStep:
        """
        Choose the actions of one step of all policies; see :meth:`TRVPolicy.step`.

        :param observations: ``(K, N, *obs)``
        :param prev_trvs: ``(K, N, Z)``
        :param t: the time step of all
        :param streams: where each draws from
        :return: ``(K, N, ...)``
        """
        features = self.extract_features(observations.flatten(0, 1), self.features_extractor)
        inputs = th.cat([prev_trvs, features.unflatten(0, observations.shape[:2])], dim=-1)
        mean, std = self._encoder_density(self.encoder.at(inputs, t))
        noise = th.stack(streams.each(lambda: th.randn_like(mean[0])))
        trvs = mean + std * noise
        parameters = iter(self.action_head.at(trvs, t))
        actions = streams.each(lambda: self.policies[0]._action_distribution(next(parameters)).get_actions())
        return PolicyStep(th.stack(actions), trvs, mean, std, noise)

    def _sigmoid(self, x: th.Tensor) -> th.Tensor:  # type: ignore[override]
        # One by one: torch computes the last few numbers of a tensor in another way, which may differ in a bit.
        parts = x.chunk(len(self.policies)) if len(x) > 1 else (x,)
        return th.cat([th.sigmoid(part) for part in parts])

    def prev_trvs(self, trvs: th.Tensor) -> th.Tensor:  # type: ignore[override]
        """See :meth:`TRVPolicy.prev_trvs`: ``(K * T, N, Z) -> (K * T, N, Z)``."""
        by_policy = trvs.unflatten(0, (-1, self.horizon))
        return th.cat([th.zeros_like(by_policy[:, :1]), by_policy[:, :-1]], dim=1).flatten(0, 1)

    def rebuild_trvs(self, features: th.Tensor, noise: th.Tensor, start: th.Tensor | None = None) -> RebuiltTRVs:
        """See :meth:`TRVPolicy.rebuild_trvs`: ``(K * T, N, ...)`` to ``(K * T, N, Z)``; ``start`` is ``(K, N, Z)``."""
        features_by_step, noise_by_step = (x.unflatten(0, (-1, self.horizon)).unbind(1) for x in (features, noise))
        unrolled = self._unroll(features_by_step, noise_by_step, start)
        return RebuiltTRVs(*(th.stack(x, dim=1).flatten(0, 1) for x in unrolled))


class StackedPairing(Pairing):
    """
    Pairs episodes for the critics of K trainings, each from its own stream.

    :param streams: One for each training.
    :param n: K
    :param horizon: T
    """

    def __init__(self, streams: RandomStreams, n: int, horizon: int) -> None:
        self._streams, self._n, self._horizon = streams, n, horizon
        self._only: int | None = None
        self.n_refits = [0] * n

    def choose(self, size: int, n_episodes: int, n: int, device: th.device) -> th.Tensor:
        """See :class:`Pairing`: ``(size, K * T, n)``."""
        return self._draw(lambda: super(StackedPairing, self).choose(size, n_episodes, n, device), dim=1)

    def derange(self, n: int, device: th.device) -> th.Tensor:
        """See :class:`Pairing`: ``(K * T, n)``."""
        return self._draw(lambda: super(StackedPairing, self).derange(n, device), dim=0)

    def _draw(self, draw: Callable[[], th.Tensor], dim: int) -> th.Tensor:
        if self._only is not None:
            return draw()
        return th.cat(self._streams.each(draw), dim).repeat_interleave(self._horizon, dim)

    def refits(self, broken: th.Tensor) -> Iterator[th.Tensor]:
        """Take the trainings one by one."""
        for k in range(self._n):
            rows = broken[broken // self._horizon == k]
            self.n_refits[k] = len(rows)
            if len(rows) > 0:
                self._only = k
                with self._streams.of(k):
                    yield rows
                self._only = None


class StackedEstimator:
    """
    The information estimators of K trainings as one.

    :param estimators: They have the same settings.
    :param settings: Their keywords.
    :param streams: One for each training.
    """

    def __init__(
        self, estimators: Sequence[InformationEstimator], settings: dict[str, Any], streams: RandomStreams
    ) -> None:
        first = estimators[0]
        with th.random.fork_rng(devices=[]):
            self._stacked = type(first)(len(estimators) * first.horizon, first.state_dim, first.trv_dim, **settings)
        self._estimators = list(estimators)
        self._pairing: StackedPairing | None = None
        if isinstance(first, CriticEstimator):
            assert isinstance(self._stacked, CriticEstimator)
            self._pairing = self._stacked.pairing = StackedPairing(streams, len(estimators), first.horizon)
            self._stacked.is_warm = first.is_warm
            parts = [dict(estimator.state_dict()) for estimator in estimators]
            tensors = {name: th.cat([part[name] for part in parts]) for name in parts[0] if name != EXTRA}
            self._stacked.load_state_dict({**tensors, EXTRA: self._stacked.get_extra_state()})

    def fit(self, batch: InformationBatch) -> list[dict[str, float]]:
        """Fit all critics; return the diagnostics of each training."""
        self._stacked.fit(batch)
        if self._pairing is None:
            return [{} for _ in self._estimators]
        tensors = dict(self._stacked.state_dict())
        tensors.pop(EXTRA)
        parts = {name: tensor.chunk(len(self._estimators)) for name, tensor in tensors.items()}
        for k, estimator in enumerate(self._estimators):
            assert isinstance(estimator, CriticEstimator)
            extra = {**estimator.get_extra_state(), "is_warm": True}
            estimator.load_state_dict({**{name: part[k] for name, part in parts.items()}, EXTRA: extra})
        return [{"critic_refits": float(n)} for n in self._pairing.n_refits]

    def __call__(self, batch: InformationBatch) -> th.Tensor:
        """Estimate I[x_t; x~_t] in nats, see :class:`InformationEstimator`: ``(K, T)``."""
        return self._stacked(batch).unflatten(0, (len(self._estimators), -1))


EXTRA = "_extra_state"  # the name under which torch keeps it
