"""Tuned settings in rl-zoo3's YAML format; ``tdpg.yml`` has one block for each environment and variant."""

from __future__ import annotations

from importlib import resources
from typing import Any

import yaml


def load_hyperparams(block: str, algo: str = "tdpg") -> dict[str, Any]:
    """
    Read a block of ``<algo>.yml``.

    :param block: An environment id, for some with a suffix for a variant (``Lava-v0``, ``Lava-v0-pg``, ...).
    :param algo: Name of the file.
    :return: a fresh dictionary: the caller may change it
    :raises KeyError: if there is no such block; the message lists those there are.
    """
    blocks = yaml.safe_load(resources.files(__name__).joinpath(f"{algo}.yml").read_text(encoding="utf-8"))
    if block not in blocks:
        raise KeyError(f"{algo}.yml has no block {block!r}; it has {sorted(blocks)}")
    return blocks[block]
