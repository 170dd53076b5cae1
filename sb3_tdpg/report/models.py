"""Read the models of a report: group the arguments into methods, and load the files."""

import glob
import hashlib
import json
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from sb3_tdpg.evaluation.environments import load_statistics
from sb3_tdpg.vec_env import make_episodes_env

# File names that any model may have: then the folder names the model.
PLAIN_NAMES = re.compile(r"model|best_model|final_model|selected|last|rl_model_\d+_steps")
SEED = re.compile(r"[-_. ]*(seed[-_. ]?\d+|_\d+)$", re.IGNORECASE)

# A model is recognised by the module of its policy, or by a setting that only its algorithm has.
ALGORITHMS = {
    "sb3_tdpg.": "sb3_tdpg:TDPG",
    "sb3_contrib.common.recurrent.": "sb3_contrib:RecurrentPPO",
    "sb3_contrib.common.maskable.": "sb3_contrib:MaskablePPO",
    "sb3_contrib.ars.": "sb3_contrib:ARS",
    "sb3_contrib.crossq.": "sb3_contrib:CrossQ",
    "sb3_contrib.qrdqn.": "sb3_contrib:QRDQN",
    "sb3_contrib.tqc.": "sb3_contrib:TQC",
    "stable_baselines3.dqn.": "stable_baselines3:DQN",
    "stable_baselines3.sac.": "stable_baselines3:SAC",
    "stable_baselines3.td3.": "stable_baselines3:TD3",  # and DDPG, which acts in the same way
}
SETTINGS = {
    "mi_estimator": "sb3_tdpg:TDPG",
    "cg_max_steps": "sb3_contrib:TRPO",
    "clip_range": "stable_baselines3:PPO",
    "normalize_advantage": "stable_baselines3:A2C",
}

Source = Path | Any
"""A model's file, or the model itself."""


def parse_models(arguments: Sequence[str], env_id: str = "") -> dict[str, list[Path]]:
    """
    Read models from the command line, and group them into methods.

    An argument is a file, a folder with a ``model.zip``, or a pattern such as ``runs/pg-seed*/model.zip``, with an
    optional ``LABEL=`` in front. Without a label, the name of the method is that of the file, or that of its folder if
    any model may have the file's name (``model.zip``, ``best_model.zip``, the environment's id), without the seed:
    ``runs/pg-seed3/model.zip`` is a model of ``pg``.

    :return: the files of each method, in the order of the arguments
    :raises ValueError: if a file does not exist, or is given twice.
    """
    methods: dict[str, list[Path]] = {}
    seen: dict[Path, str] = {}
    for argument in arguments:
        label, pattern = _split(argument)
        for path in _files(pattern, argument):
            name = label or label_of(path, env_id)
            if (before := seen.setdefault(path.resolve(), name)) != name or path in methods.get(name, ()):
                raise ValueError(f"{path} is given twice, for {before!r} and for {name!r}: a model counts once")
            methods.setdefault(name, []).append(path)
    if not methods:
        raise ValueError("give at least one model: runs/pg-seed0/model.zip, or PG=runs/pg-seed*/model.zip")
    return methods


def label_of(path: Path, env_id: str = "") -> str:
    """Return the name of the method of a model file; see :func:`parse_models`."""
    stem = path.name.removesuffix(".zip")
    is_plain = PLAIN_NAMES.fullmatch(stem) is not None or stem == env_id.rpartition(":")[2]
    folder = path.absolute().parent.name
    name = folder if is_plain and folder else stem
    return SEED.sub("", name) or name


def _split(argument: str) -> tuple[str, str]:
    """Split ``LABEL=PATTERN``; an argument with a path separator before the ``=`` is a path."""
    label, equals, pattern = argument.partition("=")
    if not equals or os.sep in label or Path(argument).exists():
        return "", argument
    if not label.strip() or not pattern:
        raise ValueError(f"{argument!r}: write LABEL=FILE, for instance PG=runs/pg-seed0/model.zip")
    return label.strip(), pattern


def _files(pattern: str, argument: str) -> list[Path]:
    pattern = os.path.expanduser(pattern)
    found = [Path(pattern)] if Path(pattern).exists() else [Path(name) for name in sorted(glob.glob(pattern))]
    files = [path / "model.zip" if path.is_dir() else path for path in found]
    if missing := [path for path in files if not path.is_file()]:
        raise ValueError(f"{missing[0].parent} holds no model.zip: give the .zip file itself")
    if not files:
        raise ValueError(f"{argument}: there is no such file; give the .zip file that model.save() wrote")
    return files


def load_model(path: Path, env_id: str, env_kwargs: Mapping[str, Any]) -> Any:
    """
    Load a model of TDPG, Stable-Baselines3 or sb3-contrib, and recognise its algorithm from the file.

    If rl-zoo3 has saved a ``vecnormalize.pkl`` beside it, observations are normalised as in training. Loading unpickles
    the file, which can run any code: load only files that you trust.

    :param path: The file that ``model.save`` wrote.
    :param env_id: Id of the environment, for the normalisation.
    :param env_kwargs: Keywords of the environment.
    :raises ValueError: if the file cannot be read, or its algorithm is unknown.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            settings = dict(json.loads(archive.read("data")))
    except Exception as e:  # damaged bytes lead to any error
        raise ValueError(f"{path} cannot be read ({e}): give the .zip file that model.save() wrote") from e
    policy = settings.get("policy_class")
    module = str(policy.get("__module__", "")) if isinstance(policy, dict) else ""
    known = [name for prefix, name in ALGORITHMS.items() if module.startswith(prefix)]
    known += [name for setting, name in SETTINGS.items() if setting in settings]
    if not known:
        raise ValueError(f"{path} is of an unknown algorithm: load it in Python, and pass it to robustness_report")
    package, name = known[0].split(":")
    try:
        model = getattr(import_module(package), name).load(path, device="cpu")
    except Exception as e:
        reason = " ".join(str(e).split())
        if str(path) in reason:
            raise ValueError(reason) from e
        raise ValueError(f"{path} looks like a model of {name} but cannot be loaded: {reason[:200]}") from e
    statistics = [path.parent / "vecnormalize.pkl", path.with_suffix("") / "vecnormalize.pkl"]
    if found := [each for each in statistics if each.is_file()]:
        env = make_episodes_env(env_id, model.n_envs, env_kwargs=env_kwargs, use_processes=False)
        model.set_env(load_statistics(found[0], env))
    return model


def load_all(
    sources: Mapping[str, Sequence[Source]], env_id: str, env_kwargs: Mapping[str, Any]
) -> dict[str, list[Any]]:
    """Load the models that are given as files."""
    return {
        label: [load_model(s, env_id, env_kwargs) if isinstance(s, Path) else s for s in of_method]
        for label, of_method in sources.items()
    }


def fingerprint(model: Any) -> str:
    """Return a hash of the weights of a model and of the statistics that it normalises observations with."""
    digest = hashlib.sha256(type(model).__name__.encode())
    for name, values in sorted(model.policy.state_dict().items()):
        digest.update(name.encode())
        digest.update(values.detach().cpu().numpy().tobytes())
    if (normalize := model.get_vec_normalize_env()) is not None and normalize.norm_obs:
        digest.update(normalize.obs_rms.mean.tobytes() + normalize.obs_rms.var.tobytes())
    return digest.hexdigest()[:12]
