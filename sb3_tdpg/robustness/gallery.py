"""Draw every perturbation of images in every severity."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg.evaluation.figures import new_figure
from sb3_tdpg.problem import horizon_of
from sb3_tdpg.robustness.core import Perturber
from sb3_tdpg.robustness.registry import N_SEVERITIES, PERTURBATIONS, applicable, find_applicable, scene_perturbations
from sb3_tdpg.robustness.sensor import Sensor
from sb3_tdpg.vec_env import make_episodes_env

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PANEL = 1.1  # inches a side
N_STEPS = 8  # number of steps before the image is taken


def perturbation_gallery(
    env: VecEnv | str, names: Sequence[str] | None = None, *, env_kwargs: Mapping[str, Any] | None = None, seed: int = 0
) -> Figure:
    """
    Draw one image under each perturbation (rows) in each severity (columns), beside the unperturbed image.

    The image comes from the first environment after 8 steps with the action 0 (clipped to the bounds), so that late and
    lost frames are visible. If the episode is shorter, its last image is drawn. If ``env`` is an id, the perturbations
    of its scene (:func:`.scene_perturbations`) are drawn, too.

    :param env: An environment with images, or a registered id.
    :param names: Names of the perturbations to draw. By default, all perturbations of images that apply are drawn.
    :param env_kwargs: Keywords for the environment's constructor, if ``env`` is an id.
    :param seed: Seed of the environment and the perturbations.
    :raises ValueError: if the observations are not images, a perturbation does not apply, or there is none to draw.
    """
    if env_kwargs and not isinstance(env, str):
        raise ValueError("env_kwargs are for an environment that is made here: give its id in place of it")
    if names is not None and not names:
        raise ValueError("names=[] leaves nothing to draw: name a perturbation, or give None for all that apply")
    scenes = scene_perturbations(env) if isinstance(env, str) else {}

    def look(scene_kwargs: Mapping[str, Any]) -> tuple[spaces.Space, int | None, list[np.ndarray]]:
        if not isinstance(env, str):
            return _look(env, seed)
        kwargs = {**(env_kwargs or {}), **scene_kwargs}
        with contextlib.closing(make_episodes_env(env, 1, env_kwargs=kwargs, use_processes=False)) as made:
            return _look(made, seed)

    space, horizon, frames = look({})
    sensor = Sensor(space, horizon=len(frames))  # so that failures have begun by the last frame
    if not sensor.is_image:
        raise ValueError(f"a gallery shows images, and the observation space is {space}")
    rows: dict[str, list[np.ndarray]] = {}
    # The kind "any" is left out: it changes the timing, which a single picture does not show.
    shown = [name for name in applicable(space, horizon) if PERTURBATIONS[name].kind == "image"]
    for name in [*shown, *scenes] if names is None else names:
        if name in scenes:
            rows[name] = [look(scene_kwargs)[-1][-1] for scene_kwargs in scenes[name]]
            continue
        perturbation = find_applicable(name, space, horizon)
        perturbers = [Perturber(perturbation, severity, sensor, 1, seed=seed) for severity in range(1, 6)]
        rows[name] = [[perturber(frame[None]) for frame in frames][-1][0] for perturber in perturbers]
    return _draw(frames[-1], rows, sensor)


def _look(env: VecEnv, seed: int) -> tuple[spaces.Space, int | None, list[np.ndarray]]:
    """Return space, horizon and the images of the first environment's episode, up to the image to draw."""
    env.seed(seed)
    frames, horizon = [np.asarray(env.reset())[0]], horizon_of(env)
    actions = np.stack([Sensor(env.action_space).blank] * env.num_envs)
    for _ in range(min(N_STEPS, (horizon or N_STEPS + 1) - 1)):
        observations, _, dones, _ = env.step(actions)
        if dones[0]:
            break
        frames.append(np.asarray(observations)[0])
    return env.observation_space, horizon, frames


def _draw(unperturbed: np.ndarray, rows: Mapping[str, Sequence[np.ndarray]], sensor: Sensor) -> Figure:
    n_columns = N_SEVERITIES + 1
    figure = new_figure(PANEL * n_columns + 1.2, PANEL * len(rows) + 0.3)
    panels = figure.subplots(len(rows), n_columns, squeeze=False)
    for axes_of_row, (name, images) in zip(panels, rows.items(), strict=True):
        for axes, image in zip(axes_of_row, (unperturbed, *images), strict=True):
            picture = sensor.to_units(image[None])[-1].transpose(1, 2, 0)
            colors = picture if picture.shape[2] == 3 else picture[..., 0]
            # In depth images, near pixels are bright.
            axes.imshow(colors, cmap="gray_r" if sensor.is_depth else "gray", vmin=0, vmax=1, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
        axes_of_row[0].set_ylabel(name, rotation=0, ha="right", va="center", fontsize=9)
    for axes, title in zip(panels[0], ("none", *range(1, n_columns)), strict=True):
        axes.set_title(str(title), fontsize=9)
    return figure
