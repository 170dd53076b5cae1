"""The rows of a report, as data: the environment as it is, its own test rows, and each perturbation by severity."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from gymnasium import spaces

from sb3_tdpg.common.provenance import jsonable
from sb3_tdpg.envs.scenarios import PAPER_ROWS, Scenario
from sb3_tdpg.robustness import applicable, scene_perturbations
from sb3_tdpg.robustness.registry import N_SEVERITIES, find

UNPERTURBED = "unperturbed"
ALL = "all perturbations"

FAST: Mapping[str, Mapping[str, Any]] = MappingProxyType({"BallCatch-v0": dict(renderer="fast")})
"""Keywords that spare time and change next to nothing, by environment; a user's own win."""


@dataclass(frozen=True)
class Row:
    """
    One condition that every model is run in.

    :param perturbation: What is perturbed; of an own row of the environment its title.
    :param severity: 1 to 5, and 0 where there are no severities.
    :param kind: ``"unperturbed"``, ``"own"`` (a row of the environment's), ``"sensor"`` or ``"scene"``.
    :param scenario: The environment with its keywords.
    :param value: The parameter of a perturbation of the sensor.
    """

    perturbation: str
    severity: int
    kind: str
    scenario: Scenario
    value: float | None = None

    @property
    def title(self) -> str:
        """What the row is called."""
        return f"{self.perturbation} {self.severity}" if self.severity else self.perturbation

    @property
    def file_name(self) -> str:
        """A name for a file of its records; another one if the environment or the value of a severity change."""
        slug = "".join(c if c.isalnum() else "-" for c in self.title.lower())
        env = [self.scenario.env_id, self.scenario.env_kwargs]
        content = json.dumps(jsonable([self.title, self.kind, *env, self.value]), sort_keys=True)
        return f"{slug}-{hashlib.sha256(content.encode()).hexdigest()[:8]}.csv.xz"


def default_env_kwargs(env_id: str, env_kwargs: Mapping[str, Any] | None) -> dict[str, Any]:
    """Put the keywords of :data:`FAST` beneath those that are given."""
    return {**FAST.get(env_id.rpartition(":")[2], {}), **(env_kwargs or {})}


def own_scenarios(env_id: str) -> Sequence[Scenario]:
    """Return the rows of the paper's table of an environment, without that of the training."""
    return PAPER_ROWS.get(env_id.rpartition(":")[2], ())[1:]


def make_rows(
    env_id: str,
    env_kwargs: Mapping[str, Any],
    space: spaces.Space,
    horizon: int | None,
    *,
    perturbations: Sequence[str] | None = None,
    severities: Sequence[int] = (1, 2, 3, 4, 5),
    scenarios: Sequence[Scenario] | None = None,
) -> list[Row]:
    """
    List the rows of a report.

    :param env_id: A registered id.
    :param env_kwargs: Keywords for all rows.
    :param space: The observation space.
    :param horizon: Controls in an episode, where it is known.
    :param perturbations: Of the sensor and of the scene; default: all that apply.
    :param severities: Which of the five.
    :param scenarios: The environment's own rows; default: :func:`own_scenarios`.
    :raises ValueError: if a perturbation is unknown or does not apply, a severity is none, or two rows have one name.
    """
    scenes = scene_perturbations(env_id)
    names = [*applicable(space, horizon), *scenes] if perturbations is None else list(dict.fromkeys(perturbations))
    severities = sorted(set(severities))
    if not severities or not set(severities) <= set(range(1, N_SEVERITIES + 1)):
        raise ValueError(f"severities={list(severities)} must be some of 1 to {N_SEVERITIES}")
    plain = Scenario(UNPERTURBED, env_id, env_kwargs)
    rows = [Row(UNPERTURBED, 0, "unperturbed", plain)]
    for name in names:
        if name not in scenes:
            _check_applies(name, space, horizon, [*applicable(space, horizon), *scenes])
        for severity in severities:
            if name in scenes:
                scenario = Scenario(name, env_id, {**env_kwargs, **scenes[name][severity - 1]})
                rows.append(Row(name, severity, "scene", scenario))
            else:
                rows.append(Row(name, severity, "sensor", plain, find(name).value(severity)))
    for own in own_scenarios(env_id) if scenarios is None else scenarios:
        rows.append(Row(own.name, 0, "own", Scenario(own.name, own.env_id, {**env_kwargs, **own.env_kwargs})))
    titles = [row.title for row in rows]
    # In the tables a perturbation's name stands for all its severities, and ALL for all of them.
    groups = {ALL, *(row.perturbation for row in rows if row.kind != "own")}
    of_groups = {row.title for row in rows if row.kind == "own"} & groups
    if twice := sorted(of_groups | {title for title in titles if titles.count(title) > 1}):
        raise ValueError(f"{twice} name several rows of the report: rename the scenarios")
    return rows


def _check_applies(name: str, space: spaces.Space, horizon: int | None, known: Sequence[str]) -> None:
    try:
        objection = find(name).objection(space, horizon)
    except ValueError as e:
        raise ValueError(f"perturbation={name!r} is unknown: here there are {list(known)}") from e
    if objection is not None:
        raise ValueError(f"the perturbation {name!r} does not apply: {objection}")
