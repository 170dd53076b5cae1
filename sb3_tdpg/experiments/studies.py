"""
One Optuna study that any number of worker processes on any number of machines work at.

What is to be done follows from the trials in the storage alone, so that a worker may be killed between any two steps:

- A *job* is a parameter set that is to be run to its end once. Its trials are its *attempts*: they share the
  attribute ``job``, the number of the first one or what :func:`enqueue_once` wrote there.
- Of several living attempts at a job the one with the lowest number counts; the others are handed back before they are
  run. So is a job beyond ``n_trials``, as appears when two workers begin the last one at once.
- A worker changes the attribute ``heartbeat`` of its trial every few seconds. A running trial whose heartbeat no other
  worker sees change for ``grace_period`` is failed, and attempted again with the same parameters.

Optuna's own heartbeats are not used: there are none for journal files, a trial whose worker dies before its first
heartbeat counts as running for ever, and one whose finder dies before it has put it into the queue again is lost.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

try:
    import optuna
except ImportError as e:
    raise ImportError("studies need Optuna: pip install sb3_tdpg[zoo]") from e

from sb3_tdpg.common.provenance import differences, jsonable
from sb3_tdpg.experiments.storages import open_storage, quiet_optuna, told_in_one_line
from sb3_tdpg.experiments.study_jobs import JOB, job_of
from sb3_tdpg.experiments.study_worker import Objective, UnfitWorkerError, Worker, values_of

__all__ = ["UnfitWorkerError", "enqueue_once", "open_storage", "open_study", "quiet_optuna", "work"]

GRACE_PERIOD = 120.0  # seconds
CREATION_TIME = 10.0  # seconds from the creation of a study to the description of its space, at most
SPACE = "space"  # attribute of a study


@told_in_one_line()
def open_study(
    storage: optuna.storages.BaseStorage,
    name: str,
    *,
    directions: Sequence[str] = ("minimize",),
    sampler: optuna.samplers.BaseSampler | None = None,
    pruner: optuna.pruners.BasePruner | None = None,
    space: Mapping[str, Any],
) -> optuna.Study:
    """
    Create a study, or load it if it is there; workers may do so at once.

    :param storage: From :func:`open_storage`.
    :param name: Name of the study.
    :param directions: ``"minimize"`` or ``"maximize"`` for each objective.
    :param sampler: As for ``optuna.create_study``. Not shared: each worker has its own.
    :param pruner: Likewise.
    :param space: All that makes one trial comparable with another, in JSON's types: search space, environment,
        settings. It is kept with the study.
    :raises ValueError: if the study was made with another space or other directions; it says what differs. Likewise if
        the storage does not answer.
    """
    wanted = jsonable(space)
    kinds: list[Any] = list(directions)
    try:
        study = optuna.create_study(storage=storage, study_name=name, directions=kinds, sampler=sampler, pruner=pruner)
    except optuna.exceptions.DuplicatedStudyError:
        study = optuna.load_study(study_name=name, storage=storage, sampler=sampler, pruner=pruner)
        # Only the one that created the study writes, so that two with different spaces cannot both believe in theirs.
        deadline = time.monotonic() + CREATION_TIME
        while SPACE not in study.user_attrs and not study.get_trials(deepcopy=False) and time.monotonic() < deadline:
            time.sleep(0.1)
        if SPACE not in study.user_attrs and study.get_trials(deepcopy=False):
            raise ValueError(
                f"study {name!r} was made by another program and does not say what its trials are: choose another name"
            ) from None
        if SPACE in study.user_attrs:
            found = [d.name.lower() for d in study.directions]
            changed = differences({"directions": found}, {"directions": list(directions)})
            if changed := changed or differences(study.user_attrs[SPACE], wanted):
                raise ValueError(
                    f"study {name!r} is there with other settings, {changed}: choose another name for the study, or "
                    "the settings that it was made with"
                ) from None
            return study
    study.set_user_attr(SPACE, wanted)
    return study


@told_in_one_line()
def enqueue_once(study: optuna.Study, jobs: Sequence[Mapping[str, Any]]) -> None:
    """
    Put jobs into the queue, each once, however often and by however many workers at once this is called.

    :param study: From :func:`open_study`.
    :param jobs: Parameters of each, in JSON's types. An objective gets them through ``trial.suggest_*``.
    """
    there = {job_of(trial) for trial in study.get_trials(deepcopy=False)}
    for job in jobs:
        name = json.dumps(jsonable(job), sort_keys=True)
        if name not in there:
            study.enqueue_trial(dict(job), user_attrs={JOB: name})


def work(
    study: optuna.Study,
    objective: Objective,
    n_trials: int | None = None,
    *,
    max_retries: int = 3,
    grace_period: float = GRACE_PERIOD,
    heartbeat_interval: float | None = None,
    report: Callable[[str], None] = print,
    describe: Callable[[optuna.trial.FrozenTrial], str] = values_of,
) -> None:
    """
    Run trials of a study until it is finished, beside any number of workers that do the same.

    A trial is finished when it is complete or pruned. One that raises a ``ValueError`` is pruned, and keeps the message
    as its attribute ``reason``. Any other exception is recorded likewise, puts the trial back into the queue and ends
    this worker. Ctrl-C and an ``UnfitWorkerError`` put the trial back. One whose worker was killed is run again by
    another, or by a later, worker. A worker that was suspended for so long that it counted as dead is interrupted in
    its trial, whose result is dropped, and goes on with the next one.

    :param study: From :func:`open_study`.
    :param objective: Gets a trial, returns its value or values.
    :param n_trials: Finished trials that the study is to have, all workers and earlier calls together; ``None``: all
        that :func:`enqueue_once` put into the queue.
    :param max_retries: How often a trial that failed, or took its worker with it, is run again. Then it is left, and
        if ``n_trials`` is given, another one takes its place.
    :param grace_period: Seconds without a heartbeat after which a worker counts as dead; the same for all workers.
    :param heartbeat_interval: Seconds; default: a sixth of the grace period.
    :param report: Gets a line of text whenever something happens.
    :param describe: What the line says of a complete trial; default: its values.
    :raises ValueError: if the grace period is too short, or the storage stays away.
    """
    if n_trials is not None and n_trials < 1:
        raise ValueError(f"n_trials={n_trials} must be at least 1")
    if heartbeat_interval is None:
        heartbeat_interval = grace_period / 6
    if not 0 < 2 * heartbeat_interval <= grace_period:
        raise ValueError(f"{grace_period=} must be at least twice {heartbeat_interval=}, and both positive (seconds)")
    Worker(study, objective, n_trials, max_retries, heartbeat_interval, grace_period, report, describe).run()
