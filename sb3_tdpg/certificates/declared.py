"""Certify saved policies under a declared nuisance: bound their cost for random members of the nuisance."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from sb3_tdpg.certificates.shifts import Shift, TrainingEpisodes
from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.common.provenance import how_made, provenance, write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import threads
from sb3_tdpg.envs.lava import GOAL, WALL
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import check_models_fit, scenario_env
from sb3_tdpg.evaluation.loading import load_model
from sb3_tdpg.robustness.nuisance import held_family
from sb3_tdpg.tdpg import TDPG

FAMILY = "a member for each episode"


def certify_nuisance(
    models: Sequence[Path],
    env_id: str,
    declared: Any,
    out: Path,
    *,
    cost_bound: float | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    n_members: int = 1000,
    n_episodes: int = 100_000,
    n_budget_episodes: int = 20_000,
    n_test_episodes: int = 2000,
    confidence: float = 0.95,
    seed: int = 0,
) -> str:
    """
    Certify policies under a declared nuisance, and compare the bounds with the measured costs.

    In the first row of a model in ``nuisance.csv``, each episode has its own random member of the nuisance. In every
    other row, all episodes have one random member in common.

    :param models: Files that ``model.save()`` wrote.
    :param env_id: Id of the training environment, which must be one of this package.
    :param declared: The nuisance, declared as for :class:`~sb3_tdpg.robustness.families.Family`.
    :param out: Folder for ``summary.md``, ``nuisance.csv`` and ``config.json``.
    :param cost_bound: Upper bound on the cost of an episode; the certified cost is clipped there. Default for Lava: the
        cost of standing at the wall for a whole episode.
    :param env_kwargs: Keywords of the training environment.
    :param n_episodes: Number of training episodes for the distribution of the cost.
    :param n_budget_episodes: Number of further training episodes, in which each member perturbs the observations; at
        most ``n_episodes``.
    :param n_test_episodes: Number of episodes in which the cost under each member is measured.
    :param confidence: Confidence of each certificate.
    :return: the summary, as Markdown
    :raises ValueError: if an argument is invalid; no episode has been run then.
    """
    if n_test_episodes < 2 or n_members < 1:
        raise ValueError(f"n_test_episodes={n_test_episodes} must be at least 2, n_members={n_members} at least 1")
    if seed < 0:
        raise ValueError(f"seed={seed} must be at least 0")
    training = Scenario("Training", env_id, dict(env_kwargs or {}))
    loaded = {str(path): load_model(path, env_id, training.env_kwargs) for path in models}
    if unfit := [
        path for path, model in loaded.items() if not isinstance(model, TDPG) or model.get_vec_normalize_env()
    ]:
        raise ValueError(f"{unfit[0]} is not certified: it must be a TDPG model that was trained without VecNormalize")
    check_models_fit(loaded, [training])
    if cost_bound is None:
        if env_id.rpartition(":")[2] != "Lava-v0":
            raise ValueError(f"cost_bound is needed for {env_id}: an upper bound on the cost of an episode")
        # The stage costs at the wall, and the terminal cost there, which has a weight of 100.
        cost_bound = (next(iter(loaded.values())).horizon + 100.0) * float(GOAL[0] - WALL)
    out.mkdir(parents=True, exist_ok=True)
    n_budget_episodes = min(n_budget_episodes, n_episodes)
    settings: dict[str, Any] = dict(n_episodes=n_episodes, cost_bound=cost_bound, confidence=confidence, seed=seed)
    rows: list[dict[str, Any]] = []
    with threads(1):
        for label, model in loaded.items():
            family = held_family(declared, scenario_env(training, model, n_episodes=1, n_envs=1))
            print(f"{label}: {n_episodes:,} training episodes")
            episodes = TrainingEpisodes(model, training, n_budget_episodes=n_budget_episodes, **settings)
            shifts = [Shift(FAMILY, nuisance=partial(family.members, seed=seed))]
            shifts += [Shift(f"member {i}", nuisance=partial(family.one, seed + i)) for i in range(n_members)]
            for i, shift in enumerate(tqdm(shifts, desc=label)):
                row = dict(model=label, shift=shift.name, training_cost=episodes.costs.mean())
                rows.append(row | _compare(episodes, shift, n_test_episodes, cost_bound, seed + 1 + i))
    records = pd.DataFrame(rows)
    write_frame_atomically(records, out / "nuisance.csv")
    settings.update(nuisance=str(declared), n_members=n_members, n_budget_episodes=n_budget_episodes)
    settings.update(n_test_episodes=n_test_episodes, env_id=env_id, env_kwargs=training.env_kwargs)
    text = (
        f"The trivial bound is {cost_bound:g}: the cost is clipped there. Confidence of each bound: {confidence:.0%}."
    )
    how = provenance()
    write_run_config(out / "config.json", dict(models=[path.name for path in models], **settings, provenance=how))
    summary = "\n\n".join([nuisance_table(records, cost_bound), text, how_made(how["command"], how)]) + "\n"
    write_atomically(out / "summary.md", summary)
    return summary


def _compare(episodes: TrainingEpisodes, shift: Shift, n_test_episodes: int, cost_bound: float, seed: int) -> dict:
    """Certify one shift, and measure the cost under it."""
    certified = episodes.certify(shift)
    costs, measured_kl = episodes.measure(shift, n_test_episodes, seed=seed)
    cost = dict(cost=costs.mean(), standard_error=costs.std(ddof=1) / math.sqrt(len(costs)))
    bound = dict(clipped_cost=np.minimum(costs, cost_bound).mean(), bound=certified.bound)
    return dict(**cost, **bound, **certified.budget._asdict(), measured_kl=measured_kl)


def nuisance_table(records: pd.DataFrame, trivial: float) -> str:
    """Count the members whose cost exceeds the bound, and summarise how far the bounds are above the costs."""
    rows = []
    for label, group in records.groupby("model", sort=False):
        family, members = group[group["shift"] == FAMILY].iloc[0], group[group["shift"] != FAMILY]
        cost, bound, error = members["clipped_cost"], members["bound"], members["standard_error"]
        above = cost - bound
        row = {"policy": label, "cost in training": f"{family['training_cost']:.3g}"}
        row["a member for each episode: cost, bound"] = f"{family['clipped_cost']:.3g}, {family['bound']:.3g}"
        row |= {"random members": len(members), "cost above the bound": int((above > 0).sum())}
        row["by more than 3 standard errors"] = int((above > 3 * error).sum())
        row["bound below the trivial one"] = int((bound < 0.999 * trivial).sum())
        quantiles = (bound - cost).quantile([0.1, 0.5, 0.9])
        row["bound - cost: median [10 %, 90 %]"] = "{1:.3g} [{0:.3g}, {2:.3g}]".format(*quantiles)
        rows.append(row)
    return markdown_table(rows)
