"""Reproduce Table II with the paper's own algorithm, and compare TDPG with policy gradient stopped at three costs."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from sb3_tdpg.callbacks import TDPGCallback
from sb3_tdpg.common.provenance import write_frame_atomically
from sb3_tdpg.envs.scenarios import BALL_CATCH
from sb3_tdpg.evaluation import aggregate_seeds, comparison_markdown, save_figure
from sb3_tdpg.experiments.runs import complete_runs, read_progress
from sb3_tdpg.paper import common
from sb3_tdpg.paper.ball import BACKGROUND_ROWS, NOISE_ROWS, group_rows, with_groups
from sb3_tdpg.paper.common import Method
from sb3_tdpg.paper.plots import robustness_curves

FIRST_SEED = 400
# Costs at which policy gradient stops: the paper's limit for TDPG, the cost of the paper's policy gradient, and a lower
# cost after more training. TDPG starts from the policies at PAPERS_LEVEL and above.
LEVELS = (24.0, 8.7, 5.0)
PAPERS_LEVEL = 8.7
PRICES = (16, 28, 40)  # 1 / beta; the paper has every even number from 16 to 40
KINDS = {"training": ("Training",), "sensor noise": NOISE_ROWS, "test backgrounds": BACKGROUND_ROWS}


class StopAtCost(TDPGCallback):
    """
    Stop the training once the mean cost of five successive epochs is at most a limit.

    :param cost: The limit of the mean episode cost.
    """

    WINDOW = 5

    def __init__(self, cost: float) -> None:
        super().__init__()
        self.cost = cost
        self._costs: list[float] = []

    def _on_training_start(self) -> None:
        resumes = self.tdpg.num_timesteps > 0
        self._costs = vars(self.tdpg).get("recent_costs", []) if resumes else []

    def _on_rollout_end(self) -> None:
        self._costs = [*self._costs, float(self.tdpg.rollout_buffer.episode_costs.mean())][-self.WINDOW :]
        vars(self.tdpg)["recent_costs"] = self._costs  # a checkpoint saves this attribute

    def _on_step(self) -> bool:
        return len(self._costs) < self.WINDOW or sum(self._costs) / self.WINDOW > self.cost


def methods() -> tuple[Method, ...]:
    """
    List policy gradient for each level of the cost (:data:`LEVELS`), and TDPG for each price (:data:`PRICES`).

    Except for the first level, policy gradient starts from its own policy at the previous, higher level. TDPG starts
    from each policy of policy gradient whose level is at least that of the paper (:data:`PAPERS_LEVEL`).
    """
    found: list[Method] = []
    start = None
    for level in LEVELS:
        pg = f"PG to {level:g}"
        stop = {"sb3_tdpg.paper.ball_paper.StopAtCost": dict(cost=level)}
        found.append(Method(pg, "BallCatch-v0-paper-pg", start, overrides=dict(callback=[stop])))
        found += [
            Method(f"TDPG {price} from {level:g}", "BallCatch-v0-paper", pg, overrides=dict(beta=1 / price))
            for price in PRICES
            if level >= PAPERS_LEVEL
        ]
        start = pg
    return tuple(found)


def select(runs: pd.DataFrame, records: pd.DataFrame) -> pd.DataFrame:
    """
    Select policies by the paper's rule: for each seed and level, the price whose selected epoch has least information.

    :param runs: ``model``, ``train_seed`` and ``information`` (NaN if no epoch met the limit) of each run of TDPG.
    :param records: Episodes of all runs.
    :return: the records of policy gradient and of the selected policies, with the label ``TDPG from <level>``
    """
    kept = [records[records["model"].str.startswith("PG")].assign(price=None)]
    level = runs["model"].str.split(" from ").str[1]
    met = runs.assign(level=level).dropna(subset="information")
    for (of_level, seed), candidates in met.groupby(["level", "train_seed"], sort=False):
        best = candidates.loc[candidates["information"].idxmin()]
        chosen = records[(records["model"] == best["model"]) & (records["train_seed"] == seed)]
        kept.append(chosen.assign(model=f"TDPG from {of_level}", price=best["model"].split()[1]))
    return pd.concat(kept, ignore_index=True)


def reproduce_ball_paper(out: Path, *, n_seeds: int = 5, **options: Any) -> str:
    """
    Train policy gradient, and TDPG from its policies, with the paper's algorithm; write tables, a figure and records.

    :param out: Folder for ``summary.md``, ``runs.csv``, ``seeds.csv``, ``robustness.png``, ``config.json``, ``runs/``.
    :param n_seeds: Number of training seeds of each method.
    :param options: See :class:`~sb3_tdpg.paper.common.Options`. By default each row has 200 episodes.
    :return: the summary, as Markdown
    """
    given = common.Options(**{"n_eval_episodes": 200, **options})
    everything = common.seed_by_seed(methods(), FIRST_SEED, n_seeds)
    rows = list(BALL_CATCH)
    tasks = common.make_tasks("BallCatch-v0", out / "runs", everything, lambda _: rows, given.overrides)
    complete_runs(tasks, **given.of_runs)
    folders = common.folders_of(tasks)

    records = common.read_records(tasks)
    training = records[records["scenario"] == "Training"].groupby(["model", "train_seed"])["cost"].mean()
    runs = pd.DataFrame(
        dict(model=m.label, train_seed=seed, cost=training[m.label, seed], **_progress(folders[m.label, seed]))
        for m, seed in everything
    )
    write_frame_atomically(runs, out / "runs.csv")
    chosen = select(runs[runs["model"].str.startswith("TDPG")], records)
    table = with_groups(chosen)
    write_frame_atomically(common.means_by_seed(table), out / "seeds.csv")
    save_figure(robustness_curves(chosen, NOISE_ROWS, BACKGROUND_ROWS), out / "robustness.png")

    cost_rows = [*rows, *group_rows(rows)]
    names = {f"PG to {PAPERS_LEVEL:g}": "PG", f"TDPG from {PAPERS_LEVEL:g}": "TDPG"}
    of_paper = table[table["model"].isin(list(names)) & table["scenario"].isin([row.name for row in cost_rows])]
    shown = chosen[chosen["model"].str.startswith("TDPG")].groupby(["model", "train_seed"])["price"].first()
    pairs = [(f"TDPG from {level:g}", f"PG to {other:g}") for level in LEVELS for other in LEVELS if other <= level]
    return common.write_results(
        out,
        "ball_paper.md",
        tasks,
        "make reproduce-ball-paper",
        given.publish,
        cost=comparison_markdown(aggregate_seeds(of_paper.assign(model=of_paper["model"].map(names))), cost_rows),
        comparisons=common.comparisons_table(table, pairs, KINDS),
        runs=common.markdown_table(_runs_table(runs)),
        chosen=common.markdown_table(shown.unstack().reset_index().rename(columns=dict(model="policy"))),
    )


def _progress(folder: Path) -> Mapping[str, float]:
    """Return the number of epochs of a run, and the information of its selected epoch (NaN if there is none)."""
    path = folder / "selected.json"
    information = pd.read_json(path, typ="series")["information"] if path.exists() else math.nan
    return dict(epochs=len(read_progress(folder)), information=information)


def _runs_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Average the runs of each method over seeds, and count the runs in which an epoch met the limit on the cost."""
    groups = runs.groupby("model", sort=False)
    table = groups[["epochs", "cost", "information"]].mean().round(1).assign(selected=groups["information"].count())
    return table.astype(str).reset_index().rename(columns=dict(model="method"))
