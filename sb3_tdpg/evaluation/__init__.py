"""Evaluation: scenario -> per-episode records -> table -> figure."""

from sb3_tdpg.evaluation.figures import (
    cost_histograms,
    diagnosis_bars,
    failures_by_camera,
    failures_by_yaw,
    information_timeline,
    knowledge_map,
    lava_trajectories,
    robustness_curves,
    save_figure,
    training_curves,
)
from sb3_tdpg.evaluation.information import InformationReport, information_report, interval_frame
from sb3_tdpg.evaluation.knowledge import draw_mugs, encode_mugs, grasp_knowledge, state_knowledge, trv_knowledge
from sb3_tdpg.evaluation.records import evaluate_scenarios
from sb3_tdpg.evaluation.statistics import aggregate_seeds, paired_difference, probability_of_improvement
from sb3_tdpg.evaluation.tables import add_ratio, comparison_markdown, summary_table
from sb3_tdpg.evaluation.trajectories import Trajectories, rollout_states

__all__ = [
    "InformationReport",
    "Trajectories",
    "add_ratio",
    "aggregate_seeds",
    "comparison_markdown",
    "cost_histograms",
    "diagnosis_bars",
    "draw_mugs",
    "encode_mugs",
    "evaluate_scenarios",
    "failures_by_camera",
    "failures_by_yaw",
    "grasp_knowledge",
    "information_report",
    "information_timeline",
    "interval_frame",
    "knowledge_map",
    "lava_trajectories",
    "paired_difference",
    "probability_of_improvement",
    "robustness_curves",
    "rollout_states",
    "save_figure",
    "state_knowledge",
    "summary_table",
    "training_curves",
    "trv_knowledge",
]
