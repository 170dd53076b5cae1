"""Sphinx configuration: MyST Markdown, the Read the Docs theme, and docstrings of the code itself."""

import re
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst.directives.images import Figure
from sphinx.application import Sphinx

import sb3_tdpg

project = "sb3_tdpg"
author = "the sb3_tdpg developers"
copyright = f"2026, {author}"
release = version = sb3_tdpg.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx_copybutton"]
exclude_patterns = ["_build", "results/*/*"]  # what is in there is included by the pages beside it
nitpicky = True  # a reference that leads nowhere is a warning, and with -W an error
nitpick_ignore_regex = [("py:.*", r"(stable_baselines3|gymnasium|pathlib)\..*")]  # their pages are elsewhere

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
suppress_warnings = ["myst.header"]  # the changelog's headings are SB3's

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the signature is long enough without; the text says what is expected
autodoc_class_signature = "mixed"

copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

html_theme = "sphinx_rtd_theme"
html_theme_options = {"navigation_depth": 3}
html_static_path = ["_static"]
html_css_files = ["custom.css"]


# Where a cell is not to break: before a unit, in an interval, in an exponent ("43.9 ms", "[8.20, 9.04]", "1e-3").
TOGETHER = re.compile(r"(?<=\d) (?=%|(?:[nµm]?s|min|nat)\b)|(?<=\d,) (?=[^\s\]]+\])")
EXPONENT = re.compile(r"(?<=\de-)(?=\d)")


def keep_numbers_together(app: Sphinx, doctree: nodes.document) -> None:
    """Let the cells of tables break where a reader would."""
    for entry in doctree.findall(nodes.entry):
        for text in list(entry.findall(nodes.Text)):
            if not isinstance(text.parent, nodes.literal):
                kept = EXPONENT.sub("\N{WORD JOINER}", TOGETHER.sub("\N{NO-BREAK SPACE}", text))
                text.parent.replace(text, nodes.Text(kept))


class FigureIfMade(Figure):
    """A figure, or, before the script that draws it has been run, the command to run."""

    def run(self) -> list[nodes.Node]:
        if "alt" not in self.options:
            raise self.error(f"{self.arguments[0]} needs an :alt: text, for those who cannot see it")
        page = Path(self.state.document.current_source or "").parent
        if (page / self.arguments[0]).is_file():
            return super().run()
        return [nodes.paragraph("", f"(figure {self.arguments[0]}: not made yet)")]


def setup(app: Sphinx) -> None:
    app.add_directive("figure-if-made", FigureIfMade)
    app.connect("doctree-read", keep_numbers_together)
