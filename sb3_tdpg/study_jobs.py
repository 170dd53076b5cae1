"""What the trials of a study amount to; see :mod:`sb3_tdpg.studies` for jobs and attempts."""

from __future__ import annotations

from collections.abc import Sequence

from optuna.trial import FrozenTrial, TrialState, create_trial

# Attributes of a trial.
JOB, HEARTBEAT, WORKER, REASON = "job", "heartbeat", "worker", "reason"
GIVEN_UP, HANDED_BACK = "given_up", "handed_back"
BOOKKEEPING = frozenset({JOB, HEARTBEAT, WORKER, REASON, GIVEN_UP, HANDED_BACK})

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
            if GIVEN_UP not in trial.user_attrs and (n_trials is not None or JOB in trial.user_attrs):
                attempts.setdefault(job_of(trial), []).append(trial)
        self.n_trials = n_trials
        self.done = {job for job, tried in attempts.items() if any(t.state in DONE for t in tried)}
        self.open: dict[int | str, FrozenTrial | None] = {}  # the attempt that counts, if one is alive
        self.failed: dict[int | str, FrozenTrial] = {}  # the last attempt
        for job, tried in attempts.items():  # in the order of their first attempts
            alive = next((t for t in tried if t.state in ALIVE), None)
            failures = sum(t.state == TrialState.FAIL and HANDED_BACK not in t.user_attrs for t in tried)
            if job in self.done:
                continue
            if alive is None and failures > max_retries:
                self.failed[job] = tried[-1]
            elif n_trials is None or len(self.done) + len(self.open) < n_trials:
                self.open[job] = alive
        self._last_attempts = {job: attempts[job][-1] for job in self.open}

    @property
    def finished(self) -> bool:
        """Whether nothing is left to do."""
        return not self.open if self.n_trials is None else len(self.done) >= self.n_trials

    @property
    def has_room(self) -> bool:
        """Whether another trial may begin: one waits, or there are too few."""
        waits = any(trial is not None and trial.state == TrialState.WAITING for trial in self.open.values())
        return waits or (self.n_trials is not None and len(self.done) + len(self.open) < self.n_trials)

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
