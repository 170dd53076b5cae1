"""The last sentence of a summary: how it was made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any


def how_made(command: str, how: Mapping[str, Any], commits: Sequence[str] = ()) -> str:
    """
    Say in a sentence how a summary was made.

    :param command: The command that makes it again.
    :param how: The result of :func:`~sb3_tdpg.common.provenance.provenance`.
    :param commits: The commits at which the runs were made, if they are known.
    """
    versions = ", ".join(f"{name} {version}" for name, version in how["versions"].items() if version)
    git: Mapping[str, Any] = how["git"] or dict(commit="outside a checkout", dirty=False)
    commit = git["commit"] + " with uncommitted changes" * git["dirty"]
    runs = f"runs at {', '.join(commits)}; " if commits else ""
    return f"Made by `{command}` at commit {commit}, {runs}{how['utc_time']}, {versions}. {how['platform']}."
