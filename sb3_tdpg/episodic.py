"""
On-policy learning from whole episodes: environments, ``learn``, saving, resuming and exporting.

The method of :class:`~sb3_tdpg.TDPG` is in :mod:`sb3_tdpg.tdpg`; this module has the base class with everything else.

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
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_tdpg.advantages import ValueFunction
from sb3_tdpg.auto_weight import AutoWeight
from sb3_tdpg.buffers import EpisodeBuffer
from sb3_tdpg.callbacks import MINECallback, TDPGProgressBar
from sb3_tdpg.checks import refuse_others, warn_if_short
from sb3_tdpg.common.files import replaced_atomically
from sb3_tdpg.common.random_state import RandomState
from sb3_tdpg.common.threads import threads
from sb3_tdpg.features import of_images
from sb3_tdpg.information import InformationEstimator
from sb3_tdpg.policies import TRVPolicy
from sb3_tdpg.presets import DEFAULTS, Defaults, implied, preset_of
from sb3_tdpg.problem import Problem, named_shapes, read_problem

SelfEpisodic = TypeVar("SelfEpisodic", bound="EpisodicAlgorithm")

HARDLY_ANY = 0.1  # nats per episode, a seventh of a bit


class TrainingDivergedError(ValueError):
    """
    Raised if a cost, the information, a loss or a gradient is NaN or infinite.

    The model keeps the parameters of the last successful update.
    """


class EpisodicAlgorithm(OnPolicyAlgorithm):
    """
    An on-policy algorithm that rolls out N whole episodes of a :class:`~sb3_tdpg.TRVPolicy` per epoch.

    A subclass sets the attributes below, and implements ``collect_rollouts``, ``fit_critics`` and ``train``.
    """

    policy: TRVPolicy  # type: ignore[assignment]
    rollout_buffer: EpisodeBuffer
    estimator: InformationEstimator
    value_function: ValueFunction | None = None
    """The value network, with ``baseline="value"``."""
    nuisance: Any = None
    """Declared perturbations of the rollouts, see :func:`~sb3_tdpg.robustness.nuisance.with_nuisance`."""
    n_episodes: int | None
    """Number of episodes of an epoch."""
    epoch_steps: int | None = None
    """Number of steps of an epoch, instead of ``n_episodes``: no episode begins after that many steps."""
    n_threads: int | None
    preset: str | None
    cost_limit: float | str | None
    auto_weight: AutoWeight | None = None
    """The weight of the information with ``beta="auto"``."""
    first_cost: float | None = None
    """Mean episode cost of the first epoch."""
    # These are plain numbers, so that a model loaded without an environment can rebuild its networks.
    horizon: int = 0
    state_dim: int = 0
    epoch: int = 0
    """Number of completed policy epochs."""
    information: np.ndarray | None = None
    """
    Estimate of I[x_t; x~_t] for the last rollouts in nats, ``(T,)``; its sum over time, ``(1,)``, if one estimate pools
    all steps; None without a penalty.
    """
    normalizes: bool = False
    """Whether the training environment normalised observations (``VecNormalize``)."""
    _random_state: RandomState | None = None
    _problem: Problem | None = None

    def __init__(self, *args: Any, device: th.device | str = "auto", **kwargs: Any) -> None:
        try:
            is_cuda = device != "auto" and th.device(device).type == "cuda"
        except RuntimeError as e:
            raise ValueError(f"device={device!r} is unknown: use 'cpu', 'cuda', 'cuda:1' or 'auto'") from e
        if is_cuda and not th.cuda.is_available():
            warnings.warn(f"device={str(device)!r}, but torch finds no GPU: the model is on the CPU", stacklevel=3)
        # Unused here: n_steps is set once the horizon is known, and the others belong to other algorithms.
        unused: dict[str, Any] = dict(n_steps=0, ent_coef=0.0, vf_coef=0.0, use_sde=False, sde_sample_freq=-1)
        super().__init__(*args, device=device, **unused, _init_setup_model=False, **kwargs)  # type: ignore[misc]

    # -- the environment --------------------------------------------------------------------------------------

    def _check_problem(self, env: VecEnv) -> Problem:
        """
        Read the horizon and the state's dimension from the environment.

        :raises ValueError: if the environment does not fit the algorithm, or differs in shape from the one that the
            model was made for.
        """
        normalize = unwrap_vec_normalize(env)
        if normalize is not None and normalize.norm_reward:
            raise ValueError(
                "VecNormalize(norm_reward=True) rescales the cost and with it, silently, beta: use norm_reward=False"
            )
        if self.n_episodes is not None and self.n_episodes % env.num_envs != 0:
            raise ValueError(
                f"n_episodes={self.n_episodes} must be a multiple of the number of environments ({env.num_envs}), so "
                "that each environment runs the same number of episodes: use "
                f"{max(1, round(self.n_episodes / env.num_envs)) * env.num_envs}"
            )
        problem = read_problem(env, **of_images(self.policy_kwargs))
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
        """Number of steps of an epoch: ``epoch_steps``, or those of ``n_episodes`` episodes that reach the horizon."""
        if self.n_episodes is not None:
            return self.horizon * self.n_episodes
        assert self.epoch_steps is not None
        return self.epoch_steps

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """Set the environment; see :meth:`stable_baselines3.common.base_class.BaseAlgorithm.set_env`."""
        wrapped = self._with_nuisance(self._wrap_env(env, self.verbose))
        problem = self._check_problem(wrapped)  # before the model's own environment is replaced
        super().set_env(wrapped, force_reset)
        self._set_problem(problem, wrapped)

    def _with_nuisance(self, env: VecEnv) -> VecEnv:
        """Wrap an environment in the declared nuisance; the environment may come from another model."""
        from sb3_tdpg.robustness.nuisance import with_nuisance  # the algorithm itself needs no perturbations

        return with_nuisance(env, self.nuisance)

    # -- what the rollouts need ----------------------------------------------------------------------------------

    def _first_observations(self, env: VecEnv) -> Any:
        if self._last_obs is None:
            with named_shapes(env):
                self._last_obs = env.reset()  # type: ignore[assignment]
            self._last_episode_starts = np.ones(env.num_envs, dtype=bool)
        return self._last_obs

    def _steps_of_this_epoch(self) -> int:
        """
        Return the number of steps of this epoch: ``epoch_size`` for the first epoch of a training.

        A later epoch has all remaining steps, but at most ``epoch_size``. It has at least about a tenth of that, and
        enough steps for two episodes if each time step has its own weights.
        """
        size = self.epoch_size
        if self.epoch == 0:
            return size
        least = size // 10  # fewer steps would give a noisy update
        if self.policy.time_varying:  # an estimate at each time step needs two episodes
            least = max(least, self.horizon + 1)
        return min(size, max(self.remaining_timesteps, least))

    def dump_logs(self, iteration: int = 0) -> None:
        """Write the log, with the mean cost over all episodes of the epoch."""
        if self.rollout_buffer.full:  # a callback may ask for the log at any step
            self.logger.record("rollout/ep_cost_mean", float(self.rollout_buffer.episode_costs.mean()))
        super().dump_logs(iteration)

    def _check_finite(self, name: str, value: th.Tensor) -> None:
        """Raise a ``TrainingDivergedError`` before the parameters change if the value is not finite."""
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

    def learn(
        self: SelfEpisodic,
        total_timesteps: int | None = None,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "TDPG",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfEpisodic:
        """
        Train the model; see :meth:`stable_baselines3.common.base_class.BaseAlgorithm.learn`.

        After Ctrl-C the model has the parameters of the last finished update, and can be used, saved or trained
        further.

        :param total_timesteps: Number of environment steps. Default: 400 policy epochs for vectors over a horizon below
            50 (a million steps on Lava), 75 for images, and 100 for depth images and for vectors over a longer horizon.
            Epochs consist of whole episodes, so the training can take more steps. With ``n_episodes``, it takes
            up to one epoch more. With ``epoch_steps``, it takes up to one episode of each environment or a tenth of an
            epoch more.
        :raises TrainingDivergedError: if a cost, the information, a loss or a gradient is NaN or infinite; the model
            keeps the parameters of the last successful update.
        """
        if total_timesteps is None:
            total_timesteps = self._defaults.total_epochs * self.epoch_size
        warn_if_short(total_timesteps, self.epoch_size)
        try:
            with threads(self.n_threads):
                super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        finally:
            TDPGProgressBar.close()
            if self.auto_weight is not None and self.epoch > 0:
                self.auto_weight.warn_if_never_met()
        if self.verbose >= 1 and (kept := self._information_kept()) is not None:
            print(f"Information: {kept}")
        return self

    def _information_kept(self) -> str | None:
        """Describe the information of the last epoch if it was penalised, and say if there is hardly any."""
        if self.auto_weight is not None:
            return self.auto_weight.kept()
        if self.information is None or not self.rollout_buffer.full:  # a callback stopped learn() within an epoch
            return None
        nats = float(self.information.sum())
        text = f"{nats:.3g} nats kept, at a cost of {self.rollout_buffer.episode_costs.mean():.3g}"
        if nats < HARDLY_ANY:
            text += "; this policy hardly looks at its sensor. If it must, use beta='auto', which keeps the cost low"
        return text

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        given = callback if isinstance(callback, list) else [callback]
        callbacks = [c if isinstance(c, BaseCallback) else ConvertCallback(c) for c in given]
        callbacks = [c for each in callbacks for c in (each.callbacks if type(each) is CallbackList else [each])]
        first = [c for c in callbacks if _has_mine(c)] or [MINECallback()]
        callbacks = [*first, *(c for c in callbacks if c not in first)]  # so that the others can read the information
        if progress_bar:
            callbacks.append(TDPGProgressBar())
        return super()._init_callback(callbacks)

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
        self.normalizes = (normalize := unwrap_vec_normalize(self.env)) is not None and normalize.norm_obs
        self._last_obs = None  # a user may have stepped the environments since the last epoch
        if reset_num_timesteps:
            self.epoch = 0
            self._current_progress_remaining = 1.0
        random_state, self._random_state = self._random_state, None
        with named_shapes(self.env):
            result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if random_state is not None and not reset_num_timesteps:
            # This comes last, because the set-up also draws random numbers. The first rollout then resets the
            # environments again.
            random_state.restore(self.env)
            self._last_obs = None
        return result

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        # The last epoch may overshoot, and schedules are defined on [0, 1].
        super()._update_current_progress_remaining(min(num_timesteps, total_timesteps), total_timesteps)

    @property
    def remaining_timesteps(self) -> int:
        """Number of timesteps that the last call of ``learn`` has not run yet."""
        return max(0, self._total_timesteps - self.num_timesteps)

    def save_checkpoint(self, path: str | os.PathLike[str]) -> None:
        """
        Save the model between two epochs, with the state of all random number generators.

        The environments are reset here and after loading, so that only their generators have to be saved. See
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
        """Save the model to a zip file; an older file is replaced only when the new one is complete."""
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

        :param kwargs: Arguments of TDPG to change, for instance ``beta=1 / 75`` to continue from a policy-gradient
            model.
        :raises ValueError: if the file is damaged or TDPG did not save it.
        """
        kwargs |= implied(kwargs)  # as in the constructor
        known = {name for each in cls.__mro__[:-1] for name in signature(each).parameters}
        refuse_others({name: 0 for name in kwargs if name not in known and name[0] != "_"}, known)
        if "batch_size" in kwargs:
            kwargs.setdefault("_has_default_batch_size", kwargs["batch_size"] is None)
        try:
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except Exception as e:
            # A damaged file can raise any error. The arguments of this call cannot raise one while the file is read.
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
            # SB3 itself reports missing contents: "No data found in the saved file", or a missing key.
            is_lacking = names[-1] == "load" and isinstance(e, (AssertionError, KeyError))
            if isinstance(e, OSError) or not (is_read or is_lacking):
                raise
            raise ValueError(
                f"{path} is not a model of TDPG: the file is damaged, or another program made it "
                f"({' '.join(str(e).split())[:200]})"
            ) from e

    def export(self, path: str | os.PathLike[str], *, format: str | None = None) -> Path:
        """
        Export the policy's computation for one step to a file that runs without this package. See
        :func:`~sb3_tdpg.deployment.export.export_policy`.

        If the model's environment has a ``VecNormalize``, the file includes its normalisation of the observations.

        :param path: Path of the file, ``.onnx`` or ``.pt``.
        :param format: ``"onnx"`` or ``"torchscript"``; default: chosen by the file's suffix.
        :return: path of the file
        :raises ValueError: if the training used a ``VecNormalize``, and the model has none.
        """
        from sb3_tdpg.deployment.export import export_trained

        return export_trained(self, path, format, self.get_vec_normalize_env())

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_problem", "_has_default_device"]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        # The state dict of an estimator with critics also holds Adam's moments.
        value = [] if self.value_function is None else ["value_function", "value_function.optimizer"]
        return ["policy", "policy.optimizer", "estimator", *value], []

    @property
    def _defaults(self) -> Defaults:
        return DEFAULTS[self.preset or preset_of(self.observation_space, None)]


def _has_mine(callback: BaseCallback) -> bool:
    return isinstance(callback, MINECallback) or any(map(_has_mine, getattr(callback, "callbacks", ())))


def check_policy(policy: Any, aliases: Collection[str]) -> None:
    """Raise a ``ValueError`` unless the policy is one of TDPG's aliases or a subclass of ``TRVPolicy``."""
    if isinstance(policy, str) and policy not in aliases:
        hint = "" if not policy.endswith("Policy") else "; TRVPolicy takes vectors, images and dicts of them"
        raise ValueError(f"policy={policy!r} is unknown: use one of {list(aliases)}{hint}")
    if not isinstance(policy, str) and not (isinstance(policy, type) and issubclass(policy, TRVPolicy)):
        raise ValueError(
            f"policy={policy!r} is neither 'TRVPolicy' nor a subclass of TRVPolicy; if it comes from a file, another "
            "algorithm saved it: load it with the class that saved it"
        )
