"""The search space of ``tune``: read from YAML, sampled by Optuna, put into a block."""

from __future__ import annotations

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

WEIGHT = "mi_coef"  # stands for beta, see tdpg-search.yml


def read_space(path: Path | None = None) -> Space:
    """
    Read and check a search space.

    :param path: A file; default: ``hyperparams/tdpg-search.yml``.
    :raises ValueError: if the space is malformed.
    """
    file = resources.files(hyperparams).joinpath("tdpg-search.yml") if path is None else path
    try:
        space = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as e:
        raise ValueError(f"the search space {file} cannot be read: {' '.join(str(e).split())}") from e
    if not isinstance(space, dict) or not space:
        raise ValueError(f"the search space {file} must map names of arguments to ranges")
    for name, entry in space.items():
        _check_entry(f"{name} of {file}", name, entry)
    return space


def _check_entry(where: str, name: str, entry: Any) -> None:
    prefix, _, argument = name.rpartition(".")
    owners: dict[str, Any] = {"": TDPG, "policy_kwargs": TRVPolicy}
    if prefix not in owners or (name != WEIGHT and argument not in inspect.signature(owners[prefix]).parameters):
        raise ValueError(f"{where} is no argument of TDPG, nor of its policy after 'policy_kwargs.', nor {WEIGHT}")
    keys = set(entry) if isinstance(entry, dict) else set()
    if keys != {"choices"} and not {"low", "high"} <= keys <= {"low", "high", "log"}:
        raise ValueError(f"{where} must have low and high, and may have log: true; or choices. It is {entry!r}")
    if "choices" in entry:
        if not isinstance(entry["choices"], list) or not entry["choices"]:
            raise ValueError(f"{where} must have a list of choices, not {entry['choices']!r}")
        return
    low, high = entry["low"], entry["high"]
    if not all(isinstance(x, (int, float)) and math.isfinite(x) for x in (low, high)) or low >= high:
        raise ValueError(f"{where} must have finite numbers low < high (write 1.0e-3, not 1e-3), not {low!r}, {high!r}")
    if entry.get("log", False) and low <= 0:
        raise ValueError(f"{where} has log: true, for which low={low} must be positive")


def relevant(space: Space, block: Mapping[str, Any]) -> Space:
    """Remove the weight of the information from a space if the block's beta leaves no choice of it."""
    is_fixed = block.get("beta") in (None, "auto", math.inf)
    return {name: entry for name, entry in space.items() if not (name == WEIGHT and is_fixed)}


def sample(trial: optuna.Trial, space: Space) -> dict[str, Any]:
    """Sample a value for each name."""
    values: dict[str, Any] = {}
    for name, entry in space.items():
        if "choices" in entry:
            values[name] = trial.suggest_categorical(name, entry["choices"])
        else:
            is_integer = isinstance(entry["low"], int) and isinstance(entry["high"], int)
            suggest: Any = trial.suggest_int if is_integer else trial.suggest_float
            values[name] = suggest(name, **entry)
    return values


def put_in(block: Mapping[str, Any], values: Mapping[str, Any], cost_scale: float) -> dict[str, Any]:
    """
    Return a block with sampled values in it; the other ``policy_kwargs`` of the block stay.

    :param block: Hyperparameters, as in the YAML files.
    :param values: From :func:`sample`, or the ``params`` of a trial.
    :param cost_scale: Unit of :data:`WEIGHT`: the absolute value of the cost limit.
    """
    block = {**block, "policy_kwargs": copy.deepcopy(dict(block.get("policy_kwargs") or {}))}
    for name, value in values.items():
        prefix, _, argument = name.rpartition(".")
        if prefix:
            block[prefix][argument] = value
        elif name == WEIGHT:
            block["beta"] = 1.0 / (value * cost_scale)
        elif name == "learning_rate":
            block[name] = f"lin_{value!r}"
        else:
            block[name] = value
    return block
