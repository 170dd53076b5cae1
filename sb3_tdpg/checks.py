"""Checks of the algorithm's arguments: each error names what was given, what was expected and how to mend it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_tdpg.advantages import get_baseline
from sb3_tdpg.information import get_estimator_class
from sb3_tdpg.policies import TRVPolicy

POLICY_NAMES = ("TRVPolicy",)
ENCODER_GRADIENTS = ("score", "pathwise")
SUPPORTED_ACTION_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)


def check_arguments(settings: Mapping[str, Any]) -> None:
    """
    Check what can be checked without an environment.

    :param settings: Arguments of :class:`~sb3_tdpg.tdpg.TDPG` by their names; others are left alone.
    :raises ValueError: for the first that is out of its range.
    """
    check_policy(settings["policy"])
    check_beta_argument(settings["beta"], settings["cost_limit"])
    for rate in _values(settings["learning_rate"]):
        check_learning_rate(rate)
    get_estimator_class(settings["mi_estimator"])
    get_baseline(settings["baseline"])
    n_episodes, batch_size = settings["n_episodes"], settings["batch_size"]
    for name in ("n_episodes", "n_epochs"):
        check_count(name, settings[name])
    for name in ("batch_size", "bptt_steps", "n_threads"):
        if settings[name] is not None:
            check_count(name, settings[name])
    if n_episodes < 2:
        raise ValueError(f"n_episodes={n_episodes} must be at least 2: baseline and information are taken over a batch")
    if batch_size is not None and not 2 <= batch_size <= n_episodes:
        raise ValueError(
            f"batch_size={batch_size} must be between 2 and n_episodes={n_episodes}: it is a number of episodes, since "
            "the memory of an episode cannot be cut"
        )
    for clip_range in _values(settings["clip_range"]):
        # A schedule may fall to 0, and a policy that is only to be watched is loaded with one that is 0 by rl-zoo3.
        lowest_is_allowed = callable(settings["clip_range"])
        is_number = isinstance(clip_range, (int, float, np.number))
        if not (is_number and (clip_range > 0 or (clip_range == 0 and lowest_is_allowed))):
            raise ValueError(
                f"clip_range={clip_range!r} must be a positive number, or a function of the remaining progress that "
                "returns one; float('inf') turns the clipping off"
            )
    n_updates = settings["n_epochs"] * (1 if batch_size is None else math.ceil(n_episodes / batch_size))
    if n_updates > 1 and not callable(settings["clip_range"]) and math.isinf(settings["clip_range"]):
        raise ValueError(
            f"n_epochs={settings['n_epochs']} and batch_size={batch_size} make {n_updates} updates with the same "
            "rollouts, which need a limit to how far the policy may go: give clip_range=0.2, as PPO has, or make one"
        )
    encoder_gradient = settings["encoder_gradient"]
    if encoder_gradient not in ENCODER_GRADIENTS:
        raise ValueError(f"encoder_gradient={encoder_gradient!r} is unknown: use one of {list(ENCODER_GRADIENTS)}")
    if not 0.0 < settings["gamma"] <= 1.0:
        raise ValueError(f"gamma={settings['gamma']} must be in (0, 1]; the paper's problems have gamma=1")
    if not 0.0 <= settings["gae_lambda"] <= 1.0:
        raise ValueError(f"gae_lambda={settings['gae_lambda']} must be in [0, 1]; 1 leaves the gradient unbiased")
    if not settings["max_grad_norm"] > 0:
        raise ValueError(f"max_grad_norm={settings['max_grad_norm']} must be positive, or None for no clipping")


def _values(number_or_schedule: Any) -> list[Any]:
    """Return a number, or what a schedule gives at the beginning and at the end."""
    if callable(number_or_schedule):
        return [number_or_schedule(1.0), number_or_schedule(0.0)]
    return [number_or_schedule]


def check_policy(policy: Any) -> None:
    """Raise a ``ValueError`` unless the policy is TDPG's."""
    if isinstance(policy, str) and policy not in POLICY_NAMES:
        raise ValueError(f"policy={policy!r} is unknown: use one of {list(POLICY_NAMES)}")
    if not isinstance(policy, str) and not (isinstance(policy, type) and issubclass(policy, TRVPolicy)):
        raise ValueError(
            f"policy={policy!r} is neither 'TRVPolicy' nor a subclass of TRVPolicy; if it comes from a file, that was "
            "saved by another algorithm: load it with the class that saved it"
        )


def check_beta_argument(beta: Any, cost_limit: Any) -> None:
    """Raise a ``ValueError`` unless beta is a positive number, a schedule of such, or "auto" with a fitting limit."""
    if beta != "auto":
        for value in _values(beta):
            check_beta(value)
        if cost_limit is not None:
            raise ValueError(
                f"cost_limit={cost_limit} is for beta='auto', which finds the weight that keeps it, but beta={beta!r} "
                "is given: leave one of them out (to select an epoch under a limit, use SelectionCallback)"
            )
        return
    if cost_limit is not None and not (
        isinstance(cost_limit, (int, float, np.number)) and math.isfinite(cost_limit) and cost_limit != 0
    ):
        raise ValueError(
            f"cost_limit={cost_limit!r} must be a finite number other than 0 (the weight moves in its parts)"
        )


def check_count(name: str, value: Any) -> None:
    """Raise a ``ValueError`` unless the value is an integer of at least 1."""
    if not (isinstance(value, (int, np.integer)) and value >= 1):
        raise ValueError(f"{name}={value!r} must be an integer of at least 1")


def check_beta(beta: float) -> float:
    """Return beta, or raise a ``ValueError`` if it is not a positive number."""
    if not (isinstance(beta, (int, float, np.number)) and beta > 0):  # NaN compares false
        raise ValueError(
            f"beta={beta!r} must be a positive number (or a function of the remaining progress that returns one): the "
            "weight of the cost against the information. float('inf') gives plain policy gradient, 'auto' the weight "
            "at which the expected cost is cost_limit"
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
