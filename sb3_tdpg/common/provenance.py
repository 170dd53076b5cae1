"""Record how a result was made (versions, commit, machine and command), and write its files atomically."""

from __future__ import annotations

import json
import math
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime, timezone
from functools import partial
from importlib import metadata
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th

from sb3_tdpg.common.files import replaced_atomically, write_atomically

if TYPE_CHECKING:
    import pandas as pd

MAX_DIFFERENCES = 3
PACKAGES = ("stable-baselines3", "sb3-contrib", "torch", "gymnasium", "numpy", "pandas", "pybullet")


def provenance() -> dict[str, Any]:
    """
    Describe the current run in plain JSON types.

    :return: ``versions``, ``git`` (commit and whether files were changed; None outside a checkout), ``platform``,
        ``cpu_count``, ``torch_threads``, ``cuda_device`` (None without a GPU), ``utc_time``, ``command``
    """
    from sb3_tdpg import __version__

    versions = {"python": platform.python_version(), "sb3_tdpg": __version__}
    for package in PACKAGES:
        with suppress(metadata.PackageNotFoundError):
            versions[package] = metadata.version(package)
    return dict(
        versions=versions,
        git=_git(),
        platform=platform.platform(),
        cpu_count=os.cpu_count(),
        torch_threads=th.get_num_threads(),
        cuda_device=th.cuda.get_device_name() if th.cuda.is_available() else None,
        utc_time=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        command=_command(),
    )


def how_made(command: str, how: Mapping[str, Any], commits: Sequence[str] = ()) -> str:
    """Describe how a summary was made: the command to remake it, its :func:`provenance` and the commits of its runs."""
    versions = ", ".join(f"{name} {version}" for name, version in how["versions"].items() if version)
    git: Mapping[str, Any] | None = how["git"]  # None for an installed package, which the version identifies
    commit = f" at commit {git['commit']}{' with uncommitted changes' * git['dirty']}" if git else ""
    runs = f"runs at {', '.join(commits)}; " if commits else ""
    return f"Made by `{command}`{commit}, {runs}{how['utc_time']}, {versions}. {how['platform']}."


def write_run_config(path: Path, config: Mapping[str, Any]) -> None:
    """
    Write a run's configuration as JSON, atomically; a missing :func:`provenance` is added.

    :param path: The file; missing folders are created.
    :param config: Settings and seeds, which ``jsonable`` converts to JSON types.
    """
    content = jsonable({**config, "provenance": config.get("provenance") or provenance()})
    write_atomically(path, json.dumps(content, indent=2) + "\n")


def check_same_config(path: Path, config: Mapping[str, Any], what: str) -> None:
    """
    Raise a ``ValueError`` if a file of :func:`write_run_config` holds another configuration; the provenance may differ.

    A missing file is no error. A setting that is missing in the file is a difference. ``what`` names the content of the
    folder in the message.
    """
    if not path.exists():
        return
    try:
        found = json.loads(path.read_text())
        found.pop("provenance")
    except (ValueError, KeyError, AttributeError, TypeError) as e:
        raise ValueError(f"{path} is there already and is not that of a {what}: choose another folder") from e
    if changed := differences(found, jsonable(config)):
        raise ValueError(
            f"{path.parent} holds a {what} with other settings, {changed}: choose another folder or remove it"
        )


def differences(found: Any, wanted: Any) -> str:
    """
    Describe the first few differences between two JSON values in one line; return an empty string if they are equal.

    :return: for example ``settings.learning_rate: 0.001 there, 0.0005 here; settings.normalize: not there, true here``
    """
    old, new = dict(_leaves(found)), dict(_leaves(wanted))
    keys = [key for key in sorted({*old, *new}) if old.get(key) != new.get(key)]
    lines = [f"{key}: {old.get(key, 'not')} there, {new.get(key, 'not')} here" for key in keys[:MAX_DIFFERENCES]]
    if len(keys) > MAX_DIFFERENCES:
        lines.append(f"and {len(keys) - MAX_DIFFERENCES} more")
    return "; ".join(lines)


def _leaves(value: Any, where: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and the JSON text of all values, and of empty dicts, in nested dicts and lists of dicts."""
    if isinstance(value, list) and any(isinstance(row, dict) for row in value):
        value = dict(enumerate(value))
    if not (isinstance(value, dict) and value):
        yield where, json.dumps(value)
        return
    for key, item in value.items():
        yield from _leaves(item, f"{where}.{key}" if where else str(key))


def write_frame_atomically(frame: pd.DataFrame, path: Path) -> None:
    """
    Write a ``DataFrame`` as CSV without its index, atomically; the same data give the same bytes.

    The path ends in ``.csv``, or for a compressed file in ``.csv.gz`` or ``.csv.xz`` (which is smaller). Missing
    folders are created.
    """
    if not path.name.endswith((".csv", ".csv.gz", ".csv.xz")):
        raise ValueError(f"path={str(path)!r} must end in .csv, .csv.gz or .csv.xz")
    # Without a fixed mtime the compressed file would differ from one second to the next.
    compression: Any = dict(method="gzip", mtime=0) if path.suffix == ".gz" else "infer"
    with replaced_atomically(path) as unfinished:
        frame.to_csv(unfinished, index=False, compression=compression)


def _command() -> str:
    """Return the command line; paths inside the working directory are relative to that directory."""
    here = Path.cwd()
    program, *arguments = as_typed(sys.orig_argv)
    relative = [str(Path(a).relative_to(here)) if Path(a).is_relative_to(here) else a for a in arguments]
    return shlex.join([program, *relative])


def as_typed(command: Sequence[str]) -> list[str]:
    """Return a command as the user typed it: without the program's folder and an installed program's interpreter."""
    interpreter, arguments = Path(command[0]), list(command[1:])
    if arguments and interpreter.is_absolute() and Path(arguments[0]).parent == interpreter.parent:
        return [Path(arguments[0]).name, *arguments[1:]]
    return [interpreter.name, *arguments]


def _git() -> dict[str, Any] | None:
    """Return the commit of the checkout that contains this package, and whether tracked files were changed since."""
    package = Path(__file__).resolve().parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(package), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    try:
        # An installed package may lie in the checkout of another project (in a virtual environment there).
        git("ls-files", "--error-unmatch", str(package / "__init__.py"))
        return dict(commit=git("rev-parse", "HEAD"), dirty=bool(git("status", "--porcelain", "--untracked-files=no")))
    except (OSError, subprocess.SubprocessError):
        return None


def jsonable(value: Any) -> Any:
    """
    Convert a value to JSON types; NaN, infinite numbers and unknown types become strings, such as ``"inf"``.

    A function gives the same string in every process, except for a lambda or a function that is defined inside another,
    whose names do not identify them.
    """
    if isinstance(value, partial):
        return jsonable(dict(function=value.func, arguments=value.args, **value.keywords))
    if isinstance(value, FunctionType) and "<" not in value.__qualname__:
        return f"{value.__module__}.{value.__qualname__}"
    if isinstance(value, Mapping):
        return {str(key): jsonable(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return jsonable(value.tolist())
    if isinstance(value, (list, tuple, set, frozenset)):
        return [jsonable(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value if value is None or isinstance(value, (bool, int, float, str)) else str(value)


def with_numbers(value: Any) -> Any:
    """Replace the strings ``"inf"``, ``"-inf"`` and ``"nan"`` by numbers, which JSON cannot represent."""
    if isinstance(value, dict):
        return {key: with_numbers(item) for key, item in value.items()}
    if isinstance(value, list):
        return [with_numbers(item) for item in value]
    return float(value) if value in ("inf", "-inf", "nan") else value
