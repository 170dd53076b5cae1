"""Write the page of a report: compute its tables and verdicts, and fill the Markdown template."""

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdpg.common.markdown import escaped, fill_template, markdown_table
from sb3_tdpg.report.numbers import CLEAR, Numbers
from sb3_tdpg.report.plan import Plan
from sb3_tdpg.report.rows import ALL, PERTURBED, UNPERTURBED, Row
from sb3_tdpg.robustness.registry import PERTURBATIONS

MIN_SEEDS = 5
"""If a method has fewer models, its interval is not reliable."""


@dataclass
class Knowledge:
    """The information in the TRVs of the first model of a method."""

    label: str
    text: str  # the result in one line, or the reason why there is no result
    figures: Sequence[str] = ()


@dataclass
class Page:
    """The content of a page, except its numbers."""

    plan: Plan
    rows: Sequence[Row]
    sources: Mapping[str, Sequence[str]]  # names of each method's models
    figures: Mapping[str, str]  # the files of degradation, own_rows and examples
    knowledge: Sequence[Knowledge]
    made: str  # the last sentence
    n_rows: int  # including the missing rows


def write_page(numbers: Numbers, page: Page) -> str:
    """Write the page as Markdown."""
    costs, has_all = Costs(numbers), ALL in set(numbers.groups["perturbation"])
    perturbed = [UNPERTURBED, *numbers.perturbations, *([ALL] if has_all else [])]
    own = numbers.groups.loc[numbers.groups["kind"] == "own", "perturbation"].unique()
    tables = dict(
        perturbations=costs.groups_table(perturbed, "perturbation") if numbers.perturbations else "",
        own=costs.groups_table([UNPERTURBED, *own], "test row") if len(own) else "",
        levels=costs.levels_table() if numbers.perturbations else "",
        comparisons=_comparisons_table(numbers),
        severities=_severities_table(page),
        models=_models_table(page),
    )
    verdicts = [_verdict(numbers, label) for label in numbers.models[1:]]
    few = [label for label, names in page.sources.items() if 1 < len(names) < MIN_SEEDS]
    limits = dict(few=few, min_seeds=MIN_SEEDS, clear=CLEAR)
    return fill_template(
        "sb3_tdpg.report", "report.md", page=page, numbers=numbers, costs=costs, tables=tables, verdicts=verdicts,
        all=ALL if has_all else None, unperturbed=UNPERTURBED, **limits,
    )  # fmt: skip


class Costs:
    """Format costs with one to four decimals, if possible at least three significant digits per unperturbed cost."""

    def __init__(self, numbers: Numbers) -> None:
        self.numbers = numbers
        self.groups = numbers.groups.set_index(["model", "perturbation"])
        plain = numbers.levels.loc[numbers.levels["kind"] == "unperturbed", "iqm"].abs()
        size = plain[plain > 0].min()
        self.digits = 3 if np.isnan(size) else int(np.clip(2 - np.floor(np.log10(size)), 1, 4))

    def number(self, value: float, sign: str = "") -> str:
        """Return a number as text, as in ``31.0``."""
        return f"{round(value, self.digits) + 0.0:{sign}.{self.digits}f}"  # + 0.0: no -0

    def cell(self, row: pd.Series, name: str = "iqm") -> str:
        """Return a number and its interval as text, as in ``31.0 [30.1, 32.2]``, without a line break in between."""
        sign = "" if name == "iqm" else "+"
        low, high = (row[end] if name == "iqm" else row[f"{name}_{end}"] for end in ("low", "high"))
        interval = "" if np.isnan(low) else f" [{self.number(low, sign)},\N{NO-BREAK SPACE}{self.number(high, sign)}]"
        return self.number(row[name], sign) + interval

    def sentence(self, name: str) -> str:
        """Return a sentence with the cost of every method under a perturbation."""
        return ", ".join(f"{escaped(m)} costs {self.cell(self.groups.loc[(m, name)])}" for m in self.numbers.models)

    def worst_case(self, label: str) -> dict[str, Any]:
        """Find the perturbation and the severity at which a method costs most."""
        levels = self.numbers.levels[self.numbers.levels["model"] == label]
        plain = levels.loc[levels["kind"] == "unperturbed", "iqm"].iloc[0]
        perturbed = levels[levels["kind"].isin(PERTURBED)]
        worst = perturbed.loc[perturbed["iqm"].idxmax()]
        where = worst[["perturbation", "severity"]]
        return dict(**where, cost=self.cell(worst), unperturbed=self.number(plain))

    def groups_table(self, names: Sequence[str], title: str) -> str:
        """Make a table with a row for each perturbation: the cost and the added cost of every method."""
        models = self.numbers.models
        rows = []
        for name in names:
            row = {title: escaped(name)}
            for model in models:
                group = self.groups.loc[(model, name)]
                bold = "**" if group["lowest"] else ""
                row[f"{escaped(model)}: cost"] = f"{bold}{self.cell(group)}{bold}"
                row[f"{escaped(model)}: added cost"] = "" if name == UNPERTURBED else self.cell(group, "added")
            rows.append(row)
        return markdown_table(rows)

    def levels_table(self) -> str:
        """Make a table of the costs by severity, with a row for each perturbation and method."""
        cells = self.numbers.levels.set_index(["model", "perturbation", "severity"])
        severities = sorted(set(self.numbers.levels["severity"]) - {0})
        rows = [
            [escaped(name), escaped(model), *(self.cell(cells.loc[(model, name, level)]) for level in severities)]
            for name in self.numbers.perturbations
            for model in self.numbers.models
        ]
        return markdown_table(rows, ["perturbation", "method", *(f"severity {level}" for level in severities)])


def _verdict(numbers: Numbers, label: str) -> dict[str, Any]:
    """Compare a method with the first method; return the values for the template."""
    reference, names = numbers.models[0], numbers.perturbations
    ours, theirs = escaped(label), escaped(reference)
    sizes = [numbers.n_models(each) for each in (label, reference)]
    result: dict[str, Any] = dict(ours=ours, theirs=theirs, sizes=sizes, can_be_clear=numbers.can_be_clear(label))
    frame = numbers.comparisons[numbers.comparisons["model"] == label].set_index("perturbation")
    result["of"] = frame.loc[ALL if ALL in frame.index else names[0] if names else UNPERTURBED].to_dict()
    result["cost"] = _by_word(frame.loc[names, "cost"])
    result["own"] = _by_word(frame.loc[frame["kind"] == "own", "cost"])
    return result


def _by_word(words: pd.Series) -> dict[str, list[str]]:
    return {word: list(words.index[words == word]) for word in ("less", "more", "undecided")}


def _comparisons_table(numbers: Numbers) -> str:
    """
    Make a table of the share of pairs in which a model costs less than a model of the first method.

    The table is empty if no difference can be clear.
    """
    rows = []
    for row in numbers.comparisons.to_dict("records"):
        if numbers.can_be_clear(row["model"]):
            lower = {"less": row["model"], "more": row["reference"]}.get(row["cost"], "")
            names = [escaped(name) for name in (row["perturbation"], row["model"], lower)]
            rows.append([*names[:2], _share(row, "cost"), _share(row, "added"), names[2]])
    columns = ["perturbation", "method", "lower cost", "lower added cost", "clearly lower cost"]
    return markdown_table(rows, columns) if rows else ""


def _share(row: Mapping[str, Any], name: str) -> str:
    """Return the share of the pairs of models as text, with its p-value."""
    share, p = row[f"p_{name}"], row[f"pvalue_{name}"]
    return "" if np.isnan(share) else f"{share:.0%} (p = {p:.2g})"


def _severities_table(page: Page) -> str:
    """Make a table of the perturbations' effects, with the parameter of each severity; empty without perturbations."""
    lines = []
    perturbed = [row for row in page.rows if row.kind in PERTURBED]
    for name in dict.fromkeys(row.perturbation for row in perturbed):
        rows = [row for row in perturbed if row.perturbation == name]
        by_severity = {f"severity {row.severity}": f"{row.value:g}" for row in rows}
        what = dict(effect=PERTURBATIONS[name].summary, parameter=PERTURBATIONS[name].parameter)
        lines.append({"perturbation": escaped(name), **what, **by_severity})
    return markdown_table(lines) if lines else ""


def _models_table(page: Page) -> str:
    """Make a table of the models, with each model's number in the records."""
    sources = page.sources.items()
    rows = [(escaped(label), str(i), f"`{name}`") for label, names in sources for i, name in enumerate(names)]
    return markdown_table(rows, ["method", "`train_seed` in the records", "model"])


def to_html(markdown: str, folder: Path, title: str, *, reload: bool = False) -> str:
    """
    Convert Markdown to an HTML page that contains its pictures. HTML in the Markdown is shown as text.

    :param reload: Whether the browser loads the page again after some seconds.
    """
    from markdown_it import MarkdownIt

    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    tokens = parser.parse(markdown)
    for token in tokens:
        for child in token.children or ():
            if child.type == "image":
                data = base64.b64encode((folder / str(child.attrs["src"])).read_bytes()).decode()
                child.attrs["src"] = f"data:image/png;base64,{data}"
    body = parser.renderer.render(tokens, parser.options, {})
    return fill_template("sb3_tdpg.report", "report.html", title=title, body=body, reload=reload)
