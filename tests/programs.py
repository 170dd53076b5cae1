"""Start programs of the package in new processes, as a user does."""

import os
import signal
import subprocess
import sys
import time

ENVIRONMENT = {"OMP_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}


def start(arguments, folder):
    """Start a command of the package in a folder; Ctrl-C interrupts it."""
    return subprocess.Popen(
        [sys.executable, "-m", "sb3_tdpg", *arguments],
        cwd=folder, env={**os.environ, **ENVIRONMENT}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        # If a shell runs the tests in the background, processes ignore Ctrl-C by default.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip


def run(command, folder, **environment):
    """Run a Python command in a folder, and wait until it has ended."""
    done = subprocess.run(
        [sys.executable, *command],
        cwd=folder, env={**os.environ, **ENVIRONMENT, **environment}, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def wait_for(folder, pattern, process):
    """Wait until a process has written a file that matches a pattern."""
    deadline = time.monotonic() + 120
    while not list(folder.glob(pattern)):
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.02)
