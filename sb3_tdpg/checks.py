"""Check TDPG's arguments; the error messages say how to correct a bad value."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from inspect import signature
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_tdpg.advantages import BASELINES
from sb3_tdpg.auto_weight import share_of
from sb3_tdpg.envs.checks import count as check_count
from sb3_tdpg.information import get_estimator_class

ENCODER_GRADIENTS = ("score", "pathwise")
SUPPORTED_ACTION_SPACES = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
LARGEST = 1e18  # well below 1.8e19: the square of a number above that is infinite in float32
MIN_BATCH_STEPS = 32  # the information is estimated from the steps of a minibatch

# Arguments of PPO and RecurrentPPO, and their equivalents in TDPG.
OF_PPO = dict(
    n_steps="epoch_steps, which counts the steps of all environments together",
    ent_coef="the noise at the start, policy_kwargs=dict(action_log_var_init=...); there is no entropy bonus",
    vf_coef="nothing: the value network has an optimiser of its own",
    clip_range_vf="nothing: the value network is not clipped",
    use_sde="the noise of the TRVs, policy_kwargs=dict(encoder_log_var_init=...), which lasts from step to step",
    sde_sample_freq="nothing: the noise is drawn at each step",
    rollout_buffer_class="nothing: rollouts are whole episodes",
    rollout_buffer_kwargs="nothing: rollouts are whole episodes",
)


def nearest_name(name: str, names: Iterable[str]) -> str:
    """Suggest the name that was probably meant, as ``": did you mean ...?"``, or return an empty string."""
    found = get_close_matches(name, list(names), n=1)
    return f": did you mean {found[0]!r}?" if found else ""


def refuse_others(others: Mapping[str, Any], names: Iterable[str]) -> None:
    """Raise a ``TypeError`` for unknown arguments; suggest the equivalent of a PPO argument or the nearest name."""
    for name in others:
        of_ppo = next(iter(get_close_matches(name, OF_PPO, n=1, cutoff=0.85)), None)
        hint = f": use {OF_PPO[of_ppo]} (see 'Coming from PPO' in the docs)" if of_ppo else nearest_name(name, names)
        raise TypeError(f"TDPG has no argument {name!r}{hint}")


def check_arguments(settings: Mapping[str, Any]) -> None:
    """Raise a ``ValueError`` for the first bad argument of TDPG that does not depend on the environment."""
    check_beta_argument(settings["beta"], settings["cost_limit"])
    for rate in _values(schedule_of("learning_rate", settings["learning_rate"])):
        check_learning_rate(rate)
    get_estimator_class(settings["mi_estimator"])
    if settings["baseline"] not in BASELINES:
        raise ValueError(f"baseline={settings['baseline']!r} is unknown: use one of {sorted(BASELINES)}")
    n_episodes, epoch_steps = settings["n_episodes"], settings["epoch_steps"]
    check_count("n_epochs", settings["n_epochs"])
    for name in ("n_episodes", "epoch_steps", "batch_size", "bptt_steps", "n_threads"):
        if settings[name] is not None:
            check_count(name, settings[name])
    if (n_episodes is None) == (epoch_steps is None):
        raise ValueError(
            f"n_episodes={n_episodes} and epoch_steps={epoch_steps}: give one of them, the length of an epoch in "
            "episodes or in steps"
        )
    if n_episodes is not None and n_episodes < 2:
        raise ValueError(
            f"n_episodes={n_episodes} must be at least 2: the baseline and the information are estimated from a batch"
        )
    # A schedule may fall to 0, and rl-zoo3 loads models for evaluation with a schedule that is always 0.
    lowest_is_allowed = callable(settings["clip_range"])
    for clip_range in _values(settings["clip_range"]):
        if not (is_number(clip_range) and (clip_range > 0 or (clip_range == 0 and lowest_is_allowed))):
            raise ValueError(
                f"clip_range={clip_range!r} must be a positive number, or a function of the remaining progress that "
                "returns one; float('inf') turns the clipping off"
            )
    encoder_gradient = settings["encoder_gradient"]
    if encoder_gradient not in ENCODER_GRADIENTS:
        raise ValueError(f"encoder_gradient={encoder_gradient!r} is unknown: use one of {list(ENCODER_GRADIENTS)}")
    for name, is_valid, wanted in (
        ("gamma", lambda x: 0 < x <= 1, "a number in (0, 1]; the paper's problems have gamma=1"),
        ("gae_lambda", lambda x: 0 <= x <= 1, "a number in [0, 1]; 1 leaves the gradient unbiased"),
        ("max_grad_norm", lambda x: x > 0, "a positive number; float('inf') turns the clipping off"),
        ("target_kl", lambda x: x > 0, "a positive number; float('inf') sets no limit"),
    ):
        if not (is_number(settings[name]) and is_valid(settings[name])):
            raise ValueError(f"{name}={settings[name]!r} must be {wanted}")


def is_number(value: Any) -> bool:
    """Return whether a value is a Python or NumPy number."""
    return isinstance(value, (int, float, np.number))


def check_batches(settings: Mapping[str, Any], epoch_size: int, *, time_varying: bool) -> None:
    """Check ``bptt_steps`` and ``batch_size``, and that several updates on the same rollouts use clipping."""
    batch_size, n_epochs, horizon = settings["batch_size"], settings["n_epochs"], settings["horizon"]
    bptt_steps, least, why = settings["bptt_steps"], MIN_BATCH_STEPS, ""
    if time_varying:
        least, why = 2 * horizon, "each time step has weights of its own (policy_kwargs: time_varying)"
        if bptt_steps is not None and bptt_steps < horizon:
            raise ValueError(
                f"bptt_steps={bptt_steps} cuts the horizon of {horizon} steps into parts, but {why}: give "
                "policy_kwargs=dict(time_varying=False), or leave bptt_steps out"
            )
        if epoch_size < least:
            raise ValueError(
                f"epoch_steps={settings['epoch_steps']} is less than two episodes, and {why}: give n_episodes=2 or "
                "more, or more steps"
            )
        why = f"; it has two episodes at least, because {why}"
    if batch_size is not None and not min(least, epoch_size) <= batch_size <= epoch_size:
        raise ValueError(
            f"batch_size={batch_size} must be between {least} and {epoch_size}, the steps of an epoch{why}"
        )
    n_updates = n_epochs * (1 if batch_size is None else math.ceil(epoch_size / batch_size))
    if n_updates > 1 and math.isinf(_values(settings["clip_range"])[0]):
        raise ValueError(
            f"n_epochs={n_epochs} and batch_size={batch_size} make {n_updates} updates on the same rollouts, which "
            "needs clipping: give clip_range=0.2, as in PPO, or make one update"
        )


def warn_if_short(total_timesteps: int, epoch_size: int) -> None:
    """Warn if a training is shorter than one policy epoch, and say which argument to change."""
    if total_timesteps < epoch_size:
        warnings.warn(
            f"learn({total_timesteps}) makes a single update, since a policy epoch has {epoch_size} steps: give "
            f"total_timesteps={50 * epoch_size} or more, or a smaller n_episodes or epoch_steps",
            stacklevel=3,
        )


def schedule_of(name: str, value: Any) -> Schedule | Any:
    """
    Convert a string such as ``"lin_1e-3"`` (falls to 0) or ``"lin_1e-3_1e-5"`` to a schedule; keep other values.

    :param name: Name of the argument, for the error message.
    """
    if not isinstance(value, str):
        return value
    match = re.fullmatch(r"lin_([^_]+)(?:_([^_]+))?", value)
    try:
        return LinearSchedule(float(match[1]), float(match[2] or 0), 1.0)  # type: ignore[index]
    except (TypeError, ValueError) as e:
        auto = ", or 'auto'" if name == "beta" else ""
        raise ValueError(
            f"{name}={value!r} must be a number, a function, or a text such as 'lin_1e-3' (falls to 0) or "
            f"'lin_1e-3_1e-5'{auto} (in YAML write the number 1.0e-3: YAML reads 1e-3 as text)"
        ) from e


def _values(number_or_schedule: Any) -> list[Any]:
    """Return the number, or the first and last value of the schedule."""
    if callable(number_or_schedule):
        return [number_or_schedule(1.0), number_or_schedule(0.0)]
    return [number_or_schedule]


def check_beta_argument(beta: Any, cost_limit: Any) -> None:
    """Raise a ``ValueError`` unless beta is positive, a schedule of positive numbers, or "auto" with a valid limit."""
    if beta != "auto":
        for value in _values(schedule_of("beta", beta)):
            check_beta(value)
        if cost_limit is not None:
            raise ValueError(
                f"cost_limit={cost_limit} needs beta='auto', but beta={beta!r} is given: leave one of them out (to "
                "select an epoch under a cost limit, use SelectionCallback)"
            )
        return
    is_cost = is_number(cost_limit) and math.isfinite(cost_limit) and cost_limit != 0
    if not (cost_limit is None or is_cost or share_of(cost_limit) is not None):
        raise ValueError(
            f"cost_limit={cost_limit!r} must be a finite number other than 0 (the weight is adapted in fractions of "
            "it), or a share of the improvement to keep between 0 and 100 %, as text: '95%'"
        )


def check_beta(beta: float) -> float:
    """Return beta, or raise a ``ValueError`` if it is not a positive number."""
    if not (is_number(beta) and beta > 0):  # NaN compares false
        raise ValueError(
            f"beta={beta!r} must be a positive number (or a function of the remaining progress that returns one): the "
            "weight of the cost against the information. float('inf') gives plain policy gradient, 'auto' adapts the "
            "weight to cost_limit"
        )
    return float(beta)


def check_learning_rate(rate: float) -> None:
    """Raise a ``ValueError`` if the learning rate is negative or not a finite number."""
    if not (is_number(rate) and 0 <= rate < math.inf):
        raise ValueError(
            f"learning_rate={rate!r} must be a finite, non-negative number, or a function of the remaining "
            "progress that returns one (in YAML write 1.0e-3: YAML reads 1e-3 as text)"
        )


def check_action_space(space: spaces.Space) -> None:
    """
    Raise a ``ValueError`` if TDPG does not support this action space.

    The bounds of a ``Box`` must be at most 1e18 in absolute value, and a discrete space must begin with 0.
    """
    if not isinstance(space, SUPPORTED_ACTION_SPACES):
        names = ", ".join(kind.__name__ for kind in SUPPORTED_ACTION_SPACES)
        raise ValueError(f"the action space {space} is not supported: use one of {names}")
    check_start("action", space)
    if isinstance(space, spaces.Box) and not (np.abs([space.low, space.high]) <= LARGEST).all():
        raise ValueError(
            f"the action space {space} has infinite bounds, or above {LARGEST:g}: give it finite ones, for instance "
            "with gymnasium.wrappers.RescaleAction or in the environment itself; actions beyond them are clipped"
        )


def check_start(what: str, space: spaces.Space) -> None:
    """Raise a ``ValueError`` if a discrete space, or a discrete part of a ``Dict``, does not begin with 0."""
    for part in space.values() if isinstance(space, spaces.Dict) else [space]:
        if isinstance(part, (spaces.Discrete, spaces.MultiDiscrete)) and np.any(part.start != 0):
            raise ValueError(f"the {what} space {part} must begin with 0: SB3 takes and returns 0 to n - 1")


def with_keywords(name: str, kwargs: dict[str, Any], make: partial[Any]) -> Any:
    """Call ``make`` with the user's keywords, or raise a ``ValueError`` that suggests a similar keyword."""
    what = f"{name}={kwargs!r} must be a dict of keywords of {make.func.__name__}"
    if not isinstance(kwargs, dict):
        raise ValueError(what)
    try:
        return make(**kwargs)
    except TypeError as e:
        # An estimator passes keywords that it does not know on to its base class.
        known = {key for cls in make.func.__mro__[:-1] for key in signature(cls).parameters}  # type: ignore[attr-defined]
        hints = (nearest_name(key, known) for key in kwargs if key not in known)
        raise ValueError(f"{what}: {e}{next(filter(None, hints), '')}") from e


def check_single(observation: Any) -> None:
    """Raise a ``ValueError`` for the tuple that ``reset`` returns."""
    if isinstance(observation, tuple) and len(observation) == 2 and isinstance(observation[1], dict):
        raise ValueError(
            "the observation is a tuple. You are probably mixing Gym API with SB3 VecEnv API: an environment's "
            "reset() returns (obs, info), that of a VecEnv obs alone; pass obs"
        )


def check_memory(memory: np.ndarray, expected: tuple[int, ...]) -> None:
    """Raise a ``ValueError`` unless the memory given to ``predict`` has the expected shape."""
    if memory.shape != expected:
        raise ValueError(
            f"state[0] has shape {memory.shape}, expected {expected}: "
            "pass the state that the last predict() returned, for the same number of environments"
        )


def check_time(t: np.ndarray, horizon: int) -> None:
    """Raise a ``ValueError`` if an episode has more steps than the policy has weights for."""
    if (t >= horizon).any():
        raise ValueError(
            f"predict() was called for step {int(t.max()) + 1} of an episode, but the policy has weights for "
            f"{horizon} steps: pass episode_start=True at the first step of an episode (or state=None), or "
            "train a policy that goes on for any number of steps with policy_kwargs=dict(time_varying=False)"
        )


def check_action_mean(means: Sequence[float], space: spaces.Space) -> np.ndarray:
    """Return the initial mean actions as an array, ``(U,)``, or raise a ``ValueError`` if they do not fit the space."""
    array = np.asarray(means, dtype=np.float32).ravel()
    size = math.prod(space.shape) if isinstance(space, spaces.Box) else 0
    if len(array) != size or not np.isfinite(array).all():
        raise ValueError(f"policy_kwargs: action_mean_init={means!r} must be {size} numbers, one for each in {space}")
    return array


def check_net_arch(given: dict[str, Sequence[int]] | None, default: dict[str, list[int]]) -> dict[str, list[int]]:
    """Fill in missing layer sizes, or raise a ``ValueError`` for keys that the default does not have."""
    given = {} if given is None else given
    if not isinstance(given, dict) or not set(given) <= set(default):
        raise ValueError(
            f"policy_kwargs: net_arch={given!r} must be a dict with the keys {sorted(default)}, for instance {default}"
        )
    return {key: list(given.get(key, sizes)) for key, sizes in default.items()}
