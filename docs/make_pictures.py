"""
Draw the pictures of the front page, the environments and the guide: ``make pictures``.

``python docs/make_pictures.py lava.gif when.png`` draws only these two. All pictures take half an hour, because the
policies in the videos are trained first.
"""

import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from fault_film import sensor_fault
from panda_film import panda_squeeze
from PIL import Image

from sb3_tdpg import TDPG
from sb3_tdpg.envs.ball_catch import DT, BallCatchEnv
from sb3_tdpg.envs.base import POMDPEnv
from sb3_tdpg.envs.bullet import enlarge
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.envs.panda_grasp import NOMINAL_GRASP, PandaGraspEnv
from sb3_tdpg.envs.panda_view import depth_picture
from sb3_tdpg.envs.peg_corner import HOLE, PegCornerEnv
from sb3_tdpg.envs.scenarios import PANDA_GRASP_CAMERA
from sb3_tdpg.envs.squeeze_insert import SqueezeInsertEnv
from sb3_tdpg.envs.textures import TEST_TEXTURES, TRAINING_TEXTURE, load_texture
from sb3_tdpg.evaluation import save_figure
from sb3_tdpg.evaluation.animation import save_gif
from sb3_tdpg.evaluation.enjoy import enjoy
from sb3_tdpg.evaluation.figures import new_figure
from sb3_tdpg.robustness import perturbation_gallery

Policy = Callable[[np.ndarray, int], Sequence[float] | np.ndarray]
STARTS = (0.5, 2.0, 3.5, 4.5)  # m
OPEN_LOOP = (-5.0, 0.0, 1.5, 0.0, -1.5)
MUG = (0.5, 0.02, 0.0, 0.6)  # m and rad; the handle points towards the viewer


def lava(path: Path) -> None:
    """Animate the open-loop strategy, which drives to the wall and then to the goal, from four initial positions."""
    rows_of_frames = []
    for start in STARTS:
        env = LavaEnv(render_mode="rgb_array")
        env.reset(seed=0)
        env._state = np.array([[start, 0.0]])
        pictures = [env.render()]
        for control in OPEN_LOOP:
            env.step(np.array([control]))
            pictures.append(env.render())
        rows_of_frames.append(pictures)
    frames = [Image.fromarray(np.concatenate(rows)) for rows in zip(*rows_of_frames, strict=True)]
    durations = [900] * (len(frames) - 1) + [2500]  # ms
    save_gif(path, frames, durations)


def ways(path: Path, env: POMDPEnv, starts: Sequence[Sequence[float]], look: Policy, blind: Policy) -> None:
    """
    Animate two policies from the same initial states: above a closed-loop policy, below an open-loop policy.

    :param look: The closed-loop policy, which returns the action for a state and a time.
    :param blind: The open-loop policy, which has the same arguments but uses only the time.
    """
    rows = []
    for policy in (look, blind):
        columns = []
        for start in starts:
            env.reset(seed=0)
            env._state = np.array([start], dtype=np.float64)
            pictures = [env.render()]
            for t in range(env.horizon):
                env.step(np.asarray(policy(env._state[0], t)))
                pictures.append(env.render())
            columns.append(pictures)
        rows.append([side_by_side(list(pictures)) for pictures in zip(*columns, strict=True)])
    gap = np.full((6, rows[0][0].shape[1], 3), 255, np.uint8)
    frames = [Image.fromarray(np.concatenate([above, gap, below])) for above, below in zip(*rows, strict=True)]
    durations = [1200] * (len(frames) - 1) + [2500]  # ms
    save_gif(path, frames, durations)


def squeeze_insert(path: Path) -> None:
    """Animate four parts that are turned by a closed-loop policy and by the best fixed angles."""
    turn, basin, fixed = 0.85, np.deg2rad(64), (0.428, -0.073, -3.14, -3.123)

    def look(state: np.ndarray, t: int) -> list[float]:
        yaw = 0.5 * np.arctan2(state[0], state[1])
        fingers = -yaw * (1 - turn) / turn
        return [fingers if abs(yaw - fingers) < basin else yaw - np.sign(yaw) * basin]

    yaws = np.deg2rad([-70.0, -25.0, 40.0, 85.0])
    starts = np.column_stack([np.sin(2 * yaws), np.cos(2 * yaws)])
    env = SqueezeInsertEnv(render_mode="rgb_array")
    ways(path, env, starts, look, lambda state, t: [fixed[t]])


def peg_corner(path: Path) -> None:
    """Animate four pegs that move to the hole, on a straight line and via the corner."""
    fixed = ((-2.5, -2.5), (-1.27, -1.34), (-2.35, -2.19), (0.94, 0.92))
    starts = [(5.6, 5.2), (2.4, 5.0), (4.0, 2.6), (3.2, 3.8)]
    env = PegCornerEnv(render_mode="rgb_array")
    ways(path, env, starts, lambda state, t: HOLE - state, lambda state, t: fixed[t])


def when(path: Path) -> None:
    """Draw the decision tree of the page "When to use what"."""
    figure = new_figure(9.0, 2.9)
    figure.set_layout_engine("none")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set(xlim=(0.05, 3.95), ylim=(0.15, 1.85))
    steps = [
        ("Can you list what will\nchange about the sensor?", "train on it:\nnuisances, noise\nof that range"),
        ("Does a policy that hardly\nlooks cost little more?\n(sb3-tdpg frontier)", "the bottleneck:\nbeta=1/75"),
        ("Are velocities or earlier\nobservations hidden?", "a memory:\nTRVs or\nRecurrentPPO"),
    ]
    box = dict(boxstyle="round,pad=0.5", facecolor="white", edgecolor="#0072B2")
    end = dict(boxstyle="round,pad=0.5", facecolor="#E6F1F8", edgecolor="none")
    arrow = dict(arrowstyle="->", color="0.4", shrinkA=24, shrinkB=24)
    for i, (question, answer) in enumerate(steps):
        x = 0.5 + i
        axes.text(x, 1.5, question, ha="center", va="center", fontsize=8.5, bbox=box)
        axes.text(x, 0.45, answer, ha="center", va="center", fontsize=8.5, bbox=end)
        axes.annotate("", (x, 0.45), (x, 1.5), arrowprops=arrow)
        axes.text(x + 0.06, 0.98, "yes", fontsize=8.5)
        axes.annotate("", (x + 1, 1.5), (x, 1.5), arrowprops=dict(arrow, shrinkA=62, shrinkB=62))
        axes.text(x + 0.5, 1.58, "no", fontsize=8.5, ha="center")
    axes.text(
        3.5,
        1.5,
        "PPO, or TDPG with\nbeta=inf, and a\nsb3-tdpg report",
        ha="center",
        va="center",
        fontsize=8.5,
        bbox=end,
    )
    save_figure(figure, path)


def side_by_side(images: list[np.ndarray], gap: int = 6) -> np.ndarray:
    """Join images of the same height ``(H, W, 3)`` in a row, with white gaps."""
    space = np.full((images[0].shape[0], gap, 3), 255, np.uint8)
    return np.concatenate([part for image in images for part in (image, space)][:-1], axis=1)


def fly(texture: str = TRAINING_TEXTURE) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """
    Run an episode of a scripted oracle that drives at a constant speed to the point where the ball lands.

    :return: 26 pictures from ``render`` and 26 images from the camera
    """
    env = BallCatchEnv(render_mode="rgb_array", texture=texture, robot_range=(-1.7, -1.7))
    observation, info = env.reset(seed=0)
    d, ball_x, _, speed_x, _ = info["state"]
    lands = ball_x + speed_x * DT * env.horizon
    speed = (lands - d) / (env.control_gain * env.horizon)
    pictures, observations = [env.render()], [observation]
    for _ in range(env.horizon):
        observations.append(env.step(np.array([speed]))[0])
        pictures.append(env.render())
    env.close()
    return pictures, [image.transpose(1, 2, 0) for image in observations]


def ball_textures(path: Path) -> None:
    """Draw the eight textures upright, as on the wall, with the camera's image below each texture."""
    columns = []
    for name in (TRAINING_TEXTURE, *TEST_TEXTURES):
        (observation, _) = BallCatchEnv(renderer="fast", texture=name, robot_range=(0, 0)).reset(seed=0)
        upright = np.rot90(load_texture(name))
        columns.append(np.concatenate([upright, np.full((6, 128, 3), 255, np.uint8), enlarge(
            observation.transpose(1, 2, 0), 2)]))  # fmt: skip
    Image.fromarray(side_by_side(columns)).quantize(224, Image.Quantize.MAXCOVERAGE).save(path, optimize=True)


def ball_camera(path: Path) -> None:
    """Draw three images of the camera: early, in the middle and late in the flight of the ball."""
    _, observations = fly()
    Image.fromarray(side_by_side([enlarge(observations[t], 4) for t in (1, 9, 18)])).save(path, optimize=True)


def ball_catch(path: Path) -> None:
    """Animate the scene from the side and the camera's image, at two thirds of the real speed."""
    pictures, observations = fly()
    frames = []
    for picture, observation in zip(pictures, observations, strict=True):
        scene = Image.fromarray(picture[:, :512]).resize((320, 160), Image.Resampling.LANCZOS)
        seen = Image.fromarray(observation).resize((160, 160), Image.Resampling.NEAREST)
        frames.append(Image.fromarray(side_by_side([np.array(scene), np.array(seen)])))
    # Additional patches keep the colours of small parts in the palette.
    rare = np.array([(0, 120, 0), (0, 155, 0), (0, 190, 0), (10, 30, 80), (15, 60, 130), (35, 35, 40)], np.uint8)
    patches = rare[None].repeat(81, axis=1)[:, : frames[0].width].repeat(600, axis=0)
    palette = Image.fromarray(np.concatenate([*frames[::6], patches])).quantize(64)
    durations = [100] * (len(frames) - 1) + [2000]  # ms
    save_gif(path, frames, durations, palette)


def grasp(motion: str) -> PandaGraspEnv:
    """Let a scripted oracle, which knows the mug's pose, grasp a mug by its rim; return the environment."""
    env = PandaGraspEnv(motion=motion, render_mode="rgb_array")
    env.reset(seed=0)
    env._state = np.array([MUG])
    pose = NOMINAL_GRASP.copy()
    pose[:2] = MUG[0] + 0.045, MUG[1] + 0.01
    env.step((pose - NOMINAL_GRASP) / 0.1)
    return env


def panda_depth(path: Path) -> None:
    """Draw the scene before a grasp from the side, and the depth image."""
    env = grasp("fast")
    env._view.place(env._film[0])
    scene = env._view.scene_picture(768, 1152)
    seen = enlarge(depth_picture(env._world.camera.images(np.array([MUG]))[0]), 3)
    env.close()
    small = np.array(Image.fromarray(scene).resize((576, 384), Image.Resampling.LANCZOS))
    Image.fromarray(side_by_side([small, seen])).save(path, optimize=True)


def panda_camera(path: Path) -> None:
    """Draw a mug from five camera heights: the usual one, and the lowest and highest in training and in the test."""
    (test, train) = (PANDA_GRASP_CAMERA[i].env_kwargs["camera_range"] for i in (1, 0))
    env = PandaGraspEnv()
    heights = [test[0], train[0], 0.0, train[1], test[1]]
    images = env.sensor(np.array([[*MUG, height] for height in heights]))
    env.close()
    Image.fromarray(side_by_side([enlarge(depth_picture(image), 2) for image in images])).save(path, optimize=True)


def panda_grasp(path: Path) -> None:
    """Animate the paper's slow motion (down, close, up), with fewer frames while the hand comes down."""
    env = grasp("reference")
    pictures = list(env.film())
    env.close()
    # Moving down and closing take more than half of the time, but the lift is more important.
    shown = [*range(40, 126, 6), *range(126, 139, 2), *range(139, len(pictures), 3)]
    durations = [80] * (len(shown) - 1) + [2000]  # ms
    save_gif(path, [Image.fromarray(pictures[i]) for i in shown], durations)


def learned(path: Path, env_id: str, **shown: Any) -> None:
    """Train TDPG with its defaults, and record episodes with the TRVs below the scene."""
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder, "model.zip")
        TDPG("TRVPolicy", env_id, seed=0).learn().save(model)
        enjoy(model, env_id, record=path, **shown)


def perturbations(path: Path, env_id: str, **env_kwargs: object) -> None:
    """Draw one image under each perturbation at five severities."""
    perturbation_gallery(env_id, env_kwargs=env_kwargs).savefig(path, dpi=80)
    with Image.open(path) as picture:
        # The picture has no palette, which would turn blurs into bands of colour.
        picture.convert("RGB").save(path, optimize=True)


DOCS = Path(__file__).parent
PICTURES: dict[str, Callable[[Path], None]] = {
    "guide/sensor_fault.gif": sensor_fault,
    "guide/when.png": when,
    "guide/perturbations_ball.png": partial(perturbations, env_id="BallCatch-v0", renderer="fast"),
    "guide/perturbations_grasp.png": partial(perturbations, env_id="PandaGrasp-v0"),
    "environments/lava.gif": lava,
    "environments/squeeze_insert.gif": squeeze_insert,
    "environments/panda_squeeze.gif": panda_squeeze,
    "environments/peg_corner.gif": peg_corner,
    "environments/ball_textures.png": ball_textures,
    "environments/ball_camera.png": ball_camera,
    "environments/ball_catch.gif": ball_catch,
    "environments/ball_catch_tdpg.gif": partial(learned, env_id="BallCatch-v0", env_kwargs=dict(texture="blue_tiles")),
    "environments/panda_depth.png": panda_depth,
    "environments/panda_camera.png": panda_camera,
    "environments/panda_grasp.gif": panda_grasp,
    "environments/panda_grasp_tdpg.gif": partial(
        learned, env_id="PandaGrasp-v0", env_kwargs=dict(yaw_range=(0.0, 6.28)), n_episodes=3, seed=1
    ),
}


if __name__ == "__main__":
    wanted = sys.argv[1:] or [Path(name).name for name in PICTURES]
    if unknown := set(wanted) - {Path(name).name for name in PICTURES}:
        sys.exit(f"no such pictures: {sorted(unknown)}; there are {[Path(name).name for name in PICTURES]}")
    for name, draw in PICTURES.items():
        if Path(name).name in wanted:
            draw(DOCS / name)
            print(f"docs/{name}", flush=True)
