"""
Measure the information of a trained policy: confidence intervals, and checks of them.

Only ``callback`` imports Stable-Baselines3.
"""

from sb3_tdpg.measurement.checks import TrustBadge, TrustCheck, trust_checks
from sb3_tdpg.measurement.interval import InformationInterval, information_interval

__all__ = [
    "InformationInterval",
    "TrustBadge",
    "TrustCheck",
    "information_interval",
    "trust_checks",
]
