"""
Task-Driven Policy Gradient (Algorithm 2) as a Stable-Baselines3 algorithm.

Dimension key: T horizon, N episodes of an epoch, X state, Z task-relevant variables (TRVs), U action.
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_tdpg.auto_weight import AutoWeight
from sb3_tdpg.buffers import EpisodeBuffer
from sb3_tdpg.callbacks import MINECallback, TDPGProgressBar
from sb3_tdpg.checks import check_action_space, check_arguments, check_beta, check_count, nearest_multiples
from sb3_tdpg.common.files import replaced_atomically
from sb3_tdpg.common.random_state import RandomState
from sb3_tdpg.common.threads import threads
from sb3_tdpg.defaults import defaults_for, fill_in
from sb3_tdpg.information import InformationEstimator, get_estimator_class
from sb3_tdpg.policies import TRVPolicy
from sb3_tdpg.policy_update import PolicyUpdate, TrainingDivergedError
from sb3_tdpg.problem import Problem, read_problem, reward_threshold
from sb3_tdpg.vec_env import make_episodes_env

__all__ = ["TDPG", "TrainingDivergedError"]

SelfTDPG = TypeVar("SelfTDPG", bound="TDPG")


class TDPG(OnPolicyAlgorithm):
    r"""
    Task-Driven Policy Gradient (Pacelli and Majumdar, 2020).

    Minimises the expected cost of an episode plus the information that the task-relevant variables carry about the
    state (equation 3, divided by beta):

    .. math:: E[c(\tau)] + \frac1\beta \sum_t I[x_t; \tilde x_t]

    One policy epoch rolls out ``n_episodes`` episodes, fits the mutual-information critics to them
    (:class:`~sb3_tdpg.callbacks.MINECallback`), and updates the policy: once, as in the paper, or with several clipped
    passes, as PPO does. ``beta=inf`` is plain policy gradient with the same policy.

    The environment needs a finite horizon: an attribute ``horizon`` or a time limit (``max_episode_steps``). The true
    state comes from ``info["state"]`` of ``reset`` and ``step`` together with an attribute ``state_space``; an
    environment without it is taken as fully observed if its observation is a vector.

    Where a default has two values below, the first is for vector observations and the second for images; depth images
    (of floats) differ in a few more (``sb3_tdpg.defaults``).

    :param policy: ``"TRVPolicy"`` or a subclass of :class:`~sb3_tdpg.policies.TRVPolicy`.
    :param env: A registered id, an environment or a ``VecEnv``. An id is vectorised with ``n_envs``.
    :param beta: Weight of the cost against the information, a positive number or a function of the remaining progress
        (1 to 0). ``inf``: no penalty. ``"auto"``: the information is minimised as far as the expected cost stays below
        ``cost_limit`` (:class:`~sb3_tdpg.auto_weight.AutoWeight`). Default: 1/75 and ``"auto"``; ``"auto"`` wherever a
        ``cost_limit`` is given.
    :param cost_limit: The limit for ``beta="auto"``; default: minus the ``reward_threshold`` with which the environment
        is registered.
    :param learning_rate: Learning rate of the policy, a number or a function of the remaining progress; default:
        linearly from 2e-3 to 2e-5, and from 1e-3 to 5e-5. The critics have their own (``mi_kwargs``).
    :param n_episodes: Episodes N of a policy epoch; default: 500 and 160.
    :param n_envs: Number of environments that a string id is turned into; default: see
        :func:`~sb3_tdpg.make_episodes_env`.
    :param mi_estimator: ``"mine"``, ``"nwj"``, ``"smile"``, ``"infonce"``, ``"logdet"``, ``"loo"``, ``"vib"`` or a
        subclass of :class:`~sb3_tdpg.information.InformationEstimator`; default: ``"mine"`` and ``"logdet"``.
    :param mi_kwargs: Keywords of the estimator.
    :param baseline: ``"value"``: cost to come minus its regression on the true state at each time step;
        ``"mean"``: cost of the whole episode minus the mean over the batch, as in the paper.
    :param encoder_gradient: ``"score"``: likelihood-ratio gradient through log q (equation 13), as in the
        paper; ``"pathwise"``: the noise is held fixed and log pi differentiated through the TRVs. Both are unbiased;
        the second varies less. Default: ``"score"`` and ``"pathwise"``.
    :param bptt_steps: Steps that a gradient flows back through the memory: the pathwise one, and the information's.
        ``None``: to the start of the episode. For long horizons: the horizon is cut into parts of so many steps, which
        are computed side by side; what a TRV does for the steps beyond its part is then not credited to it. The steps
        must share their weights (``time_varying=False``).
    :param n_epochs: Passes over the rollouts of a policy epoch, as in SB3's PPO; default: 1 and 4.
    :param batch_size: Minibatch size, in *episodes*: the memory of an episode cannot be cut. Default: all and 80.
    :param clip_range: PPO's limit to the ratio of probabilities, a number or a function of the remaining progress;
        ``inf``: none. Default: ``inf`` and 0.2.
    :param normalize_advantage: Whether to bring the advantages to mean 0 and variance 1; the penalty is divided by the
        same number, so that ``beta`` keeps its meaning. Default: no and yes.
    :param gamma: Discount factor; the paper has none.
    :param gae_lambda: Bias against variance of the advantages with ``baseline="value"``: 1 uses the costs as they
        were, 0 the regression at the next state in their place, which is less noisy and blind to the policy's memory.
    :param max_grad_norm: Clip the norm of the policy's gradient to this; ``None``: no clipping.
    :param stats_window_size: Episodes that ``rollout/ep_rew_mean`` averages over.
    :param tensorboard_log: Folder of the TensorBoard log.
    :param policy_kwargs: Keywords of the policy, see :class:`~sb3_tdpg.policies.TRVPolicy`.
    :param verbose: 0: nothing; 1: what the environment is wrapped in, and a table each epoch; 2: debug messages.
    :param seed: Seed of all random number generators. With another number of environments it gives other episodes.
    :param device: ``"cpu"``, ``"cuda"`` or ``"auto"``.
    :param n_threads: Threads that ``learn`` computes with, of torch and of NumPy's linear algebra; default: 1, which is
        enough for networks this small and gives the same numbers on any machine, and as many as torch is set to.
    :param _init_setup_model: Whether to build the networks at once.
    :raises ValueError: if an argument is out of its range or does not fit the environment; the message says how to mend
        it. Nothing has been trained by then.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"TRVPolicy": TRVPolicy}
    policy: TRVPolicy  # type: ignore[assignment]
    rollout_buffer: EpisodeBuffer
    estimator: InformationEstimator

    def __init__(
        self,
        policy: str | type[TRVPolicy] = "TRVPolicy",
        env: GymEnv | str | None = None,
        *,
        beta: float | Schedule | str | None = None,
        cost_limit: float | None = None,
        learning_rate: float | Schedule | None = None,
        n_episodes: int | None = None,
        n_envs: int | None = None,
        mi_estimator: str | type[InformationEstimator] | None = None,
        mi_kwargs: dict[str, Any] | None = None,
        baseline: str = "value",
        encoder_gradient: str | None = None,
        bptt_steps: int | None = None,
        n_epochs: int | None = None,
        batch_size: int | None = None,
        clip_range: float | Schedule | None = None,
        normalize_advantage: bool | None = None,
        gamma: float = 1.0,
        gae_lambda: float = 0.95,
        max_grad_norm: float | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        n_threads: int | None = None,
        _init_setup_model: bool = True,
    ) -> None:
        for name, count in (("n_episodes", n_episodes), ("n_envs", n_envs)):
            if count is not None:
                check_count(name, count)
        if isinstance(env, str):
            env = make_episodes_env(env, n_envs, n_episodes=n_episodes)
        elif n_envs is not None and getattr(env, "num_envs", 1) != n_envs:
            raise ValueError(
                f"n_envs={n_envs} is for an environment given by its id; "
                f"the environment given has {getattr(env, 'num_envs', 1)} of its own: leave n_envs out"
            )
        if env is not None:
            check_action_space(env.action_space)
        given = dict(
            beta="auto" if beta is None and cost_limit is not None else beta,
            learning_rate=learning_rate,
            n_episodes=n_episodes,
            mi_estimator=mi_estimator,
            encoder_gradient=encoder_gradient,
            n_epochs=n_epochs,
            batch_size=batch_size,
            clip_range=clip_range,
            normalize_advantage=normalize_advantage,
            n_threads=n_threads,
        )
        settings = fill_in(given, None if env is None else env.observation_space)
        settings.update(
            policy=policy,
            cost_limit=cost_limit,
            baseline=baseline,
            bptt_steps=bptt_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            max_grad_norm=math.inf if max_grad_norm is None else max_grad_norm,
        )
        check_arguments(settings)
        super().__init__(
            policy=policy,  # type: ignore[arg-type]
            env=env,  # type: ignore[arg-type]
            learning_rate=settings["learning_rate"],
            n_steps=0,  # known once the horizon is
            gamma=gamma,
            gae_lambda=gae_lambda,
            # What follows belongs to algorithms with a value network and is not used.
            ent_coef=0.0,
            vf_coef=0.0,
            max_grad_norm=settings["max_grad_norm"],
            use_sde=False,
            sde_sample_freq=-1,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
        )
        self.beta: float | Schedule | str = settings["beta"]
        self.cost_limit = cost_limit
        self.n_episodes: int = settings["n_episodes"]
        self.mi_estimator: str | type[InformationEstimator] = settings["mi_estimator"]
        self.mi_kwargs = {} if mi_kwargs is None else mi_kwargs
        self.baseline = baseline
        self.encoder_gradient: str = settings["encoder_gradient"]
        self.bptt_steps = bptt_steps
        self.n_epochs: int = settings["n_epochs"]
        self.batch_size: int | None = settings["batch_size"]
        self.clip_range: float | Schedule = settings["clip_range"]
        self.normalize_advantage: bool = settings["normalize_advantage"]
        self.n_threads: int | None = settings["n_threads"]
        self.auto_weight: AutoWeight | None = None
        """The weight of the information with ``beta="auto"``."""
        # Plain numbers, so that a model loaded without an environment can rebuild its networks.
        self.horizon = 0
        self.state_dim = 0
        self.epoch = 0
        """Policy epochs completed."""
        self.information: np.ndarray | None = None
        """I[x_t; x~_t] of the last rollouts in nats, ``(T,)``; None without a penalty."""
        self._random_state: RandomState | None = None
        self._problem: Problem | None = None
        if _init_setup_model:
            self._setup_model()

    # -- construction -----------------------------------------------------------------------------------------

    def _setup_model(self) -> None:
        # Again: load() sets attributes without the constructor.
        self.max_grad_norm = math.inf if self.max_grad_norm is None else self.max_grad_norm
        check_arguments({**vars(self), "policy": self.policy_class})
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        if self.env is not None:
            self._set_problem(self._read_problem(self.env), self.env)
        elif self.horizon == 0:
            raise ValueError("TDPG needs an environment to learn the horizon and the spaces from: pass env=...")
        self._setup_beta()
        self.clip_range_schedule = FloatSchedule(self.clip_range)
        try:
            policy = self.policy_class(
                self.observation_space, self.action_space, self.lr_schedule, horizon=self.horizon, **self.policy_kwargs
            )
        except TypeError as e:
            raise ValueError(
                f"policy_kwargs={self.policy_kwargs!r} must be a dict of keywords of {self.policy_class.__name__}: {e}"
            ) from e
        self.policy = cast(TRVPolicy, policy).to(self.device)
        if self.bptt_steps is not None and self.bptt_steps < self.horizon and self.policy.time_varying:
            raise ValueError(
                f"bptt_steps={self.bptt_steps} cuts the horizon of {self.horizon} steps into parts that are computed "
                "side by side, for which all steps must share their weights: give "
                "policy_kwargs=dict(time_varying=False), or leave bptt_steps out"
            )
        # Built at beta = inf, too: a policy-gradient model must be able to warm-start TDPG.
        estimator_class = get_estimator_class(self.mi_estimator)
        try:
            self.estimator = estimator_class(self.horizon, self.state_dim, self.policy.trv_dim, **self.mi_kwargs)
        except TypeError as e:
            raise ValueError(
                f"mi_kwargs={self.mi_kwargs!r} must be a dict of keywords of {estimator_class.__name__}: {e}"
            ) from e
        self.estimator.to(self.device)
        self.rollout_buffer = EpisodeBuffer(
            self.horizon,
            self.observation_space,
            self.action_space,
            device=self.device,
            gamma=self.gamma,
            n_envs=self.n_episodes,
            state_dim=self.state_dim,
            trv_dim=self.policy.trv_dim,
        )

    def _setup_beta(self) -> None:
        """Make the schedule of beta, or the weight that follows the cost limit."""
        if self.beta != "auto":
            self.auto_weight = None
            self.beta_schedule = FloatSchedule(cast("float | Schedule", self.beta))
            return
        if self.cost_limit is None:
            threshold = None if self.env is None else reward_threshold(self.env)
            if threshold is None:
                raise ValueError(
                    "beta='auto' minimises the information under a limit on the expected cost, and the environment has "
                    "none (a reward_threshold in its registration): give cost_limit=..., or beta=1/75, say, or "
                    "beta=float('inf') for plain policy gradient"
                )
            self.cost_limit = -threshold
        if self.auto_weight is None or self.auto_weight.cost_limit != self.cost_limit:
            self.auto_weight = AutoWeight(self.cost_limit)

    def _read_problem(self, env: VecEnv) -> Problem:
        """Learn horizon and state from the environment, or say why it cannot be used."""
        normalize = unwrap_vec_normalize(env)
        if normalize is not None and normalize.norm_reward:
            raise ValueError(
                "VecNormalize(norm_reward=True) rescales the cost and with it, silently, beta: use norm_reward=False"
            )
        if self.n_episodes % env.num_envs != 0:
            raise ValueError(
                f"n_episodes={self.n_episodes} must be a multiple of the number of environments ({env.num_envs}), so "
                f"that each runs as many episodes: use {nearest_multiples(self.n_episodes, env.num_envs)}"
            )
        problem = read_problem(env)
        if self.horizon not in (0, problem.horizon) or self.state_dim not in (0, problem.state_dim):
            raise ValueError(
                f"the environment has horizon={problem.horizon} and {problem.state_dim} state components, it was "
                f"made for horizon={self.horizon} and {self.state_dim}: use an environment of the same shape"
            )
        return problem

    def _set_problem(self, problem: Problem, env: VecEnv) -> None:
        self._problem = problem
        self.horizon, self.state_dim = problem.horizon, problem.state_dim
        self.n_steps = self.horizon * (self.n_episodes // env.num_envs)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """See :meth:`stable_baselines3.common.base_class.BaseAlgorithm.set_env`."""
        wrapped = self._wrap_env(env, self.verbose)
        problem = self._read_problem(wrapped)  # before the model's own environment is replaced
        super().set_env(wrapped, force_reset)
        self._set_problem(problem, wrapped)

    @property
    def mi_coef(self) -> float:
        """1 / beta at the present progress: the weight of the information, in units of cost per nat."""
        if self.auto_weight is not None:
            return self.auto_weight.value
        return 1.0 / check_beta(self.beta_schedule(self._current_progress_remaining))

    # -- one policy epoch -------------------------------------------------------------------------------------

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: EpisodeBuffer,  # type: ignore[override]
        n_rollout_steps: int,
    ) -> bool:
        """
        Roll out N whole episodes with the current policy (line 2 of Algorithm 2).

        Each of E environments runs N / E episodes one after the other. A quota per environment, not the first N that
        finish: those would be the short ones. All environments begin an epoch at t = 0.

        :param env: The training environments.
        :param callback: Called at each step, and at the beginning and the end.
        :param rollout_buffer: Where the episodes go.
        :param n_rollout_steps: Unused: an epoch is a number of episodes.
        :return: False if a callback asked to stop.
        """
        assert self._problem is not None, "the model has no environment: set_env() first"
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        callback.on_rollout_start()
        if self._last_obs is None:
            self._last_obs = env.reset()  # type: ignore[assignment]
            self._last_episode_starts = np.ones(env.num_envs, dtype=bool)

        n_envs = env.num_envs
        obs = cast(np.ndarray, self._last_obs)
        states = self._problem.initial_states(env, obs)  # (E, X)
        trvs = th.zeros(n_envs, self.policy.trv_dim, device=self.device)
        t = np.zeros(n_envs, np.int64)
        column = np.arange(n_envs)  # where each environment's present episode goes
        # A partial epoch cannot be continued: whatever ends this method early leaves the environments to be reset.
        self._last_obs = None

        while (running := np.flatnonzero(column < self.n_episodes)).size > 0:
            with th.no_grad():
                step = self.policy.step(obs_as_tensor(obs, self.device), trvs, np.minimum(t, self.horizon - 1))
            actions = step.actions.cpu().numpy()
            env_actions = actions.reshape((-1, *self.action_space.shape))  # type: ignore[misc]
            if isinstance(self.action_space, spaces.Box):
                env_actions = np.clip(env_actions, self.action_space.low, self.action_space.high)
            new_obs, rewards, dones, infos = env.step(env_actions)

            self.num_timesteps += n_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)

            stored = {
                "observations": obs.reshape(n_envs, *rollout_buffer.obs_shape),
                "states": states,
                "noise": step.noise.cpu().numpy(),
                "trvs": step.trvs.cpu().numpy(),
                "means": step.means.cpu().numpy(),
                "stds": step.stds.cpu().numpy(),
                "actions": actions.reshape(n_envs, -1),
                "costs": -rewards,
            }
            rollout_buffer.add_step(t[running], column[running], **{k: v[running] for k, v in stored.items()})

            states = self._problem.next_states(env, cast(np.ndarray, new_obs), dones, infos)
            trvs = step.trvs * th.as_tensor(~dones[:, None], device=self.device)
            t = np.where(dones, 0, t + 1)
            column = np.where(dones, column + n_envs, column)
            if (t[column < self.n_episodes] >= self.horizon).any():
                raise ValueError(
                    f"an episode did not end after horizon={self.horizon} steps: the environment must return "
                    "terminated or truncated there (or declare its true horizon)"
                )
            obs = cast(np.ndarray, new_obs)

        rollout_buffer.full = True
        if (t == 0).all():
            self._last_obs = obs
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def dump_logs(self, iteration: int = 0) -> None:
        """Write the log; the epoch's cost comes from all of its episodes."""
        self.logger.record("rollout/ep_cost_mean", float(self.rollout_buffer.episode_costs.mean()))
        super().dump_logs(iteration)

    def train(self) -> None:
        """Update encoder and action head (line 6 of Algorithm 2)."""
        update = PolicyUpdate(self)
        for _ in range(self.n_epochs):
            for episodes in update.minibatches():
                update.step(episodes)
        update.finish()

    # -- learn, save, resume ----------------------------------------------------------------------------------

    def learn(
        self: SelfTDPG,
        total_timesteps: int | None = None,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "TDPG",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfTDPG:
        """
        Train; see :meth:`stable_baselines3.common.base_class.BaseAlgorithm.learn`.

        Interrupted by Ctrl-C, the model keeps the parameters of the last finished update and can be used, saved or
        trained on.

        :param total_timesteps: Environment steps; default: 400 policy epochs for vectors (a million steps of the lava
            problem), 50 for images, 100 for depth images.
        :raises TrainingDivergedError: if a loss or a gradient is NaN or infinite; the model keeps its parameters.
        """
        if total_timesteps is None:
            total_timesteps = defaults_for(self.observation_space).total_epochs * self.n_episodes * self.horizon
        with threads(self.n_threads):
            return super().learn(
                total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar
            )

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        callbacks: list[BaseCallback] = []
        if isinstance(callback, list):
            callbacks += callback
        elif isinstance(callback, BaseCallback):
            callbacks.append(callback)
        else:
            callbacks.append(ConvertCallback(cast("Callable[[dict[str, Any], dict[str, Any]], bool]", callback)))
        if not any(isinstance(given, MINECallback) for given in callbacks):
            callbacks.insert(0, MINECallback())
        if progress_bar:
            callbacks.append(TDPGProgressBar())
        return super()._init_callback(CallbackList(callbacks))

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if self.env is None:
            raise ValueError("the model has no environment to learn in: set_env(...) first, or load(path, env=...)")
        if reset_num_timesteps:
            self.epoch = 0
            self._current_progress_remaining = 1.0
        random_state, self._random_state = self._random_state, None
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if random_state is not None and not reset_num_timesteps:
            # Last, since the set-up draws, too. The first rollout then resets the environments once more.
            random_state.restore(self.env)
            self._last_obs = None
        return result

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        # The last epoch may overshoot, and schedules are defined on [0, 1].
        super()._update_current_progress_remaining(min(num_timesteps, total_timesteps), total_timesteps)

    @property
    def remaining_timesteps(self) -> int:
        """Timesteps that the last call of ``learn`` was asked for and did not reach."""
        return max(0, self._total_timesteps - self.num_timesteps)

    def save_checkpoint(self, path: str | os.PathLike[str]) -> None:
        """
        Save the model with all random number generators, between two epochs.

        The environments are reset, here and after loading, so that their generators are all there is to know of
        them. See :class:`~sb3_tdpg.callbacks.TrainingCheckpointCallback`.
        """
        assert self.env is not None
        self._last_obs = None
        self._random_state = RandomState.capture(self.env)
        try:
            self.save(Path(path))
        finally:
            self._random_state = None

    def save(
        self,
        path: str | os.PathLike[str] | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
    ) -> None:
        """
        Save to a zip file, replaced atomically; see
        :meth:`stable_baselines3.common.base_class.BaseAlgorithm.save`.
        """
        if isinstance(path, io.IOBase):
            super().save(path, exclude, include)
            return
        target = Path(path)
        if target.suffix == "":
            target = target.with_suffix(".zip")
        target.parent.mkdir(parents=True, exist_ok=True)
        with replaced_atomically(target) as partial, partial.open("wb") as file:
            super().save(file, exclude, include)

    @classmethod
    def load(
        cls: type[SelfTDPG],
        path: str | Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfTDPG:
        """
        Load a saved model; see :meth:`stable_baselines3.common.base_class.BaseAlgorithm.load`.

        :param kwargs: Arguments to change, for instance ``beta=1 / 75`` to go on from a policy-gradient model.
        :raises ValueError: if the file is damaged or was not saved by TDPG.
        """
        # As in the constructor: a limit alone asks for the weight that keeps it, and a number for beta needs none.
        if kwargs.get("cost_limit") is not None:
            kwargs.setdefault("beta", "auto")
        elif kwargs.get("beta", "auto") != "auto":
            kwargs.setdefault("cost_limit", None)
        try:
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except AssertionError as e:
            if not str(e).startswith("No "):  # "No data found in the saved file", "No params found ..."
                raise
            raise ValueError(
                f"{path} holds no model of TDPG: it is damaged, or was made by something else ({e})"
            ) from e

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_problem"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        # The estimator's state dict holds its optimiser, too.
        return ["policy", "policy.optimizer", "estimator"], []
