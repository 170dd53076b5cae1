"""Blocks of hyperparameters: where this plugin keeps them, and what is wrong with one before it is used."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from importlib import resources
from typing import Any

import yaml
from rl_zoo3 import ALGOS

from sb3_tdpg import hyperparams

# Keys that the zoo itself reads; all others are arguments of the algorithm.
ZOO_KEYS = frozenset(
    {
        "callback",
        "env_kwargs",
        "env_wrapper",
        "frame_stack",
        "monitor_kwargs",
        "n_envs",
        "n_timesteps",
        "noise_std",
        "noise_type",
        "normalize",
        "vec_env_wrapper",
    }
)


def find_file(algo: str, block: str) -> str | None:
    """
    Return the path of this plugin's file for an algorithm if it has that block.

    :param algo: Name of the algorithm. For ``tdpg`` there is no other file.
    :param block: An environment id, or a variant of one.
    :return: ``None``: the zoo has to look into its own file
    """
    path = resources.files(hyperparams).joinpath(f"{algo}.yml")
    if algo != "tdpg" and not (path.is_file() and block in yaml.safe_load(path.read_text(encoding="utf-8"))):
        return None
    return str(path)


def check_block(block: Mapping[str, Any], algo: str, where: str) -> None:
    """
    Refuse what would end in a traceback, or would be read otherwise than it is meant.

    :param block: Hyperparameters.
    :param algo: Name of the algorithm.
    :param where: What to call the block.
    :raises ValueError: naming the key, and the mend.
    """
    cls = ALGOS[algo]
    arguments = {name for base in cls.__mro__ for name in inspect.signature(base).parameters if base is not object}
    if unknown := sorted(set(block) - ZOO_KEYS - arguments):
        own = sorted(set(inspect.signature(cls).parameters) - {"env", "_init_setup_model"})
        raise ValueError(
            f"{where} has {', '.join(unknown)}, which is neither an argument of {cls.__name__} ({', '.join(own)}) nor "
            f"a key of rl-zoo3 ({', '.join(sorted(ZOO_KEYS))})"
        )
    for key, value in block.items():
        if isinstance(value, str) and _is_number(value):
            raise ValueError(
                f"{where} has {key}: {value}, which YAML takes for text, not for a number: write {_with_point(value)}"
            )
    if "n_timesteps" not in block:
        raise ValueError(f"{where} has no n_timesteps, the length of training in environment steps: add it")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _with_point(text: str) -> str:
    """Write 1e-3 as 1.0e-3, and 1e5 as 1.0e+5, which YAML 1.1 reads as numbers."""
    mantissa, _, exponent = text.lower().partition("e")
    if not exponent:
        return repr(float(text))
    point = "" if "." in mantissa else ".0"
    sign = "" if exponent[0] in "+-" else "+"
    return f"{mantissa}{point}e{sign}{exponent}"
