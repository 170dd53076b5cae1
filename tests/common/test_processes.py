"""Pools of worker processes: order, Ctrl-C, and what happens when the main process is killed."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch as th

from sb3_tdpg.common.processes import process_pool

REPOSITORY = Path(__file__).resolve().parents[2]
PROGRAM = """
import sys, time
from pathlib import Path
from sb3_tdpg.common.processes import process_pool

def work(path):
    path.write_text("started")
    time.sleep(60)
    path.write_text("finished")

if __name__ == "__main__":
    with process_pool(2) as pool:
        for future in [pool.submit(work, Path(name)) for name in "abc"]:
            future.result()
"""


def append(path, text):
    with open(path, "a") as file:
        file.write(f"{text} {th.get_num_threads()} {_greeting}\n")
    return text


_greeting = None


def greet(text):
    global _greeting
    _greeting = text


def test_tasks_start_in_order_in_workers_with_one_thread_that_were_initialised(tmp_path):
    with process_pool(1, greet, ("hello",)) as pool:
        futures = [pool.submit(append, tmp_path / "log", i) for i in (3, 1, 2)]
        assert [future.result() for future in futures] == [3, 1, 2]
    assert (tmp_path / "log").read_text() == "3 1 hello\n1 1 hello\n2 1 hello\n"


def test_an_exception_stops_the_workers_at_once():
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt), process_pool(1) as pool:
        futures = [pool.submit(os.getpid), *(pool.submit(time.sleep, 600) for _ in range(4))]
        pid = futures[0].result()
        raise KeyboardInterrupt
    assert time.monotonic() - begin < 60
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def started(tmp_path, program):
    """Start a program whose whole group gets Ctrl-C, as in a terminal."""
    (tmp_path / "program.py").write_text(program)
    return subprocess.Popen(
        [sys.executable, "program.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


@pytest.mark.parametrize("name", ["SIGINT", "SIGKILL"])
def test_workers_end_with_the_main_process(name, tmp_path):
    with started(tmp_path, PROGRAM) as process:
        deadline = time.monotonic() + 120
        while not all((tmp_path / name).exists() for name in "ab"):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        if name == "SIGINT":
            os.killpg(process.pid, signal.SIGINT)
        else:
            process.kill()
        # The workers hold the pipe, too: it ends when the last of them has.
        error = process.communicate(timeout=30)[1]
    assert error.count("Traceback") == (name == "SIGINT")
    assert [(tmp_path / name).exists() and (tmp_path / name).read_text() for name in "abc"] == ["started"] * 2 + [False]


def test_a_worker_that_is_stopped_leaves_no_semaphore_of_its_progress_bars(tmp_path):
    program = (
        "from tqdm import tqdm\nfrom sb3_tdpg.common.processes import process_pool\n"
        "def work():\n    list(tqdm(range(3), disable=True))\n    list(tqdm(range(3), file=open('/dev/null', 'w')))\n"
        "if __name__ == '__main__':\n    with process_pool(1) as pool:\n        pool.submit(work).result()\n"
        "        raise SystemExit('stopped')\n"
    )
    with started(tmp_path, program) as process:
        assert process.communicate(timeout=120)[1] == "stopped\n"


def test_ctrl_c_while_the_workers_start_is_told_once_and_not_lost(tmp_path):
    program = PROGRAM.replace("with process_pool", "print('begins', flush=True)\n    with process_pool")
    with started(tmp_path, program) as process:
        assert process.stdout.readline() == "begins\n"
        time.sleep(0.5)  # the server of the workers imports for seconds
        os.killpg(process.pid, signal.SIGINT)
        error = process.communicate(timeout=60)[1]
    assert error.count("Traceback") == 1
    assert error.endswith("KeyboardInterrupt\n")
    assert not (tmp_path / "c").exists()


def test_other_processes_of_the_fork_server_hear_ctrl_c():
    # In a process of its own, whose fork server is that of the pool.
    code = """
import multiprocessing, signal
from sb3_tdpg.common.processes import process_pool
with process_pool(1) as pool:
    pool.submit(int).result()
with multiprocessing.get_context("forkserver").Pool(1) as others:
    print(others.apply(signal.pthread_sigmask, (signal.SIG_BLOCK, [])))
    print(others.apply(signal.getsignal, (signal.SIGINT,)))
"""
    said = subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, text=True, stdout=subprocess.PIPE)
    assert said.stdout == f"set()\n{signal.default_int_handler}\n"
