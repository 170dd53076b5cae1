"""Load policies, compare bound and cost, and write the summary, for all certificates."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sb3_tdpg.certificates.shifts import Shift, TrainingEpisodes
from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.provenance import how_made, provenance, write_run_config
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import check_models_fit
from sb3_tdpg.evaluation.loading import statistics_beside
from sb3_tdpg.tdpg import TDPG


def load_models(paths: Sequence[Path], training: Scenario) -> dict[str, TDPG]:
    """Load policies, label them, and check that they fit the training environment."""
    models: dict[str, TDPG] = {}
    if twice := [str(path) for i, path in enumerate(paths) if path in paths[:i]]:
        raise ValueError(f"{twice[0]} is given twice")
    for path in paths:
        if found := statistics_beside(path):
            raise ValueError(f"{path} acts on normalised observations ({found}): train one without VecNormalize")
        try:
            model = TDPG.load(path, device="cpu")
        except OSError as e:
            raise ValueError(f"{path} cannot be read ({e.strerror}): give .zip files that model.save() wrote") from e
        method = "PG" if model.beta == math.inf else "TDPG"
        # Choose the shortest label that is free; only the last one contains the whole path.
        labels = (method, f"{method} ({path.parent.name}/{path.stem})", f"{method} ({path})")
        models[next(label for label in labels if label not in models)] = model
    check_models_fit(models, [training])
    return models


def compare(
    episodes: TrainingEpisodes, shift: Shift, n_test: int, *, seed: int, n_budget: int | None = None
) -> dict[str, Any]:
    """Certify one shift, and measure the cost under it."""
    certified = episodes.certify(shift, n_budget)
    costs, measured_kl = episodes.measure(shift, n_test, seed=seed)
    row: dict[str, Any] = dict(cost=costs.mean(), standard_error=costs.std(ddof=1) / math.sqrt(len(costs)))
    row["clipped_cost"] = np.minimum(costs, certified.trivial).mean()
    row.update((name, getattr(certified, name)) for name in ("bound", "through_trvs", "through_sensor"))
    row.update(kl=certified.budget.kl, exceedance=certified.budget.exceedance)
    return dict(**row, measured_kl=measured_kl, sensor_kl=certified.sensor_kl)


def write_summary(out: Path, sections: Sequence[str], models: Sequence[Path], settings: Mapping[str, Any]) -> str:
    """Write ``config.json`` and ``summary.md``, and return the summary."""
    how = provenance()
    write_run_config(out / "config.json", dict(models=[path.name for path in models], **settings, provenance=how))
    summary = "\n\n".join([*sections, how_made(how["command"], how)]) + "\n"
    write_atomically(out / "summary.md", summary)
    return summary
