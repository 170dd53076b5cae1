"""Checks of the algorithm's arguments: each error names what was given, what was expected and how to mend it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from sb3_tdpg.policies import TRVPolicy

POLICY_NAMES = ("TRVPolicy",)
ENCODER_GRADIENTS = ("score", "pathwise")
SUPPORTED_ACTION_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


def check_arguments(
    policy: Any,
    beta: float | Schedule,
    learning_rate: float | Schedule,
    n_episodes: int,
    encoder_gradient: str,
    gamma: float,
    gae_lambda: float,
    max_grad_norm: float | None,
) -> None:
    """
    Check what can be checked without an environment.

    :raises ValueError: for the first argument of :class:`~sb3_tdpg.tdpg.TDPG` that is out of its range.
    """
    if isinstance(policy, str) and policy not in POLICY_NAMES:
        raise ValueError(f"policy={policy!r} is unknown: use one of {list(POLICY_NAMES)}")
    if not isinstance(policy, str) and not (isinstance(policy, type) and issubclass(policy, TRVPolicy)):
        raise ValueError(
            f"policy={policy!r} is neither 'TRVPolicy' nor a subclass of TRVPolicy; if it comes from a file, that was "
            "saved by another algorithm: load it with the class that saved it"
        )
    for progress in (1.0, 0.0):
        check_beta(beta(progress) if callable(beta) else beta)
        check_learning_rate(learning_rate(progress) if callable(learning_rate) else learning_rate)
    check_count("n_episodes", n_episodes)
    if n_episodes < 2:
        raise ValueError(f"n_episodes={n_episodes} must be at least 2: baseline and information are taken over a batch")
    if encoder_gradient not in ENCODER_GRADIENTS:
        raise ValueError(f"encoder_gradient={encoder_gradient!r} is unknown: use one of {list(ENCODER_GRADIENTS)}")
    if not 0.0 < gamma <= 1.0:
        raise ValueError(f"gamma={gamma} must be in (0, 1]; the paper's problems have gamma=1")
    if not 0.0 <= gae_lambda <= 1.0:
        raise ValueError(f"gae_lambda={gae_lambda} must be in [0, 1]; 1 leaves the gradient unbiased")
    if max_grad_norm is not None and not max_grad_norm > 0:
        raise ValueError(f"max_grad_norm={max_grad_norm} must be positive, or None for no clipping")


def check_count(name: str, value: Any) -> None:
    """Raise a ``ValueError`` unless the value is an integer of at least 1."""
    if not (isinstance(value, (int, np.integer)) and value >= 1):
        raise ValueError(f"{name}={value!r} must be an integer of at least 1")


def check_beta(beta: float) -> float:
    """Return beta, or raise a ``ValueError`` if it is not a positive number."""
    if not (isinstance(beta, (int, float, np.number)) and beta > 0):  # NaN compares false
        raise ValueError(
            f"beta={beta!r} must be a positive number (or a function of the remaining progress that returns one): the "
            "weight of the cost against the information. float('inf') gives plain policy gradient"
        )
    return float(beta)


def check_learning_rate(rate: float) -> None:
    """Raise a ``ValueError`` if the learning rate is negative or not a finite number."""
    if not (isinstance(rate, (int, float, np.number)) and 0 <= rate < math.inf):
        raise ValueError(
            f"learning_rate={rate!r} must be a finite number that is not negative, or a function of the remaining "
            "progress that returns one (in YAML write 1.0e-3: 1e-3 is read as text)"
        )


def check_action_space(space: spaces.Space) -> None:
    """Raise a ``ValueError`` if the policy has no distribution for this action space."""
    if not isinstance(space, SUPPORTED_ACTION_SPACES):
        names = ", ".join(kind.__name__ for kind in SUPPORTED_ACTION_SPACES)
        raise ValueError(f"the action space {space} is not supported: use one of {names}")
    if isinstance(space, spaces.Box) and not np.isfinite([space.low, space.high]).all():
        raise ValueError(
            f"the action space {space} has infinite bounds: give it finite ones, for instance with "
            "gymnasium.wrappers.RescaleAction or in the environment itself; actions beyond them are clipped"
        )


def nearest_multiples(n: int, divisor: int) -> str:
    """Say which multiples of ``divisor`` lie next to ``n``."""
    below = n // divisor * divisor
    return f"{below + divisor}" if below == 0 else f"{below} or {below + divisor}"
