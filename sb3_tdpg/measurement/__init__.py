"""
Measure the information of a trained policy: confidence intervals, checks of them, and estimates from i.i.d. pairs.

Only ``callback`` imports Stable-Baselines3.
"""

from sb3_tdpg.measurement.checks import TrustBadge, TrustCheck, trust_checks
from sb3_tdpg.measurement.interval import InformationInterval, information_interval
from sb3_tdpg.measurement.pairs import InformationEstimate, estimate_information

__all__ = [
    "InformationEstimate",
    "InformationInterval",
    "TrustBadge",
    "TrustCheck",
    "estimate_information",
    "information_interval",
    "trust_checks",
]
