"""Evaluate policies: run scenarios, record each episode, and make tables and figures."""

from sb3_tdpg.evaluation.figures import information_timeline, knowledge_map, save_figure, training_curves
from sb3_tdpg.evaluation.information import InformationReport, information_report, state_knowledge
from sb3_tdpg.evaluation.interval import InformationInterval, information_interval
from sb3_tdpg.evaluation.records import evaluate_scenarios, rollout_states
from sb3_tdpg.evaluation.statistics import aggregate_seeds, paired_difference, probability_of_improvement
from sb3_tdpg.evaluation.tables import add_ratio, comparison_markdown, summary_table

__all__ = [
    "InformationInterval",
    "InformationReport",
    "add_ratio",
    "aggregate_seeds",
    "comparison_markdown",
    "evaluate_scenarios",
    "information_interval",
    "information_report",
    "information_timeline",
    "knowledge_map",
    "paired_difference",
    "probability_of_improvement",
    "rollout_states",
    "save_figure",
    "state_knowledge",
    "summary_table",
    "training_curves",
]
