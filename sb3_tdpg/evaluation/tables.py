"""From records to tables: statistics over episodes, over training seeds, and beside the paper's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdpg.envs.scenarios import PaperResult, Scenario


def summary_table(records: pd.DataFrame, by: Sequence[str] = ("model", "scenario")) -> pd.DataFrame:
    """
    Summarise the cost over the episodes of each model in each scenario.

    :param records: What :func:`~sb3_tdpg.evaluation.evaluate_scenarios` returned.
    :param by: The columns that tell the rows apart. A column ``train_seed`` is put in front by itself.
    :return: the columns of ``by`` and ``n`` (episodes), ``mean``, ``std`` (with n - 1), ``sem`` (standard error of the
        mean), ``median``; ``failure_share`` if the records tell of failures; ``seed`` and ``deterministic``
    """
    keys = [*(["train_seed"] if "train_seed" in records.columns and "train_seed" not in by else []), *by]
    require_columns(records, [*keys, "cost", "seed", "deterministic"])
    groups = records.groupby(keys, sort=False)
    cost = groups["cost"]
    columns = dict(n=cost.size(), mean=cost.mean(), std=cost.std(), sem=cost.sem(), median=cost.median())
    if "failure" in records.columns:
        columns["failure_share"] = groups["failure"].apply(lambda failure: failure.astype(float).mean())
    columns.update(seed=groups["seed"].agg(one_or_all), deterministic=groups["deterministic"].agg(one_or_all))
    return pd.DataFrame(columns).reset_index()


def add_ratio(summary: pd.DataFrame, reference: str = "Training") -> pd.DataFrame:
    """
    Add a column ``ratio``: the mean over the same model's mean in a reference scenario. A robust model stays near 1.

    :param summary: From :func:`summary_table`.
    :param reference: Name of the scenario to divide by.
    """
    if reference not in set(summary["scenario"]):
        raise ValueError(
            f"reference={reference!r} is not a scenario of the table: {list(summary['scenario'].unique())}"
        )
    keys = [name for name in summary.columns[: summary.columns.get_loc("n")] if name != "scenario"]
    base = summary.loc[summary["scenario"] == reference, [*keys, "mean"]]
    means = summary[keys].merge(base, on=keys, how="left", validate="m:1")["mean"]
    return summary.assign(ratio=summary["mean"].to_numpy() / means.to_numpy())


def comparison_markdown(
    summary: pd.DataFrame, scenarios: Sequence[Scenario], *, quantity: str = "episode cost", digits: int = 2
) -> str:
    """
    Write a Markdown table: a row for each scenario, and for each model its numbers beside the paper's.

    :param summary: From :func:`summary_table`, or from :func:`aggregate_seeds`: then a cell shows the interquartile
        mean over seeds and its interval.
    :param scenarios: The rows, in this order. Where a label of a model is a key of ``scenario.paper``, the paper's
        numbers stand beside.
    :param quantity: What the numbers are, for the line below the table.
    :param digits: Digits behind the point.
    :return: the table, the lowest of ours and the lowest of the paper's in bold, and a line that says how it was made
    """
    over_seeds = "iqm" in summary.columns
    require_columns(summary, ["model", "scenario", *(("iqm", "low", "high") if over_seeds else ("mean", "std"))])
    if summary.duplicated(["model", "scenario"]).any():
        raise ValueError(
            "the summary has several rows for a model in a scenario: use aggregate_seeds, or select one seed"
        )
    missing = [scenario.name for scenario in scenarios if scenario.name not in set(summary["scenario"])]
    if missing:
        raise ValueError(f"the summary has no row for the scenarios {missing}: evaluate them, or leave them out")
    models = list(summary["model"].unique())
    in_paper = [model for model in models if any(model in scenario.paper for scenario in scenarios)]
    cells = summary.set_index(["scenario", "model"])

    header = ["Scenario"]
    for model in models:
        header += [str(model), f"{model} (paper)"] if model in in_paper else [str(model)]
    lines = [_line(header), _line(["---", *["---:"] * (len(header) - 1)])]
    for scenario in scenarios:
        ours = {model: cells.loc[(scenario.name, model)] for model in models if (scenario.name, model) in cells.index}
        value = {model: float(cell["iqm" if over_seeds else "mean"]) for model, cell in ours.items()}
        of_paper = {model: scenario.paper[model].mean for model in in_paper if model in scenario.paper}
        row = [scenario.name]
        for model in models:
            row.append(_bold_if(_our_cell(ours[model], digits), _is_lowest(model, value)) if model in ours else "")
            if model in in_paper and (result := scenario.paper.get(model)):
                row.append(_bold_if(_paper_cell(result, digits), _is_lowest(model, of_paper)))
            elif model in in_paper:
                row.append("")
        lines.append(_line(row))
    results = [scenario.paper[model] for scenario in scenarios for model in in_paper if model in scenario.paper]
    return "\n".join([*lines, "", _footer(summary, results, quantity), ""])


def _paper_cell(result: PaperResult, digits: int) -> str:
    return f"{result.mean:.{digits}f}" if result.std is None else f"{result.mean:.{digits}f} ({result.std:.{digits}f})"


def _our_cell(cell: pd.Series, digits: int) -> str:
    if cell.get("n_seeds") == 1:
        return f"{cell['iqm']:.{digits}f}"  # one seed says nothing of the others
    if "iqm" in cell:
        return f"{cell['iqm']:.{digits}f} [{cell['low']:.{digits}f}, {cell['high']:.{digits}f}]"
    return f"{cell['mean']:.{digits}f} ({cell['std']:.{digits}f})"


def _footer(summary: pd.DataFrame, paper: Sequence[PaperResult], quantity: str) -> str:
    """Say what the numbers are and how they were made."""
    if "iqm" in summary.columns and (summary["n_seeds"] == 1).all():
        what = f"Mean {quantity} of one training seed, hence without an interval"
    elif "iqm" in summary.columns:
        what = (
            f"Interquartile mean of the {quantity} over {_all(summary['n_seeds'])} training seeds "
            f"[{summary['level'].iloc[0]:.0%} bootstrap interval over seeds]"
        )
    else:
        what = f"Mean {quantity} (standard deviation over episodes)"
    if paper:
        what += "; the paper's columns: mean"
        what += " (standard deviation)" if any(result.std is not None for result in paper) else ""
    kinds = {False: "stochastic policy", True: "deterministic policy"}
    how = [f"{_all(summary['n'])} episodes a scenario"] if "n" in summary.columns else []
    how += [f"evaluation seed {_all(summary['seed'])}"] if "seed" in summary.columns else []
    how += (
        [_all(summary["deterministic"].map(kinds).fillna("stochastic and deterministic policies"))]
        if "deterministic" in summary.columns
        else []
    )
    return f"{what}. {', '.join(how)}. Lowest in bold." if how else f"{what}. Lowest in bold."


def _all(values: pd.Series) -> str:
    return ", ".join(f"{value:,}" if isinstance(value, (int, np.integer)) else str(value) for value in values.unique())


def one_or_all(values: pd.Series) -> Any:
    """Return the value that all rows share, or else all that occur as text: ``"0, 1, 2"``."""
    unique = values.unique()
    return unique[0] if len(unique) == 1 else ", ".join(str(value) for value in unique)


def _is_lowest(name: str, values: Mapping[str, float]) -> bool:
    """Among others: one value alone is not worth a mark."""
    return len(values) > 1 and values[name] == min(values.values())


def _bold_if(text: str, condition: bool) -> str:
    return f"**{text}**" if condition else text


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def require_columns(frame: pd.DataFrame, columns: Sequence[str]) -> None:
    """Raise a ``ValueError`` if a column is missing."""
    if missing := [name for name in columns if name not in frame.columns]:
        raise ValueError(f"the frame has no column {missing}; it has {list(frame.columns)}")
