"""Write a folder with a model and the files that rl-zoo3 needs; upload it to the Hugging Face Hub and download it."""

import json
import os
import shutil
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import huggingface_hub
import pandas as pd
import yaml
from huggingface_hub.errors import HTTPError, LocalTokenNotFoundError
from stable_baselines3.common.type_aliases import GymEnv

from sb3_tdpg.common.files import replaced_atomically
from sb3_tdpg.common.provenance import write_frame_atomically
from sb3_tdpg.common.trust import refuse_links
from sb3_tdpg.evaluation import save_figure, training_curves
from sb3_tdpg.evaluation.loading import statistics_beside
from sb3_tdpg.hub.model_card import ALGORITHM, model_card, model_name, results_with_intervals
from sb3_tdpg.hub.publication import Publication, plain, read_publication
from sb3_tdpg.tdpg import TDPG

LIBRARY: Any = dict(library_name="sb3_tdpg")  # for the statistics of the Hub
# Files that only some models have. An upload deletes them first, so that no file of an earlier model remains.
OPTIONAL_FILES = ["command.txt", "config.json", "replay.mp4", "selected.json", "training.png", "vec_normalize.pkl"]


def write_model_card(
    source: str | os.PathLike[str],
    out: str | os.PathLike[str],
    repo_id: str,
    *,
    n_eval_episodes: int = 1000,
) -> Path:
    """
    Write a folder with a model, its card and its records, ready for :func:`push_to_hub`.

    The folder has the files of a Stable-Baselines3 model on the Hub (``results.json`` is for the training environment),
    and also ``episodes.csv`` and, if there is a training log, ``training.png``. It appears only when all its files are
    complete. If you add a video ``replay.mp4`` (``sb3-tdpg enjoy --record``), the Hub plays it beside the card.

    :param source: The folder of a run, or a folder of rl-zoo3 (whose policy is evaluated now).
    :param out: The folder to write, which must not exist yet.
    :param repo_id: The repository for which the folder is made: ``organization/name``.
    :param n_eval_episodes: Number of evaluation episodes of each scenario, for a folder of rl-zoo3.
    :return: ``out``
    :raises ValueError: if ``out`` exists, the source is not finished, or a scenario has fewer than two episodes.
    """
    out = _new(out)
    publication = read_publication(Path(source), n_eval_episodes)
    results = results_with_intervals(publication.records)
    with replaced_atomically(out) as folder:
        folder.mkdir()
        model_path = folder / f"{model_name(publication.env_id)}.zip"
        shutil.copyfile(publication.model, model_path)
        if (beside := statistics_beside(publication.model)) is not None:
            shutil.copyfile(beside, folder / "vec_normalize.pkl")
        _write_records(publication, results, folder)
        if publication.progress is not None:
            figure = training_curves({publication.method: publication.progress})
            if "mi/total" not in publication.progress:
                figure.axes[1].set_axis_off()  # this panel has no curve
            save_figure(figure, folder / "training.png")
        names = [path.name for path in folder.iterdir()]
        model_card(publication, results, repo_id, names).save(folder / "README.md")
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
    Upload a folder that :func:`write_model_card` wrote. The repository is created if it does not exist.

    :param folder: The folder to upload.
    :param repo_id: ``organization/name``.
    :param private: Whether a new repository is private; default: the default of the organization.
    :param commit_message: Commit message for the history of the repository.
    :param token: Access token; default: the token that ``hf auth login`` stored, or the environment variable
        ``HF_TOKEN``.
    :return: the address of the repository
    :raises ValueError: if the folder has no model card, or the upload fails.
    """
    folder = Path(folder)
    if not (folder / "README.md").exists():
        raise ValueError(f"{folder} has no README.md: let write_model_card write the folder first")
    refuse_links(folder)
    api = huggingface_hub.HfApi(token=token, **LIBRARY)
    with _one_line_errors(repo_id, "written", f"; {folder} can be pushed again"):
        url = api.create_repo(repo_id, private=private, exist_ok=True)
        options: Any = dict(commit_message=commit_message, delete_patterns=OPTIONAL_FILES)
        api.upload_folder(repo_id=repo_id, folder_path=folder, **options)
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
    Load a model from the Hub; download it if it is not in the cache.

    :param repo_id: ``organization/name``.
    :param filename: The model file in the repository; default: the only ``tdpg-*.zip``.
    :param env: See :meth:`TDPG.load <sb3_tdpg.TDPG.load>`.
    :param revision: A branch, tag or commit; default: the newest commit.
    :param token: Access token for a private repository; default: see :func:`push_to_hub`.
    :param trust_remote_code: Whether to unpickle the download, which can run any code. Default: whether the
        environment variable ``TRUST_REMOTE_CODE`` is set, as in ``huggingface_sb3``.
    :param kwargs: See :meth:`TDPG.load <sb3_tdpg.TDPG.load>`.
    :raises ValueError: if ``trust_remote_code`` is not true, or if the repository cannot be read or has no such model.
    """
    if trust_remote_code is None:
        trust_remote_code = os.environ.get("TRUST_REMOTE_CODE", "").lower() in ("1", "true", "yes", "y", "on", "t")
    if not trust_remote_code:
        raise ValueError(
            f"loading {repo_id} unpickles it, which can run any code: if you trust its author, give "
            "trust_remote_code=True, or set the variable TRUST_REMOTE_CODE=True"
        )
    with _one_line_errors(repo_id, "read"):
        if filename is None:
            files = huggingface_hub.HfApi(token=token).list_repo_files(repo_id, revision=revision)
            # Skip models in subfolders: a subfolder contains the policy from which the training started.
            models = [name for name in files if "/" not in name and fnmatch(name, f"{ALGORITHM}-*.zip")]
            if len(models) != 1:
                found = f"several models ({', '.join(models)})" if models else f"no {ALGORITHM}-*.zip"
                raise ValueError(f"{repo_id} has {found}: give filename")
            filename = models[0]
        path = huggingface_hub.hf_hub_download(repo_id, filename, revision=revision, token=token, **LIBRARY)
    return TDPG.load(path, env=env, **kwargs)


def pull_from_hub(
    repo_id: str, out: str | os.PathLike[str], *, revision: str | None = None, token: str | None = None
) -> Path:
    """
    Download a repository without running or unpickling any file. A download that fails leaves nothing behind.

    :param repo_id: ``organization/name``.
    :param out: The folder for the download, which must not exist yet.
    :param revision: A branch, tag or commit; default: the newest commit.
    :param token: Access token for a private repository; default: see :func:`push_to_hub`.
    :return: ``out``
    :raises ValueError: if ``out`` exists, or the download fails.
    """
    out = _new(out)
    with _one_line_errors(repo_id, "read"), replaced_atomically(out) as folder:
        huggingface_hub.snapshot_download(repo_id, revision=revision, local_dir=folder, token=token, **LIBRARY)
    return out


def _new(out: str | os.PathLike[str]) -> Path:
    out = Path(out)
    if out.exists():
        raise ValueError(f"{out} exists already: choose another folder, or remove it")
    return out


def _write_records(publication: Publication, results: pd.DataFrame, out: Path) -> None:
    """Write the files that rl-zoo3 and other programs read, and copy the files of the publication."""
    env_kwargs, settings = plain(publication.env_kwargs), plain(publication.settings)
    args = dict(algo=ALGORITHM, env=publication.env_id, env_kwargs=env_kwargs, seed=publication.seed)
    for name, content in (("config.yml", settings), ("args.yml", args), ("env_kwargs.yml", env_kwargs)):
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
    write_frame_atomically(publication.records, out / "episodes.csv")
    for name, path in publication.files.items():
        (out / name).parent.mkdir(exist_ok=True)
        shutil.copyfile(path, out / name)


@contextmanager
def _one_line_errors(repo_id: str, action: str, comfort: str = "") -> Iterator[None]:
    """Convert errors of the network and of the Hub to a ``ValueError`` that says what to do."""
    try:
        yield
    except (OSError, HTTPError) as e:
        status = getattr(getattr(e, "response", None), "status_code", None)
        if status in (401, 403, 404) or isinstance(e, LocalTokenNotFoundError):
            advice = "check the name, and log in with `hf auth login` or set HF_TOKEN to a token with the permission"
        else:
            advice = f"try again when the Hub can be reached{comfort}"
        reason = next((line.strip() for line in str(e).splitlines() if line.strip()), type(e).__name__)
        raise ValueError(f"{repo_id} cannot be {action} ({reason}): {advice}") from e
