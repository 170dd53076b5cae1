"""
The paper's sweep over beta as one command: train, evaluate, select, draw; on one machine or on many.

Without a storage the runs are made by parallel processes of this machine, each in a folder of its own. With a storage
this process is one of any number of workers at an Optuna study, in which every run is a trial. The numbers of a run are
kept in its trial, too, so that any worker that finds the study finished can write the summary. Models and episodes are
in ``runs/`` of the folder that their worker was given: give all the same folder where they share a file system, so that
the selected model is at hand wherever it was trained, and a killed run goes on from its checkpoint.
"""

from __future__ import annotations

import json
import math
import multiprocessing as mp
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd

from sb3_tdpg.common.files import replaced_atomically, write_atomically
from sb3_tdpg.common.provenance import write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import threads
from sb3_tdpg.evaluation import save_figure
from sb3_tdpg.experiments.runs import check_folder, complete_run, complete_runs, end_with_parent
from sb3_tdpg.experiments.sweep_runs import Sweep, make_sweep, parse_inverse_beta
from sb3_tdpg.experiments.sweep_summary import sweep_summary
from sb3_tdpg.experiments.tradeoff import tradeoff_figure

# Where several policies know about nothing, which of them knows least is chance: the cheapest of them is taken.
TIE = 0.01  # nats


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
    grace_period: float = 120.0,
) -> str:
    """
    Train every beta with every seed, evaluate on the environment's scenarios, select by the paper's rule, draw.

    The rule: of the runs whose cost is below the limit, the one with the least information. Of those that know as
    little to within 0.01 nat the cheapest is taken. Finished runs are kept: the same call goes on where an
    interrupted one stopped, and one with more betas or seeds adds to it.

    :param env_id: A registered id.
    :param betas: Numbers, fractions (``"1/75"``) or ``"inf"`` (policy gradient).
    :param n_seeds: Training seeds of each, 0 to ``n_seeds - 1``.
    :param cost_limit: For the selection, on the mean cost of the evaluation; default: minus the ``reward_threshold``
        with which the environment is registered.
    :param out: Folder for ``summary.md``, ``runs.csv``, ``sweep.png``, ``selected.zip``, ``selected.json``,
        ``config.json`` and ``runs/``; default: ``results/sweep-<block>``.
    :param storage: Shared by all workers, see :func:`~sb3_tdpg.experiments.studies.open_storage`; default: none, and this machine
        works alone.
    :param study_name: Name of the study in the storage; default: ``sweep-<block>``.
    :param jobs: Runs at a time on this machine; default: the number of cores, with a storage 1.
    :param n_timesteps: Environment steps of each training; default: as in the block.
    :param n_eval_episodes: Episodes of each scenario.
    :param block: Block of ``hyperparams/tdpg.yml``; default: that of the environment.
    :param settings: What replaces settings of the block: ``dict(mi_estimator="logdet")``.
    :param grace_period: Seconds of silence after which another worker at the study counts as dead.
    :return: the summary, as Markdown
    :raises ValueError: if something is malformed or does not fit; nothing has been trained by then.
    """
    inverse_betas = list(dict.fromkeys(parse_inverse_beta(beta) for beta in betas))
    if not inverse_betas or n_seeds < 1:
        raise ValueError("a sweep needs at least one beta and one seed: --betas 1/25 1/50 1/75 1/100 --seeds 5")
    if storage is None and study_name is not None:
        raise ValueError(f"study_name={study_name!r} needs a storage that keeps the study")
    cost_limit = _cost_limit(env_id, cost_limit)
    plan = make_sweep(env_id, block or env_id, settings or {}, n_timesteps, n_eval_episodes)
    out = out or Path("results", f"sweep-{plan.block}")
    # The strongest penalty last: the legend and the tables go from the policy gradient to the least information.
    wanted = [(inverse, seed) for inverse in sorted(inverse_betas) for seed in range(n_seeds)]

    failures: dict[str, str] = {}
    if storage is None:
        tasks = [(plan.run(*job), plan.folder(out, *job), plan.scenarios) for job in wanted]
        for task in tasks:
            check_folder(*task, n_eval_episodes)
        out.mkdir(parents=True, exist_ok=True)
        complete_runs(tasks, n_eval_episodes=n_eval_episodes, jobs=jobs)
        with threads(1):
            rows = [plan.row(plan.folder(out, *job), *job) for job in wanted]
    else:
        name = study_name or f"sweep-{plan.block}"
        rows, failures = _work_at_study(plan, out, storage, name, wanted, grace_period, jobs or 1)
    if not rows:
        raise ValueError(f"no run was finished: {failures}")
    runs = pd.DataFrame(rows).sort_values(["inverse_beta", "seed"], ignore_index=True)
    return _write(plan, out, runs, failures, cost_limit)


def select(runs: pd.DataFrame, cost_limit: float) -> pd.Series | None:
    """
    Select by the paper's rule; ``None`` if no run is below the limit.

    :param runs: With the columns ``cost`` and ``information``.
    :param cost_limit: See :func:`sweep`.
    """
    below = runs[runs["cost"] < cost_limit]
    if below.empty:
        return None
    least = below[below["information"] <= below["information"].min() + TIE]
    return least.loc[least["cost"].idxmin()]


def _cost_limit(env_id: str, given: float | None) -> float:
    try:
        threshold = gym.spec(env_id).reward_threshold
    except gym.error.Error as e:
        raise ValueError(f"env={env_id!r} is not registered: {e}") from e
    if given is None and threshold is None:
        raise ValueError(f"{env_id} is registered without a reward_threshold: give a cost limit, --cost-limit 40, say")
    limit = -float(threshold or 0.0) if given is None else given
    if math.isnan(limit):
        raise ValueError("cost_limit is NaN")
    return limit


# -- many workers -----------------------------------------------------------------------------------------------


def _work_at_study(
    plan: Sweep,
    out: Path,
    storage: str,
    name: str,
    wanted: Sequence[tuple[float, int]],
    grace_period: float,
    jobs: int,
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Work until the study is finished; return the rows of all its runs, and why others failed."""
    from sb3_tdpg.experiments.studies import open_storage, open_study, quiet_optuna

    quiet_optuna()
    study = open_study(open_storage(storage), name, directions=("minimize", "minimize"), space=plan.config)
    for job in wanted:
        check_folder(plan.run(*job), plan.folder(out, *job), plan.scenarios, plan.n_eval_episodes)
    out.mkdir(parents=True, exist_ok=True)
    arguments = (plan, out, storage, name, wanted, grace_period)
    if jobs == 1:
        _work(*arguments)
    else:
        context = mp.get_context("spawn")
        workers = [context.Process(target=_work_in_process, args=arguments) for _ in range(jobs)]
        for worker in workers:
            worker.start()
        try:
            for worker in workers:
                worker.join()
        except KeyboardInterrupt:
            for worker in workers:  # the terminal has interrupted them, too: they put their runs back
                worker.join()
            raise
        if failed := sum(worker.exitcode != 0 for worker in workers):
            raise ValueError(f"{failed} of {jobs} workers failed, see above; the same command goes on")
    trials = study.get_trials(deepcopy=False)
    rows = {trial.user_attrs["job"]: trial.user_attrs["row"] for trial in trials if "row" in trial.user_attrs}
    reasons = {t.user_attrs["job"]: t.user_attrs["reason"] for t in trials if {"job", "reason"} <= t.user_attrs.keys()}
    return list(rows.values()), {job: reason for job, reason in reasons.items() if job not in rows}


def _work_in_process(*arguments: Any) -> None:
    """Be one of several workers of this machine: what ends it is told in a line."""
    end_with_parent()
    try:
        _work(*arguments)
    except KeyboardInterrupt:
        sys.exit(130)
    except (ValueError, OSError) as e:
        print(f"error: {e}", file=sys.stderr)
        sys.exit(2)


def _work(
    plan: Sweep, out: Path, storage: str, name: str, wanted: Sequence[tuple[float, int]], grace_period: float
) -> None:
    """Be one worker: run trials of the study until there are none left."""
    from sb3_tdpg.experiments.studies import (
        UnfitWorkerError,
        enqueue_once,
        open_storage,
        open_study,
        quiet_optuna,
        work,
    )

    quiet_optuna()  # in a process of its own
    study = open_study(open_storage(storage), name, directions=("minimize", "minimize"), space=plan.config)
    enqueue_once(study, [dict(inverse_beta=inverse, seed=seed) for inverse, seed in wanted])

    def objective(trial: Any) -> tuple[float, float]:
        job = trial.suggest_float("inverse_beta", 0.0, 1e9), trial.suggest_int("seed", 0, 2**31)
        run, folder = plan.run(*job), plan.folder(out, *job)
        try:
            check_folder(run, folder, plan.scenarios, plan.n_eval_episodes)
        except ValueError as e:  # a job of another worker, which this one has no place for
            raise UnfitWorkerError(str(e)) from e
        complete_run(run, folder, plan.scenarios, n_eval_episodes=plan.n_eval_episodes)
        row = plan.row(folder, *job)
        trial.set_user_attr("row", row)
        return row["cost"], row["information"]

    with threads(1):
        work(study, objective, grace_period=grace_period)


# -- results ----------------------------------------------------------------------------------------------------


def _write(plan: Sweep, out: Path, runs: pd.DataFrame, failures: Mapping[str, str], cost_limit: float) -> str:
    """Write everything but the runs; any worker may, and again."""
    best = select(runs, cost_limit)
    write_frame_atomically(runs, out / "runs.csv")
    here = _copy_selected(out, best, cost_limit)
    chosen = None if best is None else (str(best["label"]), int(best["seed"]))
    save_figure(tradeoff_figure(runs, plan.columns, cost_limit=cost_limit, selected=chosen), out / "sweep.png")
    write_run_config(out / "config.json", {**plan.config, "cost_limit": cost_limit, "runs": runs["folder"].tolist()})
    text = sweep_summary(
        runs, best, plan.columns, failures, cost_limit=cost_limit, title=plan.block, model_is_here=here, tie=TIE
    )
    write_atomically(out / "summary.md", text + "\n")
    return text


def _copy_selected(out: Path, best: pd.Series | None, cost_limit: float) -> bool:
    """Put the selected model beside the summary, if this machine has it; remove that of an earlier call."""
    model, record = out / "selected.zip", out / "selected.json"
    if best is None:
        model.unlink(missing_ok=True)
        record.unlink(missing_ok=True)
        return False
    source = out / "runs" / best["folder"] / "model.zip"
    if source.exists():
        with replaced_atomically(model) as partial:
            shutil.copyfile(source, partial)
    else:
        model.unlink(missing_ok=True)
    content = {name: best[name] for name in ("label", "seed", "cost", "std", "information", "folder")}
    text = json.dumps(
        {"beta": content.pop("label"), **content, "cost_limit": cost_limit}, indent=2, default=lambda x: x.item()
    )
    write_atomically(record, text + "\n")
    return source.exists()
