"""
On-policy learning from whole episodes: rollouts, environments, saving and resuming.

This is what :class:`~sb3_tdpg.TDPG` needs beside its own method, which is in :mod:`sb3_tdpg.tdpg`.

Dimension key: T horizon, N episodes of an epoch, E environments, X state, Z task-relevant variables (TRVs).
"""

from __future__ import annotations

import io
import os
import traceback
import warnings
from collections.abc import Collection, Iterable
from inspect import signature
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_tdpg.advantages import ValueFunction
from sb3_tdpg.buffers import EpisodeBuffer, each_part
from sb3_tdpg.checks import nearest_multiples, refuse_others
from sb3_tdpg.common.files import replaced_atomically
from sb3_tdpg.common.random_state import RandomState
from sb3_tdpg.information import InformationEstimator
from sb3_tdpg.policies import TRVPolicy
from sb3_tdpg.problem import Problem, check_numbers, check_observations, named_shapes, read_problem

SelfEpisodic = TypeVar("SelfEpisodic", bound="EpisodicAlgorithm")


class TrainingDivergedError(ValueError):
    """A loss is NaN or infinite. The model keeps the last good parameters."""


class RunningEpisodes:
    """
    The column of the buffer that the episode of each environment fills, and the end of an epoch.

    :param n_envs: E.
    :param n_episodes: Each environment runs its share of these; ``None``: it begins another episode as long as fewer
        than ``n_steps`` steps are stored.
    """

    def __init__(self, n_envs: int, n_episodes: int | None, n_steps: int) -> None:
        self.n_episodes, self.n_steps = n_episodes, n_steps
        self.column = np.arange(n_envs)
        """``(E,)``; -1: the environment has run its last episode."""
        self._n_columns, self._n_stored = n_envs, 0

    @property
    def running(self) -> np.ndarray:
        """The environments whose steps are stored, in order."""
        return np.flatnonzero(self.column >= 0)

    def advance(self, finished: np.ndarray) -> None:
        """Count a step of the running environments, and give those whose episode is over the next column: ``(E,)``."""
        self._n_stored += self.running.size
        for i in np.flatnonzero(finished & (self.column >= 0)):
            if self.n_episodes is not None:
                following = self.column[i] + len(self.column)
                self.column[i] = following if following < self.n_episodes else -1
            elif self._n_stored < self.n_steps:
                self.column[i] = self._n_columns
                self._n_columns += 1
            else:
                self.column[i] = -1


class EpisodicAlgorithm(OnPolicyAlgorithm):
    """
    An on-policy algorithm that rolls out N whole episodes of a :class:`~sb3_tdpg.TRVPolicy` per epoch.

    A subclass sets ``n_episodes`` and the attributes below, and implements ``train``.
    """

    policy: TRVPolicy  # type: ignore[assignment]
    rollout_buffer: EpisodeBuffer
    estimator: InformationEstimator
    value_function: ValueFunction | None = None
    """With ``baseline="value"``."""
    nuisance: Any = None
    """What the rollouts show beside the state, see :func:`~sb3_tdpg.robustness.nuisance.with_nuisance`."""
    n_episodes: int | None
    """Episodes of an epoch."""
    epoch_steps: int | None = None
    """Instead: an epoch ends when its episodes have that many steps."""
    # Plain numbers, so that a model that is loaded without an environment can rebuild its networks.
    horizon: int = 0
    state_dim: int = 0
    epoch: int = 0
    """Policy epochs completed."""
    information: np.ndarray | None = None
    """I[x_t; x~_t] of the last rollouts in nats, ``(T,)``; None without a penalty."""
    _random_state: RandomState | None = None
    _problem: Problem | None = None

    def __init__(self, *args: Any, device: th.device | str = "auto", **kwargs: Any) -> None:
        try:
            is_cuda = device != "auto" and th.device(device).type == "cuda"
        except RuntimeError as e:
            raise ValueError(f"device={device!r} is unknown: use 'cpu', 'cuda', 'cuda:1' or 'auto'") from e
        if is_cuda and not th.cuda.is_available():
            warnings.warn(f"device={str(device)!r}, but torch finds no GPU: the model is on the CPU", stacklevel=3)
        # Unused: the length of a rollout is set once the horizon is known, the others belong to other algorithms.
        unused: dict[str, Any] = dict(n_steps=0, ent_coef=0.0, vf_coef=0.0, use_sde=False, sde_sample_freq=-1)
        super().__init__(*args, device=device, **unused, _init_setup_model=False, **kwargs)  # type: ignore[misc]

    # -- the environment --------------------------------------------------------------------------------------

    def _check_problem(self, env: VecEnv) -> Problem:
        """
        Read horizon and state from the environment.

        :raises ValueError: if it does not fit the algorithm or what the model was made for.
        """
        normalize = unwrap_vec_normalize(env)
        if normalize is not None and normalize.norm_reward:
            raise ValueError(
                "VecNormalize(norm_reward=True) rescales the cost and with it, silently, beta: use norm_reward=False"
            )
        if self.n_episodes is not None and self.n_episodes % env.num_envs != 0:
            raise ValueError(
                f"n_episodes={self.n_episodes} must be a multiple of the number of environments ({env.num_envs}), so "
                f"that each environment runs the same number of episodes: use "
                f"{nearest_multiples(self.n_episodes, env.num_envs)}"
            )
        problem = read_problem(env)
        if self.horizon not in (0, problem.horizon) or self.state_dim not in (0, problem.state_dim):
            raise ValueError(
                f"the environment has horizon={problem.horizon} and {problem.state_dim} state components, but the "
                f"model was made for horizon={self.horizon} and {self.state_dim}: use an environment of the same shape"
            )
        return problem

    def _set_problem(self, problem: Problem, env: VecEnv) -> None:
        self._problem = problem
        self.horizon, self.state_dim = problem.horizon, problem.state_dim
        self.n_steps = self.epoch_size // env.num_envs

    @property
    def epoch_size(self) -> int:
        """Environment steps of an epoch whose episodes last to the horizon."""
        if self.n_episodes is not None:
            return self.horizon * self.n_episodes
        assert self.epoch_steps is not None
        return self.epoch_steps

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """See :meth:`stable_baselines3.common.base_class.BaseAlgorithm.set_env`."""
        wrapped = self._with_nuisance(self._wrap_env(env, self.verbose))
        problem = self._check_problem(wrapped)  # before the model's own environment is replaced
        super().set_env(wrapped, force_reset)
        self._set_problem(problem, wrapped)

    def _with_nuisance(self, env: VecEnv) -> VecEnv:
        """Put the declared nuisance around an environment, which may come from another model."""
        from sb3_tdpg.robustness.nuisance import with_nuisance  # the algorithm itself knows nothing of perturbations

        return with_nuisance(env, self.nuisance)

    # -- rollouts ---------------------------------------------------------------------------------------------

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
        would favour short ones. With ``epoch_steps`` an environment begins another episode as long as there are fewer
        steps; the last epoch of ``learn`` takes those that are left, but a tenth of an epoch at least. All environments
        begin an epoch at t = 0.

        :param env: The training environments.
        :param callback: Called at each step, and at the beginning and the end.
        :param rollout_buffer: Receives the episodes.
        :param n_rollout_steps: Unused: an epoch is a number of episodes.
        :return: False if a callback asked to stop.
        """
        assert self._problem is not None, "the model has no environment: set_env() first"
        callback.on_rollout_start()
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        n_envs = env.num_envs
        obs = self._first_observations(env)
        states = self._problem.initial_states(env, obs)  # (E, X)
        trvs = th.zeros(n_envs, self.policy.trv_dim, device=self.device)
        t = np.zeros(n_envs, np.int64)
        episodes = RunningEpisodes(n_envs, self.n_episodes, self._steps_of_this_epoch())
        # An epoch that ends early cannot be continued: leave the environments to be reset.
        self._last_obs = None

        while (running := episodes.running).size > 0:
            check_observations(self.observation_space, obs, t)
            check_numbers("state", states, (self.state_dim,), t)
            with th.no_grad():
                step = self.policy.step(obs_as_tensor(obs, self.device), trvs, np.minimum(t, self.horizon - 1))
            actions = step.actions.cpu().numpy()
            env_actions = actions.reshape((-1, *self.action_space.shape))  # type: ignore[misc]
            if isinstance(self.action_space, spaces.Box):
                env_actions = np.clip(env_actions, self.action_space.low, self.action_space.high)
            with named_shapes(env):
                new_obs, rewards, dones, infos = cast(Any, env.step(env_actions))

            check_numbers("reward", np.nan_to_num(rewards), (), t)  # train() tells of NaN
            self.num_timesteps += n_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)

            stored = {
                "observations": obs,
                "states": states,
                "noise": step.noise.cpu().numpy(),
                "trvs": step.trvs.cpu().numpy(),
                "means": step.means.cpu().numpy(),
                "stds": step.stds.cpu().numpy(),
                "actions": actions.reshape(n_envs, -1),
                "costs": -rewards,
            }
            columns = episodes.column[running]
            rollout_buffer.add_step(
                t[running], columns, **{k: each_part(lambda x: x[running], v) for k, v in stored.items()}
            )
            states = self._problem.next_states(env, new_obs, dones, infos)
            trvs = step.trvs * th.as_tensor(~dones[:, None], device=self.device)
            t = np.where(dones, 0, t + 1)
            finished = dones
            if dones.any() and (lost := np.array([info.get("episode_lost", False) for info in infos])).any():
                # RayVecEnv has restarted these environments: they run the episode again.
                rollout_buffer.clear_episodes(columns[lost[running]])
                finished = dones & ~lost
            episodes.advance(finished)
            if (t[episodes.running] >= self.horizon).any():
                raise ValueError(
                    f"an episode did not end after horizon={self.horizon} steps: the environment must return "
                    "terminated or truncated there (or declare its true horizon)"
                )
            obs = new_obs

        rollout_buffer.full = True
        if (t == 0).all():
            self._last_obs = obs
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _first_observations(self, env: VecEnv) -> Any:
        if self._last_obs is None:
            with named_shapes(env):
                self._last_obs = env.reset()  # type: ignore[assignment]
            self._last_episode_starts = np.ones(env.num_envs, dtype=bool)
        return self._last_obs

    def _steps_of_this_epoch(self) -> int:
        """Return its steps: with ``epoch_steps``, no more than are left, but for a tenth of an epoch."""
        size = self.epoch_size
        if self.epoch == 0:
            return size
        least = size // 10  # fewer would make an update of noise
        if self.policy.time_varying:  # an estimate at each time step needs two episodes
            least = max(least, self.horizon + 1)
        return min(size, max(self.remaining_timesteps, least))

    def dump_logs(self, iteration: int = 0) -> None:
        """Write the log; the mean cost comes from all episodes of the epoch."""
        self.logger.record("rollout/ep_cost_mean", float(self.rollout_buffer.episode_costs.mean()))
        super().dump_logs(iteration)

    def _check_finite(self, name: str, value: th.Tensor) -> None:
        """Stop while the parameters are still good."""
        if bool(th.isfinite(value).all()):
            return
        self._last_obs = None
        raise TrainingDivergedError(
            f"the {name} of epoch {self.epoch} is NaN or infinite (after {self.num_timesteps} timesteps). The model "
            "keeps the parameters from before this update. Check the environment's costs and observations; a smaller "
            "learning_rate, max_grad_norm=1, or a larger encoder_var_floor in policy_kwargs help against exploding "
            "log-probabilities"
        )

    # -- learn, save, resume ----------------------------------------------------------------------------------

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
        self._last_obs = None  # somebody may have stepped the environments since the last epoch
        if reset_num_timesteps:
            self.epoch = 0
            self._current_progress_remaining = 1.0
        random_state, self._random_state = self._random_state, None
        with named_shapes(self.env):
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
        Save the model with the state of all random number generators, between two epochs.

        The environments are reset, here and after loading, so that their generators are their whole state. See
        :class:`~sb3_tdpg.TrainingCheckpointCallback`.
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
        """Save to a zip file; an older file is replaced only when the new one is complete."""
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
        cls: type[SelfEpisodic],
        path: str | Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfEpisodic:
        """
        Load a saved model; see :meth:`stable_baselines3.common.base_class.BaseAlgorithm.load`.

        :param kwargs: Arguments to change, for instance ``beta=1 / 75`` to continue from a policy-gradient model.
        :raises ValueError: if the file is damaged or TDPG did not save it.
        """
        # As in the constructor: a limit alone implies beta="auto", and a number for beta needs no limit.
        if kwargs.get("cost_limit") is not None:
            kwargs.setdefault("beta", "auto")
        elif kwargs.get("beta", "auto") != "auto":
            kwargs.setdefault("cost_limit", None)
        for one, other in (("n_episodes", "epoch_steps"), ("epoch_steps", "n_episodes")):
            if kwargs.get(one) is not None:
                kwargs.setdefault(other, None)
        known = {name for each in cls.__mro__[:-1] for name in signature(each).parameters}
        refuse_others({name: 0 for name in kwargs if name not in known and name[0] != "_"}, known)
        if "batch_size" in kwargs:
            kwargs.setdefault("_has_default_batch_size", kwargs["batch_size"] is None)
        try:
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except Exception as e:
            # Damaged bytes lead to any error, but the arguments of this call to none while the file is read.
            names = [frame.f_code.co_name for frame, _ in traceback.walk_tb(e.__traceback__)]
            is_read = "load_from_zip_file" in names or ("set_parameters" in names and not kwargs)
            changed = [
                f"{k}={value!r}" for k, value in kwargs.items() if k in ("mi_estimator", "mi_kwargs", "baseline")
            ]
            if "set_parameters" in names and changed:
                raise ValueError(
                    f"{path} has no networks for {', '.join(changed)}: load it with what it was trained with, or make "
                    "a new model, and model.policy.load_state_dict(TDPG.load(path).policy.state_dict())"
                ) from e
            # What SB3 itself finds missing: "No data found in the saved file", and keys of the data.
            is_lacking = names[-1] == "load" and isinstance(e, (AssertionError, KeyError))
            if isinstance(e, OSError) or not (is_read or is_lacking):
                raise
            raise ValueError(
                f"{path} is not a model of TDPG: the file is damaged, or another program made it "
                f"({' '.join(str(e).split())[:200]})"
            ) from e

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_problem", "_has_default_device"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        # The estimator's state dict holds its optimiser, too.
        value = [] if self.value_function is None else ["value_function", "value_function.optimizer"]
        return ["policy", "policy.optimizer", "estimator", *value], []


def check_policy(policy: Any, aliases: Collection[str]) -> None:
    """Raise a ``ValueError`` unless the policy is TDPG's."""
    if isinstance(policy, str) and policy not in aliases:
        hint = "" if not policy.endswith("Policy") else "; TRVPolicy takes vectors, images and dicts of them"
        raise ValueError(f"policy={policy!r} is unknown: use one of {list(aliases)}{hint}")
    if not isinstance(policy, str) and not (isinstance(policy, type) and issubclass(policy, TRVPolicy)):
        raise ValueError(
            f"policy={policy!r} is neither 'TRVPolicy' nor a subclass of TRVPolicy; if it comes from a file, another "
            "algorithm saved it: load it with the class that saved it"
        )
