"""A page of Markdown as one file of HTML: no script, nothing to be fetched, the pictures inside."""

from __future__ import annotations

import base64
import html
from pathlib import Path

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 62rem; margin: 2rem auto;
  padding: 0 1rem; }
h1, h2, h3 { line-height: 1.25; margin: 2rem 0 0.6rem; }
h2 { border-bottom: 1px solid #ddd; padding-bottom: 0.2rem; }
img { max-width: 100%; height: auto; display: block; margin: 0.8rem auto; }
table { border-collapse: collapse; display: block; overflow-x: auto; font-size: 0.85rem; margin: 0.8rem 0;
  font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 0.7rem; border-bottom: 1px solid #e4e4e4; text-align: left; vertical-align: top; }
th { background: #f4f4f4; border-bottom: 2px solid #ccc; vertical-align: bottom; }
tr:hover td { background: #fafaf2; }
code { background: #f4f4f4; padding: 0.1rem 0.25rem; border-radius: 3px; font-size: 0.9em; overflow-wrap: anywhere; }
li { margin: 0.25rem 0; }
"""

TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml"}


def to_html(markdown: str, folder: Path, title: str) -> str:
    """
    Render Markdown as a page that needs no other file.

    :param markdown: CommonMark with tables. HTML in it is shown, not used.
    :param folder: Where the files of its pictures are.
    :param title: Of the window.
    :raises ImportError: without markdown-it-py (``pip install sb3_tdpg[plots]``).
    """
    try:
        from markdown_it import MarkdownIt
    except ImportError as e:
        raise ImportError("a page of HTML needs markdown-it-py: pip install sb3_tdpg[plots]") from e

    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(markdown)
    for token in tokens:
        for child in token.children or ():
            if child.type == "image":
                path = folder / str(child.attrs["src"])
                data = base64.b64encode(path.read_bytes()).decode()
                child.attrs["src"] = f"data:{TYPES[path.suffix]};base64,{data}"
    body = parser.renderer.render(tokens, parser.options, {})
    head = (
        '<meta charset="utf-8">\n<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{STYLE}</style>"
    )
    return f'<!DOCTYPE html>\n<html lang="en">\n<head>\n{head}\n</head>\n<body>\n{body}</body>\n</html>\n'
