"""
Task-Driven Policy Gradient (Algorithm 2) as a Stable-Baselines3 algorithm.

Dimension key: T horizon, N episodes of an epoch, X state, Z task-relevant variables (TRVs), U action.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from inspect import signature
from typing import Any, ClassVar, cast

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule, obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg import losses
from sb3_tdpg.advantages import BASELINES, ValueFunction
from sb3_tdpg.auto_weight import AutoWeight
from sb3_tdpg.buffers import EpisodeBatch, EpisodeBuffer, RunningEpisodes, each_part
from sb3_tdpg.checks import (
    check_arguments,
    check_batches,
    check_beta,
    refuse_others,
    schedule_of,
    with_keywords,
)
from sb3_tdpg.episodic import EpisodicAlgorithm, check_policy
from sb3_tdpg.features import of_images, pooled_steps
from sb3_tdpg.information import InformationEstimator, get_estimator_class
from sb3_tdpg.policies import TRVPolicy
from sb3_tdpg.presets import Defaults, fill_in, preset_of
from sb3_tdpg.problem import Problem, check_numbers, check_observations, horizon_of, named_shapes
from sb3_tdpg.vec_env import made_env


class TDPG(EpisodicAlgorithm):
    r"""
    Task-Driven Policy Gradient (Pacelli and Majumdar, 2020).

    Minimises the expected cost of an episode plus the information that the task-relevant variables (TRVs) carry about
    the state (Equation 3, divided by beta):

    .. math:: E[c(\tau)] + \frac1\beta \sum_t I[x_t; \tilde x_t]

    One policy epoch rolls out ``n_episodes`` episodes, fits the mutual-information critics to them
    (:class:`~sb3_tdpg.MINECallback`), and updates the policy. The policy is updated once, as in the paper, or in
    several clipped passes, as in PPO. ``beta=inf`` is plain policy gradient with the same policy.

    The environment needs a finite horizon: an attribute ``horizon`` or a time limit (``max_episode_steps``). It reports
    the true state as ``info["state"]`` in ``reset`` and ``step``, and declares the state's space in an attribute
    ``state_space``. Without a reported state, a vector observation stands in for the state.

    Most defaults depend on the kind of observation: a vector, an image, a depth image (floats), or a vector over a
    horizon of 50 or more steps. See the table in "TDPG: Defaults" of the documentation; the values come from
    :mod:`sb3_tdpg.presets`.

    :param policy: ``"TRVPolicy"`` or a subclass of :class:`~sb3_tdpg.TRVPolicy`.
    :param env: A registered id, an environment or a ``VecEnv``.
    :param beta: Weight of the cost against the information: a positive number, a function of the remaining progress (1
        to 0), or a string such as ``"lin_0.5_0.02"`` (linear from 0.5 to 0.02). ``inf``: no penalty. ``"auto"``:
        minimise the information subject to E[cost] <= ``cost_limit`` (:class:`~sb3_tdpg.auto_weight.AutoWeight`).
        Default with a ``cost_limit``: ``"auto"``.
    :param cost_limit: Limit for ``beta="auto"``: a cost, or the share of the improvement over training that is to be
        kept, such as ``"90%"``.
    :param learning_rate: Learning rate of the policy: a number, a schedule, or a string such as ``"lin_1e-3_1e-5"``
        (linear from 1e-3 to 1e-5).
    :param n_episodes: Number of episodes N of a policy epoch.
    :param epoch_steps: Number of steps of a policy epoch, instead of ``n_episodes``: no episode begins after that many
        steps.
    :param n_envs: Number of environments to make from an id; default: see :func:`~sb3_tdpg.make_episodes_env`.
    :param mi_estimator: A name in :data:`sb3_tdpg.information.ESTIMATORS` or a subclass of
        :class:`~sb3_tdpg.information.InformationEstimator`.
    :param mi_kwargs: Keywords of the estimator.
    :param baseline: Variance reduction of the gradient. ``"regression"``: subtract a regression of the cost-to-go on
        the true state, one for each time step up to a horizon of 50 and one for all steps above. ``"value"``: subtract
        the output of a network that gets the true state and the remaining time
        (:class:`~sb3_tdpg.advantages.ValueFunction`). ``"mean"``: subtract the mean cost of the episodes, as in the
        paper.
    :param encoder_gradient: ``"score"``: likelihood-ratio gradient through log q (Equation 13), as in the paper.
        ``"pathwise"``: hold the noise fixed and differentiate log pi through the TRVs. Over whole episodes, neither of
        them adds a bias; the pathwise gradient has less variance.
    :param bptt_steps: Length of the segments through which the gradient flows back in time, for long horizons. The time
        steps must then share their weights (``time_varying=False``). Default: 5 for vectors over a horizon of 50 or
        more steps, otherwise whole episodes. A value of T gives whole episodes.
    :param n_epochs: Number of passes over the rollouts of a policy epoch, as in PPO.
    :param batch_size: Minibatch size in steps, as in PPO. A minibatch consists of whole episodes or, with
        ``bptt_steps``, of segments.
    :param clip_range: PPO's clip range, a number or a schedule; ``inf``: no clipping.
    :param target_kl: Limit on the Kullback-Leibler divergence in nats per step, as in PPO. The passes of an epoch end
        when the divergence exceeds 1.5 times this value. ``inf``, or no clipping: no limit.
    :param normalize_advantage: Whether to normalise the advantages. The penalty is divided by the same standard
        deviation, so that ``beta`` keeps its meaning.
    :param gamma: Discount factor; the paper has none.
    :param gae_lambda: Bias-variance trade-off of the advantages. 1: observed costs; 0: predicted value of the next
        state. Unused with ``baseline="mean"``.
    :param max_grad_norm: Maximum norm of the policy's gradient, ``inf``: no clipping.
    :param nuisance: Perturbations of the rollouts that the policy should learn to ignore. ``"auto"``: random colours,
        patterns, contrasts and noise for images; noise and dropped pixels for depth images; no changes for vectors.
        ``None``: no changes. :class:`~sb3_tdpg.robustness.families.Family` describes the other values, such as a
        function, or a dict of perturbations and severities. TDPG wraps the model's environment accordingly.
    :param stats_window_size: Number of episodes that ``rollout/ep_rew_mean`` averages over.
    :param tensorboard_log: Folder of the TensorBoard log.
    :param policy_kwargs: Keywords of the policy, see :class:`~sb3_tdpg.TRVPolicy`.
    :param verbose: 0: no output; 1: a table per epoch; 2: debug messages.
    :param seed: Seed of all random number generators. The episodes also depend on the number of environments.
    :param device: ``"cpu"``, ``"cuda"`` or ``"auto"``. ``"auto"`` uses a GPU, if there is one, for images, and the CPU
        for vectors, for which it is faster.
    :param n_threads: Number of threads of torch and of NumPy's linear algebra during ``learn``. Default: torch's
        setting for images, otherwise 1. For small networks one thread is nearly as fast as two, and it gives the same
        numbers on any number of cores.
    :param _init_setup_model: Whether to build the networks in the constructor.
    :raises ValueError: if an argument is out of range or does not fit the environment.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"TRVPolicy": TRVPolicy}
    values_see_changes = False
    # The arguments that an update uses, with their defaults filled in.
    beta: float | Schedule | str
    mi_estimator: str | type[InformationEstimator]
    mi_kwargs: dict[str, Any]
    baseline: str
    encoder_gradient: str
    bptt_steps: int | None
    n_epochs: int
    batch_size: int | None
    clip_range: Any
    target_kl: float
    normalize_advantage: bool

    def __init__(
        self,
        policy: str | type[TRVPolicy] = "TRVPolicy",
        env: GymEnv | str | None = None,
        *,
        beta: float | Schedule | str | None = None,
        cost_limit: float | str | None = None,
        learning_rate: float | Schedule | str | None = None,
        n_episodes: int | None = None,
        epoch_steps: int | None = None,
        n_envs: int | None = None,
        mi_estimator: str | type[InformationEstimator] | None = None,
        mi_kwargs: dict[str, Any] | None = None,
        baseline: str | None = None,
        encoder_gradient: str | None = None,
        bptt_steps: int | None = None,
        n_epochs: int | None = None,
        batch_size: int | None = None,
        clip_range: float | Schedule | None = None,
        target_kl: float | None = None,
        normalize_advantage: bool | None = None,
        gamma: float | None = None,
        gae_lambda: float | None = None,
        max_grad_norm: float | None = None,
        nuisance: Any = "auto",
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        n_threads: int | None = None,
        _init_setup_model: bool = True,
        **others: Any,
    ) -> None:
        given = {name: value for name, value in locals().items() if name in Defaults._fields}
        refuse_others(others, signature(TDPG).parameters)
        env = made_env(env, n_envs, n_episodes=n_episodes, epoch_steps=epoch_steps)
        horizon = None if env is None else horizon_of(env)
        # A model that is being loaded gets its preset from the file.
        self.preset = None
        if env is not None and _init_setup_model:
            self.preset = preset_of(env.observation_space, horizon, **of_images(policy_kwargs))
        settings = fill_in(given, self.preset or "vector", cost_limit, getattr(env, "num_envs", 1), horizon or 1)
        self._has_default_batch_size = batch_size is None
        self._has_default_device = device == "auto"
        check_policy(policy, self.policy_aliases)
        check_arguments({**settings, "seed": seed})
        super().__init__(
            policy=policy,
            env=env,
            **{name: settings.pop(name) for name in ("learning_rate", "gamma", "gae_lambda", "max_grad_norm")},
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
        )
        vars(self).update(settings, mi_kwargs=mi_kwargs or {}, nuisance=nuisance)
        if _init_setup_model:
            self._setup_model()

    # -- construction -----------------------------------------------------------------------------------------

    def _setup_model(self) -> None:
        # load() sets attributes without the constructor, so they are checked again here.
        self.max_grad_norm = math.inf if self.max_grad_norm is None else self.max_grad_norm
        check_policy(self.policy_class, self.policy_aliases)
        check_arguments(vars(self))
        self.lr_schedule = FloatSchedule(schedule_of("learning_rate", self.learning_rate))
        if self._has_default_device and self.preset in ("vector", "long"):
            self.device = th.device("cpu")
        self.set_random_seed(self.seed)
        if self.env is not None:
            self._set_problem(self._check_problem(self.env), self.env)
            self.env = self._with_nuisance(self.env)
        elif self.horizon == 0:
            raise ValueError("TDPG needs an environment to learn the horizon and the spaces from: pass env=...")
        self._setup_beta()
        self.clip_range = FloatSchedule(self.clip_range)  # as in PPO
        make_policy = partial(
            self.policy_class, self.observation_space, self.action_space, self.lr_schedule,
            horizon=self.horizon, preset=self.preset,
        )  # fmt: skip
        policy = with_keywords("policy_kwargs", self.policy_kwargs, make_policy)
        self.policy = cast(TRVPolicy, policy).to(self.device)
        if self._has_default_batch_size:
            self.batch_size = self._defaults.minibatch(self.horizon, self.epoch_size)
        check_batches(vars(self), self.epoch_size, time_varying=self.policy.time_varying)
        if self.baseline == "value":
            if self.env is not None and "values_see_changes" not in vars(self):  # a loaded model keeps its network
                self.values_see_changes = cast(Problem, self._problem).state_is_observation
            value_function = ValueFunction(self.state_dim, self.horizon, with_changes=self.values_see_changes)
            self.value_function = value_function.to(self.device)
        # The estimator is made also for beta = inf, so that a policy-gradient model can warm-start TDPG.
        estimator_class = get_estimator_class(self.mi_estimator)
        n_critics = 1 if self.pools_information else self.horizon
        estimator = partial(estimator_class, n_critics, self.state_dim, self.policy.trv_dim)
        self.estimator = with_keywords("mi_kwargs", self.mi_kwargs, estimator).to(self.device)
        n_columns = self.n_episodes or math.ceil(self.epoch_size / self.horizon)
        self.rollout_buffer = EpisodeBuffer(
            self.horizon, self.observation_space, self.action_space, device=self.device, gamma=self.gamma,
            n_envs=n_columns, state_dim=self.state_dim, trv_dim=self.policy.trv_dim,
        )  # fmt: skip

    @property
    def pools_information(self) -> bool:
        """Whether one estimate of the information uses all time steps; true if they share the policy's weights."""
        return not self.policy.time_varying

    def _setup_beta(self) -> None:
        """Create the schedule of beta, or the weight that adapts to the cost limit."""
        if self.beta != "auto":
            self.auto_weight = None
            self.beta_schedule = FloatSchedule(schedule_of("beta", self.beta))
            return
        if self.cost_limit is None:
            self.cost_limit = self._defaults.share
        if self.auto_weight is None or self.auto_weight.cost_limit != self.cost_limit:
            self.auto_weight = AutoWeight(self.cost_limit, by_slack=self.preset == "long", first_cost=self.first_cost)

    @property
    def mi_coef(self) -> float:
        """1 / beta at the current progress: the weight of the information, in units of cost per nat."""
        if self.auto_weight is not None:
            return self.auto_weight.value
        return 1.0 / check_beta(self.beta_schedule(self._current_progress_remaining))

    @property
    def needs_information(self) -> bool:
        """Whether this epoch needs the information, for the penalty or to adapt its weight."""
        return self.auto_weight is not None or self.mi_coef > 0.0

    # -- an epoch ---------------------------------------------------------------------------------------------

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: EpisodeBuffer,  # type: ignore[override]
        n_rollout_steps: int,
    ) -> bool:
        """
        Roll out N whole episodes with the current policy (line 2 of Algorithm 2).

        Each of the E environments runs N / E episodes, one after the other. Taking the first N episodes that finish
        would favour short episodes. With ``epoch_steps`` an environment begins another episode while fewer than that
        many steps are stored, and the last epoch of ``learn`` takes only the remaining steps, but at least about a
        tenth of an epoch (if it is also the first epoch: a whole one). All environments begin an epoch at t = 0.

        :param env: The training environments.
        :param callback: Called at each step, and at the beginning and the end of the rollout.
        :param rollout_buffer: Receives the episodes.
        :param n_rollout_steps: Unused: the length of an epoch is ``n_episodes`` or ``epoch_steps``.
        :return: False if a callback asked to stop the training.
        """
        assert self._problem is not None, "the model has no environment: set_env() first"
        callback.on_rollout_start()
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        obs = self._first_observations(env)
        states = self._problem.initial_states(env, obs)  # (E, X)
        trvs = th.zeros(env.num_envs, self.policy.trv_dim, device=self.device)
        episodes = RunningEpisodes(env.num_envs, self.n_episodes, self._steps_of_this_epoch(), self.horizon)
        # An epoch that ends early cannot be continued; None makes the next epoch reset the environments.
        self._last_obs = None

        while (running := episodes.running).size > 0:
            check_observations(self.observation_space, obs, episodes.t)
            check_numbers("state", states, (self.state_dim,), episodes.t)
            with th.no_grad():
                step = self.policy.step(obs_as_tensor(obs, self.device), trvs, np.minimum(episodes.t, self.horizon - 1))
            actions = step.actions.cpu().numpy()
            with named_shapes(env):
                new_obs, rewards, dones, infos = cast(Any, env.step(self.policy.clipped(actions)))
            check_numbers("reward", np.nan_to_num(rewards), (), episodes.t)  # train() reports NaN
            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            # Environments that wait for the others go on, but their steps are not stored.
            self._update_info_buffer([infos[i] for i in running], dones[running])

            stored = dict(observations=obs, states=states, actions=actions, costs=-rewards)
            stored.update((name, getattr(step, name).cpu().numpy()) for name in ("noise", "trvs", "means", "stds"))
            stored = {name: each_part(lambda x: x[running], value) for name, value in stored.items()}
            rollout_buffer.add_step(episodes.t[running], episodes.column[running], **stored)
            rollout_buffer.clear_episodes(episodes.advance(dones, infos))
            obs, states = new_obs, self._problem.next_states(env, new_obs, dones, infos)
            trvs = step.trvs * th.as_tensor(~dones[:, None], device=self.device)

        rollout_buffer.full = True
        if (episodes.t == 0).all():
            self._last_obs = obs
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def fit_critics(self) -> None:
        """
        Fit the mutual-information critics to the rollouts (lines 3 to 5 of Algorithm 2), and set ``information``.

        :class:`~sb3_tdpg.MINECallback` calls this method at the end of the rollouts. Without a penalty no critic is
        trained.
        """
        # SB3 does this only before train(), but a schedule of beta may turn the penalty on with this epoch.
        self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
        if not self.needs_information:
            self.information = None
            return
        batch = self.rollout_buffer.episode_batch().information_batch(self.pools_information)
        diagnostics = self.estimator.fit(batch)
        with th.no_grad():
            information = self.estimator(batch).cpu().numpy()  # (T,), nats
        if self.pools_information:  # there is one estimate for all time steps
            information = information * self.rollout_buffer.mean_length
        self.information = information
        self.logger.record("mi/total", float(information.sum()))
        for name, value in diagnostics.items():
            self.logger.record(f"mi/{name}", value)
        for t, value in enumerate(information):
            self.logger.record(f"mi/t{t:02d}", float(value), exclude=("stdout", "log", "json", "csv"))

    def train(self) -> None:
        """
        Update the encoder and the action head from the rollouts (line 6 of Algorithm 2).

        :raises TrainingDivergedError: if a cost, the information, a loss or a gradient is NaN or infinite; the
            parameters keep their values from before that step.
        """
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        in_segments = not self.policy.time_varying
        batch = self.rollout_buffer.episode_batch(whole_horizon=not in_segments)
        mean_cost = batch.costs.sum(0).mean().item()
        information = 0.0 if self.information is None else float(self.information.sum())
        self._check_finite("costs", batch.costs)
        if self.first_cost is None:
            self.first_cost = mean_cost
        if self.auto_weight is not None:  # the dual step of beta="auto"
            self._check_finite("information", th.tensor(information))
            self.auto_weight.update(mean_cost, information, self._current_progress_remaining)
        mi_coef = self.mi_coef
        clip_range = self.clip_range(self._current_progress_remaining)

        advantages = self._advantages(batch)
        cost_scale = th.ones(())  # divisor of the advantages and of the penalty
        if self.normalize_advantage:
            negligible = 1e-5 * batch.costs.abs().max()
            advantages, cost_scale = losses.normalized(advantages, batch.alive, negligible)
        batch = whole = batch._replace(advantages=advantages)
        if in_segments:
            batch = batch.segments(self.bptt_steps or len(batch.costs))
        # Images are pooled once for all passes.
        passes = batch._replace(observations=pooled_steps(self.policy.features_extractor, batch.observations))
        old_log_prob = None  # (T, N) of the policy that made the rollouts
        if clip_range < math.inf:
            with th.no_grad():
                old_log_prob = self.policy.stored_log_prob(passes, self.encoder_gradient)

        for columns in (part for _ in range(self.n_epochs) for part in self._minibatches(passes)):
            part = passes.select(columns)
            log_prob, rebuilt = self.policy.evaluate_episodes(part, self.encoder_gradient, mi_coef > 0.0)
            vars(self.policy.action_dist).pop("distribution", None)  # its graph would prevent copying the policy
            if old_log_prob is None:
                policy_loss = losses.policy_gradient_loss(log_prob, part.advantages, part.alive)
            else:
                old = old_log_prob[:, columns]
                policy_loss = losses.clipped_policy_loss(log_prob, old, part.advantages, part.alive, clip_range)
                kl, clip_fraction = losses.policy_distance(log_prob.detach(), old, part.alive, clip_range)
                self.logger.record_mean("train/approx_kl", kl.item())
                self.logger.record_mean("train/clip_fraction", clip_fraction.item())
                if kl > 1.5 * self.target_kl:
                    break
            if in_segments:  # use the loss per step, since the number of segments varies
                policy_loss = policy_loss * len(part.costs[0]) / part.alive.sum()
            loss = policy_loss
            if rebuilt is not None and mi_coef > 0.0:
                # Equation 15: the critics are frozen, and the gradient flows through the rebuilt TRVs.
                information_t = self.estimator(rebuilt.information_batch(self.pools_information))
                mi_loss = mi_coef * losses.information_loss(information_t)
                loss = loss + mi_loss / cost_scale
                self.logger.record_mean("train/mi_loss", mi_loss.item())
            self._check_finite("policy loss", policy_loss)
            self._check_finite("loss", loss)

            self.policy.optimizer.zero_grad()
            loss.backward()
            grad_norm = th.nn.utils.clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
            self._check_finite("gradient", grad_norm)
            self.policy.optimizer.step()
            self.logger.record_mean("train/policy_loss", policy_loss.item())
            self.logger.record_mean("train/loss", loss.item())
            self.logger.record_mean("train/grad_norm", grad_norm.item())
        # The statistics are updated last, so that the rollouts and all of their gradients use the same statistics.
        self.policy.update_statistics(whole)

        self.epoch += 1
        self._n_updates += self.n_epochs
        self.logger.record("train/objective", mean_cost + mi_coef * information)
        self.logger.record("train/mi_coef", mi_coef)
        if self.auto_weight is not None and math.isfinite(self.auto_weight.limit):
            self.logger.record("train/cost_limit", self.auto_weight.limit)
        self.logger.record("train/trv_std", whole.stds.mean().item())
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _advantages(self, batch: EpisodeBatch) -> th.Tensor:
        """Compute the advantages, ``(T, N)``; a value network is fitted to the rollouts first."""
        baseline = BASELINES[self.baseline] or cast(ValueFunction, self.value_function).advantages
        advantages = baseline(batch.costs, batch.states, batch.alive, self.gamma, self.gae_lambda)
        if self.value_function is not None:
            self.logger.record("train/explained_variance", self.value_function.explained)
        return advantages

    def _minibatches(self, batch: EpisodeBatch) -> Sequence[th.Tensor | slice]:
        """Divide the columns at random into nearly equal parts; a single part has all columns in order."""
        n_columns = batch.costs.shape[1]
        n_parts = 1 if self.batch_size is None else math.ceil(batch.alive.sum().item() / self.batch_size)
        n_parts = min(n_parts, max(1, n_columns // 2))  # the information needs two columns in each part
        if n_parts == 1:
            return [slice(None)]
        return th.randperm(n_columns, device=self.device).tensor_split(n_parts)
