"""Run the episodes of a report: every model in every row, in parallel, with one file per finished row."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import as_completed
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import pandas as pd
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from sb3_tdpg.common.processes import process_pool
from sb3_tdpg.common.provenance import write_frame_atomically
from sb3_tdpg.common.threads import threads
from sb3_tdpg.evaluation.environments import scenario_env
from sb3_tdpg.evaluation.randomness import evaluation_seeds
from sb3_tdpg.evaluation.records import MAX_PARALLEL_EPISODES, run_episodes
from sb3_tdpg.evaluation.rollout import rollout
from sb3_tdpg.report.models import Source, load_all
from sb3_tdpg.report.rows import Row
from sb3_tdpg.robustness import PerturbedVecEnv

COLUMNS = ("episode", "cost", "length", "failure")
"""The columns of :func:`~sb3_tdpg.evaluation.records.run_episodes` that are kept; ``failure`` is kept if known."""

SIDE_BY_SIDE = 50  # number of parallel environments that are not from this package
UNKNOWN_LENGTH = 1_000  # assumed steps of an episode without a time limit
N_TIMED = 20  # number of steps that are timed
MAX_EPISODES, MAX_EPISODES_OF_IMAGES = 500, 100

Models = Mapping[str, Sequence[Any]]
"""The models of each method."""


@dataclass(frozen=True)
class Plan:
    """The settings that all rows share."""

    env_id: str
    env_kwargs: Mapping[str, Any]  # keywords of the unperturbed environment
    sources: Mapping[str, Sequence[Source]]  # models of each method; files, if several processes run them
    n_episodes: int  # for each model in each row
    seed: int  # for environments, policies and perturbations
    deterministic: bool
    scale: Any  # scale of each vector component (for each key of a Dict), the same for all models; None for images


def run_row(plan: Plan, row: Row, models: Models) -> pd.DataFrame:
    """
    Run every model in one row; all models get the same initial states and perturbations if the environment allows it.

    The columns are ``model`` (the method), ``train_seed`` (the number of the model, from 0), ``perturbation``,
    ``severity`` and ``kind``, followed by :data:`COLUMNS`.
    """

    def sensor(env: VecEnv) -> VecEnv:
        return PerturbedVecEnv(env, row.perturbation, row.severity, seed=plan.seed, scale=plan.scale)

    scenario = replace(row.scenario, sensor=sensor) if row.kind in ("sensor", "plant") else row.scenario
    labels = dict(perturbation=row.perturbation, severity=row.severity, kind=row.kind)
    frames = []
    for label, of_method in models.items():
        for number, model in enumerate(of_method):
            frame = run_episodes(model, scenario, plan.n_episodes, seed=plan.seed, deterministic=plan.deterministic)
            frames.append(frame.assign(model=label, train_seed=number, **labels))
    records = pd.concat(frames, ignore_index=True)
    keys = ("model", "train_seed", "perturbation", "severity", "kind")
    return records[[name for name in (*keys, *COLUMNS) if name in records]]


def default_episodes(kind: str | None, horizon: int | None, n_steps: int) -> int:
    """
    Return the number of episodes that a budget of steps allows.

    :param kind: Kind of the observations, ``"image"`` or another.
    :param horizon: Maximum length of an episode, if there is a limit.
    :param n_steps: The budget of steps.
    """
    most = MAX_EPISODES_OF_IMAGES if kind == "image" else MAX_EPISODES
    n = max(1, min(most, n_steps // (horizon or UNKNOWN_LENGTH)))
    # Each environment runs the same number of episodes, so that 53 episodes would run in a single environment.
    return n if n <= SIDE_BY_SIDE else n - n % SIDE_BY_SIDE


def seconds_of_a_row(plan: Plan, row: Row, models: Models, horizon: int | None) -> float:
    """Estimate the maximum time of a row in seconds, from some steps of each method's first model."""
    total = 0.0
    with threads(1):
        for first, *others in models.values():
            n_parallel = min(plan.n_episodes, MAX_PARALLEL_EPISODES)
            with closing(scenario_env(row.scenario, first, n_episodes=n_parallel)) as env:
                steps = rollout(first, env, seeds=evaluation_seeds(plan.seed), deterministic=plan.deterministic)
                next(steps)
                began = time.perf_counter()
                n_timed = len(list(islice(steps, N_TIMED)))
                steps.close()  # restores the random generators
                n_steps = -(-plan.n_episodes // env.num_envs) * (horizon or UNKNOWN_LENGTH)
                total += (time.perf_counter() - began) / n_timed * n_steps * (1 + len(others))
    return total


def missing_rows(rows: Sequence[Row], folder: Path) -> list[Row]:
    """Return the rows that do not have a file in a folder yet."""
    return [row for row in rows if not (folder / row.file_name).exists()]


def complete_rows(
    plan: Plan,
    rows: Sequence[Row],
    models: Models,
    folder: Path,
    *,
    jobs: int = 1,
    progress_bar: bool = True,
    at_row: Callable[[Mapping[Row, pd.DataFrame]], Any] = lambda records: None,
) -> pd.DataFrame:
    """
    Run the rows that do not have a file in a folder yet, and return the records of all rows.

    :param at_row: Function that is called after each finished row, with the records of all finished rows.
    """
    missing = missing_rows(rows, folder)
    finished = {row: _read_row(row, folder) for row in rows if row not in missing}
    with tqdm(total=len(rows), initial=len(finished), unit="row", disable=not progress_bar) as progress:
        try:
            for row, records in _completed(plan, missing, models, min(jobs, len(missing))):
                write_frame_atomically(records, folder / row.file_name)
                finished[row] = _read_row(row, folder)
                progress.set_postfix_str(row.title, refresh=False)
                progress.update()
                at_row(finished)
        except BaseException:
            progress.write("stopped; finished rows are kept, and the same command continues from them")
            raise
    return pd.concat([finished[row] for row in rows], ignore_index=True)


def _read_row(row: Row, folder: Path) -> pd.DataFrame:
    # These columns are read as text, because "1" or "None" can be the name of a method or of a row.
    names = dict.fromkeys(("model", "perturbation", "kind"), str)
    return pd.read_csv(folder / row.file_name, dtype=names, keep_default_na=False, na_values=[""])


def _completed(plan: Plan, rows: Sequence[Row], models: Models, jobs: int) -> Iterator[tuple[Row, pd.DataFrame]]:
    if jobs <= 1:
        with threads(1):
            for row in rows:
                yield row, run_row(plan, row, models)
        return
    with process_pool(jobs, _init_worker, (plan,)) as pool:
        futures = {pool.submit(_run_row_in_worker, row): row for row in rows}
        for future in as_completed(futures):
            yield futures[future], future.result()


_WORKER: dict[str, Any] = {}  # the plan and the models, loaded once for each worker


def _init_worker(plan: Plan) -> None:
    _WORKER.update(plan=plan, models=load_all(plan.sources, plan.env_id, plan.env_kwargs))


def _run_row_in_worker(row: Row) -> pd.DataFrame:
    return run_row(_WORKER["plan"], row, _WORKER["models"])
