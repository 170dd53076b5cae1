"""Ctrl-C in a terminal ends a command with one line and a visible cursor, even during imports."""

import os
import re
import signal
import subprocess
import sys

import pytest

from sb3_tdpg.cli import main
from sb3_tdpg.common.files import kept_by_this_process

pty = pytest.importorskip("pty")

HIDE, SHOW = b"\x1b[?25l", b"\x1b[?25h"


def interrupted(arguments, marker):
    """Run Python in a terminal, and press Ctrl-C after it has printed the marker; return exit code and output."""
    pid, terminal = pty.fork()
    if pid == 0:
        # A background job of a shell ignores Ctrl-C, and its child processes inherit this setting.
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.execv(sys.executable, [sys.executable, *arguments])
    output, pressed = b"", False
    while True:
        try:
            read = os.read(terminal, 65536)
        except OSError:  # on Linux this means that the terminal has been closed
            read = b""
        if not read:
            break
        output += read
        if not pressed and re.search(marker, output):
            os.write(terminal, b"\x03")
            pressed = True
    assert pressed, output
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), output


def test_a_training_with_a_bar(tmp_path):
    code, output = interrupted(["-m", "sb3_tdpg", "demo", "--out", str(tmp_path)], rb"cost \d")
    assert code == 130, output
    assert b"Traceback" not in output
    assert HIDE in output
    assert output.rindex(SHOW) > output.rindex(HIDE)
    assert output.count(b"the same command continues from there") == 1


def test_the_imports(tmp_path):
    code, output = interrupted(["-X", "importtime", "-m", "sb3_tdpg", "demo", "--out", str(tmp_path)], rb"torch\.\w+\s")
    assert code == 130, output
    assert b"Traceback" not in output


def test_the_help_does_not_wait_for_torch():
    code = "import sys, sb3_tdpg.cli as c\ntry: c.main(['--help'])\nexcept SystemExit: sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_two_demos_do_not_share_a_folder(tmp_path, capsys):
    with kept_by_this_process(tmp_path):
        assert main(["demo", "--out", str(tmp_path)]) == 2
    assert f"another process is writing to {tmp_path}" in capsys.readouterr().err
