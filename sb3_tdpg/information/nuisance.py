r"""
What the policy knows of a nuisance of the sensor, given the state, and a phase of training that removes it.

A nuisance :math:`\omega` changes the observations, :math:`y_t^\omega` instead of :math:`y_t^0`, and nothing else. With
:math:`P_\omega` the distribution of an episode under it,

.. math::
    I[\omega; \tau, \tilde x] \le E_\omega D(P_\omega \| P_0)
    = E_\omega \sum_t E_{P_\omega} D\big(q(\cdot | y_t^\omega, \tilde x_{t-1}) \| q(\cdot | y_t^0, \tilde x_{t-1})\big),

because dynamics and action head are the same on both sides and cancel (``docs/guide/nuisance.md``).

Dimension key: T horizon, N episodes, Z TRVs, U action.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th
from torch.distributions import Distribution, Normal, kl_divergence

BATCH_STEPS = 400  # of a gradient step: 16 episodes of 25 steps
LEVELS = ("rollouts", "action", "trv")


class Behaviour(NamedTuple):
    """What a policy does in N episodes, for given noise of the TRVs."""

    trvs: th.Tensor  #: ``(T, N, Z)``
    encoder: Normal  #: q(. | x~_{t-1}, y_t), ``(T, N, Z)``
    actions: list[Distribution]  #: pi(. | x~_t), ``(T * N, ...)``; several for a ``MultiDiscrete`` space


def behaviour(policy: Any, batch: Any, observations: Any) -> Behaviour:
    """
    Unroll a policy over recorded episodes with the recorded noise of the TRVs, but with these observations.

    :param policy: A :class:`~sb3_tdpg.TRVPolicy`.
    :param batch: An :class:`~sb3_tdpg.buffers.EpisodeBatch`.
    :param observations: ``(T, N, *obs)``, or a dict of such
    """
    batch = batch._replace(observations=observations)
    trvs, means, stds = policy.rebuild_trvs(policy.episode_features(batch), batch)
    actions = policy.episode_action_density(trvs).distribution
    return Behaviour(trvs, Normal(means, stds), actions if isinstance(actions, list) else [actions])


def action_divergence(p: Behaviour, q: Behaviour) -> th.Tensor:
    """Compute D[pi_p || pi_q] at each step, ``(T, N)``, in nats."""
    parts = zip(p.actions, q.actions, strict=True)
    divergences = [kl_divergence(of_p, of_q).reshape(p.trvs.shape[0] * p.trvs.shape[1], -1) for of_p, of_q in parts]
    return th.cat(divergences, dim=1).sum(dim=1).view(p.trvs.shape[:2])


def encoder_divergence(policy: Any, p: Behaviour, batch: Any, observations: Any) -> th.Tensor:
    """
    Compute D[q(. | x~_{t-1}, y_t of p) || q(. | x~_{t-1}, y_t)] at each step, ``(T, N)``, with the x~_{t-1} of p.

    :param observations: y_t, ``(T, N, *obs)``
    """
    prev_trvs = th.cat([batch.prev_trvs[:1], p.trvs[:-1]])
    batch = batch._replace(observations=observations, prev_trvs=prev_trvs)
    q = policy.episode_encoder_density(policy.episode_features(batch), batch)
    return kl_divergence(p.encoder, q).sum(dim=-1)


class NuisancePhase:
    r"""
    Removes what the policy knows of a nuisance, after the passes of an epoch.

    ``level="action"``: rollouts are plain. The policy on perturbed observations learns to do what it did on plain ones
    before the phase (the *teacher*), and on plain ones to stay as it was, with the same noise of the TRVs:

    .. math:: E_t\, D(\pi(\cdot | \tilde x_t^\omega) \| \bar\pi(\cdot | \tilde x_t^0))
        + D(\pi(\cdot | \tilde x_t^0) \| \bar\pi(\cdot | \tilde x_t^0)).

    ``level="trv"``: rollouts are perturbed, and the first term is the divergence of the encoder above, whose sum
    over time bounds the information; the second one keeps the actions on perturbed observations.

    ``level="rollouts"``: rollouts are perturbed, and the policy gradient alone removes what the task does not need. The
    phase takes no steps, and measures what is left.

    :param policy: A :class:`~sb3_tdpg.TRVPolicy`.
    :param n_steps: Gradient steps of a phase.
    :param level: ``"rollouts"``, ``"action"`` or ``"trv"``.
    """

    nuisance: Any = None
    """A :class:`~sb3_tdpg.robustness.nuisance.Nuisance`, once there is an environment; None: there is none."""

    def __init__(self, policy: Any, n_steps: int, level: str) -> None:
        if not (isinstance(n_steps, (int, np.integer)) and n_steps >= 1):
            raise ValueError(f"nuisance_steps={n_steps!r} must be an integer of at least 1, or nuisance=None")
        if level not in LEVELS:
            raise ValueError(f"nuisance_level={level!r} is unknown: use one of {list(LEVELS)}")
        self.policy, self.n_steps, self.level = policy, n_steps, level
        self.optimizer = th.optim.Adam(policy.parameters(), lr=1e-3, fused=True)

    def perturbed(self, batch: Any) -> Any:
        """Draw members for N episodes, and return what the changed sensor shows: ``(T, N, *obs)``."""
        if batch.plain_observations is not None:
            return batch.observations
        length, n = batch.alive.shape
        which, members = np.arange(n), self.nuisance.members(n)
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

    def divergences(self, batch: Any, perturbed: Any) -> tuple[th.Tensor, th.Tensor]:
        """Compute the divergence of the actions and of the TRVs, ``(T, N)`` each, from those on plain observations."""
        plain = batch.observations if batch.plain_observations is None else batch.plain_observations
        with th.no_grad():
            p = behaviour(self.policy, batch, perturbed)
            q = behaviour(self.policy, batch, plain)
            return action_divergence(p, q), encoder_divergence(self.policy, p, batch, plain)

    def remove(
        self, batch: Any, episode_length: float, check_finite: Callable[[str, th.Tensor], None]
    ) -> dict[str, float]:
        """
        Take the gradient steps of an epoch.

        :param batch: The rollouts: whole episodes, or segments of them.
        :param episode_length: Mean number of steps of an episode.
        :param check_finite: Called with a name and the loss; raises an error unless it is finite.
        :return: ``action_kl`` and ``trv_kl`` in nats a step and ``information`` in nats an episode, of the new policy;
            with plain rollouts on fresh perturbations
        """
        minibatches = [] if self.level == "rollouts" else self._minibatches(batch)
        with th.no_grad():  # the policy as it is now, for all steps
            parts = map(batch.select, minibatches)  # one at a time: images need room
            teachers = [behaviour(self.policy, part, part.observations) for part in parts]
        for columns, teacher in zip(minibatches, teachers, strict=True):
            part = batch.select(columns)
            n, perturbed = part.alive.sum(), self.perturbed(part)
            if self.level == "action":
                invariance = action_divergence(behaviour(self.policy, part, perturbed), teacher)
                kept = behaviour(self.policy, part, part.observations)
            else:
                kept = behaviour(self.policy, part, perturbed)
                invariance = encoder_divergence(self.policy, kept, part, part.plain_observations)
            loss = (part.alive * (invariance + action_divergence(kept, teacher))).sum() / n
            check_finite("nuisance loss", loss)
            self.optimizer.zero_grad()
            loss.backward()
            check_finite("gradient", th.nn.utils.clip_grad_norm_(self.policy.parameters(), 1.0))
            self.optimizer.step()
        (columns, *_) = self._minibatches(batch)
        fresh = batch.select(columns)
        actions, trvs = (fresh.alive * x for x in self.divergences(fresh, self.perturbed(fresh)))
        n = fresh.alive.sum()
        return dict(
            action_kl=(actions.sum() / n).item(),
            trv_kl=(trvs.sum() / n).item(),
            information=(trvs.sum() / n).item() * episode_length,
        )

    def _minibatches(self, batch: Any) -> list[th.Tensor]:
        """Draw the columns of each gradient step: about ``BATCH_STEPS`` steps, in as few passes as possible."""
        n_columns = batch.alive.shape[1]
        size = min(n_columns, max(2, round(BATCH_STEPS * n_columns / batch.alive.sum().item())))
        n_passes = math.ceil(self.n_steps * size / n_columns)
        device = batch.alive.device
        columns = th.cat([th.randperm(n_columns, device=device) for _ in range(n_passes)])
        return [columns[i * size : (i + 1) * size] for i in range(self.n_steps)]
