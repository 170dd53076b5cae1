"""Draw every perturbation of images in every severity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg.evaluation.figures import new_figure
from sb3_tdpg.problem import horizon_of
from sb3_tdpg.robustness.core import Perturber
from sb3_tdpg.robustness.registry import N_SEVERITIES, PERTURBATIONS, applicable, find_applicable
from sb3_tdpg.robustness.sensor import Sensor, kind_of
from sb3_tdpg.vec_env import make_episodes_env

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PANEL = 1.1  # inches a side
N_STEPS = 8  # number of steps before the image is taken


def perturbation_gallery(
    env_id: str, names: Sequence[str] | None = None, *, env_kwargs: Mapping[str, Any] | None = None, seed: int = 0
) -> Figure:
    """
    Draw one image under each perturbation (rows) in each severity (columns), beside the unperturbed image.

    The image is taken after 8 steps with the action 0 (clipped to the bounds), so that late and lost frames are
    visible. If the episode is shorter, its last image is drawn.

    :param env_id: A registered id of an environment with images.
    :param names: Names of the perturbations to draw. By default, all perturbations of images that apply are drawn.
    :param env_kwargs: Keywords for the environment's constructor.
    :param seed: Seed of the environment and the perturbations.
    :raises ValueError: if the observations are not images, or a perturbation does not apply.
    """
    with closing(make_episodes_env(env_id, 1, env_kwargs=env_kwargs, use_processes=False)) as env:
        space, horizon = env.observation_space, horizon_of(env)
        if kind_of(space) != "image":
            raise ValueError(f"a gallery shows images, and the observation space is {space}")
        frames = _frames(env, seed)
    sensor = Sensor(space, horizon=len(frames))  # so that failures have begun by the last frame
    if names is None:  # changes of the timing, of the kind "any", are not visible in a single picture
        names = [name for name in applicable(space, horizon) if PERTURBATIONS[name].kind == "image"]
    n_columns = N_SEVERITIES + 1
    figure = new_figure(PANEL * n_columns + 1.2, PANEL * len(names) + 0.3)
    panels = figure.subplots(len(names), n_columns, squeeze=False)
    for name, axes_of_row in zip(names, panels, strict=True):
        perturbation = find_applicable(name, space, horizon)
        images = [frames[-1]]
        for severity in range(1, n_columns):
            perturber = Perturber(perturbation, severity, sensor, 1, seed=seed)
            images.append([perturber(frame[None]) for frame in frames][-1][0])
        for axes, image in zip(axes_of_row, images, strict=True):
            picture = sensor.to_units(image[None])[-1].transpose(1, 2, 0)
            colors = picture if picture.shape[2] == 3 else picture[..., 0]
            # In depth images, near pixels are bright.
            axes.imshow(colors, cmap="gray_r" if sensor.is_depth else "gray", vmin=0, vmax=1, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
        axes_of_row[0].set_ylabel(name, rotation=0, ha="right", va="center", fontsize=9)
    for axes, title in zip(panels[0], ("none", *range(1, n_columns)), strict=True):
        axes.set_title(str(title), fontsize=9)
    return figure


def _frames(env: VecEnv, seed: int) -> list[np.ndarray]:
    """Return the images of an episode, up to the image to draw."""
    env.seed(seed)
    frames = [np.asarray(env.reset())[0]]
    for _ in range(N_STEPS):
        observations, _, dones, _ = env.step(Sensor(env.action_space).blank[None])
        if dones[0]:
            break
        frames.append(np.asarray(observations)[0])
    return frames
