"""Load saved models of TDPG, Stable-Baselines3 and sb3-contrib."""

import json
import zipfile
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from sb3_tdpg.evaluation.environments import load_statistics, stacked_for
from sb3_tdpg.vec_env import make_episodes_env

# The first entry counts that is the beginning of the module of the policy, or the name of a setting of the algorithm.
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
    "mi_estimator": "sb3_tdpg:TDPG",
    "cg_max_steps": "sb3_contrib:TRPO",
    "clip_range": "stable_baselines3:PPO",
    "normalize_advantage": "stable_baselines3:A2C",
}


def load_model(path: Path, env_id: str, env_kwargs: Mapping[str, Any]) -> Any:
    """
    Load a model of TDPG, Stable-Baselines3 or sb3-contrib, and recognise its algorithm from the file.

    If statistics of observations lie beside the file (``vecnormalize.pkl`` of rl-zoo3, ``vec_normalize.pkl`` of the
    Hub), the observations are normalised as in training. Loading unpickles the file, which can run any code: load only
    files that you trust.

    :param path: The ``.zip`` file that ``model.save`` wrote.
    :param env_id: Id of the environment, for the normalisation.
    :param env_kwargs: Keywords of the environment.
    :raises ValueError: if the file cannot be read, its algorithm is unknown, or the environment cannot be made.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            settings = dict(json.loads(archive.read("data")))
    except Exception as e:  # a damaged file can raise any error
        reason = e.strerror if isinstance(e, OSError) else e
        raise ValueError(f"{path} cannot be read ({reason}): give the .zip file that model.save() wrote") from e
    policy = settings.get("policy_class")
    module = str(policy.get("__module__", "")) if isinstance(policy, dict) else ""
    known = [name for mark, name in ALGORITHMS.items() if module.startswith(mark) or mark in settings]
    if not known:
        raise ValueError(f"{path} is of an unknown algorithm: load it in Python")
    package, name = known[0].split(":")
    try:
        model = getattr(import_module(package), name).load(path, device="cpu")
    except Exception as e:
        reason = " ".join(str(e).split())
        raise ValueError(f"{path} looks like a model of {name} but cannot be loaded: {reason[:200]}") from e
    if found := statistics_beside(path):
        try:
            env = make_episodes_env(env_id, model.n_envs, env_kwargs=env_kwargs, use_processes=False)
        except Exception as e:
            raise ValueError(f"{env_id} cannot be made: {e}") from e
        model.set_env(stacked_for(model, load_statistics(found, env, model)))
    return model


def statistics_beside(path: Path) -> Path | None:
    """
    Return the file with the statistics of observations of a model, or ``None`` if there is none.

    The file is searched beside the model and in a folder with the model's name. For ``<id>_1/best_model.zip`` it is
    also searched in ``<id>_1/<id>/``.
    """
    folder = path.parent
    folders = [folder, path.with_suffix(""), folder / folder.resolve().name.rpartition("_")[0]]
    candidates = [each / name for each in folders for name in ("vecnormalize.pkl", "vec_normalize.pkl")]
    return next((path for path in candidates if path.is_file()), None)
