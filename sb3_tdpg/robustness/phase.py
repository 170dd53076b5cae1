"""
Add a phase to the training in which the policy learns to ignore a nuisance of the sensor.

Dimension key: T horizon, N episodes, Z TRVs, U action.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.utils import update_learning_rate
from stable_baselines3.common.vec_env import unwrap_vec_normalize
from torch.distributions import Distribution, kl_divergence

from sb3_tdpg.buffers import each_part
from sb3_tdpg.callbacks import TDPGCallback
from sb3_tdpg.envs.checks import count as check_count
from sb3_tdpg.robustness.core import take
from sb3_tdpg.robustness.families import Family
from sb3_tdpg.robustness.nuisance import NuisanceVecEnv, held_family

BATCH_STEPS = 400  # time steps per gradient step, for instance 16 episodes of 25 steps


def actions(policy: Any, batch: Any) -> list[Distribution]:
    """
    Return the action distributions of a policy in episodes or segments, given the recorded noise of the TRVs.

    :param policy: A :class:`~sb3_tdpg.TRVPolicy`.
    :param batch: An :class:`~sb3_tdpg.buffers.EpisodeBatch`.
    :return: The distributions pi(. | x~_t), ``(T * N, ...)``: several for a ``MultiDiscrete`` space, otherwise one.
    """
    trvs = policy.rebuild_trvs(policy.episode_features(batch), batch).trvs
    densities = policy.episode_action_density(trvs).distribution
    return densities if isinstance(densities, list) else [densities]


def divergence(p: list[Distribution], q: list[Distribution], batch: Any) -> th.Tensor:
    """Compute the KL divergence D[pi_p || pi_q], averaged over the time steps of the episodes, in nats per step."""
    parts = zip(p, q, strict=True)
    by_part = [kl_divergence(of_p, of_q).reshape(batch.alive.numel(), -1).sum(dim=1) for of_p, of_q in parts]
    return (batch.alive * th.stack(by_part).sum(dim=0).view_as(batch.alive)).sum() / batch.alive.sum()


class NuisancePhase(TDPGCallback):
    r"""
    Train the policy to ignore a nuisance, in a phase after each epoch with unperturbed rollouts.

    The *teacher* :math:`\bar\pi` is the policy before the phase, with unperturbed observations. In the phase, the
    policy learns to act like the teacher on perturbed observations (superscript :math:`\omega`) and on unperturbed
    observations (superscript 0). The noise of the TRVs is the same in all terms of the loss:

    .. math:: E_t\, D(\pi(\cdot | \tilde x_t^\omega) \| \bar\pi(\cdot | \tilde x_t^0))
        + D(\pi(\cdot | \tilde x_t^0) \| \bar\pi(\cdot | \tilde x_t^0)).

    In the list of callbacks of ``learn``, put this callback before a :class:`~sb3_tdpg.TrainingCheckpointCallback`. If
    a training is resumed, the optimiser of the phase starts anew.

    :param nuisance: ``"auto"`` for random changes of images of bytes (which each episode keeps, except for the noise)
        or of depth images, or a declaration of a :class:`~sb3_tdpg.robustness.families.Family`.
    :param n_steps: Number of gradient steps per phase.
    :raises ValueError: if a perturbation does not exist or does not apply, or the rollouts are perturbed by TDPG's
        ``nuisance`` or normalised (``VecNormalize``).
    """

    optimizer: th.optim.Optimizer
    family: Family

    def __init__(self, nuisance: Any = "auto", n_steps: int = 24, verbose: int = 0) -> None:
        super().__init__(verbose)
        check_count("n_steps", n_steps)
        self.nuisance, self.n_steps = nuisance, n_steps

    def _init_callback(self) -> None:
        env = self.tdpg.env
        assert env is not None
        if isinstance(env, NuisanceVecEnv):
            raise ValueError("NuisancePhase needs plain rollouts: give TDPG nuisance=None")
        if (normalize := unwrap_vec_normalize(env)) is not None and normalize.norm_obs:
            raise ValueError(
                "NuisancePhase perturbs the observations of the rollouts, which VecNormalize has normalised: give "
                "norm_obs=False and policy_kwargs=dict(normalize_observations=True)"
            )
        self.family = held_family(self.nuisance, env)
        self.tdpg._last_obs = None  # reset the environment again, since a scale may have been measured in it
        self.optimizer = th.optim.Adam(self.tdpg.policy.parameters(), lr=1e-3, fused=True)

    def _on_training_start(self) -> None:
        self._epoch = self.tdpg.epoch

    def _on_rollout_start(self) -> None:  # the rollouts of the last epoch are still there
        model: Any = self.tdpg
        if model.epoch == self._epoch:
            return
        self._epoch = model.epoch
        batch = model.rollout_buffer.episode_batch(whole_horizon=model.policy.time_varying)
        update_learning_rate(self.optimizer, model.lr_schedule(model._current_progress_remaining))
        model.policy.set_training_mode(True)
        self.logger.record("nuisance/action_kl", self.remove(batch))
        model.policy.set_training_mode(False)

    def _on_training_end(self) -> None:
        self._on_rollout_start()

    def remove(self, batch: Any) -> float:
        """
        Take the gradient steps of a phase.

        :param batch: The rollouts as whole episodes, since a member of the nuisance lasts for an episode.
        :return: Divergence between the new policy's action distributions with and without newly drawn perturbations, in
            nats per step.
        """
        policy, check_finite = self.tdpg.policy, self.tdpg._check_finite
        teacher = copy.deepcopy(policy)
        for _ in range(self.n_steps):
            plain, perturbed = self._some(batch)
            with th.no_grad():
                target = actions(teacher, plain)
            loss = th.stack([divergence(actions(policy, each), target, each) for each in (perturbed, plain)]).sum()
            check_finite("nuisance loss", loss)
            self.optimizer.zero_grad()
            loss.backward()
            check_finite("gradient", th.nn.utils.clip_grad_norm_(policy.parameters(), 1.0))
            self.optimizer.step()
        plain, perturbed = self._some(batch)
        with th.no_grad():
            return divergence(actions(policy, perturbed), actions(policy, plain), plain).item()

    def _some(self, batch: Any) -> tuple[Any, Any]:
        """Draw episodes with about ``BATCH_STEPS`` steps; return them as they are, and perturbed."""
        model: Any = self.tdpg
        n = batch.alive.shape[1]
        size = min(n, max(2, round(BATCH_STEPS * n / batch.alive.sum().item())))
        plain = batch.select(th.randperm(n, device=batch.alive.device)[:size])
        both = plain, plain._replace(observations=self.perturbed(plain))
        if model.policy.time_varying:
            return both
        plain, perturbed = (each.segments(model.bptt_steps or len(batch.costs)) for each in both)
        return plain, perturbed

    def perturbed(self, batch: Any) -> Any:
        """Draw a member of the nuisance for each of N episodes; return the perturbed observations: ``(T, N, *obs)``."""
        members = self.family.members(batch.alive.shape[1], seed=int(th.randint(2**31, ())))
        plain = each_part(lambda x: x.cpu().numpy(), batch.observations)
        steps = [members(take(plain, t)) for t in range(len(batch.costs))]
        return each_part(lambda *parts: th.as_tensor(np.stack(parts), device=batch.alive.device), *steps)
