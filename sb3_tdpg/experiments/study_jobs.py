"""What the trials of a study amount to; see :mod:`sb3_tdpg.experiments.studies` for jobs and attempts."""

from __future__ import annotations

from collections.abc import Sequence

from optuna.trial import FrozenTrial, TrialState, create_trial

# Attributes of a trial.
JOB, HEARTBEAT, WORKER, REASON = "job", "heartbeat", "worker", "reason"
HANDED_BACK = "handed_back"
BOOKKEEPING = frozenset({JOB, HEARTBEAT, WORKER, REASON, HANDED_BACK})

DONE, ALIVE = (TrialState.COMPLETE, TrialState.PRUNED), (TrialState.RUNNING, TrialState.WAITING)


def job_of(trial: FrozenTrial) -> int | str:
    """Return the job that a trial is an attempt at."""
    return trial.user_attrs.get(JOB, trial.number)


class Jobs:
    """
    The jobs of a study, from its trials.

    :param trials: All of them, in the order of their numbers.
    :param n_trials: Jobs that are to be done; ``None``: those that were put into the queue, and only they count.
    :param max_retries: How often a job may fail before it is left.
    """

    def __init__(self, trials: Sequence[FrozenTrial], n_trials: int | None, max_retries: int) -> None:
        attempts: dict[int | str, list[FrozenTrial]] = {}
        for trial in trials:
            if n_trials is not None or JOB in trial.user_attrs:
                attempts.setdefault(job_of(trial), []).append(trial)
        self.n_trials = n_trials
        self.done = {job for job, tried in attempts.items() if any(t.state in DONE for t in tried)}
        self.open: dict[int | str, FrozenTrial | None] = {}  # the attempt that counts, if one is alive
        self.failed: dict[int | str, FrozenTrial] = {}  # the last attempt
        self.duplicates: set[int] = set()  # numbers of attempts that are alive and do not count
        for job, tried in attempts.items():  # in the order of their first attempts
            alive = [t for t in tried if t.state in ALIVE]
            failures = sum(t.state == TrialState.FAIL and HANDED_BACK not in t.user_attrs for t in tried)
            if job in self.done:
                self.duplicates.update(t.number for t in alive)
            elif not alive and failures > max_retries:
                self.failed[job] = tried[-1]
            elif n_trials is None or len(self.done) + len(self.open) < n_trials:
                self.open[job] = alive[0] if alive else None
                self.duplicates.update(t.number for t in alive[1:])
        self._last_attempts = {job: attempts[job][-1] for job in self.open}
        self._waiting = {t.number for t in trials if t.state == TrialState.WAITING}

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        done = not self.open if self.n_trials is None else len(self.done) >= self.n_trials
        return done and not self.duplicates & self._waiting

    @property
    def has_room(self) -> bool:
        """Whether a trial is to be begun: one that waits, or a new one."""
        counting = {trial.number for trial in self.open.values() if trial is not None}
        is_short = self.n_trials is not None and len(self.done) + len(self.open) < self.n_trials
        return is_short or bool((counting | self.duplicates) & self._waiting)

    def counts(self, number: int) -> bool:
        """Whether this trial is to be run."""
        return any(trial is not None and trial.number == number for trial in self.open.values())

    def attempt_again(self, job: int | str) -> FrozenTrial:
        """Make a waiting trial with the parameters of the last attempt."""
        last = self._last_attempts[job]
        attributes = {name: value for name, value in last.user_attrs.items() if name not in BOOKKEEPING}
        return create_trial(
            state=TrialState.WAITING,
            params=last.params,
            distributions=last.distributions,
            user_attrs={**attributes, JOB: job},
            system_attrs=last.system_attrs,
        )
