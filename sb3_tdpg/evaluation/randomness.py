"""Derive all random numbers of an evaluation from one seed, and restore the generators afterwards."""

import contextlib
import copy
import random
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch as th

_DOMAIN = 0x7D96  # any constant: an evaluation with seed 0 must not replay the episodes of a training with seed 0


class EvaluationSeeds(NamedTuple):
    """The seeds that an evaluation derives from the user's seed."""

    env: int
    policy: int


def evaluation_seeds(seed: int) -> EvaluationSeeds:
    """Derive the seeds of the environments and of the policy's sampling from the user's seed."""
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed={seed!r} must be an integer of at least 0")
    env_seed, policy_seed = np.random.SeedSequence([seed, _DOMAIN]).generate_state(2)
    # SB3 adds the environment's index to its seed, and NumPy's old generator takes 32 bits.
    return EvaluationSeeds(int(env_seed >> 1), int(policy_seed >> 1))


@contextlib.contextmanager
def isolated_randomness(seed: int, model: Any) -> Iterator[None]:
    """
    Seed every generator that ``model.predict`` may sample from, and restore all of them afterwards.

    These generators are the global ones of torch, NumPy and Python, and that of the model's action space, with which
    DQN explores.
    """
    numpy_state, python_state, action_space = np.random.get_state(), random.getstate(), model.action_space  # noqa: NPY002
    device = th.device(getattr(model, "device", "cpu"))
    with th.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        try:
            th.manual_seed(seed)
            np.random.seed(seed)  # noqa: NPY002
            random.seed(seed)
            model.action_space = copy.deepcopy(action_space)
            model.action_space.seed(seed)
            yield
        finally:
            np.random.set_state(numpy_state)  # noqa: NPY002
            random.setstate(python_state)
            model.action_space = action_space
