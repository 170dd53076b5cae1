"""Read the models of a report: group the arguments into methods, and load the files."""

import glob
import hashlib
import json
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_tdpg.evaluation.loading import load_model

# File names that do not identify a model. A model with such a name gets the name of its folder.
PLAIN_NAMES = re.compile(r"model|best_model|final_model|selected|last|rl_model_\d+_steps")
SEED = re.compile(r"[-_. ]*(seed[-_. ]?\d+|_\d+)$", re.IGNORECASE)

Source = Path | Any
"""A model's file, or the model itself."""


def parse_models(arguments: Sequence[str], env_id: str = "") -> dict[str, list[Path]]:
    """
    Read models from the command line, and group them into methods.

    An argument is a file, a folder with a ``model.zip``, or a pattern such as ``runs/pg-seed*/model.zip``, with an
    optional ``LABEL=`` in front. Without a label, the method's name is the file's name without the seed. If the file's
    name does not identify a model (``model.zip``, ``best_model.zip``, the environment's id), the method's name is
    the folder's name without the seed. For example, ``runs/pg-seed3/model.zip`` is a model of ``pg``, and
    ``logs/ppo/Lava-v0_1/Lava-v0.zip`` is a model of ``ppo Lava-v0``.

    :return: The files of each method, in the order of the arguments.
    :raises ValueError: if a file does not exist or is given twice, or if two files would get the name of one folder.
    """
    methods: dict[str, list[Path]] = {}
    seen: dict[Path, str] = {}
    for argument in arguments:
        label, pattern = _split(argument)
        for path in _files(pattern, argument):
            name = label or label_of(path, env_id)
            if (before := seen.setdefault(path.resolve(), name)) != name or path in methods.get(name, ()):
                raise ValueError(f"{path} is given twice, for {before!r} and for {name!r}: a model counts once")
            beside = [each for each in methods.get(name, ()) if each.parent.resolve() == path.parent.resolve()]
            if beside and not label and _is_named_after_folder(path, env_id):
                raise ValueError(
                    f"{path} and {beside[0]} are named after one folder, and would count as two trainings of {name!r}: "
                    f"give each a label, such as A={path}"
                )
            methods.setdefault(name, []).append(path)
    if not methods:
        raise ValueError("give at least one model: runs/pg-seed0/model.zip, or PG=runs/pg-seed*/model.zip")
    return methods


def label_of(path: Path, env_id: str = "") -> str:
    """Return the name of the method to which a model file belongs; see :func:`parse_models`."""
    name = path.absolute().parent.name if _is_named_after_folder(path, env_id) else path.name.removesuffix(".zip")
    name = SEED.sub("", name) or name
    if name != env_id.rpartition(":")[2]:
        return name
    # `train` saves every model as logs/<algo>/<env>_<n>/<env>.zip.
    record = path.parent / "run.json"
    block = json.loads(record.read_text()).get("block") if record.exists() else None
    return f"{path.absolute().parent.parent.name} {block or name}"


def _is_named_after_folder(path: Path, env_id: str) -> bool:
    stem = path.name.removesuffix(".zip")
    is_plain = PLAIN_NAMES.fullmatch(stem) is not None or stem == env_id.rpartition(":")[2]
    return is_plain and path.absolute().parent.name != ""


def _split(argument: str) -> tuple[str, str]:
    """Split ``LABEL=PATTERN``; an argument with a path separator before the ``=`` is a path."""
    label, equals, pattern = argument.partition("=")
    if not equals or os.sep in label or Path(argument).exists():
        return "", argument
    if not label.strip() or not pattern:
        raise ValueError(f"{argument!r}: write LABEL=FILE, for instance PG=runs/pg-seed0/model.zip")
    return label.strip(), pattern


def _files(pattern: str, argument: str) -> list[Path]:
    pattern = os.path.expanduser(pattern)
    found = [Path(pattern)] if Path(pattern).exists() else [Path(name) for name in sorted(glob.glob(pattern))]
    files = [path / "model.zip" if path.is_dir() else path for path in found]
    if missing := [path for path in files if not path.is_file()]:
        raise ValueError(f"{missing[0].parent} holds no model.zip: give the .zip file itself")
    if not files:
        raise ValueError(f"{argument}: there is no such file; give the .zip file that model.save() wrote")
    return files


def load_all(
    sources: Mapping[str, Sequence[Source]], env_id: str, env_kwargs: Mapping[str, Any]
) -> dict[str, list[Any]]:
    """Load the models that are files; return all models."""
    return {
        label: [load_model(s, env_id, env_kwargs) if isinstance(s, Path) else s for s in of_method]
        for label, of_method in sources.items()
    }


def fingerprint(model: Any) -> str:
    """Return a hash of a model's weights."""
    digest = hashlib.sha256(type(model).__name__.encode())
    for name, values in sorted(model.policy.state_dict().items()):
        digest.update(name.encode())
        digest.update(values.detach().cpu().numpy().tobytes())
    return digest.hexdigest()[:12]
