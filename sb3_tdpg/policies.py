"""
The recurrent stochastic policy with task-relevant variables (TRVs) between the observation and the action.

Dimension key: T horizon, N episodes or environments, Z TRVs, U action, F features of an observation.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import partial
from inspect import signature
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution, make_proba_distribution
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn
from torch.distributions import Normal
from torch.nn import functional as F

from sb3_tdpg.buffers import EpisodeBatch, PolicyStep, each_part
from sb3_tdpg.checks import (
    check_action_mean,
    check_memory,
    check_net_arch,
    check_single,
    check_time,
)
from sb3_tdpg.common.networks import MAX_TIME_VARYING_HORIZON, BatchedLinear, TimeMLP, bounded_variance
from sb3_tdpg.common.running_norms import Changes
from sb3_tdpg.envs.checks import count as check_count
from sb3_tdpg.features import ObservationNorm, TRVCnn, flat_action_space, flat_steps, observation_kind
from sb3_tdpg.presets import POLICY_DEFAULTS, PolicyDefaults, default, fill_in_extractor, fill_in_trvs

# These limits allow standard deviations of up to 7.4 for a TRV and 55 for an action, in units of the head's outputs.
MAX_TRV_VAR = math.exp(4)
MAX_ACTION_VAR = math.exp(8)


class TRVPolicy(BasePolicy):
    r"""
    Policy with encoder :math:`q^\phi(\tilde x_t | \tilde x_{t-1}, y_t)` and action head
    :math:`\pi^\psi(u_t | \tilde x_t)`.

    The encoder and the action head are diagonal Gaussians; for a discrete action space the head is SB3's distribution.
    The action head gets only the TRVs. At the first step of an episode the previous TRVs are zero.

    ``predict`` takes and returns the memory as ``state=(trv, t)``: the last TRVs, ``(n_envs, Z)``, and the index of the
    next time step, ``(n_envs,)``.

    The defaults depend on the preset: "vector", "image" (uint8), "depth" (images of floats) or "long" (vectors over a
    long horizon). See the table in "TDPG: Defaults" of the documentation and :mod:`sb3_tdpg.presets`. The presets
    "vector" and "depth" have the network sizes of the paper, except for the keypoints of "depth". The preset "paper"
    has the network sizes of the paper's ball catching.

    :param observation_space: Vectors, images with channels first, ``Discrete``, or a ``Dict`` of these.
    :param action_space: Box, Discrete, MultiDiscrete or MultiBinary.
    :param lr_schedule: Learning rate schedule.
    :param horizon: Number of time steps T; the algorithm passes the environment's horizon.
    :param preset: Name of the defaults; the algorithm passes the problem's preset. ``None``: the observation space
        alone determines the defaults.
    :param trv_dim: Number of TRVs Z.
    :param net_arch: Sizes of the hidden layers, ``dict(encoder=[...], action_head=[...])``.
    :param activation_fn: Nonlinearity of the hidden layers.
    :param time_varying: Whether each time step has its own weights. The feature extractor is always shared.
    :param skip: Whether the features are added to the means of the first TRVs. The encoder then need not learn to store
        an observation before the action head can use it.
    :param skip_changes: Whether the changes of the features since the last step are added to the means of the next
        TRVs, after those of ``skip``. Each change is scaled by how much it helps to predict the next change
        (:class:`~sb3_tdpg.common.running_norms.Changes`). Such changes reveal hidden velocities.
    :param normalize_observations: Whether vectors are standardised by the mean and the standard deviation of all
        vectors seen in training, as in SB3's ``VecNormalize``.
    :param scale_actions: Whether the head's outputs are relative to the bounds of the action space: a mean of 0 is the
        middle, and a mean of 1 is the upper bound. A standard deviation of 1 is half of the distance between the
        bounds.
    :param shared_action_noise: Whether the variance of each action is a single parameter, as in SB3's PPO (Box
        actions). Otherwise it is an output of the head and depends on the TRVs.
    :param squash_trv_mean: Whether a tanh keeps the mean of the TRVs (with ``gate``: the candidate) in [-1, 1], as in
        the paper's policies for images. Unfamiliar observations then cannot drive this mean out of [-1, 1].
    :param gate: Whether the encoder also outputs a gate g in [0, 1] for each TRV, like the update gate of a GRU. The
        gate decides how much of the last TRVs is kept: ``mean = g * candidate + (1 - g) * last TRVs``, where the
        candidate is the mean without a gate. The policy can then remember over many steps. ``gate`` cannot be combined
        with ``skip``.
    :param action_mean_init: Mean action before training, ``(U,)``, in the units of the head's outputs; default: near 0
        (Box actions).
    :param encoder_log_var_init: Constant added to the encoder's log-variance, which starts near 0.
    :param action_log_var_init: Constant added to the action head's log-variance (Box actions).
    :param encoder_var_floor: Smallest variance of a TRV: ``variance = exp(log_var) + floor``, bounded above.
    :param action_var_floor: Smallest variance of an action, applied in the same way.
    :param features_extractor_class: Network in front of the encoder; default: ``FlattenExtractor`` for vectors,
        :class:`~sb3_tdpg.features.TRVCnn` for images, SB3's ``CombinedExtractor`` for a ``Dict``.
    :param features_extractor_kwargs: Keywords of the feature extractor.
    :param normalize_images: Whether to divide uint8 images by 255.
    :param optimizer_class: Optimiser of the policy.
    :param optimizer_kwargs: Keywords of the optimiser, except the learning rate.
    :param use_sde: Must be False.
    """

    _has_warned = False  # about deterministic=True
    action_middle: th.Tensor
    action_range: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        use_sde: bool = False,
        *,
        horizon: int,
        preset: str | None = None,
        trv_dim: int | None = None,
        net_arch: dict[str, Sequence[int]] | None = None,
        activation_fn: type[nn.Module] | None = None,
        time_varying: bool | None = None,
        skip: bool | None = None,
        skip_changes: bool | None = None,
        normalize_observations: bool | None = None,
        scale_actions: bool | None = None,
        shared_action_noise: bool | None = None,
        squash_trv_mean: bool | None = None,
        gate: bool | None = None,
        action_mean_init: Sequence[float] | None = None,
        encoder_log_var_init: float | None = None,
        action_log_var_init: float | None = None,
        encoder_var_floor: float | None = None,
        action_var_floor: float = 1e-5,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        check_count("horizon", horizon)
        for name, floor in dict(encoder_var_floor=encoder_var_floor, action_var_floor=action_var_floor).items():
            if floor is not None and not floor >= 0:
                raise ValueError(f"policy_kwargs: {name}={floor} must not be negative")
        kind = observation_kind(observation_space, normalize_images=normalize_images)
        defaults = POLICY_DEFAULTS[preset or kind]
        super().__init__(
            observation_space,
            action_space,
            *fill_in_extractor(defaults, observation_space, features_extractor_class, features_extractor_kwargs),
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=False,
        )
        self.horizon = horizon
        self.preset = preset
        self.time_varying = default(time_varying, default(defaults.time_varying, horizon <= MAX_TIME_VARYING_HORIZON))
        self.normalize_observations = default(normalize_observations, defaults.is_long)
        self.scale_actions = default(scale_actions, defaults.is_long)
        self.shared_action_noise = default(shared_action_noise, defaults.is_long)
        self.squash_trv_mean = default(squash_trv_mean, not defaults.is_long)
        self.gate = default(gate, defaults.gate)
        self.activation_fn = activation_fn
        self.action_mean_init = action_mean_init
        self.encoder_log_var_init = default(encoder_log_var_init, defaults.encoder_log_var_init)
        self.action_log_var_init = default(action_log_var_init, defaults.action_log_var_init)
        self.encoder_var_floor = default(encoder_var_floor, defaults.encoder_var_floor)
        self.action_var_floor = action_var_floor
        default_arch = dict(encoder=list(defaults.encoder), action_head=list(defaults.action_head))
        self.net_arch = check_net_arch(net_arch, default_arch)

        self.features_extractor = self.make_features_extractor()
        self.features_dim = self.features_extractor.features_dim
        self.trv_dim, self.skip, self.skip_changes = fill_in_trvs(
            defaults, self.features_dim, trv_dim, skip, skip_changes
        )
        if self.gate and self.skip:
            raise ValueError("policy_kwargs: gate=True and skip=True both decide what the TRVs keep: give one of them")
        self._build(lr_schedule, defaults)

    def _build(self, lr_schedule: Schedule, defaults: PolicyDefaults) -> None:
        """Make the networks behind the feature extractor, and the optimiser."""
        action_space = self.action_space
        self.norm = ObservationNorm(self.observation_space) if self.normalize_observations else None
        self.changes = Changes(self.features_dim) if self.skip_changes else None
        self.action_dist = make_proba_distribution(flat_action_space(action_space))
        n_outputs = (3 if self.gate else 2) * self.trv_dim
        sizes = [self.trv_dim + self.features_dim, *self.net_arch["encoder"], n_outputs]
        activation = self.activation_fn or defaults.encoder_activation_fn
        self.encoder = TimeMLP(self.horizon, sizes, activation, time_varying=self.time_varying)
        sizes = [self.trv_dim, *self.net_arch["action_head"], self._n_action_parameters()]
        activation = self.activation_fn or defaults.action_head_activation_fn
        self.action_head = TimeMLP(self.horizon, sizes, activation, time_varying=self.time_varying)
        if defaults.is_long:  # start near the middle of the actions, with little more than the features in the TRVs
            self.encoder.scale_output(0.1)
            self.action_head.scale_output(0.1)
        if self.action_mean_init is not None:
            means = check_action_mean(self.action_mean_init, action_space)
            cast(BatchedLinear, self.action_head.mlp.layers[-1]).bias.data[..., : len(means)] = th.as_tensor(means)
        if self.shared_action_noise and isinstance(self.action_dist, DiagGaussianDistribution):
            self.action_log_var = nn.Parameter(th.zeros(self.action_dist.action_dim))
        if self.scale_actions and isinstance(action_space, spaces.Box):
            bounds = th.as_tensor(np.stack([action_space.low, action_space.high]).reshape(2, -1), dtype=th.float32)
            self.register_buffer("action_middle", bounds.mean(0), persistent=False)
            half = (bounds[1] - bounds[0]) / 2
            half = th.where(half > 0, half, 1.0)  # for an action with only one value
            self.register_buffer("action_range", half, persistent=False)
        self.optimizer = self.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]  # the base class has no lr, every optimiser has one
            **self.optimizer_kwargs,
        )

    @property
    def device(self) -> th.device:
        """The device of the parameters."""
        # SB3's own property searches all modules for the first parameter, at each step.
        return cast(BatchedLinear, self.action_head.mlp.layers[0]).bias.device

    def _n_action_parameters(self) -> int:
        distribution: Any = self.action_dist
        if isinstance(distribution, DiagGaussianDistribution):
            # The mean, and the log-variance where it depends on the TRVs.
            return distribution.action_dim * (1 if self.shared_action_noise else 2)
        return int(np.sum(getattr(distribution, "action_dims", None) or distribution.action_dim))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = [name for name in signature(TRVPolicy).parameters if name not in ("lr_schedule", "use_sde")]
        return {**{name: getattr(self, name) for name in names}, "lr_schedule": self._dummy_schedule}

    # -- the two conditional distributions --------------------------------------------------------------------

    def _encoder_density(
        self, parameters: th.Tensor, features: th.Tensor, prev_trv: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return the mean and the standard deviation of the TRVs from the encoder's outputs, ``(..., Z)`` each."""
        mean, log_var, *gates = parameters.chunk(3 if self.gate else 2, dim=-1)
        if self.skip:
            skipped = [features]
            if self.changes is not None:
                # Previous TRVs of zero mark the start of an episode, where nothing has changed yet.
                is_start = (prev_trv == 0).all(dim=-1, keepdim=True)
                before = th.where(is_start, features, prev_trv[..., : self.features_dim])
                skipped.append(self.changes(features, before))
            known = th.cat(skipped, dim=-1)
            mean = mean + F.pad(known, (0, self.trv_dim - known.shape[-1]))
        if self.squash_trv_mean:
            mean = th.tanh(mean)
        for gate in gates:
            mean = th.lerp(prev_trv, mean, th.sigmoid(gate))
        variance = bounded_variance(log_var + self.encoder_log_var_init, MAX_TRV_VAR, self.encoder_var_floor)
        return mean, variance.sqrt()

    def _action_distribution(self, parameters: th.Tensor) -> Distribution:
        """Return the distribution of the action from the head's outputs, ``(n, ...)`` with one batch dimension."""
        if isinstance(self.action_dist, DiagGaussianDistribution):
            return self.action_dist.proba_distribution(*self.action_gaussian(parameters))
        return self.action_dist.proba_distribution(parameters)

    def action_gaussian(self, parameters: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return the mean and log standard deviation of Box actions, ``(n, U)`` each, from the head's outputs."""
        shared = self.shared_action_noise
        mean, log_var = (parameters, self.action_log_var) if shared else parameters.chunk(2, dim=-1)
        variance = bounded_variance(log_var + self.action_log_var_init, MAX_ACTION_VAR, self.action_var_floor)
        log_std = 0.5 * th.log(variance).expand_as(mean)
        if self.scale_actions:
            mean = self.action_middle + self.action_range * mean
            log_std = log_std + self.action_range.log()
        return mean, log_std

    # -- one step, for rollouts and predict -------------------------------------------------------------------

    def step(
        self, observation: PyTorchObs, prev_trv: th.Tensor, t: np.ndarray, deterministic: bool = False
    ) -> PolicyStep:
        """
        Choose the actions of one step.

        :param observation: observations y_t, ``(N, *obs)``
        :param prev_trv: previous TRVs x~_{t-1}, ``(N, Z)``; zero at the start of an episode
        :param t: time step of each episode, ``(N,)``
        :param deterministic: Whether to use the means of the TRVs and of the action (of a discrete action: the most
            probable value) instead of samples.
        """
        mean, std = self.encoder_density(observation, prev_trv, t)
        noise = th.zeros_like(mean) if deterministic else th.randn_like(mean)
        trv = mean + std * noise
        parameters = self.action_head.at_times(trv, t)
        if isinstance(self.action_dist, DiagGaussianDistribution):  # takes a fifth of the time of a Distribution
            actions, log_std = self.action_gaussian(parameters)
            if not deterministic:
                actions = actions + log_std.exp() * th.randn_like(actions)
        else:
            actions = self._action_distribution(parameters).get_actions(deterministic)
        return PolicyStep(actions, trv, mean, std, noise)

    def clipped(self, actions: np.ndarray) -> np.ndarray:
        """Return the actions in the shape of the action space, clipped to its bounds: ``(N, *action)``."""
        actions = actions.reshape((-1, *self.action_space.shape))  # type: ignore[misc]
        if isinstance(self.action_space, spaces.Box):
            return np.clip(actions, self.action_space.low, self.action_space.high)
        return actions

    def encoder_density(
        self, observation: PyTorchObs, prev_trv: th.Tensor, t: np.ndarray
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return the mean and the standard deviation of q(x~_t | x~_{t-1}, y_t), ``(N, Z)`` each; see :meth:`step`."""
        features = self._features(observation)
        parameters = self.encoder.at_times(th.cat([prev_trv, features], dim=1), t)
        return self._encoder_density(parameters, features, prev_trv)

    def _features(self, observation: PyTorchObs) -> th.Tensor:
        """Extract the features, after standardising vectors if configured: ``(n, *obs) -> (n, F)``."""
        if self.norm is not None:
            observation = self.norm(observation)
        if isinstance(self.features_extractor, TRVCnn) and isinstance(observation, th.Tensor):
            observation = self.features_extractor.pooled(observation)  # pooling bytes is faster
        return self.extract_features(observation, self.features_extractor)

    def action_density(self, trv: th.Tensor, t: np.ndarray) -> Distribution:
        """Return pi(u_t | x~_t) for TRVs ``(N, Z)`` at time steps ``(N,)``; the next call overwrites it."""
        return self._action_distribution(self.action_head.at_times(trv, t))

    def update_statistics(self, batch: EpisodeBatch) -> None:
        """Update the statistics of observations and feature changes with an epoch, if the policy uses them."""
        if self.norm is not None:
            self.norm.update(batch.observations, batch.alive)
        if self.changes is not None:
            with th.no_grad():
                self.changes.update(self.episode_features(batch), batch.alive)

    # -- whole episodes, for training -------------------------------------------------------------------------

    def episode_features(self, batch: EpisodeBatch) -> th.Tensor:
        """Extract the features of every observation: ``(T, N, F)``."""
        flat = each_part(partial(flat_steps, self.features_extractor), batch.observations)
        return self._features(flat).unflatten(0, batch.alive.shape)

    def episode_action_density(self, trvs: th.Tensor) -> Distribution:
        """Return pi(u_t | x~_t) for TRVs ``(T, N, Z)``, as T * N distributions; the next call overwrites them."""
        return self._action_distribution(self.action_head(trvs).flatten(0, 1))

    def trv_log_prob(self, features: th.Tensor, batch: EpisodeBatch) -> th.Tensor:
        """
        Compute log q(x~_t | x~_{t-1}, y_t) at the *stored* TRVs, for the score gradient (Equation 13).

        The TRVs must be constants. With reparameterised samples that are not detached, as in
        ``Normal.log_prob(rsample())``, the gradient with respect to the mean would be zero.

        :return: log-probabilities, ``(T, N)``
        """
        parameters = self.encoder(th.cat([batch.prev_trvs, features], dim=-1))
        density = Normal(*self._encoder_density(parameters, features, batch.prev_trvs), validate_args=False)
        return density.log_prob(batch.trvs).sum(dim=-1)

    def action_log_prob(self, trvs: th.Tensor, batch: EpisodeBatch) -> th.Tensor:
        """
        Compute log pi(u_t | x~_t) at the stored actions (Equation 12).

        :param trvs: ``(T, N, Z)``: the stored TRVs for the score gradient, or the rebuilt TRVs for the pathwise
            gradient.
        :return: log-probabilities, ``(T, N)``
        """
        actions = batch.actions.flatten(0, 1)
        if isinstance(self.action_space, spaces.Discrete):
            actions = actions[:, 0]
        return self.episode_action_density(trvs).log_prob(actions).unflatten(0, trvs.shape[:2])

    def stored_log_prob(self, batch: EpisodeBatch, encoder_gradient: str) -> th.Tensor:
        """Compute the result of :meth:`evaluate_episodes` under the policy of the rollouts, from stored densities."""
        log_prob = self.action_log_prob(batch.trvs, batch)
        if encoder_gradient == "pathwise":
            return log_prob
        return log_prob + Normal(batch.means, batch.stds, validate_args=False).log_prob(batch.trvs).sum(dim=-1)

    def rebuild_trvs(self, features: th.Tensor, batch: EpisodeBatch) -> EpisodeBatch:
        """
        Unroll Equation 15, ``x~_t = mean + std * eps_t``, with the stored noise.

        Episodes start from TRVs of zero. Segments start from the stored TRVs of the step before, which are constants.

        :param features: features of the observations, ``(T, N, F)``
        :param batch: the rollouts, ``(T, N, ...)``
        :return: the rollouts with TRVs, means and stds through which gradients flow along the recurrence
        """
        trv, noise = batch.prev_trvs[0], batch.noise
        steps = []
        # unbind instead of features[t], because the gradient of each features[t] would be as large as all features.
        for t, (features_t, noise_t) in enumerate(zip(features.unbind(), noise.unbind(), strict=True)):
            parameters = self.encoder.at(th.cat([trv, features_t], dim=-1), t)
            mean, std = self._encoder_density(parameters, features_t, trv)
            trv = mean + std * noise_t
            steps.append((trv, mean, std))
        trvs, means, stds = (th.stack(x) for x in zip(*steps, strict=True))
        return batch._replace(trvs=trvs, means=means, stds=stds)

    def evaluate_episodes(
        self, batch: EpisodeBatch, encoder_gradient: str, rebuild: bool = False
    ) -> tuple[th.Tensor, EpisodeBatch | None]:
        """
        Compute the log-probability whose gradient trains the encoder and the action head.

        :param batch: whole episodes, or segments of them
        :param encoder_gradient: ``"score"`` or ``"pathwise"``, see :class:`~sb3_tdpg.TDPG`.
        :param rebuild: Whether to rebuild the TRVs from the noise even if the gradient does not need them.
        :return: the log-probability, ``(T, N)``, and the batch with rebuilt TRVs, if any
        """
        features = self.episode_features(batch)
        if encoder_gradient == "pathwise":
            rebuilt = self.rebuild_trvs(features, batch)
            return self.action_log_prob(rebuilt.trvs, batch), rebuilt
        log_prob = self.trv_log_prob(features, batch) + self.action_log_prob(batch.trvs, batch)
        return log_prob, self.rebuild_trvs(features, batch) if rebuild else None

    # -- the interface of SB3 ---------------------------------------------------------------------------------

    forward = step

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        raise NotImplementedError("the policy is recurrent: use predict() with its state")

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Choose the actions of one step.

        :param observation: one observation, or one per environment
        :param state: the memory that the last call returned; ``None`` at the start
        :param episode_start: ``(n_envs,)`` bool; the memory is cleared where it is True
        :param deterministic: Whether to use means instead of samples (of a discrete action: the most probable value).
            Without the noise, through which the bottleneck acts, the policy is not the one that was trained. The first
            such call warns. The paper's tables use ``False``.
        :return: the actions, clipped to their bounds, and the memory for the next call
        :raises ValueError: if the observation has a wrong shape, or an episode is longer than the horizon of a
            time-varying policy.
        """
        check_single(observation)
        if deterministic and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                "deterministic=True acts with means instead of samples, without the noise of the bottleneck: this is "
                "not the policy that was trained. Give deterministic=False, also to evaluate_policy and EvalCallback",
                stacklevel=3,
            )
        if self.training:
            self.set_training_mode(False)
        observation_tensor, is_vectorized = self.obs_to_tensor(observation)
        first = next(iter(observation_tensor.values())) if isinstance(observation_tensor, dict) else observation_tensor
        n_envs = len(first)
        if state is None:
            prev_trv, t = np.zeros((n_envs, self.trv_dim), np.float32), np.zeros(n_envs, np.int64)
        else:
            prev_trv, t = state
            check_memory(prev_trv, (n_envs, self.trv_dim))
        if episode_start is not None:
            start = np.asarray(episode_start, dtype=bool).reshape(-1)
            prev_trv = np.where(start[:, None], np.float32(0), prev_trv)
            t = np.where(start, 0, t)
        if self.time_varying:
            check_time(t, self.horizon)
        with th.inference_mode():
            step = self.step(observation_tensor, th.as_tensor(prev_trv, device=first.device), t, deterministic)
        actions = self.clipped(step.actions.cpu().numpy())
        return (actions if is_vectorized else actions.squeeze(axis=0)), (step.trvs.cpu().numpy(), t + 1)
