"""Fill the templates of the report."""

from __future__ import annotations

import re
from typing import Any


def render(template: str, **values: Any) -> str:
    """
    Fill a template of the folder ``templates/``.

    :param template: Its file name.
    :param values: The variables of the template.
    """
    from jinja2 import Environment, PackageLoader

    loader = PackageLoader("sb3_tdpg.report")
    env = Environment(loader=loader, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    env.filters.update(md=escaped, repr=repr)
    text = env.get_template(template).render(**values)
    return re.sub(r"\n{3,}", "\n\n", text).lstrip()


def escaped(name: str) -> str:
    """Escape the characters of a user's name that are Markdown syntax."""
    return re.sub(r"([\\`*\[\]<>]|(?<!\w)_|_(?!\w))", r"\\\1", name)
