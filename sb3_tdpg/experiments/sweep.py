"""
Run the paper's sweep over beta: train, evaluate, select and draw, on one machine or on many.

With a storage, this process is one of any number of workers of an Optuna study. Every run is a trial, which also stores
the numbers of the run, so that every worker can write the summary. Workers that share a file system should use the same
folder: then a killed run continues from its checkpoint, and the selected model is available.
"""

import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import as_completed
from dataclasses import dataclass, replace
from fractions import Fraction
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd

from sb3_tdpg.common.files import replaced_atomically, write_atomically
from sb3_tdpg.common.markdown import fill_template, markdown_table
from sb3_tdpg.common.processes import process_pool
from sb3_tdpg.common.provenance import how_made, provenance, write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import threads
from sb3_tdpg.envs.scenarios import PANDA_GRASP_CAMERA, PAPER_ROWS, Scenario
from sb3_tdpg.evaluation import save_figure
from sb3_tdpg.evaluation.information import information_bounds, rollout_information
from sb3_tdpg.experiments.runs import Run, Task, check_folder, complete_run, complete_runs
from sb3_tdpg.experiments.tradeoff import tradeoff_figure
from sb3_tdpg.experiments.training import Training, make_training
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.tdpg import TDPG

Job = tuple[float, int]  # 1 / beta, seed
N_INFORMATION = 1000  # episodes

# Smaller differences in information are chance. So among runs within this of the least, the lowest cost decides.
TIE = 0.01  # nats


def parse_inverse_beta(beta: str | float) -> float:
    """
    Read a beta and return 1 / beta, the weight of the information. ``"inf"`` gives 0.

    :raises ValueError: if the beta is not a positive number.
    """
    try:
        inverse = 0.0 if str(beta) == "inf" else float(1 / Fraction(str(beta)))
    except (ValueError, ArithmeticError):
        inverse = -1.0
    if inverse < 0:
        raise ValueError(f"beta={beta!r} must be a positive number (0.04), a fraction (1/25) or inf (policy gradient)")
    return round(inverse, 9)


def beta_label(inverse_beta: float) -> str:
    """Return the label of a beta: ``"1/75"``, ``"0.3"``, ``"2"`` or ``"inf"``."""
    if inverse_beta == 0:
        return "inf"
    return f"1/{inverse_beta:.0f}" if inverse_beta == round(inverse_beta) > 1 else f"{1 / inverse_beta:.6g}"


@dataclass(frozen=True)
class _Plan:
    """The settings that all runs share. The first scenario is the training scenario."""

    env_id: str
    block: str
    settings: Mapping[str, Any]
    scenarios: Sequence[Scenario]
    n_eval_episodes: int
    cost_limit: float
    out: Path
    study: tuple[str, str, float] | None  # storage, name, grace period

    def run(self, inverse_beta: float, seed: int) -> Run:
        """Return the run for one beta and one seed."""
        overrides = {**self.settings, "beta": 1 / inverse_beta if inverse_beta else math.inf}
        if "cost_limit" in load_hyperparams(self.block):
            overrides["cost_limit"] = None  # only for beta="auto"
        return Run(f"beta {beta_label(inverse_beta)}", self.env_id, self.block, seed, overrides)

    def task(self, inverse_beta: float, seed: int) -> Task:
        """Return a run with its folder and scenarios."""
        run = self.run(inverse_beta, seed)
        return run, self.out / "runs" / run.folder_name, self.scenarios

    def row(self, inverse_beta: float, seed: int) -> dict[str, Any]:
        """Return a finished run's row of ``runs.csv``."""
        labels = dict(label=beta_label(inverse_beta), inverse_beta=inverse_beta)
        return finished_row(self.task(inverse_beta, seed), self.n_eval_episodes, labels)

    @property
    def config(self) -> dict[str, Any]:
        """Everything that must be equal for runs to be comparable."""
        settings = {name: value for name, value in self.run(1.0, 0).settings.items() if name != "beta"}
        rows = {row.name: dict(env_id=row.env_id, env_kwargs=dict(row.env_kwargs)) for row in self.scenarios}
        shared = {name: getattr(self, name) for name in ("env_id", "block", "n_eval_episodes")}
        return {**shared, "settings": settings, "scenarios": rows}


def _columns(scenarios: Sequence[Scenario]) -> dict[str, str]:
    """Return for each scenario the column of ``runs.csv`` with its mean cost."""
    return {scenario.name: f"cost: {scenario.name}" for scenario in scenarios}


def finished_row(task: Task, n_eval_episodes: int, labels: Mapping[str, Any]) -> dict[str, Any]:
    """
    Measure a finished run's cost in each scenario and its information in the first scenario; save and return this row.

    :param task: The run.
    :param n_eval_episodes: Number of episodes for the information, at most 1000.
    :param labels: The first columns of the row.
    """
    run, folder, scenarios = task
    path = folder / "sweep_row.json"
    if path.exists():
        return json.loads(path.read_text())
    records = pd.read_csv(folder / "episodes.csv")
    costs = records.groupby("scenario", sort=False)["cost"].agg(["mean", "std"])
    model = TDPG.load(folder / "model.zip", device="cpu")
    training = scenarios[0].with_kwargs(**(run.settings.get("env_kwargs") or {}))
    n_episodes = min(N_INFORMATION, max(n_eval_episodes, model.policy.trv_dim + 2))
    upper, lower = information_bounds(rollout_information(model, training, n_episodes))
    row: dict[str, Any] = dict(
        **labels,
        seed=run.seed,
        cost=float(costs["mean"].iloc[0]),
        std=float(costs["std"].iloc[0]),
        information=upper,
        information_lower=lower,
        met_block_limits=bool(records["selected"].iloc[0]),
        folder=folder.name,
        **{column: float(costs["mean"][name]) for name, column in _columns(scenarios).items()},
    )
    write_atomically(path, json.dumps(row))
    return row


def sweep(
    env_id: str,
    *,
    betas: Sequence[str | float],
    n_seeds: int = 5,
    cost_limit: float | None = None,
    out: Path | None = None,
    storage: str | None = None,
    study_name: str | None = None,
    jobs: int | None = None,
    n_timesteps: int | None = None,
    n_eval_episodes: int = 1000,
    block: str | None = None,
    settings: Mapping[str, Any] | None = None,
    grace_period: float = 60.0,
) -> str:
    """
    Train every beta with every seed, evaluate the policies on the environment's scenarios, select one and draw figures.

    The paper's rule selects the run with the least information among the runs whose cost is below the limit. If several
    runs are within 0.01 nat of the least information, the one with the lowest cost is selected. Finished runs are kept:
    the same call resumes an interrupted sweep, and a call with more betas or seeds adds to it.

    :param env_id: A registered id.
    :param betas: Numbers, fractions (``"1/75"``) or ``"inf"`` (policy gradient).
    :param n_seeds: Number of training seeds of each beta, from seed 0 on.
    :param cost_limit: Limit of the selection on the mean cost of the evaluation; default: minus the registered
        ``reward_threshold`` of the environment.
    :param out: Folder for ``summary.md``, ``runs.csv``, ``sweep.png``, ``selected.zip``, ``selected.json``,
        ``config.json`` and ``runs/``; default: ``results/sweep-<block>``.
    :param storage: Storage that all workers share, see :func:`~sb3_tdpg.experiments.studies.open_storage`. By default
        there is no storage, and only this machine runs the sweep.
    :param study_name: Name of the study in the storage; default: ``sweep-<block>``.
    :param jobs: Number of runs at a time on this machine; default: the number of cores, or 1 with a storage.
    :param n_timesteps: Environment steps of each training; default: as in the block.
    :param n_eval_episodes: Number of episodes of each scenario.
    :param block: Block of ``hyperparams/tdpg.yml``; default: the block of the environment.
    :param settings: Settings that replace those of the block: ``dict(mi_estimator="logdet")``.
    :param grace_period: Seconds without a heartbeat after which another worker of the study counts as dead.
    :return: the summary, as Markdown
    :raises ValueError: if an argument is malformed or does not fit; no training has started in this case.
    """
    # The strongest penalty comes last: legend and tables go from policy gradient to the least information.
    wanted = [(inverse, seed) for inverse in sorted({*map(parse_inverse_beta, betas)}) for seed in range(n_seeds)]
    if not wanted:
        raise ValueError("a sweep needs at least one beta and one seed: --betas 1/25 1/50 1/75 1/100 --seeds 5")
    if storage is None and study_name is not None:
        raise ValueError(f"study_name={study_name!r} needs a storage that keeps the study")
    for name in {"beta", "seed"} & set(settings or ()):
        raise ValueError(f"{name} is varied by the sweep: leave it out of the settings")
    module, _, name = env_id.rpartition(":")
    if module:
        import_module(module)
    block = block or name
    length = {} if n_timesteps is None else {"n_timesteps": n_timesteps}
    # Not the table's own first row: its keywords would replace those of the training.
    rows = (Scenario("Training", env_id), *PAPER_ROWS.get(name, ())[1:])
    rows = tuple(replace(row, env_id=env_id) if row.env_id == name else row for row in rows)
    plan = _Plan(
        env_id,
        block,
        settings={**(settings or {}), **length},
        scenarios=PANDA_GRASP_CAMERA if block.startswith("PandaGrasp-v0-camera") else rows,
        n_eval_episodes=n_eval_episodes,
        cost_limit=_cost_limit(name, cost_limit),
        out=out or Path("results", f"sweep-{block}"),
        study=None if storage is None else (storage, study_name or f"sweep-{block}", grace_period),
    )
    build_once(lambda: plan.run(1.0, 0))
    if plan.study is not None:
        _open_study(plan)
    tasks = [plan.task(*job) for job in wanted]
    for task in tasks:
        check_folder(*task, n_eval_episodes)

    failures: dict[str, str] = {}
    with threads(1):
        if plan.study is None:
            complete_runs(tasks, n_eval_episodes=n_eval_episodes, jobs=jobs, failures=failures)
            results = [plan.row(*job) for job in wanted if plan.task(*job)[1].name not in failures]
        else:
            if jobs is None or jobs == 1:
                _work(plan, wanted)
            else:
                with process_pool(jobs) as pool:
                    for worker in as_completed([pool.submit(_work, plan, wanted) for _ in range(jobs)]):
                        worker.result()
            results, failures = _results(_open_study(plan))
    if not results:
        raise ValueError(f"no run was finished: {failures}")
    runs = pd.DataFrame(results).sort_values(["inverse_beta", "seed"], ignore_index=True)
    return _write(plan, runs, failures)


def _cost_limit(env_id: str, given: float | None) -> float:
    try:
        threshold = gym.spec(env_id).reward_threshold
    except gym.error.Error as e:
        raise ValueError(f"env={env_id!r} is not registered: {e}") from e
    if given is None and threshold is None:
        raise ValueError(f"{env_id} is registered without a reward_threshold: give a cost limit, --cost-limit 40, say")
    if given is not None and math.isnan(given):
        raise ValueError("cost_limit is NaN")
    return -float(threshold or 0.0) if given is None else given


def build_once(make_run: Callable[[], Run]) -> Training:
    """Build the model of a run, to find errors in the settings before any training."""
    try:
        run = make_run()
        training = make_training(run.env_id, run.settings, seed=0, device="cpu")
    except gym.error.Error as e:
        raise ValueError(f"env={run.env_id!r} cannot be made: {e}") from e
    except KeyError as e:
        raise ValueError(f"{e.args[0]}: choose one with --block") from e
    except TypeError as e:
        raise ValueError(f"the settings of block {run.block!r} do not fit: {e}") from e
    assert training.model.env is not None
    training.model.env.close()
    return training


def _open_study(plan: _Plan) -> Any:
    from sb3_tdpg.experiments.studies import open_storage, open_study

    assert plan.study is not None
    storage, name, grace_period = plan.study
    directions = ("minimize", "minimize")
    return open_study(open_storage(storage, grace_period), name, directions=directions, space=plan.config)


def _work(plan: _Plan, wanted: Sequence[Job]) -> None:
    """Run jobs of the study as one of its workers until no job is left."""
    from sb3_tdpg.experiments.studies import enqueue_once, work

    def objective(trial: Any) -> tuple[float, float]:
        job = trial.suggest_float("inverse_beta", 0.0, 1e9), trial.suggest_int("seed", 0, 2**31)
        task = plan.task(*job)
        try:
            check_folder(*task, plan.n_eval_episodes)
        except ValueError as e:  # the job does not fit into this worker's folder, but another worker can run it
            raise FileExistsError(str(e)) from e
        complete_run(*task, n_eval_episodes=plan.n_eval_episodes)
        row = plan.row(*job)
        trial.set_user_attr("row", row)
        return row["cost"], row["information"]

    study = _open_study(plan)
    enqueue_once(study, [dict(inverse_beta=inverse, seed=seed) for inverse, seed in wanted])
    work(study, objective)


def _results(study: Any) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return the rows of a study's finished runs, and the reasons why other runs failed."""
    attributes = [trial.user_attrs for trial in study.get_trials(deepcopy=False) if "job" in trial.user_attrs]
    rows = {each["job"]: each["row"] for each in attributes if "row" in each}
    reasons = {each["job"]: each.get("reason", "its worker failed or was killed") for each in attributes}
    return list(rows.values()), {job: reason for job, reason in reasons.items() if job not in rows}


def select(runs: pd.DataFrame, cost_limit: float) -> pd.Series | None:
    """Select a run by the paper's rule (see :func:`sweep`); return ``None`` if no run is below the limit."""
    below = runs[runs["cost"] < cost_limit]
    least = below[below["information"] <= below["information"].min() + TIE]
    return None if below.empty else least.loc[least["cost"].idxmin()]


def _write(plan: _Plan, runs: pd.DataFrame, failures: Mapping[str, str]) -> str:
    """Write all files except the runs, and return the summary. Every worker may call this more than once."""
    out, best = plan.out, select(runs, plan.cost_limit)
    write_frame_atomically(runs, out / "runs.csv")
    model, record = out / "selected.zip", out / "selected.json"
    model.unlink(missing_ok=True)
    record.unlink(missing_ok=True)
    if best is not None:
        content = {"beta": best["label"], **best[["seed", "cost", "std", "information", "folder"]]}
        text = json.dumps({**content, "cost_limit": plan.cost_limit}, indent=2, default=lambda x: x.item())
        write_atomically(record, text + "\n")
        source = out / "runs" / best["folder"] / "model.zip"
        if source.exists():
            with replaced_atomically(model) as partial:
                shutil.copyfile(source, partial)
    save_figure(tradeoff_figure(runs, _columns(plan.scenarios), best, plan.cost_limit), out / "sweep.png")
    write_run_config(out / "config.json", {**plan.config, "cost_limit": plan.cost_limit, "runs": [*runs["folder"]]})
    summary = _summary(plan, runs, best, failures)
    write_atomically(out / "summary.md", summary)
    return summary


def _summary(plan: _Plan, runs: pd.DataFrame, best: pd.Series | None, failures: Mapping[str, str]) -> str:
    limit = f"{plan.cost_limit:g}"
    is_below = runs["cost"] < plan.cost_limit
    by_beta = runs.groupby("label", sort=False)
    overview = {
        "beta": list(by_beta.groups),
        "seeds": by_beta.size(),
        "cost: mean (worst)": _mean_and_worst(by_beta["cost"]),
        "information in nats: mean (most)": _mean_and_worst(by_beta["information"], "{:.2g}"),
        f"runs below {limit}": is_below.groupby(runs["label"], sort=False).sum(),
    }
    columns = _columns(plan.scenarios)
    costs = {f"beta {beta}": _mean_and_worst(group[list(columns.values())]) for beta, group in by_beta}
    robustness = markdown_table(pd.DataFrame({"scenario": list(columns), **costs}))
    shown = runs[["label", "seed", "cost", "std", "information", "information_lower", "met_block_limits"]]
    return fill_template(
        "sb3_tdpg.experiments",
        "sweep.md",
        block=plan.block,
        best=best,
        is_here=(plan.out / "selected.zip").exists(),
        counts=dict(n=len(runs), n_below=is_below.sum(), limit=limit, tie=TIE),
        overview=markdown_table(pd.DataFrame(overview)),
        robustness=robustness if len(columns) > 1 else "",
        runs=markdown_table(shown.rename(columns={"label": "beta"}), digits=4),
        failures=failures,
        made=how_made("sb3-tdpg sweep", provenance()),
    )


def _mean_and_worst(values: pd.DataFrame, form: str = "{:.4g}") -> list[str]:
    means, worst = values.mean(), values.max()
    return [f"{form.format(a)} ({form.format(b)})" for a, b in zip(means, worst, strict=True)]
