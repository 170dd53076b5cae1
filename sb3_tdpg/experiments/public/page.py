"""Tables and the figure of the study on public tasks, from the folders of finished trainings."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.markdown import markdown_table
from sb3_tdpg.common.provenance import how_made, provenance, write_frame_atomically, write_run_config
from sb3_tdpg.evaluation import save_figure
from sb3_tdpg.evaluation.figures import PALETTE, WIDTH, new_panels
from sb3_tdpg.evaluation.statistics import interquartile_means, probabilities_of_improvement
from sb3_tdpg.experiments.public.tasks import TASKS, PublicTask
from sb3_tdpg.experiments.public.trainings import LABEL, LIMIT, PRESET, SHARE, TUNED, Training, learning_curve

TABLES = ("episodes", "times", "curves")


class Records:
    """
    What trainings left: returns of evaluation episodes, times, learning curves.

    :param trainings: Finished trainings.
    :param root: The folder that they lie in.
    """

    def __init__(self, trainings: Sequence[Training], root: Path) -> None:
        folders = [root / each.folder_name for each in trainings]
        self.episodes = _joined([pd.read_csv(folder / "episodes.csv") for folder in folders])
        times, curves = [], []
        for each, folder in zip(trainings, folders, strict=True):
            label = dict(zip(LABEL, each.label, strict=True))
            made = json.loads((folder / "config.json").read_text())["provenance"]
            git = made["git"] or dict(commit="", dirty=False)
            origin = dict(commit=git["commit"][:7] + "+" * git["dirty"], date=made["utc_time"][:10])
            times.append({**label, **json.loads((folder / "time.json").read_text()), **origin})
            curves.append(learning_curve(folder, each.task.n_timesteps).assign(**label))
        self.times = pd.DataFrame(times)
        self.curves = _joined(curves)

    @property
    def tasks(self) -> list[PublicTask]:
        """The tasks that there are records of."""
        return [task for task in TASKS if task.env_id in set(self.episodes["env_id"])]

    def means(self, task: PublicTask, method: str, deterministic: bool) -> np.ndarray:
        """Return the mean return of each seed, ``(seeds,)``."""
        frame = self.episodes
        frame = frame[(frame["env_id"] == task.env_id) & (frame["method"] == method)]
        frame = frame[frame["deterministic"] == deterministic]
        return frame.groupby("train_seed")["return"].mean().to_numpy()

    def write(self, out: Path, command: str) -> str:
        """Write the records, ``config.json``, ``curves.png`` and ``summary.md``, and return the latter."""
        how = provenance()  # before the files below change the checkout
        for name in TABLES:
            write_frame_atomically(getattr(self, name).round(3), out / f"{name}.csv.xz")
        save_figure(self.figure(), out / "curves.png")
        write_run_config(out / "config.json", dict(provenance=how))
        parts = [
            "# Public tasks",
            "## Final returns",
            "With the noise that the policies were trained with:",
            self.returns_table(False),
            "Without noise, as `evaluate_policy` evaluates by default:",
            self.returns_table(True),
            "## Cost limit",
            self.limit_table(),
            "## CPU time",
            self.time_table(),
            how_made(command, how, sorted(self.times["commit"].unique())),
        ]
        summary = "\n\n".join(parts) + "\n"
        write_atomically(out / "summary.md", summary)
        return summary

    def returns_table(self, deterministic: bool) -> str:
        """Compare the final returns with those of the rival."""
        rows = []
        for task in self.tasks:
            rival, ours, tuned = (self.means(task, m, deterministic) for m in (task.rival, PRESET, TUNED))
            _, (low,), (high,) = interquartile_means(rival[:, None])
            (mine,), *_ = interquartile_means(ours[:, None])
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
        """Say how much of the return, and of the information, each seed keeps under its cost limit."""
        rows = []
        nats = self.times.groupby(["env_id", "method"])["nats"].median()
        for task in self.tasks:
            without, kept = (self.means(task, method, deterministic=False) for method in (PRESET, LIMIT))
            if len(kept) == 0:
                continue
            shares = 1 + (kept - without) / np.abs(without)
            before, after = (nats[task.env_id, method] for method in (PRESET, LIMIT))
            rows.append(
                {
                    "task": task.env_id,
                    "without a limit": _interval(without),
                    "with the limit": _interval(kept),
                    "share kept": f"{_interquartile(shares):.2f} ({shares.min():.2f} to {shares.max():.2f})",
                    "verdict": "kept" if _interquartile(shares) >= SHARE else "**missed**",
                    "nat a step, without": f"{before:.2f}",
                    "with": f"{after:.2f}",
                }
            )
        return markdown_table(rows)

    def time_table(self) -> str:
        """Compare CPU times of the same number of steps: the median of the trainings on the last day of each kind."""
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
        for axes, task in zip(panels.flat, self.tasks, strict=False):
            for color, method in zip(PALETTE, (PRESET, task.rival, TUNED), strict=False):
                curves = self.curves[(self.curves["env_id"] == task.env_id) & (self.curves["method"] == method)]
                if curves.empty:
                    continue
                quantiles = curves.groupby("timestep")["return"].quantile([0, 0.5, 1]).unstack()
                label = "rival" if method == task.rival else method
                axes.plot(quantiles.index / 1000, quantiles[0.5], color=color, label=label, lw=1.4)
                axes.fill_between(quantiles.index / 1000, quantiles[0], quantiles[1], color=color, alpha=0.15, lw=0)
            axes.set_title(f"{task.env_id}\n(rival: {task.rival})", fontsize=8)
        for axes in panels[-1]:
            axes.set_xlabel("steps (thousands)", fontsize=8)
        lines = {
            name: line for axes in panels.flat for line, name in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(lines.values(), lines.keys(), loc="outside upper center", ncols=3, fontsize=8, frameon=False)
        return figure


def _joined(tables: Sequence[pd.DataFrame]) -> pd.DataFrame:
    filled = [table for table in tables if len(table)]
    return pd.concat(filled, ignore_index=True) if filled else pd.DataFrame()


def _interquartile(scores: np.ndarray) -> float:
    return float(interquartile_means(scores[:, None])[0][0])


def _interval(scores: np.ndarray) -> str:
    (point,), (low,), (high,) = interquartile_means(scores[:, None])
    digits = 0 if abs(point) >= 100 else 2 if abs(point) < 10 else 1
    return f"{point:,.{digits}f} [{low:,.{digits}f}, {high:,.{digits}f}]"
