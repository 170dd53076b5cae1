"""Repeat a recorded run: the command ``sb3-tdpg rerun config.json again``."""

import json
import os
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from sb3_tdpg.common.provenance import with_numbers
from sb3_tdpg.common.trust import plain_name, say_what_is_trusted
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.experiments.runs import Run, SB3Run, complete_run


def rerun(config: str | os.PathLike[str], out: str | os.PathLike[str], *, progress_bar: bool = True) -> Path:
    """
    Train and evaluate the run that a ``config.json`` describes. The same versions give the same numbers.

    Scenarios whose sensor is changed by a function are left out, because the file contains only the function's name.

    :param config: The ``config.json``. If the run started from the policy of another run, that policy must be beside
        this file: ``<name of that run>/model.zip``.
    :param out: Folder of the new run, see :func:`~sb3_tdpg.experiments.runs.complete_run`.
    :param progress_bar: Show progress bars.
    :return: ``out``
    :raises ValueError: if the file does not describe a run, or if the policy to start from is not the recorded one.
    """
    config = Path(config)
    try:
        content = json.loads(config.read_text())
        rows = [row for row in content["scenarios"] if "sensor" not in row]
        scenarios, n_eval_episodes, start = scenarios_of(rows), content["n_eval_episodes"], content["start"]
        # The block is not read: all settings are recorded, and the block may have changed since.
        run = (partial(SB3Run, algo=content["algo"]) if "algo" in content else Run)(
            **{name: content[name] for name in ("method", "env_id", "seed", "max_attempts")},
            block=None,
            overrides=with_numbers(content["settings"]),
            start=None if start is None else config.parent / plain_name(start, f"start of {config}"),
        )
    except (OSError, KeyError, TypeError, json.JSONDecodeError) as e:
        raise ValueError(f"{config} does not describe a run ({e!r}): give the config.json of a run's folder") from e
    if run.config["start_policy"] != content["start_policy"]:
        raise ValueError(
            f"the run started from the policy {content['start_policy']}, and {config.parent / start / 'model.zip'} is "
            f"{run.config['start_policy']}: put the run's own there"
        )
    if not scenarios:
        raise ValueError(f"{config} was evaluated behind a function alone (an open loop), which a rerun leaves out")
    if run.start is not None:
        say_what_is_trusted(run.start)
    if left_out := [row["name"] for row in content["scenarios"] if "sensor" in row]:
        print(f"left out, for a function changes their sensor: {', '.join(left_out)}")
    return complete_run(run, Path(out), scenarios, n_eval_episodes=n_eval_episodes, progress_bar=progress_bar)


def scenarios_of(rows: Sequence[Mapping[str, Any]]) -> list[Scenario]:
    """Return the scenarios of a recorded evaluation, without the functions that change the sensor."""
    return [
        Scenario(row["name"], row["env_id"], with_numbers(row["env_kwargs"]), n_episodes=row.get("n_episodes"))
        for row in rows
    ]
