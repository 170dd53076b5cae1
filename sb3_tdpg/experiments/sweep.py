"""
The paper's sweep over beta as one command: train, evaluate, select, draw; on one machine or on many.

With a storage, this process is one of any number of workers of an Optuna study, in which every run is a trial that also
keeps the numbers of its run, so that every worker can write the summary. Give all workers the same folder where they
share a file system: then the selected model is at hand, and a killed run goes on from its checkpoint.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Mapping, Sequence
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd

from sb3_tdpg.common.files import replaced_atomically, write_atomically
from sb3_tdpg.common.processes import process_pool
from sb3_tdpg.common.provenance import write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import threads
from sb3_tdpg.evaluation import save_figure
from sb3_tdpg.experiments.runs import check_folder, complete_run, complete_runs
from sb3_tdpg.experiments.sweep_runs import Sweep, make_sweep, parse_inverse_beta
from sb3_tdpg.experiments.sweep_summary import select, sweep_summary
from sb3_tdpg.experiments.tradeoff import tradeoff_figure

Job = tuple[float, int]  # 1 / beta, seed


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
    Train every beta with every seed, evaluate the policies on the environment's scenarios, select one, draw.

    The paper's rule selects the run with the least information among those whose cost is below the limit. Of the runs
    within 0.01 nat of it the cheapest is taken. Finished runs are kept: the same call resumes an interrupted sweep, and
    a call with more betas or seeds adds to it.

    :param env_id: A registered id.
    :param betas: Numbers, fractions (``"1/75"``) or ``"inf"`` (policy gradient).
    :param n_seeds: Number of training seeds of each beta, from seed 0 on.
    :param cost_limit: Limit of the selection on the mean cost of the evaluation; default: minus the
        ``reward_threshold`` that the environment is registered with.
    :param out: Folder for ``summary.md``, ``runs.csv``, ``sweep.png``, ``selected.zip``, ``selected.json``,
        ``config.json`` and ``runs/``; default: ``results/sweep-<block>``.
    :param storage: Storage that all workers share, see :func:`~sb3_tdpg.experiments.studies.open_storage`; default:
        none, and this machine works alone.
    :param study_name: Name of the study in the storage; default: ``sweep-<block>``.
    :param jobs: Number of runs at a time on this machine; default: the number of cores, with a storage 1.
    :param n_timesteps: Environment steps of each training; default: as in the block.
    :param n_eval_episodes: Episodes of each scenario.
    :param block: Block of ``hyperparams/tdpg.yml``; default: that of the environment.
    :param settings: Settings that replace those of the block: ``dict(mi_estimator="logdet")``.
    :param grace_period: Seconds without a heartbeat after which another worker of the study counts as dead.
    :return: the summary, as Markdown
    :raises ValueError: if an argument is malformed or does not fit; nothing has been trained by then.
    """
    # The strongest penalty last: the legend and the tables go from the policy gradient to the least information.
    wanted = [(inverse, seed) for inverse in sorted({*map(parse_inverse_beta, betas)}) for seed in range(n_seeds)]
    if not wanted:
        raise ValueError("a sweep needs at least one beta and one seed: --betas 1/25 1/50 1/75 1/100 --seeds 5")
    if storage is None and study_name is not None:
        raise ValueError(f"study_name={study_name!r} needs a storage that keeps the study")
    cost_limit = _cost_limit(env_id, cost_limit)
    plan = make_sweep(env_id, block or env_id, settings or {}, n_timesteps, n_eval_episodes)
    out = out or Path("results", f"sweep-{plan.block}")
    study = () if storage is None else (storage, study_name or f"sweep-{plan.block}", grace_period)
    if study:
        _open_study(plan, *study)
    tasks = [(plan.run(*job), plan.folder(out, *job), plan.scenarios) for job in wanted]
    for task in tasks:
        check_folder(*task, n_eval_episodes)

    failures: Mapping[str, str] = {}
    with threads(1):
        if not study:
            complete_runs(tasks, n_eval_episodes=n_eval_episodes, jobs=jobs)
            rows = [plan.row(plan.folder(out, *job), *job) for job in wanted]
        else:
            if jobs is None or jobs == 1:
                _work(plan, out, wanted, *study)
            else:
                with process_pool(jobs) as pool:
                    for worker in as_completed([pool.submit(_work, plan, out, wanted, *study) for _ in range(jobs)]):
                        worker.result()
            rows, failures = _results(_open_study(plan, *study))
    if not rows:
        raise ValueError(f"no run was finished: {failures}")
    runs = pd.DataFrame(rows).sort_values(["inverse_beta", "seed"], ignore_index=True)
    return _write(plan, out, runs, failures, cost_limit)


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


def _open_study(plan: Sweep, storage: str, name: str, grace_period: float) -> Any:
    from sb3_tdpg.experiments.studies import open_storage, open_study, quiet_optuna

    quiet_optuna()
    storage_ = open_storage(storage, grace_period)
    return open_study(storage_, name, directions=("minimize", "minimize"), space=plan.config)


def _work(plan: Sweep, out: Path, wanted: Sequence[Job], *study_arguments: Any) -> None:
    """Be one worker: run jobs of the study until none is left."""
    from sb3_tdpg.experiments.studies import enqueue_once, work

    def objective(trial: Any) -> tuple[float, float]:
        job = trial.suggest_float("inverse_beta", 0.0, 1e9), trial.suggest_int("seed", 0, 2**31)
        run, folder = plan.run(*job), plan.folder(out, *job)
        try:
            check_folder(run, folder, plan.scenarios, plan.n_eval_episodes)
        except ValueError as e:  # a job of another worker that does not fit into this one's folder: not to be pruned
            raise FileExistsError(str(e)) from e
        complete_run(run, folder, plan.scenarios, n_eval_episodes=plan.n_eval_episodes)
        row = plan.row(folder, *job)
        trial.set_user_attr("row", row)
        return row["cost"], row["information"]

    study = _open_study(plan, *study_arguments)
    enqueue_once(study, [dict(inverse_beta=inverse, seed=seed) for inverse, seed in wanted])
    work(study, objective)


def _results(study: Any) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Return the rows of the finished runs of a study, and the reasons of the failed ones."""
    attributes = [trial.user_attrs for trial in study.get_trials(deepcopy=False) if "job" in trial.user_attrs]
    rows = {each["job"]: each["row"] for each in attributes if "row" in each}
    reasons = {each["job"]: each.get("reason", "its worker failed or was killed") for each in attributes}
    return list(rows.values()), {job: reason for job, reason in reasons.items() if job not in rows}


def _write(plan: Sweep, out: Path, runs: pd.DataFrame, failures: Mapping[str, str], cost_limit: float) -> str:
    """Write everything except the runs; any worker may do so, and more than once."""
    best = select(runs, cost_limit)
    write_frame_atomically(runs, out / "runs.csv")
    model, record, chosen = out / "selected.zip", out / "selected.json", None
    model.unlink(missing_ok=True)
    record.unlink(missing_ok=True)
    if best is not None:
        chosen = (str(best["label"]), int(best["seed"]))
        content = {"beta": best["label"], **best[["seed", "cost", "std", "information", "folder"]]}
        text = json.dumps({**content, "cost_limit": cost_limit}, indent=2, default=lambda x: x.item())
        write_atomically(record, text + "\n")
        source = out / "runs" / best["folder"] / "model.zip"
        if source.exists():
            with replaced_atomically(model) as partial:
                shutil.copyfile(source, partial)
    save_figure(tradeoff_figure(runs, plan.columns, cost_limit=cost_limit, selected=chosen), out / "sweep.png")
    write_run_config(out / "config.json", {**plan.config, "cost_limit": cost_limit, "runs": runs["folder"].tolist()})
    limits: dict[str, Any] = dict(cost_limit=cost_limit, title=plan.block, has_model=model.exists())
    text = sweep_summary(runs, best, plan.columns, failures, **limits)
    write_atomically(out / "summary.md", text + "\n")
    return text
