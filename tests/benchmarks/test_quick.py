"""The benchmarks of the speed run: ``make bench`` with small sizes."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_every_benchmark_runs_with_small_sizes(tmp_path):
    program = Path(__file__).with_name("run.py")
    done = subprocess.run([sys.executable, program, "--quick", "--out", tmp_path / "bench.md"], text=True)
    assert done.returncode == 0
    assert "TDPG against a loop over samples" in (tmp_path / "bench.md").read_text()
