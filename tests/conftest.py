"""What all tests share."""

import random
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th

# The tests are imported one by one (--import-mode=importlib): make their helper module importable.
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Use one thread: the networks are tiny, and several tests run side by side."""
    th.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def log_folder(tmp_path_factory):
    """Keep the folder that SB3 makes for every training without a log of its own out of the temporary folder."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_LOGDIR", str(tmp_path_factory.mktemp("sb3")))
        yield


@pytest.fixture
def registry(monkeypatch):
    """Forget the environments that a test registers."""
    monkeypatch.setattr(gym.envs.registration, "registry", dict(gym.registry))
    monkeypatch.setattr(gym, "registry", gym.envs.registration.registry)


@pytest.fixture(autouse=True)
def seeded(monkeypatch):
    """Make every test draw the same numbers, whichever ran before it; also those of generators without a seed."""
    th.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002 - the generator of libraries that use it
    monkeypatch.setattr("numpy.random.bit_generator.randbits", random.Random(0).getrandbits)
