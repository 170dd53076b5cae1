"""
Models go to the Hugging Face Hub and come from it, as those of Stable-Baselines3 do.

By convention a repository is ``<organization>/tdpg-<environment>`` and the model in it ``tdpg-<environment>.zip``. The
files that rl-zoo3's ``load_from_hub`` asks for lie beside it.
"""

from __future__ import annotations

import json
import os
import shutil
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pandas as pd
import yaml
from stable_baselines3.common.type_aliases import GymEnv

from sb3_tdpg.common.provenance import write_frame_atomically, write_run_config
from sb3_tdpg.evaluation import save_figure, training_curves
from sb3_tdpg.evaluation.enjoy import enjoy
from sb3_tdpg.hub.model_card import (
    ALGORITHM,
    card_metadata,
    card_text,
    import_hub_extra,
    model_name,
    plain,
    results_with_intervals,
)
from sb3_tdpg.hub.publication import Publication, read_publication
from sb3_tdpg.tdpg import TDPG

NOT_ALWAYS = ("command.txt", "replay.mp4", "selected.json", "training.png", "vec_normalize.pkl")
"""What the folder of some models has and that of others has not."""


def write_model_card(
    source: str | os.PathLike[str] | Publication,
    out: str | os.PathLike[str],
    repo_id: str,
    *,
    film_episodes: int = 0,
    **evaluation: Any,
) -> Path:
    """
    Write a folder that is ready for :func:`push_to_hub`.

    It has what people and programs look for in a Stable-Baselines3 model on the Hub: ``README.md`` with metadata,
    ``tdpg-<environment>.zip``, ``config.yml``, ``args.yml``, ``env_kwargs.yml``, ``results.json`` (of the training
    environment) and ``train_eval_metrics.zip``; and ``episodes.csv``, ``config.json`` and ``training.png``.
    The folder is there only when all is written.

    :param source: A run's folder, a folder of rl-zoo3 (its policy is evaluated now), or a publication.
    :param out: The folder; it must not exist, or be empty.
    :param repo_id: Where it will be: ``organization/name``.
    :param film_episodes: Episodes to show in ``replay.mp4``, which the Hub plays beside the card; 0: no film.
    :param evaluation: For a folder of rl-zoo3, see ``sb3_tdpg.hub.publication.read_zoo_folder``.
    :return: ``out``
    :raises ValueError: if ``out`` holds something, the source is not finished, or the records are not those of one
        policy, with two or more episodes of each scenario.
    :raises ImportError: without the extra ``hub``.
    """
    import_hub_extra()
    out = Path(out)
    _check_empty(out)
    publication = source if isinstance(source, Publication) else read_publication(Path(source), **evaluation)
    results = results_with_intervals(publication.records)
    if not isinstance(publication.model, TDPG):
        TDPG.load(publication.model, device="cpu")  # a damaged file is refused
    partial = out.with_name(out.name + ".partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    _write_folder(publication, results, partial, repo_id, film_episodes)
    if out.exists():
        out.rmdir()
    partial.rename(out)
    return out


def push_to_hub(
    folder: str | os.PathLike[str],
    repo_id: str,
    *,
    private: bool | None = None,
    commit_message: str = "Model, card and records",
    token: str | None = None,
) -> str:
    """
    Upload what :func:`write_model_card` wrote; the repository is made if there is none.

    :param folder: The folder.
    :param repo_id: ``organization/name``.
    :param private: Whether a new repository is private; default: as the organization has it.
    :param commit_message: For the repository's history.
    :param token: Default: the one that ``hf auth login`` has stored, or that of the variable ``HF_TOKEN``.
    :return: the repository's address
    :raises ValueError: if the folder has no model card, or the Hub does not take it.
    :raises ImportError: without the extra ``hub``.
    """
    hub, _ = import_hub_extra()
    folder = Path(folder)
    if not (folder / "README.md").exists():
        raise ValueError(f"{folder} has no README.md: let write_model_card write the folder first")
    api = hub.HfApi(token=token, library_name="sb3_tdpg")
    with _told_in_one_line(repo_id, "written", f"{folder} is still there to be pushed again"):
        url = api.create_repo(repo_id, private=private, exist_ok=True)
        api.upload_folder(
            repo_id=repo_id,
            folder_path=folder,
            commit_message=commit_message,
            delete_patterns=list(NOT_ALWAYS),  # those of an earlier model would be taken for this one's
        )
    return str(url)


def load_from_hub(
    repo_id: str,
    filename: str | None = None,
    env: GymEnv | None = None,
    *,
    revision: str | None = None,
    token: str | None = None,
    trust_remote_code: bool | None = None,
    **kwargs: Any,
) -> TDPG:
    """
    Download a model, unless that was done before, and load it.

    :param repo_id: ``organization/name``.
    :param filename: The model in it; default: the only ``tdpg-*.zip``.
    :param env: As of :meth:`TDPG.load <sb3_tdpg.TDPG.load>`.
    :param revision: A branch, tag or commit; default: the newest.
    :param token: For a private repository; default: as of :func:`push_to_hub`.
    :param trust_remote_code: Whether to unpickle what was downloaded, which can run any code. Default: whether the
        variable ``TRUST_REMOTE_CODE`` is set, which is what ``huggingface_sb3`` asks for.
    :param kwargs: As of :meth:`TDPG.load <sb3_tdpg.TDPG.load>`.
    :raises ValueError: without that trust, if there is no such model, or it is none of TDPG.
    :raises ImportError: without the extra ``hub``.
    """
    hub, _ = import_hub_extra()
    if trust_remote_code is None:
        trust_remote_code = os.environ.get("TRUST_REMOTE_CODE", "").lower() in ("1", "true", "yes", "y", "on", "t")
    if not trust_remote_code:
        raise ValueError(
            f"to load {repo_id} is to unpickle it, which can run any code: if you trust who made it, give "
            "trust_remote_code=True, or set the variable TRUST_REMOTE_CODE=True"
        )
    with _told_in_one_line(repo_id, "read"):
        if filename is None:
            files = hub.HfApi(token=token).list_repo_files(repo_id, revision=revision)
            filename = _only_model(repo_id, files)
        path = hub.hf_hub_download(repo_id, filename, revision=revision, token=token, library_name="sb3_tdpg")
    return TDPG.load(path, env=env, **kwargs)


def pull_from_hub(
    repo_id: str, out: str | os.PathLike[str], *, revision: str | None = None, token: str | None = None
) -> Path:
    """
    Download a repository; nothing in it is run or unpickled.

    :param repo_id: ``organization/name``.
    :param out: The folder; it must not exist, or be empty.
    :param revision: A branch, tag or commit; default: the newest.
    :param token: For a private repository; default: as of :func:`push_to_hub`.
    :return: ``out``
    :raises ValueError: if ``out`` holds something, or there is no such repository.
    :raises ImportError: without the extra ``hub``.
    """
    hub, _ = import_hub_extra()
    out = Path(out)
    _check_empty(out)
    with _told_in_one_line(repo_id, "read"):
        hub.snapshot_download(repo_id, revision=revision, local_dir=out, token=token, library_name="sb3_tdpg")
    return out


def _check_empty(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ValueError(f"{out} exists already: choose another folder, or remove it")


def _only_model(repo_id: str, files: Iterable[str]) -> str:
    # Not in a folder: there lies what a run started from.
    models = [name for name in files if "/" not in name and fnmatch(name, f"{ALGORITHM}-*.zip")]
    if len(models) != 1:
        found = f"several models ({', '.join(models)})" if models else f"no {ALGORITHM}-*.zip"
        raise ValueError(f"{repo_id} has {found}: give filename")
    return models[0]


def _write_folder(publication: Publication, results: pd.DataFrame, out: Path, repo_id: str, film_episodes: int) -> None:
    model_path = out / f"{model_name(publication.env_id)}.zip"
    if isinstance(publication.model, TDPG):
        publication.model.save(model_path)
    else:
        shutil.copyfile(publication.model, model_path)
    _write_files(publication, results, out)
    if publication.progress is not None:
        figure = training_curves({publication.method: publication.progress})
        if "mi/total" not in publication.progress:
            figure.axes[1].set_axis_off()  # nothing is drawn in it
        save_figure(figure, out / "training.png")
    if film_episodes:
        film = out / "replay.mp4"
        enjoy(model_path, publication.env_id, publication.env_kwargs, n_episodes=film_episodes, record=film)
    metadata = card_metadata(publication, results).to_yaml()
    text = card_text(publication, results, repo_id, [path.name for path in out.iterdir()])
    (out / "README.md").write_text(f"---\n{metadata}\n---\n\n{text}", encoding="utf-8")


def _write_files(publication: Publication, results: pd.DataFrame, out: Path) -> None:
    """Write what programs read."""
    for name, path in publication.files.items():
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, out / name)
    env_kwargs, settings = plain(publication.env_kwargs), plain(publication.settings)
    args = dict(algo=ALGORITHM, env=publication.env_id, env_kwargs=env_kwargs, seed=publication.seed)
    for name, content in (("config.yml", settings), ("args.yml", args), ("env_kwargs.yml", env_kwargs)):
        if name not in publication.files:
            (out / name).write_text(yaml.safe_dump(content, sort_keys=False))
    training = results.iloc[0]
    zoo_results = dict(
        mean_reward=-float(training["mean"]),
        std_reward=float(training["std"]),
        is_deterministic=bool(training["deterministic"]),
        n_eval_episodes=int(training["n"]),
        eval_datetime=publication.evaluated.isoformat(timespec="seconds"),
    )
    (out / "results.json").write_text(json.dumps(zoo_results, indent=2) + "\n")
    with zipfile.ZipFile(out / "train_eval_metrics.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for path in publication.metrics:
            archive.write(path, path.name)
    if "episodes.csv" not in publication.files:
        write_frame_atomically(publication.records, out / "episodes.csv")
    if "config.json" not in publication.files:
        rows = [dict(name=row.name, env_id=row.env_id, env_kwargs=row.env_kwargs) for row in publication.scenarios]
        config = dict(
            method=publication.method,
            env_id=publication.env_id,
            seed=publication.seed,
            settings=publication.settings,
            n_eval_episodes=int(training["n"]),
            scenarios=rows,
        )
        write_run_config(out / "config.json", config)


@contextmanager
def _told_in_one_line(repo_id: str, action: str, comfort: str = "") -> Iterator[None]:
    """Turn what goes wrong on the way to the Hub into a ``ValueError`` that says what to do."""
    hub, _ = import_hub_extra()
    try:
        yield
    except (OSError, hub.errors.HTTPError) as e:
        status = getattr(getattr(e, "response", None), "status_code", None)
        if status in (401, 403, 404) or isinstance(e, hub.errors.LocalTokenNotFoundError):
            advice = "see that the name is right, and log in with `hf auth login` or set HF_TOKEN to a token that may"
        else:
            advice = "; ".join(filter(None, ("try again when the Hub can be reached", comfort)))
        reason = next((line.strip() for line in str(e).splitlines() if line.strip()), type(e).__name__)
        raise ValueError(f"{repo_id} cannot be {action} ({reason}): {advice}") from e
