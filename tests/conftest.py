"""What all tests share."""

import sys
from pathlib import Path

import pytest
import torch as th

# The tests are imported one by one (--import-mode=importlib): make their helper module importable.
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Use one thread: the networks are tiny, and several tests run side by side."""
    th.set_num_threads(1)


@pytest.fixture(autouse=True)
def seeded_torch():
    """Make every test draw the same numbers, whichever ran before it."""
    th.manual_seed(0)
