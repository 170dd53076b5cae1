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
from sb3_tdpg.common.provenance import write_frame_atomically, write_run_config
from sb3_tdpg.evaluation.information import encode_episodes, information_bounds
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.zoo.manager import TDPGExperimentManager
from sb3_tdpg.zoo.search import Space, put_in, read_space, relevant, sample
from sb3_tdpg.zoo.studies import open_storage, open_study, work

N_EVALUATIONS = 10
RECORD = "study.json"  # settings of a study, in the folder of its results
COST, INFORMATION = "cost", "information"  # attributes of a trial; cost minus limit is also its constraint


class TuningManager(TDPGExperimentManager):
    """Tune TDPG for one of its own objectives."""

    # The program sets these, because the zoo has no flags for them.
    objective_kind: str | None = None
    cost_limit: float | None = None
    space_path: Path | None = None

    def __init__(self, args: Any, algo: str, env_id: str, *rest: Any, **kwargs: Any) -> None:
        super().__init__(args, algo, env_id, *rest, **kwargs)
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
        given = block.get("cost_limit") if self.cost_limit is None else self.cost_limit
        for limit in [*selections, -threshold] if given is None else [given]:
            if not isinstance(limit, str) and limit and math.isfinite(limit):  # a share is another cost in each trial
                return float(limit)
        needed = f"a limit on the expected cost (minus the reward) of {self.env_name.gym_id}"
        raise ValueError(f"tuning needs {needed}, a finite number other than 0: give --cost-limit")

    def objective(self, trial: optuna.Trial) -> float:
        """Train with the hyperparameters that a trial samples; return the value that is minimised."""
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
                raise optuna.TrialPruned(f"behind the others at expected cost {cost:.4g}, {information:.4g} nat")
            return information if is_constrained else cost

    def hyperparameters_optimization(self) -> None:
        """Run trials, in parallel with other workers, until the study has the requested number."""
        assert self.storage is not None and self.study_name is not None
        names = ("cost_limit", "space", "eval_env_kwargs", "n_evaluations", "n_eval_episodes")
        description: dict[str, Any] = {name: getattr(self, name) for name in names}
        description.update(env_id=self.env_name.gym_id, objective=self.objective_kind, block=self.settings)
        # Find errors in the settings, with which every trial would be pruned, before the study is created.
        with self.explained_errors():
            self.create_envs(1, eval_env=True).close()
            with contextlib.closing(self.create_envs(self.n_envs, no_log=True)) as env:
                TDPG(env=env, device=self.device, **self._hyperparams)
        sampler, pruner = self._create_sampler(self.sampler), self._create_pruner(self.pruner)
        storage = open_storage(self.storage)
        study = open_study(storage, self.study_name, sampler=sampler, pruner=pruner, space=description)
        work(study, self.objective, self.max_total_trials or self.n_trials, describe=_result)
        self._write_results(study, description)

    def _create_sampler(self, sampler_method: str) -> optuna.samplers.BaseSampler:
        if sampler_method != "tpe":
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
            mend = "raise --cost-limit, train longer with -n, or run more trials with --n-trials"
            print(f"no complete trial of {self.study_name} keeps the cost below {self.cost_limit:g}: {mend}")
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

    With an infinite limit, the number is the cost. Otherwise, policies that meet the limit have values below 1, ordered
    by information, and all other policies are ordered by cost.
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


def _result(trial: optuna.trial.FrozenTrial) -> str:
    return f"expected cost {trial.user_attrs[COST]:.4g}, {trial.user_attrs[INFORMATION]:.4g} nat"
