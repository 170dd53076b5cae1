"""Run some episodes of a saved policy, print their costs, and optionally record them as a video."""

import contextlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.animation import Episode, check_animation_path, save_animation
from sb3_tdpg.evaluation.environments import check_models_fit, wrapped_for
from sb3_tdpg.evaluation.loading import load_model
from sb3_tdpg.evaluation.randomness import evaluation_seeds
from sb3_tdpg.evaluation.rollout import rollout
from sb3_tdpg.tdpg import TDPG


def enjoy(
    model_path: str | os.PathLike[str],
    env_id: str,
    env_kwargs: Mapping[str, Any] | None = None,
    *,
    seed: int = 0,
    n_episodes: int = 1,
    deterministic: bool = False,
    record: str | os.PathLike[str] | None = None,
) -> list[Episode]:
    """
    Run episodes of a saved model and print the cost of each, and its final state if the environment reports it.

    :param model_path: File written by ``model.save`` of TDPG, Stable-Baselines3 or sb3-contrib; see
        :func:`~sb3_tdpg.report.load_model`.
    :param env_id: A registered id, also in the ``module:id`` form.
    :param env_kwargs: Keywords of the environment's constructor.
    :param seed: Seed of the environment and of the policy's sampling.
    :param n_episodes: Number of episodes.
    :param deterministic: Act without noise, which changes the policy: see :meth:`~sb3_tdpg.TRVPolicy.predict`.
    :param record: File for a video, ``.gif`` or ``.mp4``. The TRVs are drawn below the picture; for models without
        TRVs, the actions. If the environment has a method ``film``, the video also shows the pictures between two steps
        that this method returns.
    :return: the episodes; without ``record`` they have no pictures
    :raises ValueError: if the model cannot be loaded or does not fit the environment, or if the video cannot be made.
    """
    env_kwargs = dict(env_kwargs or {})
    if record is not None:
        check_animation_path(record)
        env_kwargs.setdefault("render_mode", "rgb_array")
    model = load_model(Path(model_path), env_id, env_kwargs)
    has_trvs = isinstance(model, TDPG)
    check_models_fit({str(model_path): model}, [Scenario("enjoy", env_id, env_kwargs)])
    env = gym.make(env_id, **env_kwargs)
    fps = env.metadata.get("render_fps") or 10
    recorded = DummyVecEnv([lambda: _Recorder(env, record is not None)])
    with contextlib.closing(wrapped_for(model, recorded)) as vec_env:
        if record is not None and env.render_mode != "rgb_array":
            raise ValueError(f"{env_id} needs render_mode='rgb_array' to be recorded, not {env.render_mode!r}")
        episodes: list[Episode] = []
        signals: list[np.ndarray] = []
        for step in rollout(model, vec_env, n_episodes, seeds=evaluation_seeds(seed), deterministic=deterministic):
            signals.append(step.memory[0][0] if has_trvs else np.ravel(step.actions[0]))
            if step.finished[0]:
                pictures, costs, between = step.infos[0]["recorded"]
                episodes.append(Episode(pictures, np.stack(signals), np.array(costs), between))
                text = f"episode {len(episodes)}: cost {episodes[-1].costs.sum():.2f}"
                if (state := step.infos[0].get("state")) is not None:
                    text += f", final state {np.array2string(np.asarray(state), precision=3, suppress_small=True)}"
                print(text, flush=True)
                signals = []
    if n_episodes > 1:
        print(f"mean cost {np.mean([episode.costs.sum() for episode in episodes]):.2f}")
    if record is not None:
        horizon = model.horizon if has_trvs else max(len(episode.costs) for episode in episodes)
        save_animation(episodes, record, horizon=horizon, fps=fps, signal="TRV" if has_trvs else "action")
    return episodes


class _Recorder(gym.Wrapper):
    """Keep an episode's pictures (a vectorised environment loses the last one) and exact costs (it rounds them)."""

    def __init__(self, env: gym.Env, with_pictures: bool) -> None:
        super().__init__(env)
        self.with_pictures = with_pictures
        self.film = getattr(env.unwrapped, "film", None) if with_pictures else None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        result = self.env.reset(**kwargs)
        self.costs: list[float] = []
        self.between: list[list[np.ndarray]] = []
        self.pictures: list[Any] = [self._picture()] if self.with_pictures else []
        return result

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.costs.append(-float(reward))
        if self.film is not None:
            self.between.append(list(self.film()))
        if self.with_pictures:
            self.pictures.append(self._picture())
        recorded = (self.pictures, self.costs, self.between)
        return observation, reward, terminated, truncated, {**info, "recorded": recorded}

    def _picture(self) -> Any:
        try:
            picture: Any = self.env.render()
        except gym.error.DependencyNotInstalled as e:
            raise ValueError(f"{self.env} cannot be drawn: {e}") from e
        if not (isinstance(picture, np.ndarray) and picture.dtype == np.uint8):
            raise ValueError(f"render() of {self.env} must return an array (height, width, 3) of uint8")
        return picture
