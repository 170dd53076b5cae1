"""Make tables from records: statistics over episodes, and comparisons with the paper's numbers."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.envs.scenarios import PaperResult, Scenario


def summary_table(records: pd.DataFrame) -> pd.DataFrame:
    """
    Summarise the cost over the episodes of each model in each scenario, and of each ``train_seed`` if there are any.

    :param records: Result of :func:`~sb3_tdpg.evaluation.evaluate_scenarios`.
    :return: a frame with the columns ``model``, ``scenario``, ``n`` (episodes), ``mean``, ``std`` (with n - 1), ``sem``
        (standard error of the mean), ``median``, ``failure_share`` (if there is a column ``failure``), ``seed`` and
        ``deterministic``
    """
    keys = [*(["train_seed"] if "train_seed" in records.columns else []), "model", "scenario"]
    if n_missing := int(records["cost"].isna().sum()):
        raise ValueError(f"{n_missing} of {len(records)} episodes cost NaN, and a mean over the others would hide them")
    groups = records.groupby(keys, sort=False, dropna=False)
    cost = groups["cost"]
    columns = dict(n=cost.size(), mean=cost.mean(), std=cost.std(), sem=cost.sem(), median=cost.median())
    if "failure" in records.columns:
        columns["failure_share"] = groups["failure"].apply(lambda failure: failure.astype(float).mean())
    columns.update(seed=groups["seed"].agg(one_or_all), deterministic=groups["deterministic"].agg(one_or_all))
    return pd.DataFrame(columns).reset_index()


def add_ratio(summary: pd.DataFrame, reference: str = "Training") -> pd.DataFrame:
    """
    Add a column ``ratio``: the mean cost divided by the same model's mean cost in a reference scenario.

    :param summary: Result of :func:`summary_table`.
    :param reference: Name of the scenario to divide by.
    """
    if reference not in (names := list(summary["scenario"].unique())):
        raise ValueError(f"reference={reference!r} is not a scenario of the table: {names}")
    keys = [name for name in summary.columns[: summary.columns.get_loc("n")] if name != "scenario"]
    base = summary.loc[summary["scenario"] == reference, [*keys, "mean"]]
    means = summary[keys].merge(base, on=keys, how="left", validate="m:1")["mean"]
    return summary.assign(ratio=summary["mean"].to_numpy() / means.to_numpy())


def comparison_markdown(
    summary: pd.DataFrame, scenarios: Sequence[Scenario], *, quantity: str = "episode cost", digits: int = 2
) -> str:
    """
    Write a Markdown table with a row for each scenario and, for each model, columns of its numbers and the paper's.

    :param summary: Result of :func:`summary_table`, or of :func:`aggregate_seeds`; with the latter, a cell shows the
        interquartile mean over seeds and its interval.
    :param scenarios: The rows, in this order. The paper's numbers are shown for models whose label is a key of
        ``scenario.paper``.
    :param quantity: Name of the compared quantity, for the line below the table.
    :return: the table, and a line on how it was made; if there are several models, our lowest number and the paper's
        lowest number of each row are bold
    """
    over_seeds = "iqm" in summary.columns
    if summary.duplicated(["model", "scenario"]).any():
        raise ValueError("the summary has several rows for a model in a scenario: use aggregate_seeds or select a seed")
    if missing := [scenario.name for scenario in scenarios if scenario.name not in set(summary["scenario"])]:
        raise ValueError(f"the summary has no row for the scenarios {missing}: evaluate them, or leave them out")
    models = [str(model) for model in summary["model"].unique()]
    results = [scenario.paper[model] for scenario in scenarios for model in models if model in scenario.paper]
    rows = []
    for scenario in scenarios:
        ours = {str(row["model"]): row for _, row in summary[summary["scenario"] == scenario.name].iterrows()}
        of_paper = {model: scenario.paper[model] for model in models if model in scenario.paper}
        cells = _cells({m: (_text(row, digits), row["iqm" if over_seeds else "mean"]) for m, row in ours.items()})
        paper = _cells({m: (_paper_text(result, digits), result.mean) for m, result in of_paper.items()})
        rows.append({"Scenario": scenario.name, **cells, **{f"{model} (paper)": cell for model, cell in paper.items()}})
    names = [name for model in models for name in (model, f"{model} (paper)")]
    shown = [name for name in names if name in models or any(name in row for row in rows)]
    table = markdown_table(rows, ["Scenario", *shown], align="lr")
    return f"{table}\n\n{_footer(summary, results, quantity)}\n"


def _cells(entries: Mapping[str, tuple[str, float]]) -> dict[str, str]:
    """Return the texts, the one with the lowest value in bold; a single value is not marked."""
    lowest = min(value for _, value in entries.values()) if len(entries) > 1 else None
    return {name: f"**{text}**" if value == lowest else text for name, (text, value) in entries.items()}


def _paper_text(result: PaperResult, digits: int) -> str:
    return f"{result.mean:.{digits}f}" if result.std is None else f"{result.mean:.{digits}f} ({result.std:.{digits}f})"


def _text(row: pd.Series, digits: int) -> str:
    if "iqm" not in row:
        return f"{row['mean']:.{digits}f} ({row['std']:.{digits}f})"
    interval = "" if row["n_seeds"] == 1 else f" [{row['low']:.{digits}f}, {row['high']:.{digits}f}]"
    return f"{row['iqm']:.{digits}f}{interval}"


def _footer(summary: pd.DataFrame, paper: Sequence[PaperResult], quantity: str) -> str:
    """Describe the numbers and how they were made."""
    if "iqm" not in summary.columns:
        what = f"Mean {quantity} (standard deviation over episodes)"
    elif (summary["n_seeds"] == 1).all():
        what = f"Mean {quantity} of one training seed, hence without an interval"
    else:
        what = (
            f"Interquartile mean of the {quantity} over {_all(summary['n_seeds'])} training seeds "
            f"[{summary['level'].iloc[0]:.0%} bootstrap interval over seeds]"
        )
    if paper:
        what += "; the paper's columns: mean"
        what += " (standard deviation)" if any(result.std is not None for result in paper) else ""
    kinds = summary["deterministic"].map({False: "stochastic policy", True: "deterministic policy"})
    kinds = kinds.fillna("stochastic and deterministic policies")
    how = f"{_all(summary['n'])} episodes per scenario, evaluation seed {_all(summary['seed'])}, {_all(kinds)}"
    return f"{what}. {how}. Lowest in bold."


def _all(values: pd.Series) -> str:
    return ", ".join(f"{value:,}" if isinstance(value, (int, np.integer)) else str(value) for value in values.unique())


def one_or_all(values: pd.Series) -> Any:
    """Return the value that all rows share, or else all values as text: ``"0, 1, 2"``."""
    unique = values.unique()
    return unique[0] if len(unique) == 1 else ", ".join(str(value) for value in unique)
