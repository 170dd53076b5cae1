"""
A phase of training that removes what the actions know of a nuisance of the sensor.

Dimension key: T horizon, N episodes, Z TRVs, U action.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch.distributions import Distribution, kl_divergence

BATCH_STEPS = 400  # of a gradient step: 16 episodes of 25 steps


class Behaviour(NamedTuple):
    """What a policy does in N episodes, for given noise of the TRVs."""

    trvs: th.Tensor  #: ``(T, N, Z)``
    actions: list[Distribution]  #: pi(. | x~_t), ``(T * N, ...)``; several for a ``MultiDiscrete`` space


def behaviour(policy: Any, batch: Any, observations: Any) -> Behaviour:
    """
    Unroll a policy over recorded episodes with the recorded noise of the TRVs, but with these observations.

    :param policy: A :class:`~sb3_tdpg.TRVPolicy`.
    :param batch: An :class:`~sb3_tdpg.buffers.EpisodeBatch`.
    :param observations: ``(T, N, *obs)``, or a dict of such
    """
    batch = batch._replace(observations=observations)
    trvs, *_ = policy.rebuild_trvs(policy.episode_features(batch), batch)
    actions = policy.episode_action_density(trvs).distribution
    return Behaviour(trvs, actions if isinstance(actions, list) else [actions])


def action_divergence(p: Behaviour, q: Behaviour) -> th.Tensor:
    """Compute D[pi_p || pi_q] at each step, ``(T, N)``, in nats."""
    parts = zip(p.actions, q.actions, strict=True)
    divergences = [kl_divergence(of_p, of_q).reshape(p.trvs.shape[0] * p.trvs.shape[1], -1) for of_p, of_q in parts]
    return th.cat(divergences, dim=1).sum(dim=1).view(p.trvs.shape[:2])


class NuisancePhase:
    r"""
    Removes what the actions know of a nuisance, after the passes of an epoch with plain rollouts.

    The policy on perturbed observations learns to do what it did on plain ones before the phase (the *teacher*), and on
    plain ones to stay as it was, with the same noise of the TRVs:

    .. math:: E_t\, D(\pi(\cdot | \tilde x_t^\omega) \| \bar\pi(\cdot | \tilde x_t^0))
        + D(\pi(\cdot | \tilde x_t^0) \| \bar\pi(\cdot | \tilde x_t^0)).

    :param policy: A :class:`~sb3_tdpg.TRVPolicy`.
    :param n_steps: Gradient steps of a phase.
    """

    def __init__(self, policy: Any, n_steps: int) -> None:
        if not (isinstance(n_steps, (int, np.integer)) and n_steps >= 1):
            raise ValueError(f"nuisance_steps={n_steps!r} must be an integer of at least 1, or nuisance=None")
        self.policy, self.n_steps = policy, n_steps
        self.optimizer = th.optim.Adam(policy.parameters(), lr=1e-3, fused=True)

    def perturbed(self, batch: Any, nuisance: Any) -> Any:
        """Draw members for N episodes, and return what the changed sensor shows: ``(T, N, *obs)``."""
        length, n = batch.alive.shape
        which, members = np.arange(n), nuisance.members(n)
        states = batch.states.cpu().numpy()
        seen = batch.observations
        is_dict = isinstance(seen, dict)
        arrays = {key: x.cpu().numpy() for key, x in seen.items()} if is_dict else seen.cpu().numpy()
        steps = [
            members({key: x[t] for key, x in arrays.items()} if is_dict else arrays[t], states[t], which)
            for t in range(length)
        ]
        device = batch.alive.device
        if is_dict:
            return {key: th.as_tensor(np.stack([step[key] for step in steps]), device=device) for key in arrays}
        return th.as_tensor(np.stack(steps), device=device)

    def divergence(self, batch: Any, perturbed: Any) -> th.Tensor:
        """Compute the divergence of the actions from those on plain observations, ``(T, N)``."""
        with th.no_grad():
            plain = behaviour(self.policy, batch, batch.observations)
            return action_divergence(behaviour(self.policy, batch, perturbed), plain)

    def remove(self, batch: Any, nuisance: Any, check_finite: Callable[[str, th.Tensor], None]) -> float:
        """
        Take the gradient steps of an epoch.

        :param batch: The rollouts: whole episodes, or segments of them.
        :param nuisance: A :class:`~sb3_tdpg.robustness.nuisance.Nuisance`.
        :param check_finite: Called with a name and the loss; raises an error unless it is finite.
        :return: the divergence of the new policy's actions on fresh perturbations, in nats a step
        """
        minibatches = self._minibatches(batch)
        with th.no_grad():  # the policy as it is now, for all steps
            parts = map(batch.select, minibatches)  # one at a time: images need room
            teachers = [behaviour(self.policy, part, part.observations) for part in parts]
        for columns, teacher in zip(minibatches, teachers, strict=True):
            part = batch.select(columns)
            invariance = action_divergence(behaviour(self.policy, part, self.perturbed(part, nuisance)), teacher)
            kept = action_divergence(behaviour(self.policy, part, part.observations), teacher)
            loss = (part.alive * (invariance + kept)).sum() / part.alive.sum()
            check_finite("nuisance loss", loss)
            self.optimizer.zero_grad()
            loss.backward()
            check_finite("gradient", th.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0))
            self.optimizer.step()
        fresh = batch.select(self._minibatches(batch)[0])
        left = self.divergence(fresh, self.perturbed(fresh, nuisance))
        return ((fresh.alive * left).sum() / fresh.alive.sum()).item()

    def _minibatches(self, batch: Any) -> list[th.Tensor]:
        """Draw the columns of each gradient step: about ``BATCH_STEPS`` steps, in as few passes as possible."""
        n_columns = batch.alive.shape[1]
        size = min(n_columns, max(2, round(BATCH_STEPS * n_columns / batch.alive.sum().item())))
        n_passes = math.ceil(self.n_steps * size / n_columns)
        device = batch.alive.device
        columns = th.cat([th.randperm(n_columns, device=device) for _ in range(n_passes)])
        return [columns[i * size : (i + 1) * size] for i in range(self.n_steps)]
