"""Checks of the algorithm's arguments: each error names what was given, what was expected and how to mend it."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.type_aliases import Schedule

from sb3_tdpg.policies import TRVPolicy

POLICY_NAMES = ("TRVPolicy",)
ENCODER_GRADIENTS = ("score", "pathwise")


def check_arguments(
    policy: str | type[TRVPolicy],
    beta: float | Schedule,
    n_episodes: int,
    n_envs: int | None,
    encoder_gradient: str,
    gamma: float,
    max_grad_norm: float | None,
) -> None:
    """
    Check what can be checked without an environment.

    :raises ValueError: for the first argument of :class:`~sb3_tdpg.tdpg.TDPG` that is out of its range.
    """
    if isinstance(policy, str) and policy not in POLICY_NAMES:
        raise ValueError(f"policy={policy!r} is unknown: use one of {list(POLICY_NAMES)}")
    if not isinstance(policy, str) and not issubclass(policy, TRVPolicy):
        raise ValueError(
            f"the policy {policy.__name__} is no TRVPolicy; if it comes from a file, that was saved by another "
            "algorithm: "
            "load it with the class that saved it"
        )
    for progress in (1.0, 0.0):
        check_beta(beta(progress) if callable(beta) else beta)
    for name, value in (("n_episodes", n_episodes), ("n_envs", n_envs)):
        if value is not None and not (isinstance(value, (int, np.integer)) and value >= 1):
            raise ValueError(f"{name}={value!r} must be an integer of at least 1")
    if n_episodes < 2:
        raise ValueError(f"n_episodes={n_episodes} must be at least 2: baseline and information are taken over a batch")
    if encoder_gradient not in ENCODER_GRADIENTS:
        raise ValueError(f"encoder_gradient={encoder_gradient!r} is unknown: use one of {list(ENCODER_GRADIENTS)}")
    if not 0.0 < gamma <= 1.0:
        raise ValueError(f"gamma={gamma} must be in (0, 1]; the paper's problems have gamma=1")
    if max_grad_norm is not None and not max_grad_norm > 0:
        raise ValueError(f"max_grad_norm={max_grad_norm} must be positive, or None for no clipping")


def check_beta(beta: float) -> float:
    """Return beta, or raise a ``ValueError`` if it is not a positive number."""
    if not (isinstance(beta, (int, float, np.number)) and beta > 0):  # NaN compares false
        raise ValueError(
            f"beta={beta!r} must be a positive number (or a function of the remaining progress that returns one): "
            "the weight "
            "of the cost against the information. float('inf') gives plain policy gradient"
        )
    return float(beta)


def nearest_multiples(n: int, divisor: int) -> str:
    """Say which multiples of ``divisor`` lie next to ``n``."""
    below = n // divisor * divisor
    return f"{below + divisor}" if below == 0 else f"{below} or {below + divisor}"
