"""List the rows of a report: the unperturbed environment, the perturbations by severity, and the test rows."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from gymnasium import spaces

from sb3_tdpg.common.provenance import jsonable
from sb3_tdpg.envs.scenarios import PAPER_ROWS, Scenario
from sb3_tdpg.robustness.registry import N_SEVERITIES, applicable, find_applicable

UNPERTURBED = "unperturbed"
ALL = "all perturbations"
PERTURBED = ("sensor", "plant")
"""The kinds of rows with severities. They change observations or actions."""


@dataclass(frozen=True, eq=False)
class Row:
    """One condition in which every model is run."""

    perturbation: str  # its name, or the title of a test row of the environment
    severity: int  # 1 to 5, or 0 if the row has no severity
    kind: str  # "unperturbed", "own" (a test row of the environment), or one of PERTURBED
    scenario: Scenario
    value: float | None = None  # the parameter of a perturbation of sensor or plant

    @property
    def title(self) -> str:
        """The name of the row."""
        return f"{self.perturbation} {self.severity}" if self.severity else self.perturbation

    @property
    def file_name(self) -> str:
        """The name of the file with the row's records; it depends on the environment and on the severity's value."""
        slug = "".join(c if c.isalnum() else "-" for c in self.title.lower())
        env = [self.scenario.env_id, self.scenario.env_kwargs, self.scenario.sensor]
        content = json.dumps(jsonable([self.title, self.kind, *env, self.value]), sort_keys=True)
        return f"{slug}-{hashlib.sha256(content.encode()).hexdigest()[:8]}.csv.xz"


def make_rows(
    env_id: str,
    env_kwargs: Mapping[str, Any],
    space: spaces.Space,
    horizon: int | None,
    action_space: spaces.Space | None = None,
    *,
    perturbations: Sequence[str] | None = None,
    severities: Sequence[int] = (1, 2, 3, 4, 5),
    scenarios: Sequence[Scenario] | None = None,
) -> list[Row]:
    """
    List the rows of a report; see :func:`~sb3_tdpg.report.robustness_report`.

    :raises ValueError: if a perturbation is unknown or does not apply, a severity does not exist, or two rows have the
        same name.
    """
    names = applicable(space, horizon, action_space) if perturbations is None else list(dict.fromkeys(perturbations))
    severities = sorted(set(severities))
    if not severities or not set(severities) <= set(range(1, N_SEVERITIES + 1)):
        raise ValueError(f"severities={list(severities)} must be integers from 1 to {N_SEVERITIES}")
    plain = Scenario(UNPERTURBED, env_id, env_kwargs)
    rows = [Row(UNPERTURBED, 0, "unperturbed", plain)]
    for name in names:
        found = find_applicable(name, space, horizon, action_space)
        kind = "plant" if found.kind == "action" else "sensor"
        rows += [Row(name, severity, kind, plain, found.value(severity)) for severity in severities]
    # The first row is left out, because in a table of the paper it is the training row.
    for own in PAPER_ROWS.get(env_id.rpartition(":")[2], ())[1:] if scenarios is None else scenarios:
        kept = replace(own, env_kwargs={**env_kwargs, **own.env_kwargs}, n_episodes=None)
        rows.append(Row(own.name, 0, "own", kept))
    # In the tables, the name of a perturbation means all its severities, and ALL means all perturbations.
    titles = [row.title for row in rows]
    groups = {ALL, *(row.perturbation for row in rows if row.kind != "own")}
    twice = {row.title for row in rows if row.kind == "own"} & groups
    if twice := twice | {title for title in titles if titles.count(title) > 1}:
        raise ValueError(f"{sorted(twice)} name several rows of the report: rename the scenarios")
    return rows
