"""Load the policies to certify."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import check_models_fit
from sb3_tdpg.tdpg import TDPG


def load_models(paths: Sequence[Path], training: Scenario) -> dict[str, TDPG]:
    """Load policies by a label, and check that they fit the training environment."""
    models: dict[str, TDPG] = {}
    if twice := [str(path) for i, path in enumerate(paths) if path in paths[:i]]:
        raise ValueError(f"{twice[0]} is given twice")
    for path in paths:
        try:
            model = TDPG.load(path, device="cpu")
        except OSError as e:
            raise ValueError(f"{path} cannot be read ({e.strerror}): give .zip files that model.save() wrote") from e
        method = "PG" if model.beta == math.inf else "TDPG"
        # The shortest label that is free; only the last one contains the whole path.
        labels = (method, f"{method} ({path.parent.name}/{path.stem})", f"{method} ({path})")
        models[next(label for label in labels if label not in models)] = model
    check_models_fit(models, [training])
    return models
