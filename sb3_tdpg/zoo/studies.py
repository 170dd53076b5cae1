"""
Run Optuna studies that any number of worker processes share, on one machine or on many.

Optuna's heartbeats show which workers are alive. The trial of a dead worker is put back into the queue, at most three
times. This module adds heartbeats for journal files, and a loop that waits for the trials of other workers.
"""

import contextlib
import math
import os
import re
import time
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import optuna
import sqlalchemy as sa
from optuna.exceptions import DuplicatedStudyError, ExperimentalWarning, StorageInternalError, TrialPruned
from optuna.storages import BaseStorage, JournalStorage, RDBStorage, RetryHeartbeatStaleTrialCallback, fail_stale_trials
from optuna.storages._heartbeat import BaseHeartbeat
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, TrialState

from sb3_tdpg.common.provenance import differences, jsonable

GRACE_PERIOD = 60.0  # seconds
MAX_RETRIES = 3
FORMS = "postgresql://user:password@host/database (many machines) or a path that ends in .log (one machine)"
POSTGRES = dict(connect_timeout=5, keepalives_idle=30, keepalives_interval=10, keepalives_count=3)  # seconds
OPEN_ATTEMPTS = 5
OUTAGE = (StorageInternalError, sa.exc.DBAPIError)
PATIENCE = 60.0  # seconds

SPACE = "space"  # attribute of a study
HEARTBEAT, STARTED, REASON = "heartbeat", "started", "reason"  # attributes of a trial
DONE = (TrialState.COMPLETE, TrialState.PRUNED)


class _Journal(JournalStorage, BaseHeartbeat):
    """A journal file with heartbeats. Its workers run on one machine, so that their clocks agree."""

    def __init__(self, path: Path, grace_period: float) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        # The path is absolute, because the lock is a link to it. Through the link, workers see the age of a lock.
        super().__init__(JournalFileBackend(str(path.absolute())))
        self.grace_period = grace_period

    def record_heartbeat(self, trial_id: int) -> None:
        with contextlib.suppress(optuna.exceptions.UpdateFinishedTrialError):
            self.set_trial_user_attr(trial_id, HEARTBEAT, time.time())

    def get_heartbeat_interval(self) -> int:
        return _interval(self.grace_period)

    def get_heartbeat_stale_trial_callback(self) -> Callable[[optuna.Study, FrozenTrial], None]:
        return RetryHeartbeatStaleTrialCallback(MAX_RETRIES)

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        return [trial._trial_id for trial in _silent_trials(self, study_id)]


class _Database(RDBStorage):
    """A database whose heartbeats continue after an outage and also cover the first moment of a trial."""

    def record_heartbeat(self, trial_id: int) -> None:
        with contextlib.suppress(StorageInternalError, sa.exc.SQLAlchemyError):
            super().record_heartbeat(trial_id)

    def _get_stale_trial_ids(self, study_id: int) -> list[int]:
        # Without this, Optuna would wait forever for a worker that died before its first heartbeat.
        early = [t._trial_id for t in _silent_trials(self, study_id) if t.user_attrs.get(STARTED) != t.number]
        return [*super()._get_stale_trial_ids(study_id), *early]


def _interval(grace_period: float) -> int:
    return max(1, int(grace_period / 6))


def _silent_trials(storage: Any, study_id: int) -> list[FrozenTrial]:
    """Return the running trials that neither started nor sent a heartbeat in the grace period (on this clock)."""
    trials = storage.get_all_trials(study_id, deepcopy=False, states=(TrialState.RUNNING,))
    since = time.time() - storage.grace_period
    # A repeated trial has inherited an old heartbeat.
    return [t for t in trials if max(t.datetime_start.timestamp(), t.user_attrs.get(HEARTBEAT, 0.0)) < since]


def open_storage(storage: str | os.PathLike[str], grace_period: float = GRACE_PERIOD) -> BaseStorage:
    """
    Open the storage that workers share, create its tables or file if necessary, and turn off Optuna's messages.

    :param storage: For the processes of one machine: the path of a journal file, which ends in ``.log``. For many
        machines: ``postgresql://user:password@host:port/database`` (with psycopg 3, unless the URL names another
        driver). Other databases of SQLAlchemy also work, except SQLite, which is not made for several workers.
    :param grace_period: Seconds without a heartbeat after which a worker counts as dead, at least 2. All workers must
        use the same value.
    :raises ValueError: if the storage is malformed or does not answer.
    :raises ImportError: if the driver of the database is not installed.
    """
    text = os.fspath(storage)
    url = re.sub(r"^postgres(ql)?://", "postgresql+psycopg://", text)
    shown = re.sub(r"(//[^:@]*):.*@", r"\1:***@", text)
    if text.startswith("sqlite") or ("://" not in text and not text.endswith(".log")):
        raise ValueError(f"storage={shown!r} must be {FORMS}; SQLite is not meant for several workers")
    if text.count("@") > 1:
        raise ValueError(f"storage={shown!r}: write an @ in the password as %40")
    optuna.logging.set_verbosity(optuna.logging.CRITICAL)  # work() reports the trials
    warnings.filterwarnings("ignore", category=ExperimentalWarning)

    def open_once() -> BaseStorage:
        if "://" not in text:
            return _Journal(Path(text), grace_period)
        return _Database(
            url.replace("{", "{{").replace("}", "}}"),  # Optuna formats the URL
            dict(pool_pre_ping=True, connect_args=POSTGRES if url.startswith("postgresql") else {}),
            heartbeat_interval=_interval(grace_period),
            grace_period=int(grace_period),
            heartbeat_stale_trial_callback=RetryHeartbeatStaleTrialCallback(MAX_RETRIES),
        )

    try:
        for _ in range(OPEN_ATTEMPTS - 1):
            with contextlib.suppress(sa.exc.DBAPIError, AssertionError):
                return open_once()
            time.sleep(0.5)  # workers that start at the same time can fail when they create the tables
        return open_once()
    except ImportError as e:
        raise ImportError(f"storage {shown} needs a driver: pip install 'sb3_tdpg[postgres]'") from e
    except (OSError, ValueError, KeyError, AssertionError, RuntimeError, sa.exc.SQLAlchemyError) as e:
        if isinstance(e, sa.exc.ArgumentError) or ("://" in text and isinstance(e, ValueError)):
            raise ValueError(f"storage={shown!r} is malformed or of an unknown kind, expected {FORMS}") from e
        raise ValueError(f"storage {shown} cannot be opened: {_one_line(e)}") from e


def _one_line(error: BaseException) -> str:
    error = getattr(error.__cause__, "orig", None) or getattr(error, "orig", None) or error
    return " ".join(str(error).split()) or type(error).__name__


def open_study(storage: BaseStorage, name: str, *, space: Mapping[str, Any], **options: Any) -> optuna.Study:
    """
    Create a study, or load it if it exists.

    :param storage: From :func:`open_storage`.
    :param name: Name of the study.
    :param space: Everything that must be equal for trials to be comparable: search space, environment, settings.
    :param options: ``sampler`` and ``pruner`` of ``optuna.create_study``.
    :raises ValueError: if the study was made with another space; the message names the differences.
    """
    try:
        study = optuna.create_study(storage=storage, study_name=name, **options)
    except DuplicatedStudyError:
        study = optuna.create_study(storage=storage, study_name=name, load_if_exists=True, **options)
        study.sampler.reseed_rng()  # otherwise two workers with the same seed would try the same points
    if SPACE not in study.user_attrs:
        if study.get_trials(deepcopy=False):
            raise ValueError(f"study {name!r} was made by another program: choose another name")
        study.set_user_attr(SPACE, jsonable(space))
    elif changed := differences(study.user_attrs[SPACE], jsonable(space)):
        mend = "choose another name for the study, or the settings that it was made with"
        raise ValueError(f"study {name!r} exists with other settings, {changed}: {mend}")
    return study


def work(
    study: optuna.Study,
    objective: Callable[[optuna.Trial], float],
    n_trials: int,
    *,
    describe: Callable[[FrozenTrial], str] = lambda trial: f"{trial.value:.4g}",
    report: Callable[[str], None] = print,
) -> None:
    """
    Run trials in parallel with any number of other workers until a study is finished.

    A ``ValueError``, for instance from a training that diverged, prunes the trial. The message becomes the trial's
    attribute ``reason``. Any other exception (unless the storage does not answer) and Ctrl-C end this worker and put
    the trial back into the queue. The trial of a killed worker is put back by another worker, or by the next worker
    that starts.

    :param study: From :func:`open_study`.
    :param objective: Function that gets a trial and returns its value.
    :param n_trials: Number of complete and pruned trials of all workers together. Each worker may add one more trial.
    :param describe: Function that describes a complete trial; default: its value.
    :param report: Function that gets a line of text for each trial.
    :raises ValueError: if the storage does not answer for a minute. After a shorter outage, the lost trials are run
        again.
    """
    number: int | None = None  # number of the trial that this worker runs
    is_interrupted = False

    def attempt(trial: optuna.Trial) -> float:
        nonlocal number, is_interrupted
        number = trial.number
        trial.set_user_attr(STARTED, number)  # a repeated trial inherits the attribute
        try:
            value = objective(trial)
            if math.isnan(value):
                raise ValueError(f"the result is {value}")
            return value
        except KeyboardInterrupt:  # Optuna loses this exception if it cannot store the state of the trial
            is_interrupted = True
            raise
        except (TrialPruned, ValueError) as e:
            trial.set_user_attr(REASON, _one_line(e))
            raise TrialPruned(_one_line(e)) from e

    def say(_: optuna.Study, trial: FrozenTrial) -> None:
        if trial.state in DONE:
            text = describe(trial) if trial.state == TrialState.COMPLETE else f"pruned: {trial.user_attrs[REASON]}"
            n_done = len(study.get_trials(deepcopy=False, states=DONE))
            report(f"trial {trial.number}: {text} ({n_done} of {n_trials} finished)")

    is_waiting = False
    while True:
        number = None
        try:
            fail_stale_trials(study)
            n = Counter(trial.state for trial in study.get_trials(deepcopy=False))
            n_done, n_running = n[TrialState.COMPLETE] + n[TrialState.PRUNED], n[TrialState.RUNNING]
            if n[TrialState.WAITING] or n_done + n_running < n_trials:
                is_waiting = False
                study.optimize(attempt, n_trials=1, callbacks=[say])
            elif n_running and n_done < n_trials:
                if not is_waiting:
                    report(f"waiting for {n_running} trials of other workers; trials of dead workers will be run again")
                is_waiting = True
                time.sleep(1.0)
            else:
                return
        except (Exception, KeyboardInterrupt) as e:
            is_interrupted |= isinstance(e, KeyboardInterrupt)
            if outage := _outage_in(e):
                report(f"the storage does not answer ({_one_line(outage)}): waiting for it")
            trials = _trials_when_answered(study)
            if any(number in trial.system_attrs.get("retry_history", ()) for trial in trials):
                report(f"trial {number} was taken over by another worker: its result is dropped")
                if is_interrupted:
                    raise KeyboardInterrupt from e
                continue
            if number is not None and trials[number].state == TrialState.FAIL:
                # A trial may be interrupted, or lost in an outage, any number of times.
                max_retries = None if outage or is_interrupted else MAX_RETRIES
                RetryHeartbeatStaleTrialCallback(max_retries)(study, trials[number])
            if is_interrupted:
                raise KeyboardInterrupt from e
            if not outage:
                raise


def _outage_in(error: BaseException | None) -> BaseException | None:
    """Return the storage's error that caused an exception, such as the one that Optuna's ``tell`` raises."""
    while error is not None and not isinstance(error, OUTAGE):
        error = error.__cause__ or error.__context__
    return error


def _trials_when_answered(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials of a study; wait if the database is being restarted."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            return study.get_trials()
        except OUTAGE as e:
            if time.monotonic() > deadline:
                raise ValueError(f"the storage has not answered for {PATIENCE:g} seconds: {_one_line(e)}") from e
            time.sleep(0.5)
