"""Extend the experiment manager of rl-zoo3 to the environments and the algorithm of this package."""

import copy
import json
import os
import re
import shlex
import shutil
import warnings
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from functools import partial
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import rl_zoo3.train
import torch as th
import yaml
from huggingface_sb3 import EnvironmentName
from rl_zoo3 import ALGOS
from rl_zoo3.exp_manager import ExperimentManager
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from sb3_tdpg import hyperparams as yaml_files
from sb3_tdpg.callbacks import SelectionCallback, TrainingCheckpointCallback
from sb3_tdpg.checks import schedule_of
from sb3_tdpg.common.provenance import differences, jsonable, write_run_config
from sb3_tdpg.common.trust import check_plain
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.vec_env import batched_class, largest_divisor, make_episodes_env

CHECKPOINT, RECORD = "checkpoint.zip", "run.json"
# A checkpoint resets the environments, so checkpoints are rare, but frequent enough that an interrupt loses little.
CHECKPOINT_EPOCHS = 10
# Keys whose text the zoo evaluates as Python code.
EVALUATED = {"monitor_kwargs", "normalize", "policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs"}


def find_file(algo: str, block: str) -> str | None:
    """Return the path of this package's file for an algorithm if the file has the block, or else ``None``."""
    path = resources.files(yaml_files).joinpath(f"{algo}.yml")
    if algo == "tdpg" or (path.is_file() and block in yaml.safe_load(path.read_text(encoding="utf-8"))):
        return str(path)  # for tdpg the zoo has no file of its own
    return None


def check_numbers(block: Mapping[str, Any], where: str) -> None:
    """Raise an error for a number that YAML reads as text; ``where`` names the block in the message."""
    for key, value in block.items():
        try:
            number = float(value) if isinstance(value, str) else None
        except ValueError:
            continue
        if number is not None:
            correct = yaml.safe_dump(int(number) if number.is_integer() else number).split()[0]
            raise ValueError(f"{where} has {key}: {value}, which YAML reads as text, not as a number: write {correct}")


class TDPGExperimentManager(ExperimentManager):
    """
    Set up and run one training of rl-zoo3.

    - Every algorithm runs environments of this package as a :class:`~sb3_tdpg.vec_env.BatchedVecEnv`, unless
      ``--vec-env subproc`` or wrappers of single environments are given.
    - Blocks in this package's files are found without ``--conf-file``. A training with bad settings leaves no files.
    - The evaluation environment gets the ``env_kwargs`` of the block unless other keywords are given for it.
    - The evaluation of TDPG uses the stochastic policy that is trained.
    - An interrupted training of TDPG leaves a checkpoint from which it can be resumed. A finished training leaves the
      policy that the :class:`~sb3_tdpg.SelectionCallback` of its block selected.
    """

    # The zoo has no flags for these values: a program sets them in a subclass.
    block: str | None = None
    resume: Path | None = None
    arguments: tuple[str, ...] = ()

    def __init__(self, args: Any, algo: str, env_id: str, *rest: Any, **kwargs: Any) -> None:
        kwargs["config"] = kwargs.get("config") or find_file(algo, self.block or env_id)
        super().__init__(args, algo, env_id, *rest, **kwargs)
        self.where = f"block {self.block or env_id} of {self.config}"
        self.is_batch = batched_class(env_id) is not None and self.vec_env_class is DummyVecEnv
        self.is_interrupted = self.has_claimed = False
        self.deterministic_eval = self.deterministic_eval and algo != "tdpg"
        if self.resume is not None:
            self.save_path = str(self.resume)
            self.params_path = f"{self.save_path}/{self.env_name}"
            self.trained_agent = os.path.join(self.save_path, CHECKPOINT)
            self.continue_training = True

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        """Create the environment and the model; if this fails, remove the folder that was created for them."""
        try:
            with self.explained_errors():
                return super().setup_experiment()
        except BaseException:
            if self.has_claimed:
                shutil.rmtree(self.save_path, ignore_errors=True)
            raise

    @contextmanager
    def explained_errors(self) -> Iterator[None]:
        """Turn Python's errors for unknown arguments, classes and names into a ``ValueError`` that names the block."""
        try:
            yield
        except (AttributeError, LookupError, NameError, SyntaxError, TypeError) as e:
            reason = f"({type(e).__name__}: {' '.join(str(e).split())})"
            raise ValueError(f"{self.where} or a setting on the command line does not fit {reason}: correct it") from e

    def create_log_folder(self) -> None:
        """Create the folder of the training; trainings that start at the same time get folders of their own."""
        while not (self.has_claimed or self.resume is not None or self.optimize_hyperparameters):
            try:
                os.makedirs(self.save_path)
                self.has_claimed = True
            except FileExistsError:
                self.save_path = re.sub(r"\d+$", lambda number: str(int(number[0]) + 1), self.save_path)
                self.params_path = f"{self.save_path}/{self.env_name}"
        super().create_log_folder()

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Read and check the block of hyperparameters."""
        env_name, block = self.env_name, self.block or self.env_name.gym_id
        self.env_name = EnvironmentName(block)  # the zoo searches for the block by this name
        try:
            hyperparams, saved = super().read_hyperparameters()
        except (OSError, ValueError, TypeError, AttributeError, yaml.YAMLError) as e:  # TypeError: an empty block
            reason = " ".join(str(e).split())
            raise ValueError(
                f"{self.config} has no readable block {block!r} for {self.algo} ({reason}): choose another one with "
                "--block, or another file with --conf-file"
            ) from e
        finally:
            self.env_name = env_name
        saved = copy.deepcopy(saved)  # the zoo adds gamma to normalize
        if self.resume is not None:
            now = jsonable(saved)
            if changed := differences(json.loads(Path(self.resume, RECORD).read_text()).get("hyperparams", now), now):
                raise ValueError(f"{self.resume} was trained with other settings than {self.config} has now, {changed}")
            for key in EVALUATED & set(hyperparams):
                if isinstance(text := hyperparams[key], str):
                    check_plain(text, f"{self.resume} was trained with {key}:")
        check_numbers(hyperparams, self.where)
        return hyperparams, saved

    def _preprocess_schedules(self, hyperparams: dict[str, Any]) -> dict[str, Any]:  # type: ignore[override]
        if self.algo != "tdpg":
            return super()._preprocess_schedules(hyperparams)
        # The zoo's class is not used: its schedules always end at 0, and loading a model with it needs the zoo.
        names = {"learning_rate", "clip_range"} & set(hyperparams)
        return {**hyperparams, **{name: schedule_of(name, hyperparams[name]) for name in names}}

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        if self.algo == "tdpg" and "n_envs" not in hyperparams:
            # Keywords from the command line replace those of the block.
            env_kwargs = self.env_kwargs or hyperparams.get("env_kwargs")
            hyperparams["n_envs"] = self._default_n_envs(env_kwargs, hyperparams)
        processed = super()._preprocess_hyperparams(hyperparams)
        if self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = self.env_kwargs
        return processed

    def _default_n_envs(self, env_kwargs: dict[str, Any] | None, settings: Mapping[str, Any]) -> int:
        length = {name: settings.get(name) for name in ("n_episodes", "epoch_steps")}
        env_id = self.env_name.gym_id
        with closing(make_episodes_env(env_id, env_kwargs=env_kwargs, **length, use_processes=False)) as env:
            return env.num_envs if self.is_batch else largest_divisor(env.num_envs)

    def create_envs(self, n_envs: int, eval_env: bool = False, no_log: bool = False) -> VecEnv:
        """Create the environments, as a batch if this is possible."""
        if self.is_batch and self.env_wrapper is None:
            is_logged = not (eval_env or no_log or self.optimize_hyperparameters)
            env_kwargs = self.eval_env_kwargs if eval_env else self.env_kwargs
            self.vec_env_class = partial(self._make_batch, env_kwargs, is_logged)  # type: ignore[assignment]
        elif self.resume is not None and not (eval_env or no_log):
            # Monitor would overwrite its files, so the files of the first start get higher numbers.
            logs = {int(path.name.partition(".")[0]): path for path in Path(self.save_path).glob("*.monitor.csv")}
            for number, path in sorted(logs.items(), reverse=True):
                path.rename(path.with_name(f"{number + n_envs}.monitor.csv"))
        return super().create_envs(n_envs, eval_env, no_log)

    def _make_batch(self, env_kwargs: dict[str, Any], is_logged: bool, env_fns: list[Any]) -> VecEnv:
        env = make_episodes_env(self.env_name.gym_id, len(env_fns), env_kwargs=env_kwargs, seed=self.seed)
        # A resumed training logs its episodes to another file; the zoo's plots read all files of a folder.
        n_logs = len(list(Path(self.save_path).glob("*.monitor.csv")))
        with warnings.catch_warnings():
            # The batch already reports the returns of its episodes, but it does not write them to a file.
            warnings.filterwarnings("ignore", message="The environment is already wrapped with a `Monitor`")
            file = os.path.join(self.save_path, str(n_logs)) if is_logged else None
            return VecMonitor(env, file, tuple(self.monitor_kwargs.get("info_keywords", ())))

    def create_callbacks(self) -> None:
        """Create the callbacks; those of TDPG write the selected policy and the checkpoint to the training's folder."""
        super().create_callbacks()
        if self.algo != "tdpg" or self.optimize_hyperparameters:
            return
        for callback in self.callbacks:
            if isinstance(callback, SelectionCallback) and callback.save_path is None:
                callback.save_path = Path(self.save_path, "selected.zip")
        self.callbacks.append(TrainingCheckpointCallback(Path(self.save_path, CHECKPOINT), CHECKPOINT_EPOCHS))
        for callback in self.callbacks:
            if isinstance(callback, EvalCallback):
                # A resumed training evaluates other episodes, but it must draw the same random numbers.
                callback._on_step = th.random.fork_rng()(callback._on_step)  # type: ignore[method-assign]

    def learn(self, model: BaseAlgorithm) -> None:
        """Train the model. An interrupt ends the training; :meth:`save_trained_model` raises it again."""

        def learn(n_timesteps: int, **kwargs: Any) -> None:
            if self.resume is not None:
                assert isinstance(model, TDPG)
                n_timesteps, kwargs["reset_num_timesteps"] = model.remaining_timesteps, False
                for callback in self.callbacks:
                    callback.n_calls = model.num_timesteps // model.n_envs  # keeps the interval between evaluations
                    if isinstance(callback, EvalCallback):
                        _go_on_evaluating(callback, model.num_timesteps)
            try:
                model.learn(n_timesteps, **kwargs)
            except KeyboardInterrupt:  # the zoo catches this exception without raising it again
                self.is_interrupted = True
                raise

        # These are the attributes that the zoo's loop uses.
        super().learn(SimpleNamespace(env=model.env, policy=model.policy, learn=learn))  # type: ignore[arg-type]

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        """Save the model; after a finished training it has the selected policy."""
        selections = [] if self.is_interrupted else [c for c in self.callbacks if isinstance(c, SelectionCallback)]
        for selection in selections:
            assert isinstance(model, TDPG)
            try:
                best = selection.restore(model)
                print(f"selected the policy of {best}")
            except ValueError as e:
                print(f"no policy was selected: {e}")
        super().save_trained_model(model)
        checkpoint = Path(self.save_path, CHECKPOINT)
        if not self.is_interrupted:
            checkpoint.unlink(missing_ok=True)
            return
        print(f"interrupted after {model.num_timesteps} of {model._total_timesteps} steps")
        if checkpoint.exists():
            print(f"`sb3-tdpg train --resume {shlex.quote(self.save_path)}` continues from the last checkpoint")
        raise KeyboardInterrupt

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        if self.resume is None:  # a resumed training keeps the record of the first start
            super()._save_config(saved_hyperparams)
            env_id = self.env_name.gym_id
            config: dict[str, Any] = dict(algo=self.algo, env_id=env_id, block=self.block or env_id, seed=self.seed)
            config |= dict(arguments=self.arguments, hyperparams=saved_hyperparams)
            write_run_config(Path(self.save_path, RECORD), config)


def register(manager: type[ExperimentManager] = TDPGExperimentManager) -> None:
    """
    Add TDPG to the algorithms of rl-zoo3 in this process, so that rl-zoo3's programs accept ``--algo tdpg``.

    :param manager: The experiment manager that ``train`` uses.
    """
    ALGOS["tdpg"] = TDPG  # all programs of the zoo share this dictionary
    rl_zoo3.train.ExperimentManager = manager  # type: ignore[misc]


def _go_on_evaluating(callback: EvalCallback, n_timesteps: int) -> None:
    """Restore the evaluations before a checkpoint, and the best reward, in a resumed callback."""
    path = Path(f"{callback.log_path}.npz")
    if callback.log_path is None or not path.exists():
        return
    with np.load(path) as found:
        kept = found["timesteps"] <= n_timesteps
        callback.evaluations_timesteps = found["timesteps"][kept].tolist()
        callback.evaluations_results = found["results"][kept].tolist()
        callback.evaluations_length = found["ep_lengths"][kept].tolist()
        if "successes" in found:
            callback.evaluations_successes = found["successes"][kept].tolist()
        # The best model may come from an evaluation after the checkpoint.
        callback.best_mean_reward = float(found["results"].mean(axis=1).max())
