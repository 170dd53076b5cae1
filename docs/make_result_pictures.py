"""
Draw the pictures of the results pages again from the published records: ``python docs/make_result_pictures.py``.

The records in ``docs/results/`` call the ablation without the penalty "its control". The pictures and pages call it
"TDPG without the penalty". ``training.png`` needs the training logs, which are not published, and is not drawn here.
"""

from itertools import cycle
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_tdpg.envs.scenarios import BALL_CATCH, BALL_CATCH_DIAGNOSIS, LAVA, PANDA_GRASP, PANDA_GRASP_CAMERA
from sb3_tdpg.evaluation import save_figure
from sb3_tdpg.evaluation.figures import PALETTE
from sb3_tdpg.paper.certificates import certificate_figure
from sb3_tdpg.paper.plots import diagnosis_bars, failures_by_camera, failures_by_yaw, robustness_curves

RESULTS = Path(__file__).parent / "results"
BENCHMARK_MI = Path(__file__).parents[1] / "tests" / "benchmarks" / "benchmark_mi"

ABLATIONS = {
    "its control": "TDPG without the penalty",
    "control, plain images": "TDPG without the penalty, plain images",
}
# Method in the records of ball catching -> name among the baselines, as in the table of results/baselines.md.
RECORDED_BALL = {
    "control, plain images": "PG",
    "its control": "PG, perturbed images",
    "TDPG": "TDPG, perturbed images",
}
NOISE_ROWS = [row.name for row in BALL_CATCH[1:5]]
BACKGROUND_ROWS = [row.name for row in BALL_CATCH[5:]]
N_LAVA_SEEDS = 5  # the baselines have the first five of ten


def episodes(folder: Path) -> pd.DataFrame:
    """Read the episodes of a folder, with the names that the pages use."""
    return pd.read_csv(folder / "episodes.csv.xz").replace({"model": ABLATIONS})


def ball_catch(folder: Path) -> None:
    """Costs under noise and in front of other walls, and what the policies use."""
    records = episodes(folder)
    table = records[records["scenario"].isin([row.name for row in BALL_CATCH])]
    # The paper's own settings have one seed, and their own table.
    own = table[~table["model"].str.startswith("paper's")]
    save_figure(robustness_curves(own, NOISE_ROWS, BACKGROUND_ROWS), folder / "robustness.png")
    diagnosis = records[records["scenario"].isin([row.name for row in BALL_CATCH_DIAGNOSIS])]
    save_figure(diagnosis_bars(diagnosis[diagnosis["model"].isin(own["model"])]), folder / "diagnosis.png")


def grasps() -> None:
    """Share of failures over the yaw of the mug, and over the height of the camera."""
    for folder, row, draw, name in (
        (RESULTS / "panda_grasp", PANDA_GRASP[1], failures_by_yaw, "yaw.png"),
        (RESULTS / "panda_grasp_camera", PANDA_GRASP_CAMERA[1], failures_by_camera, "camera.png"),
    ):
        records = episodes(folder)
        save_figure(draw(records[records["scenario"] == row.name]), folder / name)


def seed_means(seeds: pd.DataFrame, rows: list[str]) -> pd.DataFrame:
    """Mean cost over some rows, for each seed: ``(seeds, methods)``."""
    means = seeds[seeds["scenario"].isin(rows)].groupby(["train_seed", "model"], sort=False)["cost"].mean()
    return means.unstack("model")


def plain_ticks(axes: Axes, which: str, ticks: list[int]) -> None:
    """Label a logarithmic axis with plain numbers."""
    axes.tick_params(axis=which, which="minor", labelbottom=False, labelleft=False)
    axes.set(**{f"{which}ticks": ticks, f"{which}ticklabels": ticks})


def draw_lava(axes: Axes, seeds: pd.DataFrame) -> None:
    """Draw the median seed of each method over the sensor noise."""
    for color, (model, group) in zip(cycle(PALETTE), seeds.groupby("model", sort=False), strict=False):
        medians = group.groupby("scenario", sort=False)["cost"].median()[[row.name for row in LAVA]]
        style = "--" if model == "VIB" else "-"  # its line lies on that of TDPG
        axes.plot(range(len(LAVA)), medians, style, marker=".", color=color, label=model)
    axes.set_xticks(range(len(LAVA)), [f"{row.env_kwargs['sensor_noise_std'] ** 2:.0e}" for row in LAVA], fontsize=8)
    axes.set(yscale="log", xlabel=r"sensor noise $\sigma^2$", ylabel="mean episode cost", title="Lava")
    plain_ticks(axes, "y", [10, 20, 50, 100, 200])
    axes.legend(fontsize=8, frameon=False)


def draw_ball(axes: Axes, seeds: pd.DataFrame, models: list[str]) -> None:
    """Draw every seed's mean cost under noise and in front of other walls, one method a line."""
    for offset, color, label, rows in (
        (-0.15, PALETTE[1], "sensor noise, mean of 4", NOISE_ROWS),
        (0.15, PALETTE[0], "test backgrounds, mean of 7", BACKGROUND_ROWS),
    ):
        costs = seed_means(seeds, rows)[models]  # (seeds, methods)
        at = np.arange(len(models)) + offset
        axes.plot(costs.to_numpy(), np.broadcast_to(at, costs.shape), ".", color=color, alpha=0.7)
        axes.plot(costs.median(), at, "|", color=color, markersize=12, label=label)
    axes.set_yticks(range(len(models)), models, fontsize=8)
    axes.invert_yaxis()
    axes.set(xscale="log", xlabel="mean episode cost")
    axes.set_title("Ball catching", pad=22)
    plain_ticks(axes, "x", [2, 5, 10, 20, 50])
    axes.legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.4, 0.98), ncols=2)


def baselines(path: Path) -> None:
    """Costs of all methods on lava and on ball catching."""
    seeds = pd.read_csv(path.parent / "seeds.csv")
    lava = seeds[(seeds["env_id"] == "Lava-v0") & (seeds["model"] != "TDPG (log-det)")]
    recorded = pd.read_csv(RESULTS / "lava" / "episodes_text.csv.gz")
    recorded = recorded[recorded["model"] == "TDPG (log-det)"]
    means = recorded.groupby(["model", "train_seed", "scenario"], sort=False)["cost"].mean().reset_index()
    means = means[means["train_seed"] < means["train_seed"].min() + N_LAVA_SEEDS]

    ball = seeds[(seeds["env_id"] == "BallCatch-v0") & ~seeds["model"].isin(["first stage", *RECORDED_BALL.values()])]
    ball_recorded = pd.read_csv(RESULTS / "ball_catch" / "seeds.csv")
    ball_recorded = ball_recorded[ball_recorded["model"].isin(list(RECORDED_BALL))].replace({"model": RECORDED_BALL})
    ball_models = [*RECORDED_BALL.values(), *ball["model"].unique()]

    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    draw_lava(left, pd.concat([means, lava]))
    draw_ball(right, pd.concat([ball_recorded, ball]), ball_models)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path)


def estimators(path: Path) -> None:
    """Estimates on benchmark-mi divided by the true information, at n = 1000."""
    frames = [pd.read_csv(BENCHMARK_MI / name) for name in ("theirs.csv", "ours.csv")]
    both = pd.concat(frames)
    both = both[both["n"] == 1000]
    both["ratio"] = both["estimate"] / both["truth"]
    labels = {"cca": "CCA", "ksg": "KSG", "mine": "package's MINE", "our mine": "our MINE"}
    ratios = both.groupby(["task", "estimator"], sort=False)["ratio"].mean().unstack("estimator")[list(labels)]
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    axes = figure.add_subplot()
    axes.axvspan(0.9, 1.1, color="#DDDDDD", linewidth=0)
    for color, marker, (name, label) in zip(PALETTE, "sv^o", labels.items(), strict=False):
        # Beyond the axis at its edge: CCA reaches 2.5 times the truth, and the package's MINE -8 times.
        axes.plot(ratios[name].clip(-0.5, 2), range(len(ratios)), marker, color=color, label=label, markersize=5)
    axes.set_yticks(range(len(ratios)), ratios.index, fontsize=7)
    axes.invert_yaxis()
    axes.set_xlim(-0.55, 2.05)
    axes.set_xlabel("estimate / truth (mean over seeds; values beyond -0.5 and 2 at the edge)", fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=4, frameon=False, fontsize=9)
    save_figure(figure, path)


def certificate(folder: Path) -> None:
    """The figure of ``sb3-tdpg certify``."""
    frames = (pd.read_csv(folder / name) for name in ("random.csv.xz", "paper.csv"))
    save_figure(certificate_figure(*frames, trivial=315.0), folder / "certificate.png")


if __name__ == "__main__":
    ball_catch(RESULTS / "ball_catch")
    ball_catch(RESULTS / "ball_catch_varying")
    grasps()
    baselines(RESULTS / "baselines" / "costs.png")
    estimators(RESULTS / "benchmark_mi" / "accuracy.png")
    certificate(RESULTS / "certificate")
