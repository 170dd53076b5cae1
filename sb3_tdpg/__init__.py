"""Task-Driven Policy Gradient (TDPG) for Stable-Baselines3."""

import importlib
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

# In a checkout, envs/ and hyperparams/ lie beside this folder; in a wheel, they lie inside it. If the checkout itself
# is on sys.path (as the working directory, or by PYTHONPATH), Python does not find them as parts of this package.
_package = Path(__file__).resolve().parent
for _name in ("envs", "hyperparams"):
    _init = _package.parent / _name / "__init__.py"
    if not (_package / _name).is_dir() and _init.is_file() and f"{__name__}.{_name}" not in sys.modules:
        _spec = importlib.util.spec_from_file_location(
            f"{__name__}.{_name}", _init, submodule_search_locations=[str(_init.parent)]
        )
        assert _spec is not None and _spec.loader is not None
        sys.modules[_spec.name] = globals()[_name] = importlib.util.module_from_spec(_spec)
        _spec.loader.exec_module(globals()[_name])

from sb3_tdpg import envs, hyperparams

if TYPE_CHECKING:
    from sb3_tdpg.callbacks import MINECallback, SelectionCallback, TrainingCheckpointCallback
    from sb3_tdpg.episodic import TrainingDivergedError
    from sb3_tdpg.evaluation.information_callback import InformationCallback
    from sb3_tdpg.policies import TRVPolicy
    from sb3_tdpg.tdpg import TDPG
    from sb3_tdpg.vec_env import BatchedVecEnv, make_episodes_env

__version__ = "0.2.0"

__all__ = [
    "TDPG",
    "BatchedVecEnv",
    "InformationCallback",
    "MINECallback",
    "SelectionCallback",
    "TRVPolicy",
    "TrainingCheckpointCallback",
    "TrainingDivergedError",
    "envs",
    "hyperparams",
    "make_episodes_env",
]

_MODULES = {
    "TDPG": "tdpg",
    "BatchedVecEnv": "vec_env",
    "InformationCallback": "evaluation.information_callback",
    "MINECallback": "callbacks",
    "SelectionCallback": "callbacks",
    "TRVPolicy": "policies",
    "TrainingCheckpointCallback": "callbacks",
    "TrainingDivergedError": "episodic",
    "make_episodes_env": "vec_env",
}


def __getattr__(name: str) -> Any:
    # Importing torch takes seconds, so it happens only when one of the names above is used.
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
