"""
Mutual-information estimators and bounds; independent of Stable-Baselines3.

To add an estimator, add a file here and a row to :data:`ESTIMATORS`.
"""

from sb3_tdpg.information.base import InformationBatch, InformationEstimator
from sb3_tdpg.information.critic import CriticEstimator
from sb3_tdpg.information.directed import DirectedLeaveOneOut, DirectedLogDet
from sb3_tdpg.information.infonce import InfoNCE
from sb3_tdpg.information.logdet import LogDet
from sb3_tdpg.information.loo import LeaveOneOut, own_sample_bound
from sb3_tdpg.information.mine import Mine
from sb3_tdpg.information.nwj import Nwj
from sb3_tdpg.information.smile import Smile
from sb3_tdpg.information.vib import VariationalBottleneck

ESTIMATORS: dict[str, type[InformationEstimator]] = {
    "mine": Mine,
    "nwj": Nwj,
    "smile": Smile,
    "infonce": InfoNCE,
    "logdet": LogDet,
    "directed": DirectedLogDet,
    "loo": LeaveOneOut,
    "directed-loo": DirectedLeaveOneOut,
    "vib": VariationalBottleneck,
}


def get_estimator_class(estimator: str | type[InformationEstimator]) -> type[InformationEstimator]:
    """
    Return the class of an estimator that is named in :data:`ESTIMATORS` or is such a class itself.

    :raises ValueError: if it is neither.
    """
    if isinstance(estimator, str) and estimator in ESTIMATORS:
        return ESTIMATORS[estimator]
    if isinstance(estimator, type) and issubclass(estimator, InformationEstimator):
        return estimator
    raise ValueError(
        f"mi_estimator={estimator!r} is unknown: use one of {sorted(ESTIMATORS)} or a subclass of InformationEstimator"
    )


__all__ = [
    "ESTIMATORS",
    "CriticEstimator",
    "DirectedLeaveOneOut",
    "DirectedLogDet",
    "InfoNCE",
    "InformationBatch",
    "InformationEstimator",
    "LeaveOneOut",
    "LogDet",
    "Mine",
    "Nwj",
    "Smile",
    "VariationalBottleneck",
    "get_estimator_class",
    "own_sample_bound",
]
