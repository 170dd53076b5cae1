"""
Tune hyperparameters with Optuna through the zoo.

Tuning on the reward alone would remove the information penalty, because the penalty lowers the reward in the training
environment. So there are two other objectives. ``information`` minimises the information under a limit on the expected
cost, which is the paper's rule for selecting a policy. ``shift`` minimises the expected cost in an environment that
differs from the training environment.
"""

import contextlib
import copy
import math
import shlex
from pathlib import Path
from typing import Any

import gymnasium as gym
import optuna
import torch as th
import yaml
from rl_zoo3.utils import get_callback_list
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_tdpg.callbacks import SelectionCallback
from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.provenance import check_same_config, with_numbers, write_frame_atomically, write_run_config
from sb3_tdpg.evaluation.information import encode_episodes, information_bounds
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.zoo.manager import TDPGExperimentManager
from sb3_tdpg.zoo.search import Space, put_in, read_space, relevant, sample
from sb3_tdpg.zoo.studies import DONE, REASON, open_storage, open_study, work

N_EVALUATIONS = 10
BEHIND = "behind the others"  # reason why a trial without an error is pruned
RECORD = "study.json"  # settings of a study, in the folder of its results
COST, INFORMATION = "cost", "information"  # attributes of a trial; cost minus limit is also its constraint


class TuningManager(TDPGExperimentManager):
    """Tune TDPG for its own objectives, and other algorithms as the zoo does."""

    # The program sets these, because the zoo has no flags for them.
    objective_kind: str | None = None
    cost_limit: float | None = None
    space_path: Path | None = None

    def __init__(self, args: Any, algo: str, env_id: str, *rest: Any, **kwargs: Any) -> None:
        super().__init__(args, algo, env_id, *rest, **kwargs)
        if algo != "tdpg":
            given = dict(objective=self.objective_kind, cost_limit=self.cost_limit, space=self.space_path)
            if ours := [f"--{name.replace('_', '-')}" for name, value in given.items() if value is not None]:
                raise ValueError(f"{', '.join(ours)} is for TDPG, not for {algo}, which the zoo tunes for the reward")
            return
        if self.objective_kind is None:
            self.objective_kind = "information" if self._eval_env_kwargs_args is None else "shift"
        if self.objective_kind == "shift" and self._eval_env_kwargs_args is None:
            raise ValueError("--objective shift needs --eval-env-kwargs: how the environment differs from training")
        if self.n_jobs != 1:
            threads = f"--n-jobs {self.n_jobs} would be threads of one process, which do not make TDPG faster"
            raise ValueError(f"{threads}: start the same command several times instead")
        self.n_evaluations = self.n_evaluations or N_EVALUATIONS
        self.study_name = self.study_name or f"{self.block or env_id}-{self.objective_kind}"
        self.save_path = self.params_path = str(Path(self.log_path, f"study-{self.study_name}"))
        self.storage = self.storage or str(Path(self.save_path, "study.log"))
        self.settings: dict[str, Any] = {}
        self.space: Space = read_space(self.space_path)

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """Read the block and find the limit on the cost; see the base class."""
        block, saved = super().read_hyperparameters()
        if self.algo == "tdpg":
            self.settings = copy.deepcopy(dict(saved))
            if self.env_kwargs:  # from the command line and the block; the zoo merges them
                self.settings["env_kwargs"] = dict(self.env_kwargs)
            if self.n_timesteps > 0:  # the schedules depend on it
                self.settings["n_timesteps"] = self.n_timesteps
            policy_kwargs = self.settings.get("policy_kwargs")
            if isinstance(policy_kwargs, str):  # the command line and the zoo's own files give text
                self.settings["policy_kwargs"] = eval(policy_kwargs, {"nn": th.nn})
            try:
                yaml.safe_dump(self.settings)
            except yaml.YAMLError as e:  # raised before the trials instead of after them
                reason = " ".join(str(e).split())
                raise ValueError(f"tune writes the best block as YAML, which this one has no form in: {reason}") from e
            self.space = relevant(self.space, block)
            self.cost_limit = self._find_limit(block)
            if block.get("beta") == "auto":
                block["cost_limit"] = self.settings["cost_limit"] = self.cost_limit
        return block, saved

    def _find_limit(self, block: dict[str, Any]) -> float:
        selections = [c.cost_limit for c in get_callback_list(block) if isinstance(c, SelectionCallback)]
        threshold = gym.spec(self.env_name.gym_id).reward_threshold or 0.0
        given = self.cost_limit
        if given is not None and not (math.isfinite(given) and given != 0):
            raise ValueError(f"--cost-limit {given} must be a finite number other than 0")
        if given is None and isinstance(share := block.get("cost_limit"), str):
            raise ValueError(
                f"cost_limit: {share} is another cost in each trial, and tuning needs one: give --cost-limit"
            )
        for limit in (given, block.get("cost_limit"), *selections, -threshold):
            if limit and math.isfinite(limit):
                return float(limit)
        needed = f"a limit on the expected cost (minus the reward) of {self.env_name.gym_id}"
        raise ValueError(f"tuning needs {needed}, a finite number other than 0: give --cost-limit")

    def objective(self, trial: optuna.Trial) -> float:
        """Train with the hyperparameters that a trial samples; return the value that is minimised."""
        if self.algo != "tdpg":
            return super().objective(trial)
        assert self.cost_limit is not None
        settings = put_in(self.settings, sample(trial, self.space), abs(self.cost_limit))
        sampled = {key: value for key, value in settings.items() if value != self.settings.get(key)}
        hyperparams = {**self._hyperparams, **self._preprocess_schedules(sampled)}
        n_envs = self.n_envs
        if "n_envs" not in self.settings and {"n_episodes", "epoch_steps"} & set(self.space):
            n_envs = self._default_n_envs(self.env_kwargs, settings)
        with (
            contextlib.closing(self.create_envs(n_envs, no_log=True)) as env,
            contextlib.closing(self.create_envs(self.n_eval_episodes, eval_env=True)) as eval_env,
        ):
            model = TDPG(env=env, seed=trial.number, device=self.device, **hyperparams)
            model.set_logger(Logger(None, []))  # SB3's own logger would create a folder in /tmp for each trial
            is_constrained = self.objective_kind == "information"
            limit = self.cost_limit if is_constrained else math.inf
            measuring = _Measuring(trial, eval_env, limit, self.n_timesteps // self.n_evaluations)
            callbacks = get_callback_list({"callback": self.specified_callbacks})
            others = [c for c in callbacks if not isinstance(c, SelectionCallback)]  # the last policy is evaluated
            model.learn(self.n_timesteps, [*others, measuring])
            cost, information = measuring.last if measuring.is_pruned else measuring.measure()
            if self.optimization_log_path is not None:
                model.save(Path(self.optimization_log_path, f"trial_{trial.number}", "model.zip"))
            if is_constrained:
                trial.set_constraint(COST, cost - limit)
            if measuring.is_pruned:
                raise optuna.TrialPruned(f"{BEHIND} at expected cost {cost:.4g}, {information:.4g} nat")
            return information if is_constrained else cost

    def hyperparameters_optimization(self) -> None:
        """Run trials, in parallel with other workers, until the study has the requested number."""
        if self.algo != "tdpg":
            super().hyperparameters_optimization()
            return
        assert self.storage is not None and self.study_name is not None
        names = ("cost_limit", "space", "eval_env_kwargs", "n_evaluations", "n_eval_episodes")
        description: dict[str, Any] = {name: getattr(self, name) for name in names}
        description.update(env_id=self.env_name.gym_id, objective=self.objective_kind, block=self.settings)
        record = Path(self.save_path, RECORD)
        if Path(self.storage) != record.with_name("study.log"):  # for this file, open_study() checks the settings
            check_same_config(record, dict(study=self.study_name, **description), "study")
        self._check_trials()
        sampler, pruner = self._create_sampler(self.sampler), self._create_pruner(self.pruner)
        storage = open_storage(self.storage)
        study = open_study(storage, self.study_name, sampler=sampler, pruner=pruner, space=description)
        work(study, self.objective, self.max_total_trials or self.n_trials, describe=_result)
        self._write_results(study, description)

    def _check_trials(self) -> None:
        """Raise an error before the first trial for settings with which every trial would be pruned."""
        self.create_envs(1, eval_env=True).close()
        with contextlib.closing(self.create_envs(self.n_envs, no_log=True)) as env:
            model = TDPG(env=env, device=self.device, **self._hyperparams)
        searched = self.space.get("policy_kwargs.trv_dim", {})
        n_trvs = max(searched.get("choices", [searched.get("high", model.policy.trv_dim)]))
        if self.n_eval_episodes < n_trvs + 2:
            few = (
                f"--eval-episodes {self.n_eval_episodes} are too few to measure the information of up to {n_trvs} TRVs"
            )
            raise ValueError(f"{few}: give at least {n_trvs + 2}")

    def _create_sampler(self, sampler_method: str) -> optuna.samplers.BaseSampler:
        if self.algo != "tdpg" or sampler_method != "tpe":
            return super()._create_sampler(sampler_method)
        options: dict[str, Any] = dict(n_startup_trials=self.n_startup_trials, seed=self.seed, multivariate=True)
        # Like the zoo's sampler, except that workers avoid points near the running trials of other workers.
        return optuna.samplers.TPESampler(**options, constant_liar=True)

    def _write_results(self, study: optuna.Study, description: dict[str, Any]) -> None:
        folder = Path(self.save_path)
        write_frame_atomically(study.trials_dataframe(), folder / "trials.csv")
        write_run_config(folder / RECORD, dict(study=self.study_name, **description))
        best = best_trial(study)
        assert self.cost_limit is not None
        if best is None:
            reasons = [trial.user_attrs.get(REASON, BEHIND) for trial in study.get_trials(states=DONE)]
            if not any(reason.startswith(BEHIND) for reason in reasons):
                mend = "change the block or --space, and choose another --study-name"
                raise ValueError(f"no trial of {self.study_name} could be trained ({reasons[-1]}): {mend}")
            mend = "raise --cost-limit, train longer with -n, or run more trials with --n-trials"
            print(f"no trial of {self.study_name} keeps the expected cost below {self.cost_limit:g}: {mend}")
            return
        settings = put_in(self.settings, best.params, abs(self.cost_limit))
        text = yaml.safe_dump({self.block or self.env_name.gym_id: settings}, sort_keys=False)
        write_atomically(folder / "best.yml", f"# Trial {best.number} of {self.study_name}: {_result(best)}\n{text}")
        print(f"best of {len(study.trials)} trials is number {best.number}, {_result(best)}:")
        for name, value in best.params.items():
            print(f"  {name}: {value:.4g}" if isinstance(value, float) else f"  {name}: {value}")
        command = ["sb3-tdpg", "train", "--env", self.env_name.gym_id, "--conf-file", str(folder / "best.yml")]
        command += [] if self.block is None else ["--block", self.block]
        print(f"results are in {folder}; to train with them: {shlex.join(command)}")


class _Measuring(BaseCallback):
    """Measure cost and information on fresh episodes at intervals, and stop a training that the pruner rejects."""

    def __init__(self, trial: optuna.Trial, env: VecEnv, limit: float, interval: int) -> None:
        super().__init__()
        # With an infinite limit the cost is minimised instead of the information. The interval is in environment steps.
        self.trial, self.env, self.limit, self.interval = trial, env, limit, interval
        self.is_pruned, self.last, self._next, self._n_reports = False, (math.inf, math.inf), interval, 0

    def measure(self) -> tuple[float, float]:
        """Return the expected cost and the information in nats of the current policy."""
        assert isinstance(self.model, TDPG)
        trained_in, fresh = unwrap_vec_normalize(self.training_env), unwrap_vec_normalize(self.env)
        if trained_in is not None and fresh is not None and trained_in.norm_obs:
            fresh.obs_rms = trained_in.obs_rms
        batch, costs = encode_episodes(self.model, self.env, seed=self.trial.number)
        self.last = (float(costs.mean()), max(0.0, information_bounds(batch).upper))
        for name, value in zip((COST, INFORMATION), self.last, strict=True):
            self.trial.set_user_attr(name, value)
        return self.last

    def _on_rollout_start(self) -> None:
        if self.num_timesteps >= self._next:
            self._next += self.interval
            self._n_reports += 1  # the zoo's pruners count evaluations, not steps
            self.trial.report(_rank(*self.measure(), self.limit), self._n_reports)
            self.is_pruned = self.trial.should_prune()

    def _on_step(self) -> bool:
        return not self.is_pruned


def _rank(cost: float, information: float, limit: float) -> float:
    """
    Return a number that orders policies; lower is better.

    Policies that meet the limit have values below 1, ordered by information. All other policies are ordered by cost.
    """
    if math.isinf(limit):
        return cost
    if cost <= limit:
        return information / (information + 1)
    return 1 + (cost - limit) / (cost - limit + abs(limit))


def best_trial(study: optuna.Study) -> optuna.trial.FrozenTrial | None:
    """Return the complete trial with the least value among those that meet the limit on the cost."""
    complete = study.get_trials(states=(optuna.trial.TrialState.COMPLETE,))
    met = [trial for trial in complete if all(value <= 0 for value in trial.constraints.values())]
    return min(met, key=lambda trial: trial.value, default=None)  # type: ignore[arg-type, return-value]


def block_of_trial(storage: str, study_name: str, number: int | None = None) -> dict[str, Any]:
    """
    Return the hyperparameters of a trial of :class:`TuningManager`; default: the best trial.

    :raises ValueError: if there is no such study or trial.
    """
    if "://" not in storage and not Path(storage).exists():  # opening it would create the file
        raise ValueError(f"there is no storage {storage}: give the --storage that tune was run with")
    try:
        study = optuna.load_study(study_name=study_name, storage=open_storage(storage))
        described = study.user_attrs["space"]
    except KeyError as e:
        found = optuna.get_all_study_names(open_storage(storage))
        raise ValueError(f"the storage has no study {study_name!r} of tune: it has {', '.join(found) or 'none'}") from e
    trials = {trial.number: trial for trial in study.get_trials()}
    trial = best_trial(study) if number is None else trials.get(number)
    if trial is None:
        missing = "trial that meets its limit on the cost" if number is None else f"trial {number}"
        raise ValueError(f"study {study_name!r} has no {missing}: it has {len(trials)}, from number 0")
    return put_in(with_numbers(described["block"]), trial.params, abs(described["cost_limit"]))


def _result(trial: optuna.trial.FrozenTrial) -> str:
    return f"expected cost {trial.user_attrs[COST]:.4g}, {trial.user_attrs[INFORMATION]:.4g} nat"
