"""Make a video of two policies side by side, without and with a sensor fault; ``make pictures`` runs this module."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.transforms import Affine2D
from PIL import Image
from stable_baselines3.common.utils import set_random_seed

from sb3_tdpg import TDPG, make_episodes_env
from sb3_tdpg.envs.lava import GOAL, LAVA
from sb3_tdpg.envs.squeeze_insert import wrap
from sb3_tdpg.evaluation.animation import save_gif
from sb3_tdpg.evaluation.figures import INK, PALETTE
from sb3_tdpg.robustness import PerturbedVecEnv

BLUE, GREEN, GHOST, RED = PALETTE[1], PALETTE[2], "#B0307F", "#C00000"
POLICIES = {"policy gradient": dict(beta=float("inf")), "TDPG": {}}
FAULT = dict(perturbation="vector_dropout", severity=5, scale=1.0, seed=0)
FAULT_SAID = ("Sensor fault: 7 of 10 readings lost", GHOST)
N_EPISODES = 1000
JAMS = 0.1  # rad
BETWEEN = 6  # number of frames from one step to the next
MIDDLE: dict[str, Any] = dict(ha="center", va="center")
TITLE = dict(MIDDLE, fontsize=21, weight="bold")  # legible on a phone, which shows the 800 pixels as 358


@dataclass(frozen=True, kw_only=True)
class Take:
    """
    Episodes of one policy, sorted by their initial states, which are the same for all policies.

    :param states: True states ``(T + 1, N, X)``.
    :param reports: Sensor readings of the states ``(T + 1, N, X)``.
    :param actions: Actions ``(T, N, U)``.
    :param costs: Episode costs ``(N,)``.
    """

    states: np.ndarray
    reports: np.ndarray
    actions: np.ndarray
    costs: np.ndarray


Takes = dict[tuple[str, str, bool], Take]  # keys: task, policy, and whether the sensor has the fault


def play(model: TDPG, env_id: str, faulty: bool) -> Take:
    set_random_seed(0)  # for the policy's noise
    env = make_episodes_env(env_id, N_EPISODES, seed=0)
    if faulty:
        env = PerturbedVecEnv(env, **FAULT)
    report, memory, start = env.reset(), None, np.ones(N_EPISODES, dtype=bool)
    states, reports, actions = [np.array([info["state"] for info in env.reset_infos])], [report], []
    costs = np.zeros(N_EPISODES)
    for _ in range(model.horizon):
        action, memory = model.predict(report, memory, start, deterministic=False)
        report, rewards, start, infos = env.step(action)
        states.append(np.array([info["state"] for info in infos]))
        reports.append(np.array([i.get("terminal_observation", y) for i, y in zip(infos, report, strict=True)]))
        actions.append(action)
        costs -= rewards
    order = np.argsort(states[0][:, 0] if env_id == "Lava-v0" else yaw_of(states[0]))
    parts = (np.array(part)[:, order] for part in (states, reports, actions))
    return Take(**dict(zip(("states", "reports", "actions"), parts, strict=True)), costs=costs[order])


def representative(costs: np.ndarray, n: int) -> np.ndarray:
    """Choose n episodes with evenly spread starts whose mean cost is closest to the mean cost of all episodes."""
    every = len(costs) // n
    choices = [first + every * np.arange(n) for first in range(every)]
    return min(choices, key=lambda chosen: abs(costs[chosen].mean() - costs.mean()))


def yaw_of(state: np.ndarray) -> np.ndarray:
    """Return the yaw of the part in rad from its sine and cosine: ``(...)`` from ``(..., 2)``."""
    return 0.5 * np.arctan2(state[..., 0], state[..., 1])


def box(
    axes: Axes,
    middle: tuple[float, float],
    size: tuple[float, float],
    angle: float,
    across: float = 0.0,
    **looks: object,
) -> None:
    """Draw a box with this length and width, rotated by an angle in rad about the middle of its cell."""
    patch = Rectangle((-size[0] / 2, across - size[1] / 2), *size, **looks)
    patch.set_transform(Affine2D().rotate(angle).translate(*middle) + axes.transData)
    axes.add_patch(patch)


def label(axes: Axes | Figure, x: float, y: float, words: str, colour: str, pad: float = 0.25, **looks: Any) -> None:
    """Write white text on a coloured label."""
    plate = dict(boxstyle=f"round,pad={pad}", facecolor=colour, edgecolor="none")
    axes.text(x, y, words, bbox=plate, color="white", **{**TITLE, **looks})


def tell_fault(figure: Figure, height: float, faulty: bool) -> None:
    """Write at this height in the figure whether the sensor works."""
    label(figure, 0.5, height, *FAULT_SAID if faulty else ("The sensor works", GREEN))


def drawn(figure: Figure) -> Image.Image:
    """Return the figure as an RGB image."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])


def draw_squeeze(axes: Axes, take: Take, shown: np.ndarray, step: int, share: float) -> None:
    """Draw twelve parts from above: slot, part, sensor reading and fingers, and a mark on parts that do not fit."""
    axes.set(xlim=(-0.55, 5.55), ylim=(-1.6, 0.5), aspect="equal")
    is_end = step == len(take.actions)
    for place, i in enumerate(shown):
        middle = (place % 6, -1.1 * (place // 6))
        yaw = yaw_of(take.states[step, i])
        box(axes, middle, (0.86, 0.34), 0.0, facecolor="#55555A")
        if share > 0:  # the fingers close, and the part turns
            yaw += share * wrap(yaw_of(take.states[step + 1, i]) - yaw)
            gap = 0.16 + 0.26 * (1 - min(1.0, 2 * share))
            for side in (-1, 1):
                box(axes, middle, (0.5, 0.07), take.actions[step, i, 0], side * gap, facecolor="#8C8C96", zorder=3)
        box(axes, middle, (0.76, 0.24), yaw, facecolor="#E69F00", zorder=2)
        if not is_end:
            seen = yaw_of(take.reports[step, i])
            box(axes, middle, (0.84, 0.3), seen, fill=False, edgecolor=GHOST, linestyle="--", linewidth=1.3, zorder=4)
        elif abs(yaw) > JAMS:
            label(axes, *middle, "jams", RED, pad=0.2, fontsize=12, zorder=5)


def draw_lava(axes: Axes, take: Take, shown: np.ndarray, step: int, share: float) -> None:
    """Draw each robot on its own line between wall and lava, and the position that its sensor shows."""
    n = len(shown)
    axes.set(xlim=(-1.0, 6.0), ylim=(-0.8, n - 0.2))
    axes.add_patch(Rectangle((-1, -1), 1, n + 1, facecolor="#8C8C96"))
    axes.add_patch(Rectangle((LAVA, -1), 1, n + 1, facecolor="#EB5A14"))
    axes.axvline(GOAL[0], color=GREEN, linewidth=3)
    axes.text(-0.5, n / 2 - 0.5, "wall", rotation=90, **MIDDLE, color="white", fontsize=16)
    axes.text(LAVA + 0.5, n / 2 - 0.5, "lava", rotation=90, **MIDDLE, color="white", fontsize=16)
    axes.text(GOAL[0] + 0.1, n - 0.75, "goal", color=GREEN, fontsize=14)
    for lane, i in enumerate(shown):
        here, seen = take.states[step, i, 0], take.reports[step, i, 0]
        if share > 0:
            here += share * (take.states[step + 1, i, 0] - here)
        axes.plot([0, LAVA], [lane, lane], color="0.8", linewidth=0.8, zorder=0)
        axes.plot(here, lane, "o", color=BLUE, markersize=10, zorder=2)
        if step < len(take.actions):
            seen = np.clip(seen, -0.9, 5.9)
            axes.plot(seen, lane, "o", color=GHOST, markersize=12, fillstyle="none", markeredgewidth=1.3, zorder=3)


TASKS = {
    "squeeze, insert": ("SqueezeInsert-v0", 800_000, draw_squeeze, 12),
    "lava": ("Lava-v0", 1_000_000, draw_lava, 5),
}


def frame(takes: Takes, shown: dict[str, np.ndarray], faulty: bool, time: float) -> Image.Image:
    """Draw both tasks with both policies at a time in steps; an episode that has ended does not move."""
    figure = Figure(figsize=(8.0, 5.6), dpi=100, facecolor="white")
    tell_fault(figure, 0.955, faulty)
    for column, name in enumerate(POLICIES):
        figure.text(0.275 + 0.475 * column, 0.875, name, **TITLE, color=INK)
        for row, (task, (_, _, draw, _)) in enumerate(TASKS.items()):
            axes = figure.add_axes((0.06 + 0.475 * column, 0.485 - 0.395 * row, 0.455, 0.3))
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_color("0.8")
            take = takes[task, name, faulty]
            step = min(int(time), len(take.actions))
            draw(axes, take, shown[task], step, 0.0 if step == len(take.actions) else time - step)
            cost = f"mean cost {take.costs.mean():.0f}"
            axes.set_title(cost, loc="right", fontsize=17, color=INK, pad=3)
            if column == 0:
                figure.text(0.028, 0.635 - 0.395 * row, task, rotation=90, **MIDDLE, fontsize=16, color=INK)
    figure.text(0.5, 0.03, "filled: the truth    pink: what the sensor says", **MIDDLE, fontsize=17, color=INK)
    return drawn(figure)


def sensor_fault(path: Path) -> None:
    """Train both policies on two tasks with seed 0 in two minutes, and record them without and with the fault."""
    takes = {}
    for task, (env_id, n_steps, _, _) in TASKS.items():
        for name, settings in POLICIES.items():
            model = TDPG("TRVPolicy", env_id, seed=0, **settings).learn(n_steps)
            takes.update({(task, name, faulty): play(model, env_id, faulty) for faulty in (False, True)})
    film(path, takes)


def film(path: Path, takes: Takes) -> None:
    """Write the episodes as a GIF; the episodes without the fault come first."""
    sensing = next(iter(POLICIES))
    shown = {task: representative(takes[task, sensing, True].costs, n) for task, (_, _, _, n) in TASKS.items()}
    n_steps = max(len(take.actions) for take in takes.values())
    frames, durations = [], []
    for faulty in (False, True):
        for i in range(n_steps * BETWEEN + 1):
            frames.append(frame(takes, shown, faulty, i / BETWEEN))
            durations.append(500 if i % BETWEEN == 0 else 80)  # ms
        durations[-1] = 3000
    palette = Image.fromarray(np.concatenate([frames[0], frames[3], frames[-1]])).quantize(96)
    save_gif(path, frames, durations, palette)
