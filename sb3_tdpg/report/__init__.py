"""Write a robustness report: one page that compares models under every perturbation and severity."""

from sb3_tdpg.report.main import robustness_report
from sb3_tdpg.report.models import load_model, parse_models

__all__ = ["load_model", "parse_models", "robustness_report"]
