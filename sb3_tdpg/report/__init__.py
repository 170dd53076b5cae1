"""The robustness report: models in an environment, every perturbation in every severity, one page to read."""

from sb3_tdpg.report.main import robustness_report
from sb3_tdpg.report.models import load_model, parse_models

__all__ = ["load_model", "parse_models", "robustness_report"]
