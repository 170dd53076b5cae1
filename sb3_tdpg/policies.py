"""
The recurrent stochastic policy with task-relevant variables (TRVs) between the observation and the action.

Dimension key: T horizon, N episodes or environments, Z TRVs, U action, F features of an observation.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution, Distribution, make_proba_distribution
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from torch import nn

from sb3_tdpg.buffers import EpisodeBatch
from sb3_tdpg.features import flat_action_space, observation_kind
from sb3_tdpg.networks import MAX_TIME_VARYING_HORIZON, TimeMLP
from sb3_tdpg.settings import POLICY_DEFAULTS

# Standard deviations of at most 7.4 for a TRV and 55 for an action.
MAX_TRV_VAR = math.exp(4)
MAX_ACTION_VAR = math.exp(8)


class PolicyStep(NamedTuple):
    """Actions and TRVs of N episodes at one time step."""

    actions: th.Tensor  # (N, U), not clipped
    trvs: th.Tensor  # (N, Z)
    means: th.Tensor  # (N, Z)
    stds: th.Tensor  # (N, Z)
    noise: th.Tensor  # (N, Z)


class RebuiltTRVs(NamedTuple):
    """The TRVs of whole episodes, rebuilt from the stored noise so that gradients flow through the recurrence."""

    trvs: th.Tensor  # (T, N, Z)
    means: th.Tensor  # (T, N, Z)
    stds: th.Tensor  # (T, N, Z)


class TRVPolicy(BasePolicy):
    r"""
    Encoder :math:`q^\phi(\tilde x_t | \tilde x_{t-1}, y_t)` and action head :math:`\pi^\psi(u_t | \tilde x_t)`.

    Both are diagonal Gaussians; for a discrete action space the head is SB3's distribution. The action head sees only
    the TRVs. At the first step of an episode the previous TRVs are zero.

    ``predict`` takes and returns the memory as ``state=(trv, t)``: the last TRVs, ``(n_envs, Z)``, and the index of the
    next time step, ``(n_envs,)``.

    Three defaults are for vectors, images (uint8) and depth images (floats). The network sizes are the paper's.

    :param observation_space: A vector, or an image with channels first.
    :param action_space: Box, Discrete, MultiDiscrete or MultiBinary.
    :param lr_schedule: Learning rate schedule.
    :param horizon: Number of time steps T; the algorithm passes the environment's.
    :param trv_dim: Number of TRVs Z; default: 2, 8, 16.
    :param net_arch: Hidden layers, ``dict(encoder=[...], action_head=[...])``; default: ``[64, 64]`` and ``[64, 64]``,
        ``[32]`` and none, ``[128, 64]`` and ``[64, 64]``.
    :param activation_fn: Nonlinearity of the hidden layers; default: ELU, tanh, tanh (encoder) and ELU (head).
    :param time_varying: Whether each time step has its own weights; default: up to a horizon of 50. The feature
        extractor is always shared.
    :param squash_trv_mean: Whether a tanh keeps the mean of the TRVs in [-1, 1], as in the paper's policies for images.
        Unfamiliar observations then cannot drive the TRVs to values that the action head has never seen.
    :param squash_trv_log_var: Whether a tanh also keeps the log-variance in [-1, 1], before ``encoder_log_var_init`` is
        added, as in the paper's policies for images. The standard deviation is then at least 0.6, which hurts.
    :param encoder_log_var_init: Constant added to the encoder's log-variance, which starts near 0; default: 0, -3, -3.
    :param action_log_var_init: The same for the action head (Box actions); default: 0, -1, -2.
    :param encoder_var_floor: Smallest variance of a TRV: ``variance = exp(log_var) + floor``, bounded above.
    :param action_var_floor: Smallest variance of an action, likewise.
    :param features_extractor_class: Network in front of the encoder; default: flatten for vectors, the paper's two
        convolutional layers for images (:class:`~sb3_tdpg.features.TRVCnn`).
    :param features_extractor_kwargs: Keywords of the feature extractor.
    :param normalize_images: Whether to divide uint8 images by 255.
    :param optimizer_class: Optimiser of the policy.
    :param optimizer_kwargs: Keywords of the optimiser, except the learning rate.
    :param use_sde: Must be False.
    """

    _has_warned = False  # of deterministic=True

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        use_sde: bool = False,
        *,
        horizon: int,
        trv_dim: int | None = None,
        net_arch: dict[str, Sequence[int]] | None = None,
        activation_fn: type[nn.Module] | None = None,
        time_varying: bool | None = None,
        squash_trv_mean: bool = True,
        squash_trv_log_var: bool = False,
        encoder_log_var_init: float | None = None,
        action_log_var_init: float | None = None,
        encoder_var_floor: float = 1e-3,
        action_var_floor: float = 1e-5,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        defaults = POLICY_DEFAULTS[observation_kind(observation_space, normalize_images=normalize_images)]
        if features_extractor_class is None:
            features_extractor_class = defaults.features_extractor_class
            features_extractor_kwargs = {**defaults.features_extractor_kwargs, **(features_extractor_kwargs or {})}
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=False,
        )
        self.horizon = horizon
        self.trv_dim = defaults.trv_dim if trv_dim is None else trv_dim
        self.time_varying = horizon <= MAX_TIME_VARYING_HORIZON if time_varying is None else time_varying
        self.squash_trv_mean = squash_trv_mean
        self.squash_trv_log_var = squash_trv_log_var
        self.activation_fn = activation_fn
        self.encoder_log_var_init = _default(encoder_log_var_init, defaults.encoder_log_var_init)
        self.action_log_var_init = _default(action_log_var_init, defaults.action_log_var_init)
        self.encoder_var_floor = encoder_var_floor
        self.action_var_floor = action_var_floor
        default_arch = dict(encoder=list(defaults.encoder), action_head=list(defaults.action_head))
        self.net_arch = _check_net_arch(net_arch, default_arch)
        for name, value in (("horizon", horizon), ("policy_kwargs: trv_dim", self.trv_dim)):
            if not (isinstance(value, (int, np.integer)) and value >= 1):
                raise ValueError(f"{name}={value!r} must be an integer of at least 1")
        for name, floor in (("encoder_var_floor", encoder_var_floor), ("action_var_floor", action_var_floor)):
            if not floor >= 0:
                raise ValueError(f"policy_kwargs: {name}={floor} must not be negative")

        self.features_extractor = self.make_features_extractor()
        self.features_dim = self.features_extractor.features_dim
        self.action_dist = make_proba_distribution(flat_action_space(action_space))
        self.encoder = TimeMLP(
            horizon,
            [self.trv_dim + self.features_dim, *self.net_arch["encoder"], 2 * self.trv_dim],
            activation_fn or defaults.encoder_activation_fn,
            time_varying=self.time_varying,
        )
        self.action_head = TimeMLP(
            horizon,
            [self.trv_dim, *self.net_arch["action_head"], self._n_action_parameters()],
            activation_fn or defaults.action_head_activation_fn,
            time_varying=self.time_varying,
        )
        self.optimizer = self.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]  # the base class takes none, every optimiser does
            **self.optimizer_kwargs,
        )

    def _n_action_parameters(self) -> int:
        """Return the number of outputs of the action head."""
        distribution: Any = self.action_dist
        if isinstance(distribution, DiagGaussianDistribution):
            return 2 * distribution.action_dim  # mean and log-variance
        return int(np.sum(getattr(distribution, "action_dims", None) or distribution.action_dim))

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        names = (
            "horizon", "trv_dim", "net_arch", "activation_fn", "time_varying", "squash_trv_mean", "squash_trv_log_var",
            "encoder_log_var_init", "action_log_var_init", "encoder_var_floor", "action_var_floor",
            "features_extractor_class", "features_extractor_kwargs", "optimizer_class", "optimizer_kwargs",
        )  # fmt: skip
        data.update({name: getattr(self, name) for name in names}, lr_schedule=self._dummy_schedule)
        return data

    # -- the two conditional distributions --------------------------------------------------------------------

    def _encoder_density(self, parameters: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return mean and standard deviation of q: ``(..., 2 Z) -> 2 x (..., Z)``."""
        mean, log_var = parameters.chunk(2, dim=-1)
        if self.squash_trv_mean:
            mean = th.tanh(mean)
        if self.squash_trv_log_var:
            log_var = th.tanh(log_var)
        variance = self._variance(log_var + self.encoder_log_var_init, MAX_TRV_VAR, self.encoder_var_floor)
        return mean, variance.sqrt()

    def _action_distribution(self, parameters: th.Tensor) -> Distribution:
        """Return the distribution of the action from the head's outputs, ``(n, ...)`` with one batch dimension."""
        if isinstance(self.action_dist, DiagGaussianDistribution):
            mean, log_var = parameters.chunk(2, dim=-1)
            variance = self._variance(log_var + self.action_log_var_init, MAX_ACTION_VAR, self.action_var_floor)
            return self.action_dist.proba_distribution(mean, 0.5 * th.log(variance))
        return self.action_dist.proba_distribution(parameters)

    def _variance(self, log_var: th.Tensor, maximum: float, floor: float) -> th.Tensor:
        # A bounded exp(log_var): unfamiliar observations would drive it to inf. A clamp would stop the gradient there.
        return maximum * th.sigmoid(log_var - math.log(maximum)) + floor

    # -- one step, for rollouts and predict -------------------------------------------------------------------

    def step(
        self, observation: PyTorchObs, prev_trv: th.Tensor, t: np.ndarray, deterministic: bool = False
    ) -> PolicyStep:
        """
        Choose the actions of one step.

        :param observation: y_t, ``(N, *obs)``
        :param prev_trv: x~_{t-1}, ``(N, Z)``; zero at the start of an episode
        :param t: time step of each episode, ``(N,)``
        :param deterministic: Use the means of the TRVs and of the action instead of samples.
        """
        mean, std = self.encoder_density(observation, prev_trv, t)
        noise = th.zeros_like(mean) if deterministic else th.randn_like(mean)
        trv = mean + std * noise
        distribution = self.action_density(trv, t)
        return PolicyStep(distribution.get_actions(deterministic), trv, mean, std, noise)

    def encoder_density(
        self, observation: PyTorchObs, prev_trv: th.Tensor, t: np.ndarray
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Return mean and standard deviation of q(x~_t | x~_{t-1}, y_t), ``(N, Z)`` each.

        :param observation: y_t, ``(N, *obs)``
        :param prev_trv: x~_{t-1}, ``(N, Z)``; zero at the start of an episode
        :param t: time step of each episode, ``(N,)``
        """
        inputs = th.cat([prev_trv, self.extract_features(observation, self.features_extractor)], dim=1)
        return self._encoder_density(self._at_times(self.encoder, inputs, t))

    def action_density(self, trv: th.Tensor, t: np.ndarray) -> Distribution:
        """
        Return pi(u_t | x~_t). The next call overwrites the returned distribution.

        :param trv: x~_t, ``(N, Z)``
        :param t: time step of each episode, ``(N,)``
        """
        return self._action_distribution(self._at_times(self.action_head, trv, t))

    @staticmethod
    def _at_times(network: TimeMLP, inputs: th.Tensor, t: np.ndarray) -> th.Tensor:
        """Evaluate a network on rows at different time steps: ``(N, I) -> (N, O)``."""
        if not network.time_varying or (t == t[0]).all():
            return network.at(inputs, int(t[0]))
        rows = [np.flatnonzero(t == step) for step in np.unique(t)]
        outputs = [network.at(inputs[r], int(t[r[0]])) for r in rows]
        return th.cat(outputs)[np.argsort(np.concatenate(rows))]

    # -- whole episodes, for training -------------------------------------------------------------------------

    def episode_features(self, batch: EpisodeBatch) -> th.Tensor:
        """Extract the features of every observation: ``(T, N, F)``."""
        observations = batch.observations.flatten(0, 1)
        if observations.dim() == 4:  # change the layout while the pixels are still bytes: it is cheaper
            observations = observations.contiguous(memory_format=th.channels_last)
        features = self.extract_features(observations, self.features_extractor)
        return features.unflatten(0, batch.observations.shape[:2])

    @staticmethod
    def prev_trvs(trvs: th.Tensor) -> th.Tensor:
        """Return x~_{t-1}, which is zero at t = 0: ``(T, N, Z) -> (T, N, Z)``."""
        return th.cat([th.zeros_like(trvs[:1]), trvs[:-1]])

    def trv_log_prob(self, features: th.Tensor, batch: EpisodeBatch) -> th.Tensor:
        """
        Compute log q(x~_t | x~_{t-1}, y_t) at the *stored* TRVs, for the score path (Equation 13).

        The stored TRVs are constants: ``Normal.log_prob(rsample())`` without a detach has zero gradient in the mean.

        :return: ``(T, N)``
        """
        mean, std = self._encoder_density(self.encoder(th.cat([self.prev_trvs(batch.trvs), features], dim=-1)))
        return th.distributions.Normal(mean, std, validate_args=False).log_prob(batch.trvs).sum(dim=-1)

    def action_log_prob(self, trvs: th.Tensor, batch: EpisodeBatch) -> th.Tensor:
        """
        Compute log pi(u_t | x~_t) at the stored actions (Equation 12).

        :param trvs: ``(T, N, Z)``: the stored ones for the score path, rebuilt ones for the pathwise gradient.
        :return: ``(T, N)``
        """
        parameters = self.action_head(trvs).flatten(0, 1)  # (T * N, .)
        actions = batch.actions.flatten(0, 1)
        if isinstance(self.action_space, spaces.Discrete):
            actions = actions[:, 0]
        return self._action_distribution(parameters).log_prob(actions).unflatten(0, trvs.shape[:2])

    def rebuild_trvs(self, features: th.Tensor, noise: th.Tensor, start: th.Tensor | None = None) -> RebuiltTRVs:
        """
        Unroll Equation 15, ``x~_t = mean + std * eps_t``, from t = 0 with the stored noise.

        :param features: ``(T, N, F)``
        :param noise: eps_t, ``(T, N, Z)``
        :param start: x~_{-1}, ``(N, Z)``; default: zero
        """
        trv = th.zeros_like(noise[0]) if start is None else start
        steps = []
        # unbind, not features[t]: the gradient of each features[t] would be as large as all features.
        for t, (features_t, noise_t) in enumerate(zip(features.unbind(), noise.unbind(), strict=True)):
            mean, std = self._encoder_density(self.encoder.at(th.cat([trv, features_t], dim=-1), t))
            trv = mean + std * noise_t
            steps.append((trv, mean, std))
        return RebuiltTRVs(*(th.stack(x) for x in zip(*steps, strict=True)))

    def evaluate_episodes(
        self, batch: EpisodeBatch, encoder_gradient: str, bptt_steps: int | None = None, rebuild: bool = False
    ) -> tuple[th.Tensor, RebuiltTRVs | None]:
        """
        Compute the log-probability whose gradient trains encoder and head.

        :param encoder_gradient: ``"score"`` or ``"pathwise"``, see :class:`~sb3_tdpg.TDPG`.
        :param bptt_steps: See :class:`~sb3_tdpg.TDPG`.
        :param rebuild: Also rebuild the TRVs from the noise when the gradient does not need them.
        :return: ``(T, N)``, and the rebuilt TRVs
        """
        features = self.episode_features(batch)
        rebuilt = None
        if rebuild or encoder_gradient == "pathwise":
            if bptt_steps is None or bptt_steps >= self.horizon:
                rebuilt = self.rebuild_trvs(features, batch.noise)
            else:
                rebuilt = self.rebuild_trvs_in_parts(features, batch, bptt_steps)
        if encoder_gradient == "pathwise":
            assert rebuilt is not None
            return self.action_log_prob(rebuilt.trvs, batch), rebuilt
        return self.trv_log_prob(features, batch) + self.action_log_prob(batch.trvs, batch), rebuilt

    def rebuild_trvs_in_parts(self, features: th.Tensor, batch: EpisodeBatch, n_steps: int) -> RebuiltTRVs:
        """
        Unroll Equation 15 in parts of the horizon: truncated back-propagation through time.

        Each part starts from the stored TRVs of the step before it, without a gradient.

        :param features: ``(T, N, F)``
        :param batch: the rollouts, ``(T, N, ...)``
        :param n_steps: Length of a part. All steps must share their weights.
        """
        assert not self.time_varying
        horizon, n_episodes = batch.noise.shape[:2]
        n_parts = math.ceil(horizon / n_steps)

        def split(x: th.Tensor) -> th.Tensor:  # (T, N, .) -> (n_steps, n_parts * N, .)
            padded = th.cat([x, x.new_zeros(n_parts * n_steps - horizon, *x.shape[1:])])
            return padded.unflatten(0, (n_parts, n_steps)).transpose(0, 1).flatten(1, 2)

        rebuilt = self.rebuild_trvs(split(features), split(batch.noise), split(self.prev_trvs(batch.trvs))[0])
        return RebuiltTRVs(
            *(x.unflatten(1, (n_parts, n_episodes)).transpose(0, 1).flatten(0, 1)[:horizon] for x in rebuilt)
        )

    # -- the interface of SB3 ---------------------------------------------------------------------------------

    def forward(
        self, observation: PyTorchObs, prev_trv: th.Tensor, t: np.ndarray, deterministic: bool = False
    ) -> PolicyStep:
        """See :meth:`step`."""
        return self.step(observation, prev_trv, t, deterministic)

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
        Choose actions, one step at a time.

        :param observation: one observation, or one per environment
        :param state: the memory that the last call returned; ``None`` at the start
        :param episode_start: ``(n_envs,)`` bool; clears the memory where True
        :param deterministic: Use means instead of samples. This removes the channel noise that the bottleneck acts
            through, so it is not the policy that was trained (the first such call warns); the paper's tables use
            ``False``.
        :return: the actions, clipped to their bounds, and the memory for the next call
        :raises ValueError: if the observation has a wrong shape, or an episode runs beyond the horizon.
        """
        if isinstance(observation, dict):
            raise ValueError("the observation is a dict, but TRVPolicy takes arrays: flatten it (FlattenObservation)")
        if isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict):
            raise ValueError(
                "the observation is a tuple. You are probably mixing Gym API with SB3 VecEnv API: an environment's "
                "reset() returns (obs, info), that of a VecEnv obs alone; pass obs"
            )
        if deterministic and not self._has_warned:
            self._has_warned = True
            warnings.warn(
                "deterministic=True acts with means instead of samples, without the noise of the bottleneck: this is "
                "not the policy that was trained. Give deterministic=False, also to evaluate_policy and EvalCallback",
                stacklevel=3,
            )
        self.set_training_mode(False)
        observation_tensor, is_vectorized = self.obs_to_tensor(observation)
        assert isinstance(observation_tensor, th.Tensor)
        n_envs = observation_tensor.shape[0]
        if state is None:
            prev_trv, t = np.zeros((n_envs, self.trv_dim), np.float32), np.zeros(n_envs, np.int64)
        else:
            prev_trv, t = state
            if prev_trv.shape != (n_envs, self.trv_dim):
                raise ValueError(
                    f"state[0] has shape {prev_trv.shape}, expected {(n_envs, self.trv_dim)}: "
                    "pass the state that the last predict() returned, for the same number of environments"
                )
        if episode_start is not None:
            start = np.asarray(episode_start, dtype=bool).reshape(-1)
            prev_trv = np.where(start[:, None], np.float32(0), prev_trv)
            t = np.where(start, 0, t)
        if (t >= self.horizon).any():
            raise ValueError(
                f"predict() was called for step {int(t.max()) + 1} of an episode, but the policy's horizon is "
                f"{self.horizon}: pass episode_start=True at the first step of an episode (or state=None)"
            )
        with th.no_grad():
            step = self.step(observation_tensor, th.as_tensor(prev_trv, device=self.device), t, deterministic)
        actions = step.actions.cpu().numpy().reshape((-1, *self.action_space.shape))  # type: ignore[misc]
        if isinstance(self.action_space, spaces.Box):
            actions = np.clip(actions, self.action_space.low, self.action_space.high)
        return (actions if is_vectorized else actions.squeeze(axis=0)), (step.trvs.cpu().numpy(), t + 1)


def _default(value: float | None, default: float) -> float:
    return default if value is None else value


def _check_net_arch(given: dict[str, Sequence[int]] | None, default: dict[str, list[int]]) -> dict[str, list[int]]:
    given = {} if given is None else given
    if not isinstance(given, dict) or not set(given) <= set(default):
        raise ValueError(
            f"policy_kwargs: net_arch={given!r} must be a dict with the keys {sorted(default)}, for instance {default}"
        )
    return {key: list(given.get(key, sizes)) for key, sizes in default.items()}
