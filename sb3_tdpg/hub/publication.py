"""Read the content of a model card from the folder of a run or of rl-zoo3."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from stable_baselines3.common.monitor import get_monitor_files, load_results

from sb3_tdpg.callbacks import Candidate
from sb3_tdpg.common.provenance import as_typed, jsonable, with_numbers
from sb3_tdpg.common.trust import PlainLoader, plain_name, refuse_links, say_what_is_trusted
from sb3_tdpg.envs.scenarios import PAPER_ROWS, Scenario
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.evaluation.loading import load_model
from sb3_tdpg.experiments.rerun import scenarios_of
from sb3_tdpg.experiments.runs import read_progress


@dataclass(frozen=True, kw_only=True)
class Publication:
    """A trained policy, its evaluation, and how it was made."""

    model: Path  # the file that ``model.save`` wrote
    env_id: str
    method: str  # name of the method ("PG", "TDPG")
    seed: int  # training seed
    settings: Mapping[str, Any]  # hyperparameters in the form of a block of hyperparams/tdpg.yml
    records: pd.DataFrame  # evaluation episodes of this policy, from evaluate_scenarios
    scenarios: Sequence[Scenario]  # the scenarios of the records
    evaluated: datetime  # when the records were made
    progress: pd.DataFrame | None  # training log, see training_curves
    notes: Sequence[str]  # sentences about the training
    command: str | None  # the command that made the model
    again: str | None = None  # the command that repeats the training in the published folder
    how: Mapping[str, Any] | None  # provenance() at the time of the training
    files: Mapping[str, Path]  # additional files by their paths in the published folder
    metrics: Sequence[Path]  # files for train_eval_metrics.zip, which rl-zoo3 reads

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Keywords of the training environment."""
        return dict(self.settings.get("env_kwargs") or {})


def plain(value: Any) -> Any:
    """Convert a value to text, numbers (finite or infinite), lists and mappings, which YAML can contain."""
    return with_numbers(jsonable(value))


def read_publication(folder: Path, n_eval_episodes: int) -> Publication:
    """Read the folder of a run with :func:`read_run`, or evaluate a folder of rl-zoo3 with :func:`read_zoo_folder`."""
    refuse_links(folder)
    if (folder / "config.json").exists():
        try:
            return read_run(folder)
        except (AttributeError, KeyError, TypeError, json.JSONDecodeError) as e:
            raise ValueError(f"{folder / 'config.json'} does not describe a run ({e!r}): give a run's folder") from e
    if next(folder.glob("*/args.yml"), None) is not None:
        return read_zoo_folder(folder, n_eval_episodes)
    raise ValueError(
        f"{folder} holds no training: give the folder of one run, with config.json in it, or a folder that rl-zoo3 "
        "wrote, such as logs/tdpg/Lava-v0_1"
    )


def read_run(folder: Path) -> Publication:
    """Read the folder of a finished run; see :func:`~sb3_tdpg.experiments.runs.complete_run`."""
    if missing := [n for n in ("config.json", "model.zip", "episodes.csv") if not (folder / n).exists()]:
        raise ValueError(
            f"{folder} holds no finished run, since {', '.join(missing)} is missing: finish it with the command that "
            "started it, or give the folder of one run"
        )
    config = json.loads((folder / "config.json").read_text())
    settings, records = dict(with_numbers(config["settings"])), pd.read_csv(folder / "episodes.csv")
    files = {name: folder / name for name in ("config.json", "episodes.csv", "selected.json")}
    notes = [_selection_note(folder, settings)]
    if (attempts := int(records["attempts"].iloc[0])) > 1:
        notes.append(f"It comes from attempt {attempts} of at most {config['max_attempts']}, each with another seed.")
    start = config.get("start")
    if start is not None:
        start = plain_name(start, f"start of {folder / 'config.json'}")
        refuse_links(folder.parent / start)
        notes.append(f"The training started from the policy of another run, {start}.")
        files[f"{start}/model.zip"] = folder.parent / start / "model.zip"
    # A run cannot be repeated if its initial policy is missing, or if one of its settings is a class (the file
    # contains only the name of the class).
    has_class = "<class '" in json.dumps(config["settings"])
    is_repeatable = (start is None or files[f"{start}/model.zip"].exists()) and not has_class
    return Publication(
        model=folder / "model.zip",
        **{name: config[name] for name in ("env_id", "method", "seed")},
        records=records,
        scenarios=scenarios_of(config["scenarios"]),
        settings=settings,
        progress=read_progress(folder),
        notes=notes,
        command=_typed_command(config["provenance"]["command"]),
        again="sb3-tdpg rerun config.json again" if is_repeatable else None,
        how=config["provenance"],
        evaluated=datetime.fromtimestamp((folder / "episodes.csv").stat().st_mtime, timezone.utc),
        files={name: path for name, path in files.items() if path.exists()},
        metrics=sorted(folder.glob("progress_*.csv")),
    )


def read_zoo_folder(folder: Path, n_eval_episodes: int) -> Publication:
    """
    Read a folder that rl-zoo3's ``train`` wrote (``logs/tdpg/<environment>_<number>``), and evaluate its policy.

    The scenarios are the training environment and, if the paper has a table for it, the rows of this table except the
    first (the training). These rows keep the keywords of the training environment that they do not replace.

    :param n_eval_episodes: Number of episodes of each scenario.
    """
    inner = next(folder.glob("*/args.yml")).parent
    model_path = folder / f"{inner.name}.zip"
    if not model_path.exists():
        raise ValueError(f"{folder} has no {inner.name}.zip: let the training end first")
    args, settings = (_read_plain(inner / name) for name in ("args.yml", "config.yml"))
    if missing := {"env", "seed"} - set(args):
        raise ValueError(f"{inner / 'args.yml'} lacks {', '.join(sorted(missing))}: give a folder that rl-zoo3 wrote")
    if wrapped := [name for name in ("env_wrapper", "vec_env_wrapper") if settings.get(name)]:
        raise ValueError(
            f"{folder} was trained with {' and '.join(wrapped)}, and the evaluation for the card knows no wrappers: "
            "publish the model's file with huggingface_sb3.push_to_hub"
        )
    env_kwargs = settings["env_kwargs"] = args.get("env_kwargs") or settings.get("env_kwargs") or {}
    say_what_is_trusted(folder)
    env_id = str(args["env"])
    model = load_model(model_path, env_id, env_kwargs)
    # The table's first row is left out, because its keywords would replace those of the training.
    rows = [Scenario("Training", env_id), *PAPER_ROWS.get(env_id.rpartition(":")[2], ())[1:]]
    options: Any = dict(env_kwargs=env_kwargs, labels=dict(train_seed=args["seed"]))
    records = evaluate_scenarios({"TDPG": model}, rows, n_eval_episodes, **options)
    progress = None
    if get_monitor_files(str(folder)):  # compute the mean cost of each epoch from the log of episodes
        log = load_results(str(folder))
        # The length of an epoch is a number of episodes or a number of steps.
        done = log["l"].cumsum().to_numpy() if model.n_episodes is None else np.arange(1, len(log) + 1)
        size = model.n_episodes or model.epoch_size
        means = -log["r"].groupby((done - 1) // size).mean()[: done[-1] // size]
        progress = pd.DataFrame({"time/iterations": np.arange(1, len(means) + 1), "rollout/ep_cost_mean": means})
    # A finished training of our `train` saves the selected policy; rl-zoo3's `train` saves the last policy.
    is_ours = (folder / "run.json").exists()
    is_selected = is_ours and not (folder / "checkpoint.zip").exists()
    note = _selection_note(folder, settings) if is_selected else "The policy is the last one."
    files = {name: inner / name for name in ("args.yml", "config.yml", "command.txt") if (inner / name).exists()}
    return Publication(
        model=model_path,
        env_id=env_id,
        method="TDPG",
        seed=args["seed"],
        settings=settings,
        records=records,
        scenarios=rows,
        evaluated=datetime.now(timezone.utc),
        progress=progress,
        notes=["Trained with rl-zoo3.", note],
        command=_typed_command(files["command.txt"].read_text()) if "command.txt" in files else None,
        how=json.loads((folder / "run.json").read_text())["provenance"] if is_ours else None,
        files=files,
        metrics=sorted([*folder.glob("*.csv"), *folder.glob("evaluations.npz")]),
    )


def _read_plain(path: Path) -> dict[str, Any]:
    """Read a YAML file of rl-zoo3 without running code that it may contain."""
    with path.open() as file:
        return dict(yaml.load(file, PlainLoader))


def _typed_command(command: str) -> str | None:
    """Return a command as a user would type it, or ``None`` if it is empty or started a worker process."""
    if "multiprocessing" in command or not command.strip():
        return None
    return shlex.join(as_typed(shlex.split(command)))


def _selection_note(folder: Path, settings: Mapping[str, Any]) -> str:
    """Return a sentence that says which training epoch the policy comes from."""
    if (folder / "selected.json").exists():
        best = Candidate.from_json((folder / "selected.json").read_text())
        return f"The selection chose the policy of {best}, measured on the episodes of that epoch."
    if "SelectionCallback" in str(settings.get("callback")):
        return "No epoch met the limits of the selection, so the policy is the last one."
    return "The policy is the last one."
