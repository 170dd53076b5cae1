"""
Read files that other people wrote: as plain data if possible, or with a warning if only pickle can read them.

docs/guide/trust.md says which command trusts which file.
"""

import ast
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import yaml

# Plain data are numbers with arithmetic as in 1/75, strings, lists, dict(...), float("inf"), and the layers of torch.nn
# by name.
_PLAIN_NODES = (
    ast.Expression, ast.Constant, ast.Tuple, ast.List, ast.Dict, ast.UnaryOp, ast.USub, ast.BinOp, ast.Add, ast.Sub,
    ast.Mult, ast.Div, ast.Load, ast.keyword,
)  # fmt: skip


def say_what_is_trusted(*paths: str | os.PathLike[str]) -> None:
    """Warn that loading the models in these files or folders can run code; call this function before loading them."""
    if not paths:
        return
    names = ", ".join(os.fspath(path) for path in paths[:3]) + f" and {len(paths) - 3} more" * (len(paths) > 3)
    print(f"trusting whoever wrote {names}: loading a model unpickles it, which can run any code", flush=True)


class PlainLoader(yaml.SafeLoader):
    """A loader for plain YAML and the two Python types that rl-zoo3 writes; it runs no code."""

    def get_single_data(self) -> Any:
        """Return the only document, which must be a mapping."""
        try:
            data = super().get_single_data()
            if not isinstance(data, dict):
                raise TypeError(f"expected a mapping, found {type(data).__name__}")
        except (yaml.YAMLError, LookupError, TypeError, ValueError) as e:
            reason = " ".join(str(e).split())
            raise ValueError(f"{self.name} is not plain data that rl-zoo3 wrote, and is not read: {reason}") from e
        if isinstance(normalize := data.get("normalize"), str):
            check_plain(normalize, f"{self.name} has normalize:")  # rl-zoo3 evaluates it
        return data


for _tag, _construct in (
    ("object/apply:collections.OrderedDict", lambda loader, node: dict(loader.construct_sequence(node, deep=True)[0])),
    ("tuple", lambda loader, node: tuple(loader.construct_sequence(node, deep=True))),
):
    PlainLoader.add_constructor(f"tag:yaml.org,2002:python/{_tag}", _construct)


def check_plain(text: str, where: str) -> None:
    """
    Raise a ``ValueError`` unless a string of Python code is plain data; call this function before evaluating it.

    :param where: Beginning of the error message, such as ``"run.json has -params"``.
    :raises ValueError: if the string is not plain data.
    """
    try:
        nodes: Iterable[ast.AST] = ast.walk(ast.parse(text.strip(), mode="eval"))
        is_plain = all(map(_is_plain, nodes))
    except (SyntaxError, ValueError, RecursionError):
        is_plain = False
    if not is_plain:
        raise ValueError(f"{where} {text}, which is not plain data and is not evaluated: write numbers, text or lists")


def _is_plain(node: ast.AST) -> bool:
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Name)
    if isinstance(node, ast.Attribute):
        return isinstance(node.value, ast.Name) and node.value.id == "nn" and node.attr[0] != "_"
    return isinstance(node, _PLAIN_NODES) or (isinstance(node, ast.Name) and node.id in ("dict", "float", "nn"))


def plain_name(name: Any, where: str) -> str:
    """Return the name of a file or a folder; raise a ``ValueError`` for a path, which could point to another folder."""
    if not isinstance(name, str) or name in ("", ".", "..") or {"/", "\\", ":", "\0"} & set(name):
        raise ValueError(f"{where} is {name!r}, which must be the name of a folder, without a path")
    return name


def refuse_links(folder: Path) -> None:
    """Raise a ``ValueError`` if a folder contains a symbolic link, through which any file could be published."""
    if link := next((path for path in sorted(folder.rglob("*")) if path.is_symlink()), None):
        raise ValueError(f"{link} is a symbolic link, which is not followed: put a copy of the file there")
