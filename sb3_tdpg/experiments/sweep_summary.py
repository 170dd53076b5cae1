"""The selection from a sweep over beta, and its summary in words and tables."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.common.provenance import provenance
from sb3_tdpg.common.summary import how_made

# Among policies with almost no information, which of them has the least is chance: the cheapest of them is taken.
TIE = 0.01  # nats

NOT_SELECTED = "**No run costs less than {limit:g}, so none is selected**: train longer or loosen the limit."
SELECTED = (
    "**Selected: beta = {best.label}, seed {best.seed}** (cost {best.cost:.4g}, information {best.information:.3g} "
    "nat; {where}). {n_below} of {n} runs are below a cost of {limit:g}; of those within {tie:g} nat of the one with "
    "the least information, it is the cheapest."
)
EVERY_RUN = (
    "Cost and its standard deviation over episodes; information in nats, summed over time, on fresh rollouts: the "
    "log-det upper bound, which the selection goes by, and a lower bound. Both are estimated from the same rollouts, "
    "and the lower bound is never above the upper one; on other rollouts both would differ a little. "
    "`met_block_limits`: whether an epoch met the limits of the block's own selection, if it has one; otherwise the "
    "model is that of the last epoch."
)


def select(runs: pd.DataFrame, cost_limit: float) -> pd.Series | None:
    """Select a run by the paper's rule (see :func:`~sb3_tdpg.experiments.sweep.sweep`), if one is below the limit."""
    below = runs[runs["cost"] < cost_limit]
    if below.empty:
        return None
    least = below[below["information"] <= below["information"].min() + TIE]
    return least.loc[least["cost"].idxmin()]


def sweep_summary(
    runs: pd.DataFrame,
    best: pd.Series | None,
    columns: Mapping[str, str],
    failures: Mapping[str, str],
    *,
    cost_limit: float,
    title: str,
    has_model: bool,
) -> str:
    """
    Write the summary as Markdown.

    :param runs: ``runs.csv``, sorted; ``best`` is the selected row.
    :param columns: Column of the mean cost, by scenario.
    :param failures: Reasons of the failed runs, by job.
    :param has_model: Whether the selected model lies in the folder of the summary.
    """
    is_below = runs["cost"] < cost_limit
    selection = NOT_SELECTED.format(limit=cost_limit)
    if best is not None:
        where = "`selected.zip`" if has_model else f"not in this folder: `runs/{best.folder}/model.zip` of its worker"
        counts = dict(n_below=is_below.sum(), n=len(runs), limit=cost_limit, tie=TIE)
        selection = SELECTED.format(best=best, where=where, **counts)
    by_beta = runs.groupby("label", sort=False)
    overview = {
        "beta": list(by_beta.groups),
        "seeds": by_beta.size(),
        "cost: mean (worst)": _mean_and_worst(by_beta["cost"]),
        "information in nats: mean (most)": _mean_and_worst(by_beta["information"], "{:.2g}"),
        f"runs below {cost_limit:g}": is_below.groupby(runs["label"], sort=False).sum(),
    }
    parts = [f"# Sweep over beta: {title}", selection, "![cost against information](sweep.png)"]
    parts += ["## By beta", markdown_table(pd.DataFrame(overview))]
    if len(columns) > 1:
        costs = {f"beta {beta}": _mean_and_worst(group[list(columns.values())]) for beta, group in by_beta}
        table = markdown_table(pd.DataFrame({"scenario": list(columns), **costs}))
        parts += ["## Robustness", "Mean episode cost: mean over seeds (worst seed).", table]
    shown = runs[["label", "seed", "cost", "std", "information", "information_lower", "met_block_limits"]]
    parts += ["## Every run", EVERY_RUN, markdown_table(shown.rename(columns={"label": "beta"}), digits=4)]
    if failures:
        parts += ["## Failed", "\n".join(f"- `{job}`: {reason}" for job, reason in failures.items())]
    return "\n\n".join([*parts, how_made("sb3-tdpg sweep", provenance(), [])])


def _mean_and_worst(values: pd.DataFrame, form: str = "{:.4g}") -> list[str]:
    means, worst = values.mean(), values.max()
    return [f"{form.format(a)} ({form.format(b)})" for a, b in zip(means, worst, strict=True)]
