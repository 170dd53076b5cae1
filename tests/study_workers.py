"""Run real worker processes of a study, which tests can kill."""

import multiprocessing as mp
import os
import signal
import sys
import time
from multiprocessing.forkserver import ensure_running
from unittest.mock import patch

import optuna

from sb3_tdpg.zoo.studies import open_storage, open_study, work

GRACE_PERIOD = 3


def open_quick(url, **kwargs):
    return open_study(open_storage(url, GRACE_PERIOD), "s", **{"space": {"x": [-1, 1]}, **kwargs})


def run_worker(url, n_trials, log, seconds):
    """Run trials of the study "s"; write the start and the end of each trial, and all reports, to a log."""
    # If a shell runs the tests in the background, processes ignore Ctrl-C by default.
    signal.signal(signal.SIGINT, signal.default_int_handler)

    def objective(trial):
        x, y = (trial.suggest_float(name, -1.0, 1.0) for name in ("x", "y"))
        write(f"begin {os.getpid()} {x} {y}")
        time.sleep(seconds)
        write(f"end {os.getpid()} {x} {y}")
        return x * x + y

    def write(text):
        with open(log, "a") as file:
            file.write(text + "\n")

    # All workers have the same seed, but they must not try the same points.
    study = open_quick(url, sampler=optuna.samplers.TPESampler(seed=0))
    work(study, objective, n_trials, report=lambda text: write(f"say {os.getpid()} {text}"))


class Workers:
    """Worker processes, and the log to which they write."""

    def __init__(self, folder, url, n_trials):
        self.url, self.n_trials, self.log = url, n_trials, folder / "log"
        self.processes = []
        # Workers start in milliseconds if a process that has already imported their modules forks them. That process
        # finds the modules only through the environment.
        self.context = mp.get_context("forkserver")
        self.context.set_forkserver_preload([__name__])
        with patch.dict(os.environ, PYTHONPATH=os.pathsep.join(sys.path)):
            ensure_running()

    def start(self, *seconds):
        """Start one worker for each given duration of a trial."""
        new = [self.context.Process(target=run_worker, args=(self.url, self.n_trials, self.log, s)) for s in seconds]
        for process in new:
            process.start()
        self.processes += new
        return new

    def lines(self, kind, process=None):
        """Return the log's lines of one kind as tuples of words, such as the parameters of trials that begin or end."""
        lines = [line.split() for line in self.log.read_text().splitlines()] if self.log.exists() else []
        return [tuple(at) for word, pid, *at in lines if word == kind and (process is None or int(pid) == process.pid)]

    @property
    def said(self):
        return "\n".join(" ".join(words) for words in self.lines("say"))

    @property
    def n_dropped(self):
        """Number of dropped results. On a busy machine even a living worker can be silent for the grace period."""
        return self.said.count("its result is dropped")

    def wait_for(self, kind, process):
        deadline = time.monotonic() + 120  # the machine can be busy
        while not self.lines(kind, process):
            assert time.monotonic() < deadline, f"no {kind} in the log: {[p.exitcode for p in self.processes]}"
            time.sleep(0.02)

    def send(self, name, process):
        os.kill(process.pid, getattr(signal, name))

    def join(self, processes):
        for process in processes:
            process.join(120)
        assert [process.exitcode for process in processes] == [0] * len(processes), self.said

    def stop(self):
        for process in self.processes:
            process.kill()
            process.join()
