"""A trained policy and all that is to be told of it: from a run's folder, from one of rl-zoo3, or by hand."""

from __future__ import annotations

import json
import shlex
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import yaml
from stable_baselines3.common.monitor import get_monitor_files, load_results
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg.common.provenance import as_typed
from sb3_tdpg.envs.scenarios import PAPER_ROWS, Scenario
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.experiments.rerun import scenarios_of, with_numbers
from sb3_tdpg.experiments.runs import read_progress
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.vec_env import make_episodes_env


@dataclass(frozen=True, kw_only=True)
class Publication:
    """
    A policy, how it did, and how it was made.

    :param model: The model, or the file that ``model.save`` wrote.
    :param env_id: The training environment.
    :param records: Episodes of this one policy, from :func:`~sb3_tdpg.evaluation.evaluate_scenarios`.
    :param scenarios: The rows of the records, for their keywords.
    :param method: What the policy's method is called ("PG", "TDPG").
    :param settings: Hyperparameters, as a block of ``hyperparams/tdpg.yml``; ``env_kwargs`` are the keywords of the
        training environment.
    :param seed: Training seed.
    :param progress: Training log, see :func:`~sb3_tdpg.evaluation.training_curves`.
    :param notes: Sentences on the training.
    :param command: The command that made it.
    :param again: The command that makes it again, in the folder that is published.
    :param how: From :func:`~sb3_tdpg.common.provenance.provenance`, of the training.
    :param evaluated: When the records were made.
    :param files: What else is published: the path in the folder, and where the file lies.
    :param metrics: Files for the zoo's ``train_eval_metrics.zip``.
    """

    model: TDPG | Path
    env_id: str
    records: pd.DataFrame
    scenarios: Sequence[Scenario] = ()
    method: str = "TDPG"
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None
    progress: pd.DataFrame | None = None
    notes: Sequence[str] = ()
    command: str | None = None
    again: str | None = None
    how: Mapping[str, Any] | None = None
    evaluated: datetime = field(default_factory=lambda: datetime.now(timezone.utc))
    files: Mapping[str, Path] = field(default_factory=dict)
    metrics: Sequence[Path] = ()

    @property
    def env_kwargs(self) -> dict[str, Any]:
        """Keywords of the training environment."""
        return dict(self.settings.get("env_kwargs") or {})


def read_publication(folder: Path, **evaluation: Any) -> Publication:
    """
    Read a run's folder (:func:`read_run`) or one of rl-zoo3 (:func:`read_zoo_folder`), whichever it is.

    :param folder: The folder.
    :param evaluation: Of what was not evaluated yet; see :func:`read_zoo_folder`.
    :raises ValueError: if it is neither.
    """
    if (folder / "config.json").exists():
        return read_run(folder)
    if next(folder.glob("*/args.yml"), None) is not None:
        return read_zoo_folder(folder, **evaluation)
    raise ValueError(
        f"{folder} holds no training: give the folder of one run, with config.json in it, or a folder that rl-zoo3 "
        "wrote, such as logs/tdpg/Lava-v0_1"
    )


def read_run(folder: Path) -> Publication:
    """
    Read the folder of a run, see :func:`~sb3_tdpg.experiments.runs.complete_run`.

    :raises ValueError: if the run is not finished.
    """
    if missing := [n for n in ("config.json", "model.zip", "episodes.csv") if not (folder / n).exists()]:
        raise ValueError(
            f"{folder} holds no finished run, since {', '.join(missing)} is missing: complete it with the command that "
            "began it, or give the folder of one run"
        )
    config = json.loads((folder / "config.json").read_text())
    settings = with_numbers(config["settings"])
    files = {name: folder / name for name in ("config.json", "episodes.csv", "selected.json")}
    records = pd.read_csv(folder / "episodes.csv")
    notes = [_selection_note(folder, settings)]
    if (attempts := int(records["attempts"].iloc[0])) > 1:
        notes.append(f"It comes from attempt {attempts} of at most {config['max_attempts']}, each from another seed.")
    start = config.get("start")
    if start is not None:
        notes.append(f"The training started from the policy of another run, {start}.")
        files[f"{start}/model.zip"] = folder.parent / start / "model.zip"
    files = {name: path for name, path in files.items() if path.exists()}
    # Runs of early versions lack the keywords of their scenarios.
    is_whole = "scenarios" in config and (start is None or f"{start}/model.zip" in files)
    return Publication(
        model=folder / "model.zip",
        env_id=config["env_id"],
        records=records,
        scenarios=scenarios_of(config) if "scenarios" in config else (),
        method=config["method"],
        settings=settings,
        seed=config["seed"],
        progress=read_progress(folder),
        notes=notes,
        command=_told_command(config["provenance"]["command"]),
        again="python -m sb3_tdpg.experiments.rerun config.json again" if is_whole else None,
        how=config["provenance"],
        evaluated=datetime.fromtimestamp((folder / "episodes.csv").stat().st_mtime, timezone.utc),
        files=files,
        metrics=sorted(folder.glob("progress_*.csv")),
    )


def read_zoo_folder(
    folder: Path,
    *,
    scenarios: Sequence[Scenario] | None = None,
    n_eval_episodes: int = 1000,
    seed: int = 0,
    progress_bar: bool = False,
) -> Publication:
    """
    Read what rl-zoo3's ``train`` left (``logs/tdpg/<environment>_<number>``), and evaluate its policy.

    That is the policy of the end of the training or, where there is none, ``best_model.zip``.

    :param folder: The folder.
    :param scenarios: What to evaluate; default: the rows of the paper's table, and where the environment has none, the
        training environment. Keywords of the training environment apply beneath those of a row.
    :param n_eval_episodes: Episodes of each.
    :param seed: Seed of the evaluation.
    :param progress_bar: Show a progress bar.
    :raises ValueError: if there is no policy.
    """
    inner = next(folder.glob("*/args.yml")).parent
    candidates = {
        folder / f"{inner.name}.zip": "of the end of the training",
        folder / "best_model.zip": "that did best in it",
    }
    model_path = next((path for path in candidates if path.exists()), None)
    if model_path is None:
        raise ValueError(f"{folder} has neither {' nor '.join(p.name for p in candidates)}: let the training end first")
    # As the zoo itself reads it. It is the user's own, and the model is unpickled, too.
    args, settings = (dict(yaml.load((inner / n).read_text(), yaml.UnsafeLoader)) for n in ("args.yml", "config.yml"))
    settings["env_kwargs"] = args.get("env_kwargs") or settings.get("env_kwargs") or {}
    env_id, env = str(args["env"]), None
    normalize = inner / "vecnormalize.pkl"
    if normalize.exists():
        env = VecNormalize.load(str(normalize), make_episodes_env(env_id, 1, env_kwargs=settings["env_kwargs"]))
    model = TDPG.load(model_path, env=env, device="cpu")
    rows = PAPER_ROWS.get(env_id, [Scenario("Training", env_id)]) if scenarios is None else scenarios
    records = evaluate_scenarios(
        {"TDPG": model},
        rows,
        n_eval_episodes,
        seed=seed,
        env_kwargs=settings["env_kwargs"],
        labels=dict(train_seed=args["seed"]),
        progress_bar=progress_bar,
    )
    files = {
        "args.yml": inner / "args.yml",
        "config.yml": inner / "config.yml",
        "command.txt": inner / "command.txt",
        "vec_normalize.pkl": normalize,
    }
    return Publication(
        model=model_path,
        env_id=env_id,
        records=records,
        scenarios=rows,
        settings=settings,
        seed=args["seed"],
        progress=_monitored_progress(folder, model.n_episodes),
        notes=_zoo_notes(folder, settings, model_path, candidates[model_path]),
        command=_told_command((inner / "command.txt").read_text()) if (inner / "command.txt").exists() else None,
        how=_zoo_provenance(folder, model_path),
        files={name: path for name, path in files.items() if path.exists()},
        metrics=sorted([*folder.glob("*.csv"), *folder.glob("evaluations.npz")]),
    )


def _told_command(command: str) -> str | None:
    """Return a command as a user would type it; ``None`` for that of a worker process, which tells nothing."""
    if "multiprocessing" in command or not command.strip():
        return None
    return shlex.join(as_typed(shlex.split(command)))


def _zoo_notes(folder: Path, settings: Mapping[str, Any], model_path: Path, which: str) -> list[str]:
    """Say which policy it is. Our ``train`` puts the selected one in the place of the last one when it is finished."""
    is_finished = (folder / "run.json").exists() and not (folder / "checkpoint.zip").exists()
    if is_finished and model_path.name != "best_model.zip":
        return ["Trained with rl-zoo3.", _selection_note(folder, settings)]
    return [f"Trained with rl-zoo3; the policy is the one {which}."]


def _zoo_provenance(folder: Path, model_path: Path) -> dict[str, Any]:
    """Return what our ``train`` has recorded; of the zoo's own only what SB3 saves of the machine with a model."""
    if (folder / "run.json").exists():
        how: dict[str, Any] = json.loads((folder / "run.json").read_text())["provenance"]
        return how
    with zipfile.ZipFile(model_path) as archive:
        lines = archive.read("system_info.txt").decode().splitlines()
    versions = dict(line.removeprefix("- ").split(": ", 1) for line in lines if line.startswith("- ") and ": " in line)
    return dict(versions=versions, platform=versions.pop("OS", "unknown"), git=None)


def _selection_note(folder: Path, settings: Mapping[str, Any]) -> str:
    """Say which epoch's policy it is."""
    path = folder / "selected.json"
    if path.exists():
        best = json.loads(path.read_text())
        return (
            f"The policy is that of epoch {best['epoch']}, which the selection chose: mean cost {best['cost']:.4g}, "
            f"information {best['information']:.3g} nat, both on the epoch's own episodes."
        )
    if "SelectionCallback" in str(settings.get("callback")):
        return "No epoch met the limits of the selection: the policy is that of the last one."
    return "The policy is that of the last epoch."


def _monitored_progress(folder: Path, n_episodes: int) -> pd.DataFrame | None:
    """Return the mean cost of each epoch by what SB3's monitor wrote of its episodes."""
    if not get_monitor_files(str(folder)):
        return None
    costs = -load_results(str(folder))["r"].to_numpy()
    epochs = costs[: len(costs) // n_episodes * n_episodes].reshape(-1, n_episodes)
    return pd.DataFrame({"time/iterations": np.arange(1, len(epochs) + 1), "rollout/ep_cost_mean": epochs.mean(axis=1)})
