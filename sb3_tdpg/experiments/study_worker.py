"""What a worker of a study does; see :func:`sb3_tdpg.experiments.studies.work`."""

from __future__ import annotations

import _thread
import math
import os
import socket
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, TypeVar

import optuna
from optuna.exceptions import StorageInternalError, TrialPruned, UpdateFinishedTrialError
from optuna.trial import FrozenTrial, TrialState

from sb3_tdpg.experiments.study_jobs import HANDED_BACK, HEARTBEAT, REASON, WORKER, Jobs

Objective = Callable[[optuna.Trial], float | Sequence[float]]
Result = TypeVar("Result")

PATIENCE = 300.0  # seconds for which a storage may be away


class UnfitWorkerError(ValueError):
    """A trial cannot be run here, but elsewhere: it is put back into the queue, and this worker ends."""


class StorageAwayError(ValueError):
    """The storage does not answer for too long."""


class _Heartbeat(AbstractContextManager["_Heartbeat"]):
    """Show the others that a trial is being run; interrupt it if one of them has taken it over nevertheless."""

    def __init__(self, trial: optuna.Trial, interval: float) -> None:
        self._trial, self._interval = trial, interval
        self._can_be_interrupted = threading.current_thread() is threading.main_thread()
        self.is_taken_over = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> _Heartbeat:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        beats = 0
        while not self._stop.wait(self._interval):
            beats += 1
            try:
                self._trial.set_user_attr(HEARTBEAT, beats)
            except UpdateFinishedTrialError:
                # As happens to a worker that was suspended. What it would go on writing is another one's by now.
                self.is_taken_over = True
                if self._can_be_interrupted:
                    _thread.interrupt_main()
                return
            except Exception:  # a storage that is away may come back: the trial must not die of it
                continue


class Worker:
    """The parameters are those of :func:`sb3_tdpg.experiments.studies.work`."""

    def __init__(
        self,
        study: optuna.Study,
        objective: Objective,
        n_trials: int | None,
        max_retries: int,
        heartbeat_interval: float,
        grace_period: float,
        report: Callable[[str], None],
        describe: Callable[[FrozenTrial], str],
    ) -> None:
        self.study, self.objective = study, objective
        self.report, self.describe = report, describe
        self.n_trials, self.max_retries = n_trials, max_retries
        self.heartbeat_interval, self.grace_period = heartbeat_interval, grace_period
        self.next_number: int | None = 0  # if this worker is alone with the study
        self.seen: dict[int, tuple[Any, float]] = {}  # running trials of others: their heartbeat, and since when
        self.looked_at = -math.inf  # when they were seen last

    def run(self) -> None:
        """Run trials until the study is finished."""
        is_waiting = False
        while True:
            jobs = self._look()
            if jobs.finished:
                break
            if jobs.has_room:
                is_waiting = False
                self._run_trial()
                continue
            if not is_waiting:
                self.report(
                    f"waiting for {len(jobs.open)} trials of other workers; those silent for {self.grace_period:g} s "
                    "are taken over"
                )
            is_waiting = True
            time.sleep(min(1.0, self.heartbeat_interval))
        for trial in jobs.failed.values():
            reason = trial.user_attrs.get(REASON, "its worker was killed")
            self.report(f"trial {trial.number} failed {self.max_retries + 1} times and is left: {reason}")

    def _look(self) -> Jobs:
        """Read the study, fail trials whose worker is dead, put back into the queue what has failed."""
        jobs = self._read()
        if self._fail_silent(jobs):
            jobs = self._read()
        lost = [jobs.attempt_again(job) for job, trial in jobs.open.items() if trial is None]
        for trial in lost:
            self._patiently(partial(self.study.add_trial, trial))
        return self._read() if lost else jobs

    def _read(self) -> Jobs:
        trials = self._patiently(lambda: self.study.get_trials(deepcopy=False))
        return Jobs(trials, self.n_trials, self.max_retries)

    def _fail_silent(self, jobs: Jobs) -> bool:
        """Fail the running trials whose heartbeat stands still; return whether there were any."""
        now, seen = time.monotonic(), {}
        # After a pause nothing follows from what was seen before it: the others may have been suspended, too.
        if now - self.looked_at > self.grace_period / 3:
            self.seen = {}
        self.looked_at = now
        running = [t for t in jobs.open.values() if t is not None and t.state == TrialState.RUNNING]
        silent = []
        for trial in running:
            heartbeat = trial.user_attrs.get(HEARTBEAT)
            before = self.seen.get(trial.number)
            seen[trial.number] = before if before is not None and before[0] == heartbeat else (heartbeat, now)
            # By this machine's clock alone: those of several machines differ.
            if now - seen[trial.number][1] > self.grace_period:
                silent.append(trial)
        self.seen = seen
        for trial in silent:
            worker = trial.user_attrs.get(WORKER, "its worker")
            self.report(f"trial {trial.number}: {worker} is silent for {self.grace_period:g} s: to be run again")
            self._tell(trial.number, state=TrialState.FAIL)
        return bool(silent)

    def _run_trial(self) -> None:
        trial = self._patiently(self.study.ask)
        # Two samplers with the same seed would try the same points.
        if self.next_number is not None and trial.number != self.next_number:
            self.study.sampler.reseed_rng()
            self.next_number = None
        if self.next_number is not None:
            self.next_number += 1
        heartbeat = _Heartbeat(trial, self.heartbeat_interval)
        try:
            if not self._read().counts(trial.number):
                self._hand_back(trial)
                return
            self._patiently(lambda: trial.set_user_attr(WORKER, f"{socket.gethostname()}:{os.getpid()}"))
            with heartbeat:
                values = self.objective(trial)
            self._finish(trial, TrialState.COMPLETE, values)
        except StorageAwayError:
            raise  # nor can it be told how the trial has ended
        except UnfitWorkerError:
            self._put_back(trial)
            raise
        except (TrialPruned, ValueError) as e:
            self._finish(trial, TrialState.PRUNED, reason=_reason(e))
        except UpdateFinishedTrialError:  # seen by the objective itself
            self._say_taken_over(trial)
        except StorageInternalError as e:  # likewise
            self._finish(trial, TrialState.FAIL, reason=_reason(e))
        except Exception as e:
            self._finish(trial, TrialState.FAIL, reason=_reason(e))
            raise
        except BaseException:
            if heartbeat.is_taken_over:
                self._say_taken_over(trial)
                return
            self._put_back(trial)
            raise

    def _put_back(self, trial: optuna.Trial) -> None:
        if self._hand_back(trial):
            self.report(f"trial {trial.number} is put back into the queue")

    def _hand_back(self, trial: optuna.Trial) -> bool:
        """End an attempt that is no failure: its job is run later, if it is still wanted. False: it has ended."""
        try:
            self._patiently(lambda: trial.set_user_attr(HANDED_BACK, True))
        except UpdateFinishedTrialError:
            return False
        told = self._tell(trial.number, TrialState.FAIL)
        return told is not None and told.state == TrialState.FAIL

    def _finish(
        self,
        trial: optuna.Trial,
        state: TrialState,
        values: float | Sequence[float] | None = None,
        reason: str | None = None,
    ) -> None:
        """
        Record how a trial ended.

        :raises ValueError: if a value is not a number.
        """
        try:
            if reason is not None:
                self._patiently(lambda: trial.set_user_attr(REASON, reason))
            told = self._tell(trial.number, state, values)
        except UpdateFinishedTrialError:
            told = None
        if told is None or told.state != state:
            self._say_taken_over(trial)
            return
        if state == TrialState.COMPLETE:
            text = self.describe(told)
        else:
            text = "pruned" if state == TrialState.PRUNED else "failed"
        text += f": {reason}" if reason else ""
        total = "" if self.n_trials is None else f" of {self.n_trials}"
        self.report(f"trial {trial.number}: {text} ({len(self._read().done)}{total} finished)")

    def _say_taken_over(self, trial: optuna.Trial) -> None:
        self.report(f"trial {trial.number} was taken over by another worker: its result is dropped")

    def _tell(
        self, number: int, state: TrialState, values: float | Sequence[float] | None = None
    ) -> FrozenTrial | None:
        """Set the state of a trial; if another worker has done so before, it stays."""
        try:
            return self._patiently(lambda: self.study.tell(number, values, state=state, skip_if_finished=True))
        except UpdateFinishedTrialError:
            return None

    def _patiently(self, call: Callable[[], Result]) -> Result:
        """Call, and again while the storage is away: what a trial has computed must outlast a restart of it."""
        deadline: float | None = None
        while True:
            try:
                return call()
            except StorageInternalError as e:
                self.seen = {}  # nobody could show a heartbeat
                if deadline is None:
                    deadline = time.monotonic() + PATIENCE
                    self.report(f"the storage does not answer: trying again for {PATIENCE:g} s")
                if time.monotonic() > deadline:
                    reason = " ".join(str(getattr(e.__cause__, "orig", None) or e).split())
                    raise StorageAwayError(f"the storage has not answered for {PATIENCE:g} s: {reason}") from e
                time.sleep(1.0)


def values_of(trial: FrozenTrial) -> str:
    """Print the values of a complete trial."""
    return ", ".join(f"{value:.4g}" for value in trial.values)


def _reason(error: Exception) -> str:
    text = str(error).strip()
    return text if isinstance(error, (ValueError, TrialPruned)) and text else f"{type(error).__name__}: {text}"
