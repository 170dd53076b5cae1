"""Configure Sphinx: MyST Markdown, the Furo theme, and the docstrings of the code."""

import configparser
import re
import unicodedata
from pathlib import Path

from docutils import nodes
from docutils.parsers.rst.directives.images import Figure
from latex2mathml.converter import convert as latex_to_mathml
from sphinx.application import Sphinx
from sphinx.util.logging import getLogger
from sphinx.writers.html5 import HTML5Translator

import sb3_tdpg

logger = getLogger(__name__)

project = "sb3_tdpg"
author = "the sb3_tdpg developers"
copyright = f"2026, {author}"
release = version = sb3_tdpg.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton"]
exclude_patterns = ["_build", "results/*/*"]  # other pages include the files in these folders
nitpicky = True  # a broken reference is a warning, and with -W it is an error
nitpick_ignore_regex = [("py:.*", r"(stable_baselines3|gymnasium|pathlib)\..*")]  # documented on other sites

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
suppress_warnings = ["myst.header"]  # the changelog uses SB3's headings

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # types would make the signatures too long, and the text describes them
autodoc_class_signature = "mixed"

copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True

html_theme = "furo"
html_title = project
# Add links to edit a page when setup.cfg contains the repository's address.
setup_cfg = configparser.ConfigParser()
setup_cfg.read(Path(__file__).parents[1] / "setup.cfg", encoding="utf-8")
repository = re.search(r"^Source = (\S+)", setup_cfg["metadata"]["project_urls"], re.MULTILINE)
if repository and "/OWNER/" not in repository[1]:
    html_theme_options = {"source_repository": repository[1], "source_branch": "main", "source_directory": "docs/"}
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["custom.css"]


# Texts without a line break: a number with its unit, an interval, an exponent ("43.9 ms", "[8.20, 9.04]", "7.6 to 10",
# "1e-3").
TOGETHER = re.compile(
    r"(?<=\d) (?=%|(?:[nµm]?s|min|nat)\b)|(?<=\d,) (?=[^\s\]]+\])|(?<=\d) (?=to [\d.])|(?<=\d to) (?=[\d.])"
)
EXPONENT = re.compile(r"(?<=\de-)(?=\d)")


def keep_numbers_together(app: Sphinx, doctree: nodes.document) -> None:
    """Prevent line breaks within numbers in tables."""
    for entry in doctree.findall(nodes.entry):
        for text in list(entry.findall(nodes.Text)):
            if not isinstance(text.parent, nodes.literal):
                kept = EXPONENT.sub("\N{WORD JOINER}", TOGETHER.sub("\N{NO-BREAK SPACE}", text))
                text.parent.replace(text, nodes.Text(kept))


# Browsers ignore the attribute mathvariant that the converter writes, so the letter itself must change.
LETTER = re.compile(r'mathvariant="(double-struck|script|monospace)">([A-Za-z])(?=<)')


def in_its_alphabet(match: re.Match[str]) -> str:
    """Replace a plain letter with a mathvariant by the letter from that mathematical alphabet."""
    alphabet, letter = match[1].upper(), match[2]
    name = f"{alphabet} {'CAPITAL' if letter.isupper() else 'SMALL'} {letter.upper()}"
    return f">{unicodedata.lookup(f'MATHEMATICAL {name}')}"


def write_math(translator: HTML5Translator, node: nodes.math | nodes.math_block) -> None:
    """Write a formula as MathML, which browsers draw without a script and without a network."""
    display = "block" if isinstance(node, nodes.math_block) else "inline"
    tex = node.astext().strip()
    if display == "block" and r"\\" in tex and r"\begin" not in tex:
        tex = rf"\begin{{split}}{tex}\end{{split}}"  # align the lines at &, as Sphinx does
    mathml = latex_to_mathml(tex, display=display)
    if unknown := re.findall(r"<m[io][^>]*>(\\.+?|&amp;|&#x00026;|&)</m[io]>", mathml):
        logger.warning("%s in a formula: %s", unknown, node.astext(), location=node)
    mathml = LETTER.sub(in_its_alphabet, mathml)
    translator.body.append(f'<div class="math">{mathml}</div>' if display == "block" else mathml)
    raise nodes.SkipNode


class FigureIfMade(Figure):
    """Insert a figure, or insert a note if the figure's file does not exist yet."""

    def run(self) -> list[nodes.Node]:
        if "alt" not in self.options:
            raise self.error(f"{self.arguments[0]} needs an :alt: text for readers who cannot see it")
        page = Path(self.state.document.current_source or "").parent
        if (page / self.arguments[0]).is_file():
            return super().run()
        return [nodes.paragraph("", f"(figure {self.arguments[0]}: not drawn yet)")]


def setup(app: Sphinx) -> None:
    app.add_directive("figure-if-made", FigureIfMade)
    app.add_html_math_renderer("mathml", (write_math, None), (write_math, None))
    app.connect("doctree-read", keep_numbers_together)
