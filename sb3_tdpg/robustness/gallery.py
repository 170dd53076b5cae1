"""A picture of every perturbation of images in every severity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg.robustness.core import Perturber
from sb3_tdpg.robustness.registry import N_SEVERITIES, applicable, find
from sb3_tdpg.robustness.scenes import scene_perturbations
from sb3_tdpg.robustness.sensor import Sensor, kind_of
from sb3_tdpg.vec_env import make_episodes_env

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PANEL = 1.1  # inches a side


def perturbation_gallery(
    env: VecEnv | str,
    names: Sequence[str] | None = None,
    *,
    env_kwargs: Mapping[str, Any] | None = None,
    n_steps: int = 8,
    seed: int = 0,
) -> Figure:
    """
    Draw one image under each perturbation (rows) in each severity (columns), beside the unperturbed one.

    It is the last one that the first environment shows in ``n_steps`` steps with the action 0, so that what comes late
    or not at all is late; in a shorter episode, the last one of this. Given an id, the perturbations of its scene
    (:func:`.scene_perturbations`) are drawn, too.

    :param env: An environment with images, or a registered id.
    :param names: The rows; default: all that apply.
    :param env_kwargs: Keywords for the environment's constructor, with an id.
    :param n_steps: Steps before the image is taken.
    :param seed: Of environment and perturbations.
    :return: a figure; ``figure.savefig("gallery.png")`` writes it
    :raises ValueError: if the observations are no images, or a perturbation does not apply.
    """
    images = _Images(env, env_kwargs, n_steps, seed)
    frames, space = images.frames({})
    if kind_of(space) != "image":
        raise ValueError(f"a gallery shows images, and the observation space is {space}")
    assert isinstance(space, spaces.Box)
    scenes = scene_perturbations(env) if isinstance(env, str) else {}
    rows: dict[str, list[np.ndarray]] = {}
    for name in [*applicable(space, images.horizon), *scenes] if names is None else names:
        if name in scenes:
            rows[name] = [images.frames(scene_kwargs)[0][-1] for scene_kwargs in scenes[name]]
        else:
            rows[name] = [_perturbed(frames, name, severity, space, images.horizon, seed) for severity in range(1, 6)]
    return _draw(frames[-1], rows, Sensor(space))


class _Images:
    """What an environment shows, with any keywords if it is made by its id."""

    def __init__(self, env: VecEnv | str, env_kwargs: Mapping[str, Any] | None, n_steps: int, seed: int) -> None:
        if env_kwargs and not isinstance(env, str):
            raise ValueError("env_kwargs are for an environment that is made here: give its id in place of it")
        self.env, self.env_kwargs, self.n_steps, self.seed = env, dict(env_kwargs or {}), n_steps, seed
        self.horizon: int | None = None

    def frames(self, scene_kwargs: Mapping[str, Any]) -> tuple[list[np.ndarray], spaces.Space]:
        """Return the images of an episode up to the one that is drawn, and their space."""
        if not isinstance(self.env, str):
            return self._roll_out(self.env), self.env.observation_space
        env = make_episodes_env(self.env, 1, env_kwargs={**self.env_kwargs, **scene_kwargs}, use_processes=False)
        try:
            return self._roll_out(env), env.observation_space
        finally:
            env.close()

    def _roll_out(self, env: VecEnv) -> list[np.ndarray]:
        self.horizon = env.get_attr("horizon", [0])[0] if env.has_attr("horizon") else None
        env.seed(self.seed)
        observations = np.asarray(env.reset())
        frames = [observations[0]]
        n_steps = self.n_steps if self.horizon is None else min(self.n_steps, self.horizon - 1)
        actions = np.zeros((env.num_envs, *(env.action_space.shape or ())), env.action_space.dtype)
        for _ in range(n_steps):
            shown, _, dones, _ = env.step(actions)
            if dones[0]:
                break
            frames.append(np.asarray(shown)[0])
        return frames


def _perturbed(
    frames: Sequence[np.ndarray], name: str, severity: int, space: spaces.Box, horizon: int | None, seed: int
) -> np.ndarray:
    """Return the last of the images of an episode as it is seen."""
    perturbation = find(name)
    if (objection := perturbation.objection(space, horizon)) is not None:
        raise ValueError(f"the perturbation {name!r} does not apply: {objection}")
    perturber = Perturber(perturbation, severity, space, 1, seed=seed)
    return [perturber(frame[None]) for frame in frames][-1][0]


def _draw(unperturbed: np.ndarray, rows: Mapping[str, Sequence[np.ndarray]], sensor: Sensor) -> Figure:
    from matplotlib.figure import Figure

    n_columns = N_SEVERITIES + 1
    figure = Figure(figsize=(PANEL * n_columns + 1.2, PANEL * len(rows) + 0.3), layout="constrained")
    panels = figure.subplots(len(rows), n_columns, squeeze=False)
    for axes_of_row, (name, images) in zip(panels, rows.items(), strict=True):
        for axes, image in zip(axes_of_row, (unperturbed, *images), strict=True):
            picture = sensor.to_units(image[None])[0].transpose(1, 2, 0)
            # What is near is bright.
            colors = picture if picture.shape[2] == 3 else picture[..., 0]
            axes.imshow(colors, cmap="gray_r" if sensor.is_depth else "gray", vmin=0, vmax=1, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
        axes_of_row[0].set_ylabel(name, rotation=0, ha="right", va="center", fontsize=9)
    for axes, title in zip(panels[0], ("none", *range(1, n_columns)), strict=True):
        axes.set_title(str(title), fontsize=9)
    return figure
