"""
What is measured after the training: intervals that hold the information, and checks of how far to trust them.

Knows nothing of Stable-Baselines3.
"""

from sb3_tdpg.measurement.interval import InformationInterval, information_interval
from sb3_tdpg.measurement.pairs import InformationEstimate, estimate_information
from sb3_tdpg.measurement.trust import TrustBadge, TrustCheck, trust_checks

__all__ = [
    "InformationEstimate",
    "InformationInterval",
    "TrustBadge",
    "TrustCheck",
    "estimate_information",
    "information_interval",
    "trust_checks",
]
