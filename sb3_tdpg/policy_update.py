"""
The update of the policy from the rollouts of one epoch (line 6 of Algorithm 2).

Dimension key: T horizon, N episodes of an epoch, n episodes of a minibatch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch as th

from sb3_tdpg.advantages import get_baseline
from sb3_tdpg.buffers import EpisodeBatch
from sb3_tdpg.losses import clipped_policy_loss, information_loss, normalized, policy_gradient_loss
from sb3_tdpg.policies import RebuiltTRVs

if TYPE_CHECKING:
    from sb3_tdpg.tdpg import TDPG


class TrainingDivergedError(ValueError):
    """A loss is NaN or infinite. The model keeps the last good parameters."""


class PolicyUpdate:
    """
    One update: what stays the same however often the rollouts are passed through, and the steps of the passes.

    :param model: The rollouts are in its buffer, and its critics are fitted to them.
    :raises TrainingDivergedError: if a cost or the information is NaN or infinite.
    """

    def __init__(self, model: TDPG) -> None:
        self.model = model
        model.policy.set_training_mode(True)
        model._update_learning_rate(model.policy.optimizer)
        self.batch: EpisodeBatch = model.rollout_buffer.episode_batch()
        costs, alive = self.batch.costs, self.batch.alive
        self._check_finite({"costs": costs})
        if model.auto_weight is not None:
            assert model.information is not None
            self._check_finite({"information": th.as_tensor(model.information)})
            model.auto_weight.update(costs.sum(0).mean().item(), float(model.information.sum()))
        self.mi_coef = model.mi_coef
        self.advantages = get_baseline(model.baseline)(
            costs, self.batch.states, alive, model.gamma, model.gae_lambda
        )  # (T, N)
        self.cost_scale = th.ones(())  # what the advantages were divided by
        if model.normalize_advantage:
            negligible = 1e-5 * costs.abs().max()
            self.advantages, self.cost_scale = normalized(self.advantages, alive, negligible)
        self.clip_range = model.clip_range_schedule(model._current_progress_remaining)
        self.old_log_prob: th.Tensor | None = None  # (T, N) of the policy that made the rollouts
        if self.clip_range < math.inf:
            with th.no_grad():
                self.old_log_prob = th.empty_like(costs)
                for episodes in self.minibatches():
                    self.old_log_prob[:, episodes] = self._evaluate(self.batch.select(episodes))[0]

    def minibatches(self) -> Sequence[th.Tensor | slice]:
        """Columns of the episodes of each minibatch: a random partition into nearly equal parts, or one of all."""
        model = self.model
        n_parts = 1 if model.batch_size is None else math.ceil(model.n_episodes / model.batch_size)
        if n_parts == 1:
            return [slice(None)]
        # Nearly equal: nothing can be estimated from the one episode that might remain.
        return th.randperm(model.n_episodes, device=model.device).tensor_split(n_parts)

    def step(self, episodes: th.Tensor | slice) -> None:
        """
        Make one step of the optimiser on a minibatch.

        :param episodes: Its columns.
        :raises TrainingDivergedError: if the loss or the gradient is NaN or infinite.
        """
        part = self.batch.select(episodes)
        log_prob, rebuilt = self._evaluate(part, rebuild=self.mi_coef > 0.0)
        information = None
        if rebuilt is not None and self.mi_coef > 0.0:
            information = self.model.estimator(part.information_batch()._replace(**rebuilt._asdict()))
        loss = self.loss(episodes, log_prob, information)
        self.model.policy.optimizer.zero_grad()
        loss.backward()
        self.descend()

    def loss(self, episodes: th.Tensor | slice, log_prob: th.Tensor, information: th.Tensor | None) -> th.Tensor:
        """
        Compute the loss of some episodes, and log it: their cost, and the penalty on the information.

        :param episodes: Their columns.
        :param log_prob: of what was sampled, ``(T, n)``
        :param information: I[x_t; x~_t] in nats, ``(T,)``; None without a penalty
        :return: scalar
        :raises TrainingDivergedError: if it is NaN or infinite.
        """
        logger = self.model.logger
        advantages, alive = self.advantages[:, episodes], self.batch.alive[:, episodes]
        if self.old_log_prob is None:
            policy_loss = policy_gradient_loss(log_prob, advantages, alive)
        else:
            old = self.old_log_prob[:, episodes]
            policy_loss = clipped_policy_loss(log_prob, old, advantages, alive, self.clip_range)
            self._record_distance(log_prob.detach() - old, alive)
        loss = policy_loss
        if information is not None:
            penalty = self.mi_coef * information_loss(information)
            loss = loss + penalty / self.cost_scale
            logger.record_mean("train/mi_loss", penalty.item())
        self._check_finite({"policy loss": policy_loss, "loss": loss})
        logger.record_mean("train/policy_loss", policy_loss.item())
        logger.record_mean("train/loss", loss.item())
        return loss

    def descend(self) -> None:
        """
        Make one step along the gradients.

        :raises TrainingDivergedError: if they are not finite; the parameters stay as they are.
        """
        policy = self.model.policy
        grad_norm = th.nn.utils.clip_grad_norm_(policy.parameters(), self.model.max_grad_norm)
        self._check_finite({"gradient": grad_norm})
        self.model.logger.record_mean("train/grad_norm", grad_norm.item())
        policy.optimizer.step()

    def finish(self) -> None:
        """Count the policy epoch, and log it."""
        model = self.model
        model.epoch += 1
        model._n_updates += model.n_epochs
        mean_cost = self.batch.costs.sum(0).mean().item()
        total = 0.0 if model.information is None else float(model.information.sum())
        model.logger.record("train/objective", mean_cost + self.mi_coef * total)
        model.logger.record("train/mi_coef", self.mi_coef)
        model.logger.record("train/trv_std", self.batch.stds.mean().item())
        model.logger.record("train/n_updates", model._n_updates, exclude="tensorboard")

    def _evaluate(self, batch: EpisodeBatch, rebuild: bool = False) -> tuple[th.Tensor, RebuiltTRVs | None]:
        model = self.model
        return model.policy.evaluate_episodes(batch, model.encoder_gradient, model.bptt_steps, rebuild)

    def _record_distance(self, log_ratio: th.Tensor, alive: th.Tensor) -> None:
        """Log how far the policy has moved from that of the rollouts, as SB3's PPO does."""
        log_ratio = th.where(alive > 0, log_ratio, 0.0)
        n = alive.sum()
        kl = (th.exp(log_ratio) - 1.0 - log_ratio).sum() / n  # http://joschu.net/blog/kl-approx.html
        clipped = ((th.exp(log_ratio) - 1.0).abs() > self.clip_range).sum() / n
        self.model.logger.record_mean("train/approx_kl", kl.item())
        self.model.logger.record_mean("train/clip_fraction", clipped.item())

    def _check_finite(self, values: dict[str, th.Tensor]) -> None:
        """Stop, while the parameters are still good, if something is NaN or infinite."""
        for name, value in values.items():
            if not bool(th.isfinite(value).all()):
                raise self._diverged(name)

    def _diverged(self, name: str) -> TrainingDivergedError:
        model = self.model
        model._last_obs = None
        return TrainingDivergedError(
            f"the {name} of epoch {model.epoch} is NaN or infinite (after {model.num_timesteps} timesteps). The model "
            "keeps the parameters from before this update. Check the environment's costs and observations; a smaller "
            "learning_rate, max_grad_norm=1, or a larger encoder_var_floor in policy_kwargs help against exploding "
            "log-probabilities"
        )
