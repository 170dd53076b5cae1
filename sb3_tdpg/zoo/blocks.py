"""Find blocks of hyperparameters, and check them before they are used."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from importlib import resources
from typing import Any

import yaml
from rl_zoo3 import ALGOS

from sb3_tdpg import hyperparams

# Keys that the zoo itself reads; all others are arguments of the algorithm.
ZOO_KEYS = (
    "callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs", "n_timesteps", "noise_std",
    "noise_type", "normalize", "vec_env_wrapper",
)  # fmt: skip


def find_file(algo: str, block: str) -> str | None:
    """Return the path of this plugin's file for an algorithm if it has that block, otherwise ``None``."""
    path = resources.files(hyperparams).joinpath(f"{algo}.yml")
    if algo == "tdpg" or (path.is_file() and block in yaml.safe_load(path.read_text(encoding="utf-8"))):
        return str(path)  # the zoo has no file for tdpg
    return None


def check_block(block: Mapping[str, Any], algo: str, where: str) -> None:
    """
    Refuse unknown keys, and numbers that YAML reads as text.

    :param block: Hyperparameters.
    :param algo: Name of the algorithm.
    :param where: Name of the block, for the message.
    :raises ValueError: naming the key, and how to correct it.
    """
    cls = ALGOS[algo]
    arguments = {name for base in cls.__mro__[:-1] for name in inspect.signature(base).parameters}
    if unknown := sorted(set(block) - set(ZOO_KEYS) - arguments):
        own = sorted(set(inspect.signature(cls).parameters) - {"env", "_init_setup_model"})
        raise ValueError(
            f"{where} has {', '.join(unknown)}, which is neither an argument of {cls.__name__} ({', '.join(own)}) nor "
            f"a key of rl-zoo3 ({', '.join(ZOO_KEYS)})"
        )
    for key, value in block.items():
        try:
            number = float(value) if isinstance(value, str) else None
        except ValueError:
            continue
        if number is not None:
            correct = yaml.safe_dump(number).split()[0]
            raise ValueError(f"{where} has {key}: {value}, which YAML reads as text, not as a number: write {correct}")
    if "n_timesteps" not in block:
        raise ValueError(f"{where} has no n_timesteps, the length of training in environment steps: add it")
