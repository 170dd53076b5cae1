"""Turn the Markdown of a report into one HTML file."""

import base64
from pathlib import Path

from sb3_tdpg.common.markdown import fill_template

TYPES = {".png": "image/png", ".jpg": "image/jpeg", ".svg": "image/svg+xml"}


def to_html(markdown: str, folder: Path, title: str, *, reload: bool = False) -> str:
    """
    Turn Markdown into an HTML page that contains its pictures; HTML in the Markdown is shown as text.

    :param reload: Whether the browser shall load the page again after some seconds.
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
    body = parser.renderer.render(tokens, parser.options, {})
    return fill_template("sb3_tdpg.report", "report.html", title=title, body=body, reload=reload)
