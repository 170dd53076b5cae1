"""The zoo's manager of an experiment, with what this plugin knows better."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import rl_zoo3.train
import yaml
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.wrappers import HistoryWrapper, HistoryWrapperObsDict
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecMonitor, VecNormalize

from sb3_tdpg.callbacks import SelectionCallback, TrainingCheckpointCallback
from sb3_tdpg.common.provenance import write_run_config
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.vec_env import batched_class, default_n_envs, make_episodes_env
from sb3_tdpg.zoo.blocks import check_block, find_file

CHECKPOINT = "checkpoint.zip"
RECORD = "run.json"
# A checkpoint resets the environments: rarely enough that this is no matter, often enough that little is lost.
CHECKPOINT_EPOCHS = 10


def register() -> None:
    """
    Make TDPG known to rl-zoo3's programs in this process, as its documentation tells third-party algorithms to.

    Afterwards ``rl_zoo3.train.train()`` and the others take ``--algo tdpg``.
    """
    ALGOS["tdpg"] = TDPG  # one dictionary, which all of them share
    rl_zoo3.train.ExperimentManager = TDPGExperimentManager  # type: ignore[misc]


class TDPGExperimentManager(ExperimentManager):
    """
    What one of the zoo's trainings is made of.

    - All episodes of one of this plugin's environments go side by side in one call
      (:class:`~sb3_tdpg.vec_env.BatchedVecEnv`), unless ``--vec-env subproc`` or a wrapper of single environments is
      asked for. This holds for every algorithm.
    - Blocks of this plugin's own files are found without ``--conf-file``.
    - A key that no one reads, or a number that YAML reads as text, is refused before anything is written.
    - The evaluation has the ``env_kwargs`` of the block, unless it is given its own.
    - TDPG is evaluated as it is trained: stochastic.
    - A killed or interrupted training of TDPG leaves a checkpoint from which it can be resumed, and a finished one the
      policy that the block's :class:`~sb3_tdpg.SelectionCallback` has chosen.
    """

    # Set by the programs of this plugin before the zoo makes the manager, since the zoo has no flags for them.
    block: str | None = None
    resume: Path | None = None
    arguments: tuple[str, ...] = ()
    # And told them by it: the zoo itself ends an interrupted training like a finished one.
    was_interrupted = False

    def __init__(self, args: Any, algo: str, env_id: str, *rest: Any, **kwargs: Any) -> None:
        kwargs["config"] = kwargs.get("config") or find_file(algo, self.block or env_id)
        super().__init__(args, algo, env_id, *rest, **kwargs)
        if algo == "tdpg":
            self.deterministic_eval = False
        if self.resume is not None:
            self.save_path = str(self.resume)
            self.params_path = f"{self.save_path}/{self.env_name}"
            self.trained_agent = os.path.join(self.save_path, CHECKPOINT)
            self.continue_training = True

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """See the zoo. Nothing is left behind if it cannot be set up."""
        was_there = os.path.exists(self.save_path)
        try:
            return super().setup_experiment()
        except BaseException:
            if not was_there:
                shutil.rmtree(self.save_path, ignore_errors=True)
            raise

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Read and check the block; see the zoo."""
        env_name, block = self.env_name, self.block or self.env_name.gym_id
        _check_file(self.config)
        self.env_name = EnvironmentName(block)  # under which the zoo looks the block up
        try:
            hyperparams, saved = super().read_hyperparameters()
        except ValueError as e:
            if "Hyperparameters not found" not in str(e):
                raise
            raise ValueError(
                f"{self.config} has no block {block!r} for {self.algo}: give --block with one that it has, or "
                "--conf-file with a file of your own"
            ) from e
        finally:
            self.env_name = env_name
        check_block(hyperparams, self.algo, f"block {block} of {self.config}")
        return hyperparams, saved

    def load_trial(
        self, storage: str, study_name: str, trial_id: int | None = None, convert: bool = True
    ) -> dict[str, Any]:
        """Return the block of a trial of ``tune``; of another algorithm's trial, see the zoo."""
        if self.algo != "tdpg":
            return super().load_trial(storage, study_name, trial_id, convert)
        from sb3_tdpg.zoo.tuning import block_of_trial

        return block_of_trial(storage, study_name, trial_id)

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        if self.algo == "tdpg" and "n_envs" not in hyperparams:
            hyperparams["n_envs"] = self._count_episodes(hyperparams)
        processed, wrap, *others = super()._preprocess_hyperparams(hyperparams)
        self.env_wrapper = None if wrap is None else partial(_wrap_with_horizon, wrap)
        if self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = self.env_kwargs
        return processed, self.env_wrapper, *others

    def _count_episodes(self, hyperparams: dict[str, Any]) -> int:
        """As many environments as an epoch has episodes if these go as a batch, otherwise a divisor of that."""
        # On the command line they replace those of the block.
        env_kwargs = self.env_kwargs or hyperparams.get("env_kwargs")
        env = self._make_batch(env_kwargs, n_episodes=hyperparams.get("n_episodes"), use_processes=False)
        n_envs = env.num_envs
        env.close()
        is_batch = batched_class(self.env_name.gym_id) is not None
        return n_envs if is_batch and self.vec_env_class is DummyVecEnv else default_n_envs(n_envs)

    def _make_batch(self, env_kwargs: dict[str, Any] | None, **kwargs: Any) -> VecEnv:
        try:
            return make_episodes_env(self.env_name.gym_id, env_kwargs=env_kwargs, **kwargs)
        except TypeError as e:  # an unknown keyword
            raise ValueError(f"{self.env_name.gym_id} cannot be made with env_kwargs={env_kwargs}: {e}") from e

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """See the zoo."""
        is_batch = (
            batched_class(self.env_name.gym_id) is not None
            and self.env_wrapper is None
            and self.vec_env_class is DummyVecEnv
        )
        if not is_batch:
            return super().create_envs(n_envs, eval_env, no_log)
        env_kwargs = self.eval_env_kwargs if eval_env else self.env_kwargs
        env = self._make_batch(env_kwargs, n_envs=n_envs, seed=self.seed)
        with warnings.catch_warnings():
            # It tells its episodes' returns itself, but writes no file, which the zoo's plots read.
            warnings.filterwarnings("ignore", message="The environment is already wrapped with a `Monitor`")
            is_logged = not (eval_env or no_log or self.optimize_hyperparameters)
            env = VecMonitor(env, self._new_monitor() if is_logged else None)
        if self.vec_env_wrapper is not None:
            env = self.vec_env_wrapper(env)
        env = self._maybe_normalize(env, eval_env)
        return env if self.frame_stack is None else VecFrameStack(env, self.frame_stack)

    def _new_monitor(self) -> str:
        """Return a name for the log of episodes: one that is resumed goes on in another file, which the plots add."""
        n = len(list(Path(self.save_path).glob("*.monitor.csv")))
        return os.path.join(self.save_path, str(n))

    def create_callbacks(self) -> None:
        """See the zoo. The policy that is selected, and what a training is resumed from, are in its folder, too."""
        super().create_callbacks()
        if self.algo != "tdpg" or self.optimize_hyperparameters:
            return
        for callback in self.callbacks:
            if isinstance(callback, SelectionCallback) and callback.save_path is None:
                callback.save_path = Path(self.save_path, "selected.zip")
        checkpoint = Path(self.save_path, CHECKPOINT)
        self.callbacks.append(_Checkpoint(checkpoint, CHECKPOINT_EPOCHS, Path(self.params_path, "vecnormalize.pkl")))

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self.resume is None:
            return super()._load_pretrained_agent(hyperparams, env)
        # Nothing is changed in it: neither the seed, nor a schedule that has come half of its way.
        return TDPG.load(
            self.trained_agent, env=env, tensorboard_log=self.tensorboard_log, verbose=self.verbose, device=self.device
        )

    def learn(self, model: BaseAlgorithm) -> None:
        """See the zoo."""
        super().learn(_Resumed(model) if self.resume is not None else model)  # type: ignore[arg-type]

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """See the zoo. The last policy is replaced by the selected one."""
        if not isinstance(model, TDPG):
            super().save_trained_model(model)
            return
        checkpoint = Path(self.save_path, CHECKPOINT)
        is_finished = model.num_timesteps >= model._total_timesteps
        if is_finished:
            for callback in self.callbacks:
                if isinstance(callback, SelectionCallback):
                    _restore_selected(callback, model)
        super().save_trained_model(model)
        if is_finished:
            checkpoint.unlink(missing_ok=True)
            return
        type(self).was_interrupted = True
        print(f"interrupted after {model.num_timesteps} of {model._total_timesteps} steps")
        if checkpoint.exists():
            print(f"`sb3-tdpg train --resume {self.save_path}` goes on from the last checkpoint")

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        if self.resume is not None:  # it says how the training began
            return
        super()._save_config(saved_hyperparams)
        config = dict(
            algo=self.algo,
            env_id=self.env_name.gym_id,
            block=self.block or self.env_name.gym_id,
            seed=self.seed,
            arguments=list(self.arguments),
            hyperparams=dict(saved_hyperparams),
        )
        write_run_config(Path(self.save_path, RECORD), config)


class _Checkpoint(TrainingCheckpointCallback):
    """Also keeps the statistics of ``normalize``, where the zoo looks for them."""

    def __init__(self, save_path: Path, save_freq: int, statistics: Path) -> None:
        super().__init__(save_path, save_freq)
        self.statistics = statistics

    def _on_rollout_start(self) -> None:
        normalize = self.model.get_vec_normalize_env()
        if isinstance(normalize, VecNormalize) and self.tdpg.epoch % self.save_freq == 0:
            normalize.save(str(self.statistics))
        super()._on_rollout_start()


class _Resumed:
    """What the zoo's ``learn`` needs of a model, which then goes on instead of beginning anew."""

    def __init__(self, model: BaseAlgorithm) -> None:
        assert isinstance(model, TDPG)
        self.model = model

    @property
    def env(self) -> VecEnv | None:
        return self.model.env

    def learn(self, _: int, **kwargs: Any) -> None:
        self.model.learn(self.model.remaining_timesteps, reset_num_timesteps=False, **kwargs)


def _wrap_with_horizon(wrap: Callable[[gym.Env], gym.Env], env: gym.Env) -> gym.Env:
    """Wrap an environment and show its horizon again, where the zoo's wrapper calls the length of its history so."""
    wrapped = layer = wrap(env)
    while layer is not env and isinstance(layer, gym.Wrapper):
        if isinstance(layer, (HistoryWrapper, HistoryWrapperObsDict)):
            del layer.horizon  # it has made its arrays, and reads this no more
        layer = layer.env
    return wrapped


def _restore_selected(selection: SelectionCallback, model: TDPG) -> None:
    try:
        best = selection.restore(model)
    except ValueError as e:
        print(f"no policy was selected: {e}")
    else:
        print(f"the policy of epoch {best.epoch} was selected: cost {best.cost:.3g}, {best.information:.3g} nat")


def _check_file(path: str) -> None:
    if not path.endswith((".yml", ".yaml")):
        return  # Python, which the zoo reads
    try:
        content = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as e:
        raise ValueError(f"--conf-file {path} cannot be read: {' '.join(str(e).split())}") from e
    if not isinstance(content, dict):
        raise ValueError(f"--conf-file {path} must map environment ids to blocks of hyperparameters")
