"""Fill the templates of the report, and turn its Markdown into one HTML file."""

import base64
import re
from pathlib import Path
from typing import Any

TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml"}


def render(template: str, **values: Any) -> str:
    """Fill a template of the folder ``templates/``."""
    from jinja2 import Environment, PackageLoader

    loader = PackageLoader("sb3_tdpg.report")
    env = Environment(loader=loader, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    env.filters.update(md=escaped, repr=repr)
    text = env.get_template(template).render(**values)
    return re.sub(r"\n{3,}", "\n\n", text).lstrip()


def escaped(name: str) -> str:
    """Escape the characters of a user's name that are Markdown syntax."""
    return re.sub(r"([\\`*\[\]<>]|(?<!\w)_|_(?!\w))", r"\\\1", name)


def to_html(markdown: str, folder: Path, title: str) -> str:
    """Turn Markdown into an HTML page that contains its pictures; HTML in the Markdown is shown as text."""
    from markdown_it import MarkdownIt

    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(markdown)
    for token in tokens:
        for child in token.children or ():
            if child.type == "image":
                path = folder / str(child.attrs["src"])
                data = base64.b64encode(path.read_bytes()).decode()
                child.attrs["src"] = f"data:{TYPES[path.suffix]};base64,{data}"
    return render("report.html", title=title, body=parser.renderer.render(tokens, parser.options, {}))
