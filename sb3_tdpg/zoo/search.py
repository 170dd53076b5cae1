"""Read the search space of ``tune`` from YAML, sample it with Optuna, and put the values into a block."""

import copy
import inspect
import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import optuna
import yaml

from sb3_tdpg import hyperparams
from sb3_tdpg.policies import TRVPolicy
from sb3_tdpg.tdpg import TDPG

Space = Mapping[str, Mapping[str, Any]]

WEIGHT = "mi_coef"  # this name of the space sets beta, see tdpg-search.yml


def read_space(path: Path | None = None) -> Space:
    """
    Read and check a search space.

    :param path: The file; default: ``hyperparams/tdpg-search.yml``.
    :raises ValueError: if the space is malformed.
    """
    file = resources.files(hyperparams).joinpath("tdpg-search.yml") if path is None else path
    try:
        space = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as e:
        raise ValueError(f"the search space {file} cannot be read: {' '.join(str(e).split())}") from e
    if not isinstance(space, dict) or not space:
        raise ValueError(f"the search space {file} must map names of arguments to ranges")
    policy = {f"policy_kwargs.{argument}" for argument in inspect.signature(TRVPolicy).parameters}
    allowed = {WEIGHT, *inspect.signature(TDPG).parameters, *policy}
    for name, entry in space.items():
        where = f"{name} of {file}"
        if name not in allowed:
            raise ValueError(f"{where} is no argument of TDPG, nor of its policy after 'policy_kwargs.', nor {WEIGHT}")
        _check_range(where, entry)
    return space


def _check_range(where: str, entry: Any) -> None:
    keys = set(entry) if isinstance(entry, dict) else set()
    if keys != {"choices"} and not {"low", "high"} <= keys <= {"low", "high", "log"}:
        raise ValueError(f"{where} must have low and high, and may have log: true; or choices. It is {entry!r}")
    choices, low, high = entry.get("choices", [0]), entry.get("low", 1), entry.get("high", 2)
    if not isinstance(choices, list) or not choices:
        raise ValueError(f"{where} must have a list of choices, not {choices!r}")
    if not all(isinstance(x, (int, float)) and math.isfinite(x) for x in (low, high)) or low >= high:
        raise ValueError(f"{where} must have finite numbers low < high (write 1.0e-3, not 1e-3), not {low!r}, {high!r}")
    if not isinstance(entry.get("log", False), bool):
        raise ValueError(f"{where} has log: {entry['log']!r}, which must be true or false")
    if entry.get("log", False) and low <= 0:
        raise ValueError(f"{where} has log: true, for which low={low} must be positive")


def relevant(space: Space, block: Mapping[str, Any]) -> Space:
    """Remove the weight of the information from a space if the block's beta determines this weight."""
    is_fixed = block.get("beta") in (None, "auto", math.inf)
    return {name: entry for name, entry in space.items() if not (name == WEIGHT and is_fixed)}


def sample(trial: optuna.Trial, space: Space) -> dict[str, Any]:
    """Sample a value for each name in the space."""

    def suggest(name: str, entry: Mapping[str, Any]) -> Any:
        if "choices" in entry:
            return trial.suggest_categorical(name, **entry)
        is_integer = isinstance(entry["low"], int) and isinstance(entry["high"], int)
        return (trial.suggest_int if is_integer else trial.suggest_float)(name, **entry)

    return {name: suggest(name, entry) for name, entry in space.items()}


def put_in(block: Mapping[str, Any], values: Mapping[str, Any], cost_scale: float) -> dict[str, Any]:
    """
    Return a copy of a block with the values of :func:`sample`; its other ``policy_kwargs`` do not change.

    :param cost_scale: The unit of :data:`WEIGHT`, which is the absolute value of the cost limit.
    """
    block = {**block, "policy_kwargs": copy.deepcopy(dict(block.get("policy_kwargs") or {}))}
    for name, value in values.items():
        prefix, _, argument = name.rpartition(".")
        if name == WEIGHT:
            block["beta"] = 1.0 / (value * cost_scale)
        else:
            (block[prefix] if prefix else block)[argument] = (
                f"lin_{value!r}" if name == "learning_rate" and not isinstance(value, str) else value
            )
    return block
