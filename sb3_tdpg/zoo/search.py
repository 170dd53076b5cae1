"""Read the search space of ``tune`` from YAML, sample it with Optuna, and put the values into a block."""

import copy
import inspect
import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import yaml
from optuna.trial import BaseTrial, FixedTrial

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
        if name not in allowed:
            mend = f"nor of its policy after 'policy_kwargs.', nor {WEIGHT}"
            raise ValueError(f"{name} of {file} is no argument of TDPG, {mend}")
        try:
            sample(FixedTrial({name: entry["choices"][0] if "choices" in entry else entry["low"]}), {name: entry})
        except (LookupError, TypeError, ValueError) as e:
            needed = "must have numbers low and high (1.0e-3, not 1e-3), and may have log: true; or choices"
            raise ValueError(f"{name} of {file} {needed}. It is {entry!r} ({e})") from e
    return space


def relevant(space: Space, block: Mapping[str, Any]) -> Space:
    """Remove the weight of the information from a space unless the block's beta is a finite number or a schedule."""
    is_fixed = block.get("beta") in (None, "auto", math.inf)
    return {name: entry for name, entry in space.items() if not (name == WEIGHT and is_fixed)}


def sample(trial: BaseTrial, space: Space) -> dict[str, Any]:
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
