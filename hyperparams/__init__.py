"""Read tuned settings in rl-zoo3's YAML format; ``tdpg.yml`` has a block for each environment and variant."""

from importlib import resources
from typing import Any

import yaml


def load_hyperparams(block: str, algo: str = "tdpg") -> dict[str, Any]:
    """
    Read a block of ``<algo>.yml``.

    :param block: An environment id, which has a suffix for some variants (``Lava-v0``, ``Lava-v0-pg``, ...).
    :param algo: Name of the file without ``.yml``.
    :return: a new dictionary, which the caller may change
    :raises KeyError: if the file has no such block; the message lists the existing blocks.
    """
    blocks = yaml.safe_load(resources.files(__name__).joinpath(f"{algo}.yml").read_text(encoding="utf-8"))
    if block not in blocks:
        raise KeyError(f"{algo}.yml has no block {block!r}; it has {sorted(blocks)}")
    return blocks[block]
