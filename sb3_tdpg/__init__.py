"""Task-Driven Policy Gradient (TDPG) for Stable-Baselines3."""

from pathlib import Path

# In a checkout envs/ and hyperparams/ lie beside this folder, in a wheel inside it. Without this, sb3_tdpg.envs is
# not found when the checkout comes first on sys.path (the working directory is the repository, or PYTHONPATH).
_package = Path(__path__[0]).resolve()
if not (_package / "envs").is_dir() and (_package.parent / "envs" / "__init__.py").is_file():
    __path__.append(str(_package.parent))

from sb3_tdpg import envs
from sb3_tdpg.callbacks import InformationCallback, MINECallback, SelectionCallback, TrainingCheckpointCallback
from sb3_tdpg.policies import TRVPolicy
from sb3_tdpg.tdpg import TDPG, TrainingDivergedError
from sb3_tdpg.vec_env import BatchedVecEnv, make_episodes_env

__version__ = "0.1.0"

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
    "make_episodes_env",
]
