"""
Estimators of mutual information and bounds on it, independent of Stable-Baselines3.

To add an estimator, add a file here and an entry to :data:`ESTIMATORS`.
"""

import pkgutil
from typing import cast

from sb3_tdpg.information.base import InformationBatch, InformationEstimator

# Only the module of the chosen estimator is imported.
ESTIMATORS: dict[str, str | type[InformationEstimator]] = {
    "mine": "sb3_tdpg.information.mine:Mine",
    "nwj": "sb3_tdpg.information.nwj:Nwj",
    "smile": "sb3_tdpg.information.smile:Smile",
    "infonce": "sb3_tdpg.information.infonce:InfoNCE",
    "logdet": "sb3_tdpg.information.logdet:LogDet",
    "directed": "sb3_tdpg.information.directed:DirectedLogDet",
    "loo": "sb3_tdpg.information.loo:LeaveOneOut",
    "directed-loo": "sb3_tdpg.information.directed:DirectedLeaveOneOut",
    "vib": "sb3_tdpg.information.vib:VariationalBottleneck",
}
"""The estimators by name: a class, or its location in the form ``"module:class"``."""


def get_estimator_class(estimator: str | type[InformationEstimator]) -> type[InformationEstimator]:
    """
    Return the class of an estimator, given its name in :data:`ESTIMATORS` or the class itself.

    :raises ValueError: if the argument is neither.
    """
    found = ESTIMATORS.get(estimator) if isinstance(estimator, str) else estimator
    if isinstance(found, str):
        found = cast(type[InformationEstimator], pkgutil.resolve_name(found))
    if isinstance(found, type) and issubclass(found, InformationEstimator):
        return found
    raise ValueError(
        f"mi_estimator={estimator!r} is unknown: use one of {sorted(ESTIMATORS)} or a subclass of InformationEstimator"
    )


__all__ = ["ESTIMATORS", "InformationBatch", "InformationEstimator", "get_estimator_class"]
