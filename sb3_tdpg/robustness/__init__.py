"""
Perturb the observations or the actions of any environment, in five severities, to evaluate policies.

:mod:`sb3_tdpg.robustness.training` has the perturbations for training.
"""

from sb3_tdpg.robustness import effects as effects  # fills the registry
from sb3_tdpg.robustness.gallery import perturbation_gallery
from sb3_tdpg.robustness.registry import (
    PERTURBATIONS,
    Perturbation,
    applicable,
    register,
)
from sb3_tdpg.robustness.scale import observation_scale
from sb3_tdpg.robustness.wrappers import PerturbedVecEnv

__all__ = [
    "PERTURBATIONS",
    "Perturbation",
    "PerturbedVecEnv",
    "applicable",
    "observation_scale",
    "perturbation_gallery",
    "register",
]
