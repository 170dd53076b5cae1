"""What stands in a model card: results with intervals, use, how it was made, and the metadata that the Hub reads."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
import yaml

from sb3_tdpg.common.provenance import jsonable
from sb3_tdpg.evaluation.tables import one_or_all, summary_table
from sb3_tdpg.experiments.rerun import with_numbers
from sb3_tdpg.hub.publication import Publication

ALGORITHM = "tdpg"
TAGS = ("deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3", "sb3_tdpg")
LEVEL = 0.95  # of the intervals


def import_hub_extra() -> tuple[Any, Any]:
    """
    Return the modules ``huggingface_hub`` and ``scipy.stats``.

    :raises ImportError: if something is missing, with the extra that has it.
    """
    try:
        import huggingface_hub.errors  # a submodule that is not there of itself
        import matplotlib  # noqa: F401
        from scipy import stats
    except ImportError as e:
        raise ImportError(f"the Hugging Face Hub needs {e.name} here: pip install sb3_tdpg[hub]") from e
    return huggingface_hub, stats


def model_name(env_id: str) -> str:
    """
    Name a model and its repository as Stable-Baselines3's are: ``tdpg-Lava-v0``.

    :param env_id: A registered id, also in the ``module:id`` form.
    """
    return f"{ALGORITHM}-{env_id.rpartition(':')[2].replace('/', '-')}"


def results_with_intervals(records: pd.DataFrame) -> pd.DataFrame:
    """
    Summarise the episodes of one policy, with 95 % confidence intervals over episodes.

    :param records: From :func:`~sb3_tdpg.evaluation.evaluate_scenarios`.
    :return: a row for each scenario, the one of the training first: the columns of
        :func:`~sb3_tdpg.evaluation.summary_table`, ``low`` and ``high`` of the mean cost (Student's t) and, if the
        records tell of failures, ``failure_low`` and ``failure_high`` of their share (Wilson)
    :raises ValueError: if the records are of several policies, or there are fewer than two episodes of a scenario.
    """
    _, stats = import_hub_extra()
    for column in ("model", "train_seed", "deterministic"):
        if column in records and records[column].nunique() > 1:
            raise ValueError(
                f"a model card is of one policy, and the records are of {column} {records[column].unique().tolist()}: "
                "select the rows of one"
            )
    if records.empty or (records.groupby("scenario").size() < 2).any():
        raise ValueError("an interval needs at least 2 episodes of each scenario: evaluate more")
    table = summary_table(records)
    table = table.sort_values("scenario", key=lambda names: names != "Training", kind="stable", ignore_index=True)
    half = stats.t.ppf((1 + LEVEL) / 2, table["n"] - 1) * table["sem"]
    table = table.assign(low=table["mean"] - half, high=table["mean"] + half)
    if "failure_share" in table:
        failures = (table["failure_share"] * table["n"]).round().astype(int)
        shares = [
            stats.binomtest(k, n).proportion_ci(LEVEL, "wilson") for k, n in zip(failures, table["n"], strict=True)
        ]
        table = table.assign(failure_low=[s.low for s in shares], failure_high=[s.high for s in shares])
    return table


def card_metadata(publication: Publication, results: pd.DataFrame) -> Any:
    """
    Return what programs read from the card, a ``huggingface_hub.ModelCardData``.

    As of any Stable-Baselines3 model, its metric is the mean reward, the negative cost; the first result is that of the
    training environment.

    :param publication: What is published.
    :param results: From :func:`results_with_intervals`.
    """
    hub, _ = import_hub_extra()
    task = "reinforcement-learning"
    evaluations = [
        hub.EvalResult(
            task_type=task,
            task_name=task,
            dataset_type=publication.env_id,
            dataset_name=publication.env_id,
            dataset_config=row.scenario,
            metric_type="mean_reward",
            metric_name="mean_reward",
            # This text is what leaderboards split.
            metric_value=f"{-row.mean:.{_digits(row)}f} +/- {row.std:.{_digits(row)}f}",
        )
        for row in results.itertuples(index=False)
    ]
    return hub.ModelCardData(
        library_name="stable-baselines3",
        pipeline_tag=task,
        tags=[publication.env_id, *TAGS],
        model_name=publication.method,
        eval_results=evaluations,
    )


def results_markdown(publication: Publication, results: pd.DataFrame) -> str:
    """
    Write the results as a Markdown table, with a line that says what the numbers are.

    :param publication: What is published.
    :param results: From :func:`results_with_intervals`.
    """
    with_failures = "failure_share" in results
    changes = {row.name: _changes(row.env_kwargs, publication.env_kwargs) for row in publication.scenarios}
    header = ["Scenario", "Keywords", "Episodes", "Mean cost [95 %]", "Std"] + ["Failures [95 %]"] * with_failures
    lines = [_line(header), _line(["---", "---", "---:", "---:", "---:"] + ["---:"] * with_failures)]
    for row in results.itertuples(index=False):
        digits = _digits(row)
        cells = [row.scenario, changes.get(row.scenario, ""), f"{row.n:,}"]
        cells += [f"{row.mean:.{digits}f} [{row.low:.{digits}f}, {row.high:.{digits}f}]", f"{row.std:.{digits}f}"]
        if with_failures:
            cells.append(f"{row.failure_share:.1%} [{row.failure_low:.1%}, {row.failure_high:.1%}]")
        lines.append(_line(cells))
    policy = "Deterministic" if results["deterministic"].all() else "Stochastic"
    footer = (
        "The cost of an episode is its negative return. Intervals are over the evaluation episodes of this one policy, "
        "not over training seeds: Student's t for the mean"
        + (", Wilson's for shares" if with_failures else "")
        + f". Std is over episodes. {policy} policy, evaluation seed {one_or_all(results['seed'])}. "
        "Every episode is in [episodes.csv](episodes.csv)."
    )
    return "\n".join([*lines, "", footer])


def card_text(publication: Publication, results: pd.DataFrame, repo_id: str, pictures: Sequence[str]) -> str:
    """
    Write the card below its metadata.

    :param publication: What is published.
    :param results: From :func:`results_with_intervals`.
    :param repo_id: Where it will be.
    :param pictures: Which of ``training.png`` and ``replay.mp4`` there are.
    """
    env_id, method = publication.env_id, publication.method
    parts = [
        f"# **{method}** on **{env_id}**",
        f"A policy for `{env_id}` that was trained by Task-Driven Policy Gradient (`sb3_tdpg`), an algorithm for "
        "[Stable-Baselines3](https://github.com/DLR-RM/stable-baselines3): it sees the world through task-relevant "
        "variables, and what they tell of the state has a price, unless `beta` is infinite.",
        "## Results",
        results_markdown(publication, results),
        "## Training",
        " ".join(publication.notes),
        "![The training, epoch by epoch](training.png)" if "training.png" in pictures else "",
        "Episodes of it: [replay.mp4](replay.mp4)." if "replay.mp4" in pictures else "",
        "## Use",
        _use(publication, repo_id),
        "## How it was made",
        _how_made(publication),
        "The settings, which are those of `config.yml`:",
        f"```yaml\n{yaml.safe_dump(plain(publication.settings), sort_keys=False).strip()}\n```",
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _use(publication: Publication, repo_id: str) -> str:
    keywords = ", ".join([repr(publication.env_id), *(f"{k}={v!r}" for k, v in plain(publication.env_kwargs).items())])
    code = f"""\
import gymnasium as gym

from sb3_tdpg.hub import load_from_hub

# A model is unpickled, which can run any code: do so only with what you trust.
model = load_from_hub("{repo_id}", "{model_name(publication.env_id)}.zip", trust_remote_code=True)
env = gym.make({keywords})

observation, _ = env.reset(seed=0)
memory, is_over, cost = None, False, 0.0
while not is_over:
    action, memory = model.predict(observation, memory)
    observation, reward, terminated, truncated, _ = env.step(action)
    cost -= float(reward)
    is_over = terminated or truncated
print(f"cost {{cost:.2f}}")"""
    parts = [
        f"```python\n{code}\n```",
        "The memory of one step goes into the next; `None` begins an episode. The policy is stochastic: with "
        "`deterministic=True` it is another one.",
    ]
    if "vec_normalize.pkl" in publication.files:
        parts.append(
            "It was trained on normalised observations: wrap a vectorised environment in "
            "`VecNormalize.load('vec_normalize.pkl', env)` and set its `training` to `False`."
        )
    return "\n\n".join(parts)


def _how_made(publication: Publication) -> str:
    parts = []
    if publication.command is not None:
        parts.append(f"By this command:\n\n```bash\n{publication.command}\n```")
    if publication.again is not None:
        parts.append(
            "To make it again, in a copy of this repository; with the versions below the numbers are the same:\n\n"
            f"```bash\n{publication.again}\n```"
        )
    facts = [] if publication.seed is None else [f"- training seed: {publication.seed}"]
    if publication.how is not None:
        git = publication.how["git"]
        changed = "" if git is None or not git["dirty"] else ", with uncommitted changes"
        versions = ", ".join(f"{name} {version}" for name, version in publication.how["versions"].items() if version)
        facts += [f"- commit: {git['commit']}{changed}"] if git is not None else []
        facts += [f"- versions: {versions}", f"- platform: {publication.how['platform']}"]
        facts += [f"- begun: {publication.how['utc_time']}"] if "utc_time" in publication.how else []
    return "\n\n".join([*parts, "\n".join(facts)])


def plain(value: Any) -> Any:
    """Turn a value into what YAML can hold: text, numbers (also infinite ones), lists, mappings."""
    return with_numbers(jsonable(value))


def _changes(env_kwargs: Mapping[str, Any], training: Mapping[str, Any]) -> str:
    """Say in what a scenario differs from the training environment."""
    differ = {key: value for key, value in plain(env_kwargs).items() if value != plain(training).get(key)}
    return ", ".join(
        f"`{key}={value:.4g}`" if isinstance(value, float) else f"`{key}={value}`" for key, value in differ.items()
    )


def _digits(row: Any) -> int:
    """Return digits behind the point so that the interval's half-width has two that count."""
    half = (row.high - row.low) / 2
    return 2 if half == 0 else min(6, max(2, 1 - math.floor(math.log10(half))))


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"
