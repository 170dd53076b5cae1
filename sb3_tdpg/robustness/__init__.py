"""
Robustness: perturbations of what a policy observes, in five severities, for any environment.

They are for the evaluation of policies; :mod:`sb3_tdpg.robustness.training` has what images go through in training.
"""

from sb3_tdpg.robustness.gallery import perturbation_gallery
from sb3_tdpg.robustness.registry import PERTURBATIONS, Perturbation, applicable, register, severity_table
from sb3_tdpg.robustness.scale import observation_scale
from sb3_tdpg.robustness.scenes import SCENES, scene_perturbations
from sb3_tdpg.robustness.wrappers import PerturbedObservation, PerturbedVecEnv

__all__ = [
    "PERTURBATIONS",
    "SCENES",
    "Perturbation",
    "PerturbedObservation",
    "PerturbedVecEnv",
    "applicable",
    "observation_scale",
    "perturbation_gallery",
    "register",
    "scene_perturbations",
    "severity_table",
]
