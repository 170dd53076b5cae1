"""The episodes of a report: every model in every row, in parallel, each row kept in a file as soon as it is done."""

from __future__ import annotations

import multiprocessing as mp
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from sb3_tdpg.common.provenance import write_frame_atomically
from sb3_tdpg.common.threads import set_threads, threads
from sb3_tdpg.evaluation.records import run_episodes
from sb3_tdpg.report.models import Source, load_all
from sb3_tdpg.report.rows import Row
from sb3_tdpg.robustness import PerturbedVecEnv

COLUMNS = ("episode", "cost", "length", "failure")
"""Of :func:`~sb3_tdpg.evaluation.records.run_episodes`, what is kept; a failure only if it is known."""


@dataclass(frozen=True)
class Plan:
    """
    What is the same in all rows.

    :param env_id: A registered id.
    :param env_kwargs: Keywords of the environment as it is.
    :param sources: Models by method: for other processes, files.
    :param n_episodes: Of each model in each row.
    :param seed: Of environments, policies and perturbations.
    :param deterministic: Act without noise.
    :param scale: Of the components of a vector, so that all models meet the same perturbations; ``None``: of an image.
    """

    env_id: str
    env_kwargs: Mapping[str, Any]
    sources: Mapping[str, Sequence[Source]]
    n_episodes: int
    seed: int
    deterministic: bool
    scale: np.ndarray | None


def run_row(plan: Plan, row: Row, methods: Mapping[str, Sequence[Any]]) -> pd.DataFrame:
    """
    Run every model in one row.

    With the same seed all models start from the same initial states and meet the same perturbations, as far as
    environment and episodes' lengths allow.

    :param plan: How.
    :param row: In what.
    :param methods: Models by method.
    :return: an episode a row; in front the columns ``model`` (the method), ``train_seed`` (the model's number, from 0),
        ``perturbation``, ``severity`` and ``kind``, then :data:`COLUMNS`
    """
    frames = []
    for label, models in methods.items():
        for number, model in enumerate(models):
            frame = run_episodes(
                model,
                row.scenario,
                plan.n_episodes,
                seed=plan.seed,
                deterministic=plan.deterministic,
                sensor=_sensor(plan, row),
            )
            keys = dict(
                model=label,
                train_seed=number,
                perturbation=row.perturbation,
                severity=row.severity,
                kind=row.kind,
            )
            frames.append(frame[[name for name in COLUMNS if name in frame]].assign(**keys))
    records = pd.concat(frames, ignore_index=True)
    return records[[*keys, *(name for name in COLUMNS if name in records)]]


def _sensor(plan: Plan, row: Row) -> Callable[[VecEnv], VecEnv] | None:
    if row.kind != "sensor":
        return None
    return lambda env: PerturbedVecEnv(env, row.perturbation, row.severity, seed=plan.seed, scale=plan.scale)


def complete_rows(
    plan: Plan,
    rows: Sequence[Row],
    models: Mapping[str, Sequence[Any]],
    folder: Path,
    *,
    jobs: int = 1,
    progress_bar: bool = True,
) -> pd.DataFrame:
    """
    Run the rows that have no file yet, and return the records of all.

    :param plan: How.
    :param rows: In what.
    :param models: Those of the plan, loaded.
    :param folder: Where the files are.
    :param jobs: Processes; with 1 it is this one.
    :param progress_bar: Show a progress bar on stderr.
    """
    missing = [row for row in rows if not (folder / row.file_name).exists()]
    folder.mkdir(parents=True, exist_ok=True)
    with tqdm(total=len(rows), initial=len(rows) - len(missing), unit="row", disable=not progress_bar) as progress:
        try:
            for row, records in _completed(plan, missing, models, min(jobs, len(missing))):
                write_frame_atomically(records, folder / row.file_name)
                progress.set_postfix_str(row.title, refresh=False)
                progress.update()
        except BaseException:
            progress.write("stopped; finished rows are kept, and the same command goes on from them")
            raise
    return pd.concat([_read(folder / row.file_name) for row in rows], ignore_index=True)


def _read(path: Path) -> pd.DataFrame:
    # "1" or "None" may be the name of a method or of a row.
    names = dict.fromkeys(("model", "perturbation", "kind"), str)
    return pd.read_csv(path, dtype=names, keep_default_na=False, na_values=[""])


def _completed(
    plan: Plan, rows: Sequence[Row], models: Mapping[str, Sequence[Any]], jobs: int
) -> Iterator[tuple[Row, pd.DataFrame]]:
    if jobs <= 1:
        with threads(1):
            for row in rows:
                yield row, run_row(plan, row, models)
        return
    context = mp.get_context("spawn")
    with ProcessPoolExecutor(jobs, context, initializer=_init_worker, initargs=(plan,)) as pool:
        try:
            running = {pool.submit(_run_row_in_worker, row): row for row in rows}
            while running:
                # With a timeout, so that Ctrl-C is seen at once.
                for future in wait(running, timeout=1.0, return_when=FIRST_COMPLETED).done:
                    yield running.pop(future), future.result()
        except BaseException:
            workers = list(getattr(pool, "_processes", {}).values())  # shutdown() forgets them
            pool.shutdown(wait=False, cancel_futures=True)
            for process in workers:
                process.terminate()
            raise


_WORKER: dict[str, Any] = {}  # what a process of the pool loads once


def _init_worker(plan: Plan) -> None:
    set_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent decides
    _WORKER.update(plan=plan, models=load_all(plan.sources, plan.env_id, plan.env_kwargs))


def _run_row_in_worker(row: Row) -> pd.DataFrame:
    return run_row(_WORKER["plan"], row, _WORKER["models"])
