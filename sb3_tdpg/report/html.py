"""Render a page of Markdown as one HTML file that contains its pictures and no script."""

from __future__ import annotations

import base64
from pathlib import Path

from sb3_tdpg.report.rendering import render

TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml"}


def to_html(markdown: str, folder: Path, title: str) -> str:
    """
    Render Markdown as a page that needs no other file.

    :param markdown: CommonMark with tables. HTML in it is shown as text.
    :param folder: The folder of its pictures.
    :param title: The title of the window.
    """
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
