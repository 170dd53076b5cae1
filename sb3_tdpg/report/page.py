"""The page of a report: from numbers to words, tables and pictures, in Markdown."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdpg.report.numbers import CLEAR, MIN_CLEAR, Numbers
from sb3_tdpg.report.rows import ALL, UNPERTURBED, Row
from sb3_tdpg.robustness.registry import find

MIN_SEEDS = 5
"""With fewer models of a method its interval says little."""


@dataclass
class Page:
    """
    What a page shows beside its numbers.

    :param env_id: The environment.
    :param env_kwargs: Its keywords.
    :param n_episodes: Of each model in each row.
    :param deterministic: Whether the policies act without noise.
    :param sources: What the models of each method are called.
    :param figures: File by name: ``degradation``, ``own_rows``, ``comparison``, ``examples``.
    :param severities: By perturbation, its rows.
    :param knowledge: What is known of each method's information.
    :param made: How the page was made, in a sentence.
    """

    env_id: str
    env_kwargs: Mapping[str, Any]
    n_episodes: int
    deterministic: bool
    sources: Mapping[str, Sequence[str]]
    figures: Mapping[str, str] = field(default_factory=dict)
    severities: Mapping[str, Sequence[Row]] = field(default_factory=dict)
    knowledge: Sequence[Knowledge] = ()
    made: str = ""


@dataclass
class Knowledge:
    """
    What the first model of a method knows of the state.

    :param label: The method.
    :param text: In a line; or why there is nothing to tell.
    :param badge: Table of the checks, in Markdown.
    :param figures: Files: the timeline, and the map of the components.
    """

    label: str
    text: str
    badge: str = ""
    figures: Sequence[str] = ()


def write_page(numbers: Numbers, page: Page) -> str:
    """
    Write the page.

    :param numbers: Of the report.
    :param page: All else.
    :return: Markdown
    """
    parts = [f"# Robustness in {page.env_id}", _introduction(numbers, page), "## In short", _short(numbers, page)]
    if numbers.perturbations:
        parts += [
            "## Cost under perturbation",
            "The mean over the severities of a perturbation, and in brackets its 95 % interval; *added* is what each "
            "model costs more than it does unperturbed. The lowest cost in bold.",
            groups_table(numbers),
        ]
    if numbers.perturbations and "degradation" in page.figures:
        parts += [
            "## From mild to strong",
            "The flatter a line, the more robust the method; the band is the 95 % interval.",
            _image("cost over severity for each perturbation", page.figures["degradation"]),
        ]
    parts += _comparisons(numbers, page)
    if "own_rows" in page.figures:
        parts += [
            "## Test rows of the environment",
            "Variants of the environment itself that it comes with; bars are 95 % intervals.",
            _image("cost in the test rows of the environment", page.figures["own_rows"]),
            own_rows_table(numbers),
        ]
    if "examples" in page.figures:
        parts += [
            "## What the policies see",
            "The same moment or episode, as it is and as each perturbation shows it, in rising severity.",
            _image("observations under each perturbation", page.figures["examples"]),
        ]
    if page.severities:
        parts += ["What happens, and by how much:", severities_table(page)]
    parts += _information(page)
    if numbers.perturbations:
        parts += ["## Every severity", "Cost and its 95 % interval.", levels_table(numbers)]
    parts += ["## The models", _models(page), "## How this was made", page.made]
    return "\n\n".join(parts) + "\n"


# -- words --------------------------------------------------------------------------------------------------------


def _introduction(numbers: Numbers, page: Page) -> str:
    *first, last = (
        f"{len(names)} {'model' if len(names) == 1 else 'models'} of **{_text(label)}**"
        for label, names in page.sources.items()
    )
    counts = f"{', '.join(first)} and {last}" if first else last
    n_rows = len(numbers.levels) // len(numbers.models)
    policy = "deterministic" if page.deterministic else "stochastic"
    kwargs = ", ".join(f"{name}={value!r}" for name, value in page.env_kwargs.items())
    where = f"`{page.env_id}`" + (f" with `{kwargs}`" if kwargs else "")
    text = (
        f"{counts} in {where}: {n_rows} conditions, in each {page.n_episodes:,} episodes of every model, with the same "
        f"initial states and the same perturbations for all; {policy} policies. **A cost is the negative return: lower "
        "is better.**"
    )
    sizes = sorted(len(names) for names in page.sources.values())
    if sizes[-1] > 1:
        text += (
            " Numbers are interquartile means over the models of a method, with 95 % stratified bootstrap intervals "
            "over them."
        )
    if sizes[0] == 1:
        text += (
            " Of a single model the interval is that of its mean over episodes: it is about this model, not about how "
            "it was trained."
        )
    few = [label for label, names in page.sources.items() if 1 < len(names) < MIN_SEEDS]
    if few:
        text += (
            f"\n\n**Few models** of {_list(few)}: with less than {MIN_SEEDS}, intervals are too narrow to be relied "
            "on. Train more seeds."
        )
    return text


def _short(numbers: Numbers, page: Page) -> str:
    groups = numbers.groups.set_index(["model", "perturbation"])
    form = Form(numbers)
    lines = []

    def costs(name: str) -> str:
        return ", ".join(f"{_text(m)} costs {form.cell(groups.loc[(m, name)])}" for m in numbers.models)

    lines.append(f"**Unperturbed**: {costs(UNPERTURBED)}.")
    if numbers.perturbations and ALL in set(numbers.groups["perturbation"]):
        lines.append(f"**Perturbed**, the mean over all perturbations and severities: {costs(ALL)}.")
    for label in numbers.models[1:]:
        lines += _verdicts(numbers, label)
    if numbers.perturbations:
        lines += [_worst(numbers, label, form) for label in numbers.models]
    lines += [f"**Information**, {_text(each.label)}: {each.text}" for each in page.knowledge]
    return "\n".join(f"- {line}" for line in lines)


def _verdicts(numbers: Numbers, label: str) -> list[str]:
    """Say where a method is better than the first one."""
    frame = numbers.comparisons[numbers.comparisons["model"] == label].set_index("perturbation")
    names, own = numbers.perturbations, list(frame.index[frame["kind"] == "own"])
    ours, theirs = _text(label), _text(frame["control"].iloc[0])
    if frame["p_cost"].isna().all():
        if not names:
            return []
        cost = numbers.groups.set_index(["model", "perturbation"])["iqm"]
        lower = [name for name in names if cost[label, name] < cost[frame["control"].iloc[0], name]]
        return [
            f"**{ours} against {theirs}**: its cost is lower under {len(lower)} of {_n(names, 'perturbation')}"
            f"{_in_brackets(lower)}. How sure this is, a single model of a method cannot tell: give several, trained "
            "with different seeds."
        ]
    lines = []
    if names:
        counts = _counts(frame.loc[names, "cost"], "under", "perturbation")
        text = f"**{ours} against {theirs}**, the mean over severities: it costs {counts}."
        if ALL in frame.index:
            p = _probability(frame.loc[ALL], "p_cost")
            text += f" Over all perturbations, a model of {ours} costs less than one of {theirs} with probability {p}."
        lines.append(text)
        counts = _counts(frame.loc[names, "added"], "under", "perturbation")
        lines.append(
            f"**What a perturbation adds** to the unperturbed cost of {ours} is, compared with {theirs}, {counts}."
        )
    if own:
        counts = _counts(frame.loc[own, "cost"], "in", "row")
        lines.append(f"**In the test rows of the environment**, compared with {theirs}, {ours} costs {counts}.")
    return lines


def _counts(verdicts: pd.Series, where: str, what: str) -> str:
    """Count in words where a method is better, worse, or neither."""
    less, more, unclear = (list(verdicts.index[verdicts == word]) for word in ("less", "more", "undecided"))
    total = _n(verdicts, what)
    if not less and not more:
        return f"neither clearly less nor clearly more {where} any of {total}"
    text = f"less {where} {len(less)} of {total}{_in_brackets(less)}"
    text += f", more {where} {len(more)}{_in_brackets(more)}" if more else ""
    return f"{text}, undecided {where} {len(unclear)}{_in_brackets(unclear)}" if unclear else text


def _worst(numbers: Numbers, label: str, form: Form) -> str:
    levels = numbers.levels[numbers.levels["model"] == label]
    plain = levels.loc[levels["kind"] == "unperturbed", "iqm"].iloc[0]
    perturbed = levels[levels["kind"].isin(("sensor", "scene"))]
    worst = perturbed.loc[perturbed["iqm"].idxmax()]
    where = f"{_text(worst['perturbation'])} at severity {worst['severity']}"
    return (
        f"**{_text(label)} suffers most** from {where}: it costs {form.cell(worst)}, unperturbed {form.number(plain)}."
    )


# -- tables -------------------------------------------------------------------------------------------------------


class Form:
    """
    How costs are written: all with as many digits behind the point as give the unperturbed ones three, at least one.

    :param numbers: Of the report.
    """

    def __init__(self, numbers: Numbers) -> None:
        plain = numbers.levels.loc[numbers.levels["kind"] == "unperturbed", "iqm"].abs()
        size = plain[plain > 0].min()
        self.digits = 3 if np.isnan(size) else int(np.clip(2 - np.floor(np.log10(size)), 1, 4))

    def cell(self, row: pd.Series, name: str = "") -> str:
        """``31.0 [30.1, 32.2]``; where a table is too wide, the interval goes to a line of its own, in one piece."""
        value, low, high = (row[column] for column in ((name, f"{name}_low", f"{name}_high") if name else LIMITS))
        sign = "+" if name else ""
        interval = "" if np.isnan(low) else f" [{self.number(low, sign)},\N{NO-BREAK SPACE}{self.number(high, sign)}]"
        return f"{self.number(value, sign)}{interval}"

    def number(self, value: float, sign: str = "") -> str:
        """``31.0``"""
        return f"{round(value, self.digits) + 0.0:{sign}.{self.digits}f}"  # + 0.0: no -0


LIMITS = ("iqm", "low", "high")


def groups_table(numbers: Numbers) -> str:
    """Return a table with a row for each perturbation: cost and what is added, by method."""
    names = [UNPERTURBED, *numbers.perturbations]
    names += [ALL] if ALL in set(numbers.groups["perturbation"]) else []
    return _cost_table(numbers, names, "perturbation")


def own_rows_table(numbers: Numbers) -> str:
    """Return a table with a row for each test row of the environment."""
    own = numbers.groups[numbers.groups["kind"] == "own"]["perturbation"].unique()
    return _cost_table(numbers, [UNPERTURBED, *own], "row")


def _cost_table(numbers: Numbers, names: Sequence[str], title: str) -> str:
    groups, form = numbers.groups.set_index(["model", "perturbation"]), Form(numbers)
    header = [title]
    for model in numbers.models:
        header += [f"{_text(model)}: cost", f"{_text(model)}: added"]
    rows = []
    for name in names:
        of_name = {model: groups.loc[(model, name)] for model in numbers.models}
        lowest = min(float(row["iqm"]) for row in of_name.values())
        cells = [_text(name)]
        for row in of_name.values():
            bold = "**" if len(of_name) > 1 and row["iqm"] == lowest else ""
            cells.append(f"{bold}{form.cell(row)}{bold}")
            cells.append("" if name == UNPERTURBED else form.cell(row, "added"))
        rows.append(cells)
    return _table(header, rows)


def comparisons_table(numbers: Numbers) -> str:
    """Return a table of the probabilities that a method is better than the first one."""
    frame = numbers.comparisons
    header = ["", "method", "costs less", "a perturbation adds less", "clearly cheaper"]
    rows = []
    for row in frame.to_dict("records"):
        clear = {"less": row["model"], "more": row["control"]}.get(row["cost"], "")
        name, model = _text(row["perturbation"]), _text(row["model"])
        rows.append([name, model, _probability(row, "p_cost"), _probability(row, "p_added"), _text(clear)])
    return _table(header, rows)


def levels_table(numbers: Numbers) -> str:
    """Return a table of the costs by severity: a row for each perturbation and method."""
    levels, form = numbers.levels, Form(numbers)
    cells = levels.set_index(["model", "perturbation", "severity"])
    severities = sorted(set(levels["severity"]) - {0})
    rows = []
    for name in numbers.perturbations:
        for i, model in enumerate(numbers.models):
            costs = [form.cell(cells.loc[(model, name, severity)]) for severity in severities]
            rows.append([_text(name) if i == 0 else "", _text(model), *costs])
    return _table(["perturbation", "method", *map(str, severities)], rows)


def severities_table(page: Page) -> str:
    """Return a table of what the perturbations are, and what their severities stand for."""
    severities = sorted({row.severity for rows in page.severities.values() for row in rows})
    lines = []
    for name, rows in page.severities.items():
        if rows[0].kind == "sensor":
            what, parameter = find(name).summary, find(name).parameter
            values = [f"{row.value:g}" for row in rows]
        else:
            changed = [
                {key: value for key, value in row.scenario.env_kwargs.items() if page.env_kwargs.get(key) != value}
                for row in rows
            ]
            what, parameter = "the environment is made otherwise", ", ".join(f"`{key}`" for key in changed[0])
            values = [", ".join(map(str, each.values())) for each in changed]
        lines.append([_text(name), what, parameter, *values])
    table = _table(["perturbation", "what happens", "parameter", *map(str, severities)], lines)
    if any("scales" in line[2] for line in lines):
        table += "\n\nA scale is how much a component of the observations varies: its standard deviation."
    return table


def _comparisons(numbers: Numbers, page: Page) -> list[str]:
    if numbers.comparisons.empty or numbers.comparisons["p_cost"].isna().all():
        return []
    control = _text(numbers.comparisons["control"].iloc[0])
    parts = [
        "## Which is more robust",
        f"The probability that a model of a method, any of its seeds, costs less than one of **{control}**, and that a "
        f"perturbation adds less to its unperturbed cost; 0.50 is no difference. From {CLEAR:g} on, and up to "
        f"{1 - CLEAR:.2g} the other way round, this page calls it clear, if there are at least {MIN_CLEAR} models of "
        "each method.",
    ]
    if "comparison" in page.figures:
        parts.append(_image(f"probability of a lower cost than {control}", page.figures["comparison"]))
    return [*parts, comparisons_table(numbers)]


def _probability(row: Mapping[str, Any] | pd.Series, name: str) -> str:
    if np.isnan(row[name]):
        return ""
    return f"{row[name]:.2f} [{row[f'{name}_low']:.2f}, {row[f'{name}_high']:.2f}]"


def _information(page: Page) -> list[str]:
    if not page.knowledge:
        return []
    parts = [
        "## What the policies know",
        "Of the first model of each method, unperturbed: an interval that holds the information in its task-relevant "
        "variables about the true state at each time step, what they know at least of each component of the state, and "
        "whether the checks of these numbers passed. In the map a component is grey where it does not vary (or too few "
        "episodes last so long), and its number in brackets where it cannot be told from 0.",
    ]
    for each in page.knowledge:
        parts += [f"### {_text(each.label)}", each.text]
        parts += [_image(f"information of {_text(each.label)}", path) for path in each.figures]
        parts += [each.badge] if each.badge else []
    return parts


def _models(page: Page) -> str:
    rows = [
        [_text(label), str(number), f"`{name}`"]
        for label, names in page.sources.items()
        for number, name in enumerate(names)
    ]
    return _table(["method", "`train_seed` in the records", "model"], rows)


# -- Markdown -----------------------------------------------------------------------------------------------------


def _table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(cell for cell in line)} |" for line in lines)


def _image(text: str, path: str) -> str:
    return f"![{text}]({path})"


def _text(name: str) -> str:
    """Escape what Markdown would take for its own in a name that a user has chosen."""
    return re.sub(r"([\\`*\[\]<>|]|(?<!\w)_|_(?!\w))", r"\\\1", name)


def _n(items: Sequence[Any] | pd.Series, what: str) -> str:
    return f"{len(items)} {what}{'' if len(items) == 1 else 's'}"


def _in_brackets(names: Sequence[str]) -> str:
    return f" ({_list(names)})" if names else ""


def _list(names: Sequence[str]) -> str:
    return ", ".join(_text(name) for name in names)
