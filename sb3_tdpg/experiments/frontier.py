"""Predict whether the information penalty will improve robustness on a task, from trainings with cost limits."""

import contextlib
import glob
import json
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from tqdm import tqdm

from sb3_tdpg.auto_weight import WINDOW, share_of
from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.markdown import fill_template, markdown_table
from sb3_tdpg.common.provenance import how_made, provenance, write_frame_atomically, write_run_config
from sb3_tdpg.common.threads import threads
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import save_figure, summary_table
from sb3_tdpg.evaluation.figures import INK, WIDTH, import_matplotlib, legend_above, new_panels
from sb3_tdpg.evaluation.information import information_bounds, rollout_information
from sb3_tdpg.evaluation.statistics import interquartile_means
from sb3_tdpg.experiments.blind import BlindVecEnv
from sb3_tdpg.experiments.runs import Run, Task, check_folder, complete_runs, read_progress
from sb3_tdpg.experiments.training import Training, make_training
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.presets import DEFAULTS, preset_of
from sb3_tdpg.tdpg import TDPG

SHARES = (99, 95, 90, 80)  # per cent
NO_PENALTY, OPEN_LOOP = "no penalty", "open loop"
N_INFORMATION = 1000  # episodes at most
LIMIT_COLOR = "#D55E00"
TIE = 0.01  # nats: smaller differences are chance, so that less information counts as none
# Thresholds of the verdict, as fractions.
IMPROVEMENT = 0.9  # of the improvement must be kept
INFORMATION = 0.1  # of the information may be kept: with more information, no limit has made a policy more robust
PRICE = 0.5  # of the cost without a penalty: the open loop may cost at most this much more
KNEE = 0.1  # of the distance from the origin to the line of mixtures: a knee is at least this far below the line


def frontier(
    env_id: str,
    *,
    shares: Sequence[float] = SHARES,
    n_seeds: int = 3,
    out: Path,
    jobs: int | None = None,
    n_timesteps: int | None = None,
    n_eval_episodes: int = 500,
    block: str | None = None,
    env_kwargs: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> str:
    """
    Predict whether the information penalty will make policies for a task more robust.

    This function trains policies without the penalty, policies with limits on the cost, and open-loop policies. It
    draws their cost against their information and writes a :func:`verdict`. Each limit keeps a share of the improvement
    of the cost during training (``beta="auto", cost_limit="95%"``). An open-loop policy is trained in the same way but
    observes only the time; the seed with the lowest cost is the *best open loop*. The information is the log-det bound
    on fresh episodes. An interval is a 95 % bootstrap interval over the seeds; with three seeds it is their range. The
    figure marks the :func:`knee`. Finished runs are kept, so that the same call resumes an interrupted one.

    :param env_id: A registered id.
    :param shares: Shares of the improvement in per cent, between 0 and 100.
    :param n_seeds: Number of training seeds of each row, from seed 0 on.
    :param out: Folder for ``frontier.md``, ``frontier.csv``, ``frontier.png``, ``runs.csv``, ``config.json`` and
        ``runs/``.
    :param jobs: Number of runs at a time; default: the number of cores.
    :param n_timesteps: Environment steps of each training; default: as in the block, or TDPG's default.
    :param n_eval_episodes: Number of episodes of each evaluation.
    :param block: Block of ``hyperparams/tdpg.yml``; default: the environment's block if there is one, or else TDPG's
        defaults. The block's callbacks are ignored, and the estimator is the log-det bound, unless
        the settings name another.
    :param env_kwargs: Keywords of the environment.
    :param settings: Settings that replace those of the block.
    :return: the summary, as Markdown
    :raises ValueError: if an argument is malformed or does not fit; no training has started in this case.
    """
    labels = [NO_PENALTY, *(f"{share:g} %" for share in sorted({*shares}, reverse=True)), OPEN_LOOP]
    if not shares or n_seeds < 1 or any(share_of(label.replace(" ", "")) is None for label in labels[1:-1]):
        raise ValueError(f"shares={[*shares]} must be at least one number between 0 and 100, and n_seeds at least 1")
    for name in {"beta", "cost_limit", "seed"} & set(settings or ()):
        raise ValueError(f"{name} is set by the frontier: leave it out of the settings")
    name = env_id.rpartition(":")[2]
    if block is None:
        with contextlib.suppress(KeyError):
            load_hyperparams(name)
            block = name
    # The penalty is the bound that the figure shows. Callbacks are removed, because they would select other epochs.
    shared: dict[str, Any] = dict(policy="TRVPolicy", mi_estimator="logdet", mi_kwargs=None, callback=[])
    shared.update({**(settings or {}), **({"env_kwargs": dict(env_kwargs)} if env_kwargs else {})})
    if block is not None:
        shared.pop("policy")
    if n_timesteps is not None or block is None:
        shared["n_timesteps"] = n_timesteps or 1
    model, _, length = _build(_task(env_id, block, shared, NO_PENALTY, 0, out)[0])
    if n_timesteps is None and block is None:
        preset = preset_of(model.observation_space, model.horizon)
        length = shared["n_timesteps"] = DEFAULTS[preset].total_epochs * model.epoch_size
    if length <= 2 * WINDOW * model.epoch_size:
        raise ValueError(
            f"{length} steps are {length // model.epoch_size} epochs of {model.epoch_size}: a share of the improvement "
            f"takes more than {2 * WINDOW} epochs"
        )
    keys = [(label, seed) for label in labels for seed in range(n_seeds)]
    tasks = [_task(env_id, block, shared, label, seed, out) for label, seed in keys]
    _build(tasks[-1][0])
    for task in tasks:
        check_folder(*task, n_eval_episodes)
    with threads(1):
        complete_runs(tasks, n_eval_episodes=n_eval_episodes, jobs=jobs)
        measured = tqdm(zip(tasks, keys, strict=True), "measuring the information", len(tasks), unit="run")
        rows = [_measure(task, label, n_eval_episodes) for task, (label, _) in measured]
    runs = pd.DataFrame(rows)
    first = np.mean([read_progress(folder)["rollout/ep_cost_mean"].iloc[0] for _, folder, _ in tasks[:n_seeds]])
    used = tasks[0][0].settings.get("env_kwargs") or {}  # includes the keywords of the block
    config = dict(env_id=env_id, block=block, settings=shared)
    return _write(out, config, runs, frontier_table(runs, float(first)), used)


def _task(env_id: str, block: str | None, shared: Mapping[str, Any], label: str, seed: int, out: Path) -> Task:
    """Return the run for one row and one seed, with its folder and its scenario."""
    own: dict[str, Any] = dict(beta=math.inf, cost_limit=None)
    if label == OPEN_LOOP:
        wrappers = {**(load_hyperparams(block) if block else {}), **shared}.get("vec_env_wrapper", [])
        own.update(nuisance=None, vec_env_wrapper=[*wrappers, f"{BlindVecEnv.__module__}.{BlindVecEnv.__name__}"])
    elif label != NO_PENALTY:
        own.update(beta="auto", cost_limit=label.replace(" ", ""))
    run = Run(label.replace("%", "per cent"), env_id, block, seed, {**shared, **own})
    scenario = Scenario("Training", env_id, sensor=BlindVecEnv if label == OPEN_LOOP else None)
    return run, out / "runs" / run.folder_name, [scenario]


def _build(run: Run) -> Training:
    """Build the model of a run, to find errors in the settings before any training."""
    try:
        training = make_training(run.env_id, run.settings, seed=0, device="cpu")
    except (gym.error.Error, KeyError, TypeError) as e:
        raise ValueError(f"env={run.env_id!r} with block {run.block!r} and the settings cannot be made: {e}") from e
    assert training.model.env is not None
    training.model.env.close()
    return training


def _measure(task: Task, label: str, n_eval_episodes: int) -> dict[str, Any]:
    """Measure the cost and the information of a finished run; return its row of ``runs.csv``."""
    run, folder, (scenario,) = task
    costs = summary_table(pd.read_csv(folder / "episodes.csv")).iloc[0]
    model = TDPG.load(folder / "model.zip", device="cpu")
    scenario = scenario.with_kwargs(**(run.settings.get("env_kwargs") or {}))
    n_episodes = min(N_INFORMATION, max(n_eval_episodes, model.policy.trv_dim + 2))
    upper, lower = information_bounds(rollout_information(model, scenario, n_episodes))
    return dict(
        label=label,
        seed=run.seed,
        cost=float(costs["mean"]),
        std=float(costs["std"]),
        information=upper,
        information_lower=lower,
        folder=folder.name,
    )


def frontier_table(runs: pd.DataFrame, first_cost: float) -> pd.DataFrame:
    """
    Summarise the runs of each label over seeds.

    :param runs: ``label``, ``seed``, ``cost`` and ``information`` of each run. The order of the labels is: no penalty,
        the shares, open loop.
    :param first_cost: Mean cost of the first epoch of the trainings without a penalty.
    :return: a row for each label: ``seeds``; the interquartile means ``cost``, ``nats`` and ``kept`` (fraction of the
        nats that the same seed has without a penalty), each with the ends ``_low`` and ``_high`` of its interval; the
        cost of the ``best`` seed; and ``improvement``, the decrease of the cost from ``first_cost`` as a fraction of
        its decrease without a penalty
    """
    # An open-loop policy's memory shares information with the state only through its actions, not through the sensor.
    runs = runs.assign(nats=runs["information"].where(runs["label"] != OPEN_LOOP, 0.0))
    of_seed = runs[runs["label"] == NO_PENALTY].set_index("seed")
    runs["kept"] = runs["nats"] / of_seed["nats"].clip(lower=TIE).loc[runs["seed"]].to_numpy()
    lowest = interquartile_means(of_seed[["cost"]].to_numpy())[0].item()
    rows = []
    for label, group in runs.groupby("label", sort=False):
        names = ("cost", "nats", "kept")
        ends = zip(names, *interquartile_means(group[list(names)].to_numpy()), strict=True)
        row = dict(label=label, seeds=len(group))
        for name, mean, low, high in ends:
            row.update({name: mean, f"{name}_low": low, f"{name}_high": high})
        gained = (first_cost - row["cost"]) / (first_cost - lowest) if first_cost > lowest else math.nan
        rows.append({**row, "best": group["cost"].min(), "improvement": gained})
    return pd.DataFrame(rows)


def knee(table: pd.DataFrame) -> str | None:
    """
    Return the label of the limit with the best trade-off, or ``None`` if no limit is clearly better than a mixture.

    A mixture uses the policy without a penalty in some episodes and the best open loop in the other episodes, so it
    lies on the line between these two policies. Nats and additional cost are divided by their values at the ends of
    the line. The origin is the cost of the policy without a penalty, with no information. The knee is the limit that
    is farthest below the line, if this distance is at least a tenth of the distance from the origin to the line.

    :param table: From :func:`frontier_table`.
    """
    rows = table.set_index("label")
    start, end = rows.loc[NO_PENALTY], rows.loc[OPEN_LOOP]
    if end["best"] <= start["cost"] or start["nats"] < TIE:
        return None
    limits = rows.drop([NO_PENALTY, OPEN_LOOP])
    height = (limits["cost"] - start["cost"]) / (end["best"] - start["cost"]) + limits["nats"] / start["nats"]
    return str(height.idxmin()) if height.min() <= 1 - KNEE else None


def verdict(table: pd.DataFrame) -> str:
    """
    Return a sentence that says whether the information penalty will probably make policies more robust.

    The verdict depends on two conditions. First, a limit keeps at least 90 % of the improvement with at most a tenth of
    the information. Second, the best open loop is cheap: it costs at most 1.5 times as much as the policy without a
    penalty. (If that cost is negative, it costs at most half of the absolute value more.) The verdict is "probably" if
    both conditions hold, "perhaps" if one holds, and otherwise "probably not". It is also "probably not" if the policy
    without a penalty carries no information.

    :param table: From :func:`frontier_table`.
    """
    rows = table.set_index("label")
    start, end = rows.loc[NO_PENALTY], rows.loc[OPEN_LOOP]
    if start["nats"] < TIE:
        return f"**Probably not**: without a penalty the policy carries {start['nats']:.2g} nats, nothing to leave out."
    limits = rows.drop([NO_PENALTY, OPEN_LOOP])
    good = limits[limits["improvement"] >= IMPROVEMENT]
    spare = good[good["kept"] <= INFORMATION]
    most = start["cost"] + PRICE * abs(start["cost"])
    is_cheap = bool(end["best"] <= most)
    word = ("Probably not", "Perhaps", "Probably")[int(len(spare) > 0) + is_cheap]
    cheapest, least = spare["cost"], (good if len(good) else limits)["kept"]
    shown = limits.loc[cheapest.idxmin() if len(spare) else least.idxmin()]
    interval = f"{_percent(shown['kept_low'])} to {_percent(shown['kept_high'])}"
    return (
        f"**{word}**: a limit of {shown.name} keeps {_percent(shown['improvement'])} of the improvement (cost "
        f"{shown['cost']:.4g}) with {_percent(shown['kept'])} of the information "
        f"({interval if shown['seeds'] > 1 else 'one seed, no interval'}), and the best open loop costs "
        f"{end['best']:.4g}, which is {'cheap' if is_cheap else 'expensive'}: the bound is {most:.4g}, half above the "
        f"{start['cost']:.4g} without a penalty."
    )


def report_command(out: Path, runs: pd.DataFrame, env_id: str, env_kwargs: Mapping[str, Any]) -> str:
    """
    Return the command that tests the verdict by comparing each limit with no penalty under every fault.

    :param out: Folder of the frontier.
    :param runs: ``label`` and ``folder`` of each run; the runs without a penalty come first.
    """
    folders = runs[runs["label"] != OPEN_LOOP].groupby("label", sort=False)["folder"].first()
    start = {label: glob.escape(str(out / "runs" / folder.rpartition("seed")[0])) for label, folder in folders.items()}
    words = [f"{label}={path}seed*/model.zip" for label, path in start.items()]
    words += ["--env", env_id, "--out", f"{out}-report"]
    if env_kwargs:
        words += ["--env-kwargs", *(f"{name}={json.dumps(value)}" for name, value in env_kwargs.items())]
    return shlex.join(["sb3-tdpg", "report", *words])


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _write(
    out: Path, config: Mapping[str, Any], runs: pd.DataFrame, table: pd.DataFrame, env_kwargs: Mapping[str, Any]
) -> str:
    write_frame_atomically(runs, out / "runs.csv")
    write_frame_atomically(table, out / "frontier.csv")
    write_run_config(out / "config.json", {**config, "runs": [*runs["folder"]]})
    best = knee(table)
    save_figure(_figure(runs, table, best), out / "frontier.png")

    def column(name: str, form: Callable[[float], str]) -> list[str]:
        ends = zip(*(table[f"{name}{end}"].map(form) for end in ("", "_low", "_high")), table["seeds"], strict=True)
        return [f"{mean} ({low} to {high})" if n > 1 else mean for mean, low, high, n in ends]

    overview = {
        "row": table["label"],
        "seeds": table["seeds"],
        "cost": column("cost", "{:.4g}".format),
        "best seed": table["best"].map("{:.4g}".format),
        "improvement kept": table["improvement"].map(_percent),
        "nats": column("nats", "{:.2g}".format),
        "of the nats": column("kept", _percent),
    }
    shown = runs[["label", "seed", "cost", "std", "information", "information_lower"]]
    summary = fill_template(
        "sb3_tdpg.experiments",
        "frontier.md",
        env_id=config["env_id"],
        verdict=verdict(table),
        knee=best,
        report=report_command(out, runs, config["env_id"], env_kwargs),
        overview=markdown_table(pd.DataFrame(overview)),
        runs=markdown_table(shown, digits=4),
        made=how_made("sb3-tdpg frontier", provenance()),
    )
    write_atomically(out / "frontier.md", summary)
    return summary


def _figure(runs: pd.DataFrame, table: pd.DataFrame, knee: str | None) -> Any:
    """Draw a dot for each run, the means with their intervals, the open loop and the knee, if there is one."""
    matplotlib = import_matplotlib()
    figure, ((axes,),) = new_panels(WIDTH * 0.75, 4.2)
    start, end = table.iloc[0], table.iloc[-1]
    points = table.iloc[:-1]
    shades = matplotlib.colormaps["viridis_r"](np.linspace(0.12, 1.0, len(points) - 1))
    axes.plot(points["nats"], points["cost"], color=INK, linewidth=0.8, zorder=2)
    mixture: dict[str, Any] = dict(color=LIMIT_COLOR, linestyle=(0, (1, 2)), linewidth=1.2, zorder=1)
    axes.plot([start["nats"], 0], [start["cost"], end["best"]], label="mixtures of the two", **mixture)
    sizes = np.linspace(9, 5, len(points))  # different sizes keep overlapping points visible
    for color, size, (_, row) in zip([INK, *shades], sizes, points.iterrows(), strict=True):
        seeds = runs[runs["label"] == row["label"]]
        axes.plot(seeds["information"], seeds["cost"], ".", color=color, markersize=5, alpha=0.6, zorder=3)
        errors = [[[row[n] - row[f"{n}_low"]], [row[f"{n}_high"] - row[n]]] for n in ("nats", "cost")]
        style: dict[str, Any] = dict(fmt="o", color=color, markersize=size, capsize=2, elinewidth=1, zorder=4)
        axes.errorbar(row["nats"], row["cost"], yerr=errors[1], xerr=errors[0], label=row["label"], **style)
        if row["label"] == knee:
            ring: dict[str, Any] = dict(facecolors="none", edgecolors=LIMIT_COLOR, linewidths=2, zorder=5)
            axes.scatter(row["nats"], row["cost"], s=170, label="knee", **ring)
    axes.scatter(0, end["best"], marker="D", s=90, color=LIMIT_COLOR, zorder=3, label="best open loop")
    axes.axhline(end["best"], color=LIMIT_COLOR, linestyle=(0, (4, 3)), linewidth=1, zorder=1)
    axes.margins(x=0.04, y=0.08)
    axes.grid(alpha=0.25)
    axes.set_xlabel("information in the TRVs (nat)", fontsize=9)
    axes.set_ylabel("mean episode cost", fontsize=9)
    legend_above(figure, axes, 5)
    return figure
