"""The summary of a sweep over beta, in words and tables."""

from __future__ import annotations

from collections.abc import Mapping

import pandas as pd

from sb3_tdpg.common.provenance import provenance
from sb3_tdpg.paper.common import how_made, markdown_table


def sweep_summary(
    runs: pd.DataFrame,
    best: pd.Series | None,
    columns: Mapping[str, str],
    failures: Mapping[str, str],
    *,
    cost_limit: float,
    title: str,
    model_is_here: bool,
    tie: float,
) -> str:
    """
    Write the summary as Markdown.

    :param runs: ``runs.csv``, sorted.
    :param best: The selected row of it, if there is one.
    :param columns: Column of the mean cost, by scenario.
    :param failures: Why runs failed, by job.
    :param cost_limit: Of the selection.
    :param title: Name of the block.
    :param model_is_here: Whether the selected model lies in the folder of the summary.
    :param tie: Nats within which two runs know as little as each other.
    """
    below = int((runs["cost"] < cost_limit).sum())
    parts = [f"# Sweep over beta: {title}", _selection(best, cost_limit, below, len(runs), model_is_here, tie)]
    parts += ["![cost against information](sweep.png)", "## By beta"]
    by_beta = runs.groupby("label", sort=False)
    overview = pd.DataFrame(
        {
            "beta": list(by_beta.groups),
            "seeds": [str(n) for n in by_beta.size()],
            "cost: mean (worst)": _mean_and_worst(by_beta["cost"]),
            "information in nats: mean (most)": _mean_and_worst(by_beta["information"], "{:.2g}"),
            f"runs below {cost_limit:g}": [str((g["cost"] < cost_limit).sum()) for _, g in by_beta],
        }
    )
    parts.append(markdown_table(overview))
    if len(columns) > 1:
        table = pd.DataFrame(
            {"scenario": list(columns), **{f"beta {b}": _mean_and_worst(g[list(columns.values())]) for b, g in by_beta}}
        )
        parts += ["## Robustness", "Mean episode cost: mean over seeds (worst seed).", markdown_table(table)]
    shown = runs[["label", "seed", "cost", "std", "information", "information_lower", "met_block_limits"]]
    parts += [
        "## Every run",
        "Cost and its standard deviation over episodes; information in nats, summed over time, on fresh rollouts: the "
        "log-det bound from above, which the selection goes by, and a bound from below on what the encoder's input "
        "tells of the TRVs. Both are estimates from the same rollouts, the second one never above the first; on other "
        "rollouts both would be a little different. `met_block_limits`: whether an epoch met the limits of the block's "
        "own selection, if it has one; otherwise the model is that of the last epoch.",
        markdown_table(shown.rename(columns={"label": "beta"}), digits=4),
    ]
    if failures:
        parts += ["## Failed", "\n".join(f"- `{job}`: {reason}" for job, reason in failures.items())]
    parts.append(how_made("sb3-tdpg sweep", provenance(), []))
    return "\n\n".join(parts)


def _selection(best: pd.Series | None, cost_limit: float, below: int, n: int, is_here: bool, tie: float) -> str:
    if best is None:
        return f"**No run costs less than {cost_limit:g}, so that none is selected**: train longer or loosen the limit."
    where = "`selected.zip`" if is_here else f"not in this folder: `runs/{best['folder']}/model.zip` of its worker"
    return (
        f"**Selected: beta = {best['label']}, seed {best['seed']}** (cost {best['cost']:.4g}, information "
        f"{best['information']:.3g} nat; {where}). {below} of {n} runs are below a cost of {cost_limit:g}; of those "
        f"that know as little as the one with the least information, to within {tie:g} nat, it is the cheapest."
    )


def _mean_and_worst(values: pd.DataFrame, form: str = "{:.4g}") -> list[str]:
    means, worst = values.mean(), values.max()
    return [f"{form.format(a)} ({form.format(b)})" for a, b in zip(means, worst, strict=True)]
