"""Settings and fixtures for all tests."""

import random
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th

# The tests are imported one by one (--import-mode=importlib), so this makes their helper modules importable.
sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """Use one thread, because the networks are tiny and several tests run in parallel."""
    th.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def log_folder(tmp_path_factory):
    """Redirect the folders that SB3 creates for trainings without a logger to a folder of pytest."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SB3_LOGDIR", str(tmp_path_factory.mktemp("sb3")))
        yield


@pytest.fixture
def registry(monkeypatch):
    """Remove the environments that a test registers."""
    monkeypatch.setattr(gym.envs.registration, "registry", dict(gym.registry))
    monkeypatch.setattr(gym, "registry", gym.envs.registration.registry)


@pytest.fixture(autouse=True)
def seeded(monkeypatch):
    """Seed all random generators, also those created without a seed: a test must not depend on earlier tests."""
    th.manual_seed(0)
    np.random.seed(0)  # noqa: NPY002 - some libraries use this generator
    monkeypatch.setattr("numpy.random.bit_generator.randbits", random.Random(0).getrandbits)
