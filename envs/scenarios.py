"""Every training and test variant of the paper, as data: a table's row is a :class:`Scenario`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

LAVA_TABLE_READING: Mapping[str, Any] = MappingProxyType(
    dict(action_cost=1.0, lava_stage_cost=3.0, lava_terminal_cost=300.0)
)
"""
Keywords of :class:`~sb3_tdpg.envs.lava.LavaEnv` that fit the numbers of Table I better than the paper's text
does.
"""


@dataclass(frozen=True)
class PaperResult:
    """The mean and the standard deviation over episodes of the cost that the paper prints in a row."""

    mean: float
    std: float


@dataclass(frozen=True)
class Scenario:
    """
    One row of a results table: an environment with the keywords that make this variant.

    :param name: The row's title.
    :param env_id: A registered Gymnasium id.
    :param env_kwargs: Keywords of the environment's constructor.
    :param paper: What the paper reports for this row, by method ("PG", "TDPG").
    """

    name: str
    env_id: str
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    paper: Mapping[str, PaperResult] = field(default_factory=dict)

    def with_kwargs(self, **env_kwargs: Any) -> Scenario:
        """Return the same row with further keywords (the row's own win)."""
        return Scenario(self.name, self.env_id, {**env_kwargs, **self.env_kwargs}, self.paper)


def _lava(name: str, variance: float, pg: PaperResult, tdpg: PaperResult) -> Scenario:
    return Scenario(name, "Lava-v0", dict(sensor_noise_std=variance**0.5), dict(PG=pg, TDPG=tdpg))


# Table I. The table prints variances sigma^2; the environment takes sigma.
LAVA: tuple[Scenario, ...] = (
    _lava("Training", 1e-4, PaperResult(31.04, 7.191), PaperResult(36.18, 23.22)),
    _lava("Sensor noise 1e-3", 1e-3, PaperResult(31.58, 8.632), PaperResult(36.55, 25.02)),
    _lava("Sensor noise 1e-2", 1e-2, PaperResult(35.69, 15.68), PaperResult(36.00, 22.32)),
    _lava("Sensor noise 1e-1", 1e-1, PaperResult(66.29, 36.48), PaperResult(36.20, 21.85)),
    _lava("Sensor noise 1e0", 1.0, PaperResult(172.40, 88.08), PaperResult(37.39, 25.60)),
)
