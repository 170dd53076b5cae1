"""
Several trainings as one batch: the same problem with other seeds and other weights of the information.

Networks as small as those for vectors keep a core busy with calls, not with numbers. Here one call serves all
trainings. Each comes out bit for bit as if it had been alone, so that it does not matter which trainings share a batch
(provided that the vectors that an estimator or a hidden layer works on have multiples of 64 numbers, as they have with
the usual widths and minibatches; otherwise up to rounding).

Dimension key: K trainings, T horizon, N episodes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TypeVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback

from sb3_tdpg.buffers import EpisodeBatch
from sb3_tdpg.callbacks import MINECallback
from sb3_tdpg.information.critic import CriticEstimator
from sb3_tdpg.policies import TRVPolicy
from sb3_tdpg.policy_update import PolicyUpdate
from sb3_tdpg.stacked import RandomStreams, StackedEstimator, StackedPolicy
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.vec_env import BatchedVecEnv

Result = TypeVar("Result")


@dataclass
class Member:
    """
    One training of a batch.

    :param model: It is trained in place.
    :param n_timesteps: As for :meth:`~sb3_tdpg.TDPG.learn`.
    :param callbacks: Likewise.
    :param reset_num_timesteps: Likewise; False to go on with a model that was loaded.
    :param random_state: The state of torch's generator with which the training is to begin.
    """

    model: TDPG
    n_timesteps: int
    callbacks: Sequence[BaseCallback] = ()
    reset_num_timesteps: bool = True
    random_state: th.Tensor = field(default_factory=th.get_rng_state)


class MemberDivergedError(ValueError):
    """
    One training of a batch has come to nothing: a loss or an action is NaN or infinite.

    :param index: Which.
    """

    def __init__(self, index: int, reason: str) -> None:
        super().__init__(reason)
        self.index = index


def batch_key(model: TDPG) -> Hashable | None:
    """
    Tell which models can be trained as one batch: those with the same key; None for one that must be trained alone.

    They may differ in the seed and in beta, but not in whether there is a penalty, nor in how far they are. All
    episodes of an epoch must run side by side in a :class:`~sb3_tdpg.vec_env.BatchedVecEnv`, and an update must be one
    pass over all of them. A feature extractor with parameters (of images) has no use for a batch.
    """
    policy, estimator, env = model.policy, model.estimator, model.env
    fits = (
        type(policy) is TRVPolicy
        and type(env) is BatchedVecEnv
        and env.num_envs == model.n_episodes
        and model.device.type == "cpu"
        and isinstance(model.beta, float)
        and model.n_epochs == 1
        and model.bptt_steps is None
        and model.batch_size is None
        and model.clip_range == math.inf
        and not any(True for _ in policy.features_extractor.parameters())
    )
    critics: tuple[bool, ...] = ()
    if isinstance(estimator, CriticEstimator):
        fits = fits and estimator.held_out == 0 and estimator.reset_moments
        critics = (estimator.is_warm,)
    else:
        # What another estimator has learnt would have to be divided among the trainings.
        fits = fits and not estimator.state_dict()
    if not fits:
        return None
    shape = policy._get_constructor_parameters()
    for name in ("lr_schedule", "optimizer_class", "optimizer_kwargs"):  # every model keeps an optimiser of its own
        shape.pop(name)
    run = (model.encoder_gradient, model.n_episodes, model.state_dim, model.mi_coef > 0.0, model.epoch)
    return repr((shape, type(estimator), model.mi_kwargs, critics, run))


class _SharedFit(MINECallback):
    """Stands in for :class:`MINECallback`: the critics of all trainings have been fitted together."""

    def __init__(self) -> None:
        super().__init__()
        self.result: tuple[dict[str, float], np.ndarray] | None = None

    def _fit(self) -> tuple[dict[str, float], np.ndarray]:
        assert self.result is not None
        return self.result


class TrainingBatch:
    """
    K trainings that are carried on together.

    :param members: Their models have the same :func:`batch_key`, and they have the same number of timesteps to go.
    """

    def __init__(self, members: Sequence[Member]) -> None:
        self.members = list(members)
        self.models = [member.model for member in members]
        keys = {batch_key(model) for model in self.models}
        if len(keys) != 1 or None in keys:
            raise ValueError(
                "these models do not fit into one batch: they may differ in seed and beta only; train them one by one"
            )
        self.streams = RandomStreams([member.random_state for member in members])
        first = self.models[0]
        self.has_penalty = first.mi_coef > 0.0
        self.policy = StackedPolicy([model.policy for model in self.models])
        self.estimator = StackedEstimator([model.estimator for model in self.models], first.mi_kwargs, self.streams)
        self.fits = [_SharedFit() for _ in members]
        self.callbacks: list[BaseCallback] = []

    def learn(self) -> None:
        """
        Train all, as :meth:`~sb3_tdpg.TDPG.learn` trains one.

        :raises MemberDivergedError: if a loss or an action of one is NaN or infinite. The others keep their last
            parameters, but have not finished.
        """
        totals = []
        for k, (member, fit) in enumerate(zip(self.members, self.fits, strict=True)):
            with self.streams.of(k):
                total, callback = member.model._setup_learn(
                    member.n_timesteps, [fit, *member.callbacks], member.reset_num_timesteps, "TDPG"
                )
                callback.on_training_start(locals(), globals())
            totals.append(total)
            self.callbacks.append(callback)
        iteration = 0
        while all(model.num_timesteps < total for model, total in zip(self.models, totals, strict=True)):
            self.policy.read()
            self._collect_rollouts()
            self._fit_critics()
            iteration += 1
            for k, (model, callback, total) in enumerate(zip(self.models, self.callbacks, totals, strict=True)):
                with self.streams.of(k):
                    callback.on_rollout_end()
                model._update_current_progress_remaining(model.num_timesteps, total)
                model.dump_logs(iteration)
            self._train()
        for callback in self.callbacks:
            callback.on_training_end()

    def _collect_rollouts(self) -> None:
        """See :meth:`~sb3_tdpg.TDPG.collect_rollouts`; all episodes are equally long."""
        observations: list[np.ndarray] = []
        for k, (model, callback) in enumerate(zip(self.models, self.callbacks, strict=True)):
            model.policy.set_training_mode(False)
            model.rollout_buffer.reset()
            with self.streams.of(k):
                callback.on_rollout_start()
            assert model.env is not None
            observations.append(cast(np.ndarray, model.env.reset() if model._last_obs is None else model._last_obs))
            model._last_obs = None
        envs = [cast(BatchedVecEnv, model.env) for model in self.models]
        states = [np.stack([info["state"] for info in env.reset_infos]) for env in envs]
        first = self.models[0]
        trvs = th.zeros(len(envs), first.n_episodes, first.policy.trv_dim)
        space = cast(spaces.Box, first.action_space)
        for t in range(first.horizon):
            with th.no_grad():
                step = self.policy.step_together(th.as_tensor(np.stack(observations)), trvs, t, self.streams)
            trvs = step.trvs
            arrays = {name: x.numpy() for name, x in step._asdict().items()}
            env_actions = np.clip(arrays["actions"].reshape(*trvs.shape[:2], *space.shape), space.low, space.high)
            for k, (model, callback, env) in enumerate(zip(self.models, self.callbacks, envs, strict=True)):
                stored = {name: array[k] for name, array in arrays.items()}
                stored.update(observations=observations[k], states=states[k])
                if t < first.horizon - 1:
                    states[k], observations[k], costs, _ = self._of_member(k, partial(env.advance, env_actions[k]))
                else:
                    last_observation, rewards, dones, infos = self._of_member(k, partial(env.step, env_actions[k]))
                    costs = -rewards
                    model._update_info_buffer(infos, dones)
                    model._last_obs = last_observation  # type: ignore[assignment]
                model.rollout_buffer.add_step(t, slice(None), costs=costs, **stored)
                model.num_timesteps += env.num_envs
                with self.streams.of(k):
                    callback.on_step()
        for model in self.models:
            model.rollout_buffer.full = True

    def _fit_critics(self) -> None:
        """Lines 3 to 5 of Algorithm 2, alg:trv-policy, for the callbacks to hand over to their models."""
        batches = (model.rollout_buffer.episode_batch() for model in self.models)
        self.batch = EpisodeBatch(*(th.cat(x) for x in zip(*batches, strict=True)))
        if not self.has_penalty:
            return
        batch = self.batch.information_batch()
        diagnostics = self.estimator.fit(batch)
        with th.no_grad():
            information = self.estimator(batch).numpy()
        for fit, result in zip(self.fits, zip(diagnostics, information, strict=True), strict=True):
            fit.result = result

    def _train(self) -> None:
        """See :meth:`~sb3_tdpg.TDPG.train`."""
        updates = [self._of_member(k, partial(PolicyUpdate, model)) for k, model in enumerate(self.models)]
        log_prob, rebuilt = self.policy.evaluate_episodes(
            self.batch, self.models[0].encoder_gradient, rebuild=self.has_penalty
        )
        information: Sequence[th.Tensor | None] = [None] * len(self.models)
        if self.has_penalty and rebuilt is not None:
            batch = self.batch.information_batch()._replace(**rebuilt._asdict())
            information = list(self.estimator(batch))
        losses = [
            self._of_member(k, partial(update.loss, slice(None), log_prob_k, information_k))
            for k, (update, log_prob_k, information_k) in enumerate(
                zip(updates, log_prob.chunk(len(updates)), information, strict=True)
            )
        ]
        self.policy.zero_grad()
        th.stack(losses).sum().backward()
        self.policy.hand_out_gradients()
        for k, update in enumerate(updates):
            self._of_member(k, update.descend)
            update.finish()

    @staticmethod
    def _of_member(k: int, call: Callable[[], Result]) -> Result:
        """Call something of one training, and say which it was if it has diverged."""
        try:
            return call()
        except ValueError as e:
            raise MemberDivergedError(k, str(e)) from e
