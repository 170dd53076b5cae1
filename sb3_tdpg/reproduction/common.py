"""What the reproductions share: small tables, how something was made, and the copy for the documentation."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd


def met(condition: bool) -> str:
    """Say whether a goal was met, so that a miss is seen."""
    return "met" if condition else "MISSED"


def markdown_table(frame: pd.DataFrame, digits: int = 3) -> str:
    """Write a frame as a Markdown table."""
    header = [f"| {' | '.join(frame.columns)} |", "|" + "---|" * len(frame.columns)]
    rows = frame.itertuples(index=False)
    cells = ([f"{x:.{digits}f}" if isinstance(x, float) else str(x) for x in row] for row in rows)
    return "\n".join([*header, *(f"| {' | '.join(row)} |" for row in cells)])


def commits_of(folders: Sequence[Path]) -> list[str]:
    """Return the commits at which the runs were made: more than one if the reproduction was resumed after a change."""
    gits = (json.loads((folder / "config.json").read_text())["provenance"]["git"] for folder in folders)
    return sorted({git["commit"][:7] for git in gits if git is not None})


def how_made(command: str, how: Mapping[str, Any], commits: Sequence[str]) -> str:
    """
    Say in a sentence how a summary was made.

    :param command: What makes it again.
    :param how: From :func:`~sb3_tdpg.evaluation.provenance`.
    :param commits: Those of the runs.
    """
    versions = ", ".join(f"{name} {version}" for name, version in how["versions"].items() if version)
    git = how["git"]
    commit = (
        "outside a checkout" if git is None else git["commit"] + (" with uncommitted changes" if git["dirty"] else "")
    )
    runs = f"runs at {', '.join(commits)}; " if commits else ""
    return f"Made by `{command}` at commit {commit}, {runs}{how['utc_time']}, {versions}. {how['platform']}."


def publish_files(out: Path, publish: Path) -> None:
    """Copy the files of a folder, but not the folders in it."""
    publish.mkdir(parents=True, exist_ok=True)
    for path in out.iterdir():
        if path.is_file():
            shutil.copy2(path, publish / path.name)
