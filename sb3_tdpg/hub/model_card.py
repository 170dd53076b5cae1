"""Write the model card: the results with intervals, how to use the model, how it was made, and metadata for the Hub."""

import math
import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from huggingface_hub import EvalResult, ModelCard, ModelCardData
from scipy import stats

from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.evaluation.tables import one_or_all, summary_table
from sb3_tdpg.hub.publication import Publication, plain

ALGORITHM = "tdpg"
TAGS = ("deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3", "sb3_tdpg")
LEVEL = 0.95  # confidence level of the intervals


def model_name(env_id: str) -> str:
    """Return the usual name of a model file and its repository, such as ``tdpg-Lava-v0`` for the id ``Lava-v0``."""
    return f"{ALGORITHM}-{env_id.rpartition(':')[2].replace('/', '-')}"


def results_with_intervals(records: pd.DataFrame) -> pd.DataFrame:
    """
    Summarise the episodes of one policy, with 95 % confidence intervals over episodes.

    :param records: From :func:`~sb3_tdpg.evaluation.evaluate_scenarios`.
    :return: a row for each scenario, the training environment first. To the columns of
        :func:`~sb3_tdpg.evaluation.summary_table` it adds the limits of the interval of the mean cost, ``low`` and
        ``high`` (Student's t). If the records have failures, it also adds the limits of the interval of the failure
        rate, ``failure_low`` and ``failure_high`` (Wilson)
    :raises ValueError: if a scenario has fewer than two episodes.
    """
    if records.empty or (records.groupby("scenario").size() < 2).any():
        raise ValueError("an interval needs at least 2 episodes of each scenario: evaluate more")
    table = summary_table(records)
    table = table.sort_values("scenario", key=lambda names: names != "Training", kind="stable", ignore_index=True)
    half = stats.t.ppf((1 + LEVEL) / 2, table["n"] - 1) * table["sem"]
    table = table.assign(low=table["mean"] - half, high=table["mean"] + half)
    if "failure_share" in table:
        pairs = zip(table["failure_share"], table["n"], strict=True)
        shares = [stats.binomtest(round(share * n), n).proportion_ci(LEVEL, "wilson") for share, n in pairs]
        table = table.assign(failure_low=[s.low for s in shares], failure_high=[s.high for s in shares])
    return table


def model_card(publication: Publication, results: pd.DataFrame, repo_id: str, names: Collection[str] = ()) -> ModelCard:
    """
    Make the model card of a repository, with the results of :func:`results_with_intervals`.

    As for any Stable-Baselines3 model, the metric is the mean reward, here the negative mean cost of an episode. The
    card mentions ``training.png`` and ``vec_normalize.pkl`` if ``names``, the files of the folder, contain them.
    """
    changes = {row.name: _changes(publication, row.env_kwargs) for row in publication.scenarios}
    task = "reinforcement-learning"
    rows: list[dict[str, str]] = []
    evaluations: list[EvalResult] = []
    for result in results.to_dict("records"):
        # The number of decimals shows two significant digits of the interval's half-width.
        half = (result["high"] - result["low"]) / 2
        digits = 2 if half == 0 else min(6, max(2, 1 - math.floor(math.log10(half))))
        mean, low, high, std = (f"{result[name]:.{digits}f}" for name in ("mean", "low", "high", "std"))
        row = {"Scenario": result["scenario"], "Keywords": changes.get(result["scenario"], "")}
        row |= {"Episodes": f"{result['n']:,}", "Mean cost [95 %]": f"{mean} [{low}, {high}]", "Std": std}
        if "failure_share" in result:
            shares = "{failure_share:.1%} [{failure_low:.1%}, {failure_high:.1%}]"
            row["Failures [95 %]"] = shares.format(**result)
        rows.append(row)
        evaluations.append(
            EvalResult(
                task_type=task,
                task_name=task,
                dataset_type=publication.env_id,
                dataset_name=publication.env_id,
                dataset_config=result["scenario"],
                metric_type="mean_reward",
                metric_name="mean_reward",
                metric_value=f"{-result['mean']:.{digits}f} +/- {std}",  # leaderboards split this text
            )
        )
    data = ModelCardData(
        library_name="stable-baselines3",
        pipeline_tag=task,
        tags=[publication.env_id, *TAGS],
        model_name=publication.method,
        eval_results=evaluations,
    )
    make_keywords = [f"{key}={value!r}" for key, value in plain(publication.env_kwargs).items()]
    card: ModelCard = ModelCard.from_template(
        data,
        template_path=str(Path(__file__).with_name("card.md")),
        publication=publication,
        table=markdown_table(rows, align="llr"),
        failures="failure_share" in results,
        deterministic=bool(results["deterministic"].all()),
        evaluation_seed=one_or_all(results["seed"]),
        names=names,
        repo_id=repo_id,
        file_name=f"{model_name(publication.env_id)}.zip",
        make_arguments=", ".join([repr(publication.env_id), *make_keywords]),
        settings=yaml.safe_dump(plain(publication.settings), sort_keys=False).strip(),
    )
    card.text = re.sub(r"\n{3,}", "\n\n", card.text) + "\n"  # false conditions of the template leave empty lines
    return card


def _changes(publication: Publication, env_kwargs: Any) -> str:
    """Return the keywords of a scenario that differ from those of the training environment."""
    training = plain(publication.env_kwargs)
    changes = {key: value for key, value in plain(env_kwargs).items() if value != training.get(key)}
    return ", ".join(f"`{k}={v:.4g}`" if isinstance(v, float) else f"`{k}={v}`" for k, v in changes.items())
