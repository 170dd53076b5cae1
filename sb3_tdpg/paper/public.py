"""Compare TDPG with its preset, with tuned blocks and with a cost limit to PPO and RecurrentPPO on public tasks."""

from __future__ import annotations

import json
from collections.abc import Sequence
from concurrent.futures import as_completed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from scipy.stats import trim_mean
from tqdm import tqdm

from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.common.processes import process_pool
from sb3_tdpg.common.provenance import write_frame_atomically
from sb3_tdpg.common.threads import usable_cores
from sb3_tdpg.evaluation import save_figure
from sb3_tdpg.evaluation.figures import PALETTE, WIDTH, new_panels
from sb3_tdpg.evaluation.statistics import interquartile_means, probabilities_of_improvement
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.paper import common
from sb3_tdpg.paper.public_trainings import (
    LIMIT,
    PRESET,
    SHARE,
    TASKS,
    TUNED,
    PublicTask,
    Training,
    complete_training,
    with_limit,
)

FIRST_SEED = 200  # seeds below 200 were used for tuning
N_CURVE_POINTS = 50


def make_trainings(seeds: Sequence[int], n_eval_episodes: int = 100, n_timesteps: int | None = None) -> list[Training]:
    """List all trainings seed by seed, so that after an interrupt all methods have the same seeds."""
    trainings = []
    for seed in seeds:
        for listed in TASKS:
            task = replace(listed, n_timesteps=n_timesteps or listed.n_timesteps)
            methods: dict[str, dict[str, Any] | None] = {PRESET: {}, task.rival: None}
            if task.tuned is not None:
                methods[TUNED] = {**load_hyperparams(task.tuned), "n_timesteps": task.n_timesteps}
            trainings += [Training(task, name, seed, how, n_eval_episodes) for name, how in methods.items()]
    return trainings


def complete(training: Training, root: Path) -> list[Training]:
    """Complete a training, and for the preset also the training with a limit; return the finished trainings."""
    complete_training(training, root)
    if training.method != PRESET:
        return [training]
    limited = with_limit(training, root)
    complete_training(limited, root)
    return [training, limited]


def reproduce_public(out: Path, *, n_seeds: int = 5, **options: Any) -> str:
    """
    Train all methods on all tasks, and compare the returns.

    This needs the extra ``public`` of the package. Each training has one thread.

    :param out: Folder of the trainings, and of ``summary.md``, ``curves.png``, ``config.json`` and the records.
    :param n_seeds: Number of training seeds of each method.
    :param options: See :class:`~sb3_tdpg.paper.common.Options`. By default there are 100 episodes with the noise of the
        policy and 100 episodes without it.
    :return: the summary, as Markdown
    """
    given = common.Options(**{"n_eval_episodes": 100, **options})
    trainings = make_trainings(range(FIRST_SEED, FIRST_SEED + n_seeds), given.n_eval_episodes, given.n_timesteps)
    n_jobs = given.jobs or usable_cores()
    with tqdm(total=len(trainings), unit="training") as progress, process_pool(n_jobs) as pool:
        tasks = [pool.submit(complete, each, out) for each in trainings]
        for task in as_completed(tasks):
            progress.set_postfix_str(task.result()[0].folder_name)
            progress.update()
    finished = [done for task in tasks for done in task.result()]
    return Records(finished, out).write(out, given.publish)


class Records:
    """
    The records of trainings: returns of evaluation episodes, times and learning curves.

    :param trainings: Finished trainings.
    :param root: The folder that contains the trainings.
    """

    def __init__(self, trainings: Sequence[Training], root: Path) -> None:
        self.runs: list[Any] = [(each, root / each.folder_name, ()) for each in trainings]  # without scenarios
        self.episodes = common.read_records(self.runs)
        times, curves = [], []
        for each, folder, _ in self.runs:
            made = json.loads((folder / "config.json").read_text())["provenance"]
            git = made["git"] or dict(commit="", dirty=False)
            origin = dict(commit=git["commit"][:7] + "+" * git["dirty"], date=made["utc_time"][:10])
            times.append({**each.labels, **json.loads((folder / "time.json").read_text()), **origin})
            curves.append(learning_curve(folder, each.task.n_timesteps).assign(**each.labels))
        self.times = pd.DataFrame(times)
        self.curves = pd.concat(curves, ignore_index=True)

    @property
    def tasks(self) -> list[PublicTask]:
        """The tasks that have records."""
        return [task for task in TASKS if task.env_id in set(self.episodes["env_id"])]

    def means(self, task: PublicTask, method: str, deterministic: bool) -> np.ndarray:
        """Return the mean return of each seed, ``(seeds,)``."""
        frame = self.episodes
        frame = frame[(frame["env_id"] == task.env_id) & (frame["method"] == method)]
        frame = frame[frame["deterministic"] == deterministic]
        return frame.groupby("train_seed")["return"].mean().to_numpy()

    def write(self, out: Path, publish: Path | None = None) -> str:
        """Write the records, ``config.json``, ``curves.png`` and ``summary.md``; return the summary."""
        for name in ("episodes", "times", "curves"):
            write_frame_atomically(getattr(self, name).round(3), out / f"{name}.csv.xz")
        save_figure(self.figure(), out / "curves.png")
        tables = dict(noisy=self.returns_table(False), plain=self.returns_table(True))
        tables.update(limits=self.limit_table(), times=self.time_table())
        return common.write_results(out, "public.md", self.runs, "sb3-tdpg reproduce public", publish, **tables)

    def returns_table(self, deterministic: bool) -> str:
        """Compare the final returns of TDPG and of the baseline."""
        rows = []
        for task in self.tasks:
            rival, ours, tuned = (self.means(task, m, deterministic) for m in (task.rival, PRESET, TUNED))
            _, (low,), (high,) = interquartile_means(rival[:, None])
            mine = trim_mean(ours, 0.25)
            better = probabilities_of_improvement(-ours[:, None], -rival[:, None])
            rows.append(
                {
                    "task": task.env_id,
                    "rival": task.rival,
                    "return of the rival": _interval(rival),
                    "TDPG, one preset": _interval(ours),
                    "TDPG, tuned": _interval(tuned) if len(tuned) else "",
                    "verdict": "above" if mine > high else "within" if mine >= low else "**below**",
                    "P(preset better)": "{:.2f} [{:.2f}, {:.2f}]".format(*(x.item() for x in better)),
                }
            )
        return markdown_table(rows)

    def limit_table(self) -> str:
        """Show what share of the return and how much information the seeds keep with a cost limit."""
        rows = []
        nats = self.times.groupby(["env_id", "method"])["nats"].median()
        for task in self.tasks:
            without, kept = (self.means(task, method, deterministic=False) for method in (PRESET, LIMIT))
            if len(kept) == 0:
                continue
            shares = 1 + (kept - without) / np.abs(without)
            share = trim_mean(shares, 0.25)
            before, after = (nats[task.env_id, method] for method in (PRESET, LIMIT))
            rows.append(
                {
                    "task": task.env_id,
                    "without a limit": _interval(without),
                    "with the limit": _interval(kept),
                    "share kept": f"{share:.2f} ({shares.min():.2f} to {shares.max():.2f})",
                    "verdict": "kept" if share >= SHARE else "**missed**",
                    "nat a step, without": f"{before:.2f}",
                    "with": f"{after:.2f}",
                }
            )
        return markdown_table(rows)

    def time_table(self) -> str:
        """Compare median CPU times for the same number of steps; for each task and method, only the last day counts."""
        kind, dates = ["env_id", "method"], self.times["date"].fillna("")
        is_last = dates == dates.groupby([self.times[column] for column in kind]).transform("max")
        medians = self.times[is_last].groupby(kind)["cpu_s"].median()
        rows: list[list[str]] = []
        ratios: dict[str, list[float]] = {"PPO": [], "RecurrentPPO": []}
        for task in self.tasks:
            rival, ours = (medians[task.env_id, method] for method in (task.rival, PRESET))
            ratios[task.rival].append(ours / rival)
            seconds = [f"{rival:.0f}", f"{ours:.0f}", f"{ours / rival:.2f}", f"{task.n_timesteps / ours:.0f}"]
            rows.append([task.env_id, task.rival, *seconds])
        for rival, values in ratios.items():
            if values:
                rows.append(["geometric mean", rival, "", "", f"{np.exp(np.mean(np.log(values))):.2f}", ""])
        return markdown_table(
            rows, ["task", "rival", "rival (CPU-s)", "TDPG (CPU-s)", "ratio", "TDPG: steps per CPU-second"], align="llr"
        )

    def figure(self) -> Figure:
        """Draw the learning curves: median and range of the seeds' training returns."""
        n_columns = 4
        n_rows = -(-len(self.tasks) // n_columns)
        figure, panels = new_panels(WIDTH, 1.9 * n_rows, n_rows, n_columns)
        for axes in panels.flat[len(self.tasks) :]:
            axes.set_visible(False)
        lines = {}
        for axes, task in zip(panels.flat, self.tasks, strict=False):
            for color, method in zip(PALETTE, (PRESET, task.rival, TUNED), strict=False):
                curves = self.curves[(self.curves["env_id"] == task.env_id) & (self.curves["method"] == method)]
                if curves.empty:
                    continue
                quantiles = curves.groupby("timestep")["return"].quantile([0, 0.5, 1]).unstack()
                steps = quantiles.index / 1000
                name = "rival" if method == task.rival else method
                (lines[name],) = axes.plot(steps, quantiles[0.5], color=color, lw=1.4)
                axes.fill_between(steps, quantiles[0], quantiles[1], color=color, alpha=0.15, lw=0)
            axes.set_title(f"{task.env_id}\n(rival: {task.rival})", fontsize=8)
        for axes in panels[-1]:
            axes.set_xlabel("steps (thousands)", fontsize=8)
        figure.legend(lines.values(), lines.keys(), loc="outside upper center", ncols=3, fontsize=8, frameon=False)
        return figure


def learning_curve(folder: Path, n_timesteps: int) -> pd.DataFrame:
    """Average the returns of a training's episodes in intervals with equal numbers of steps."""
    episodes = pd.read_csv(folder / "training.csv")
    width = n_timesteps // N_CURVE_POINTS
    episodes["timestep"] = ((episodes["timestep"] - 1) // width + 1) * width
    return episodes.groupby("timestep", as_index=False)["return"].mean()


def _interval(scores: np.ndarray) -> str:
    (point,), (low,), (high,) = interquartile_means(scores[:, None])
    digits = 0 if abs(point) >= 100 else 2 if abs(point) < 10 else 1
    return f"{point:,.{digits}f} [{low:,.{digits}f}, {high:,.{digits}f}]"
