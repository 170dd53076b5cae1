"""Training on ordinary environments, whose episodes may last for hundreds of steps or end after a few."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO

from sb3_tdpg import TDPG
from tests.benchmarks.speed.measure import SEED, Row, Sizes, compare, seconds

STEPS = 2000


class Walk(gym.Env):
    """Noise for an observation, in episodes of a fixed length, which may be shorter than the horizon."""

    observation_space = spaces.Box(-np.inf, np.inf, (8,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, horizon: int, length: int) -> None:
        self.horizon, self.length, self.t = horizon, length, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode."""
        super().reset(seed=seed)
        self.t = 0
        return self.np_random.standard_normal(8, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Count."""
        self.t += 1
        return self.np_random.standard_normal(8, np.float32), -float(action[0]), self.t == self.length, False, {}


def epoch(horizon: int, length: int, **kwargs: Any) -> Any:
    """Return a function that measures an epoch of TDPG with its defaults, with whole segments in each episode."""
    model = TDPG("TRVPolicy", Walk(horizon, length), seed=SEED, device="cpu", **kwargs)
    model.learn(STEPS)
    return lambda: seconds(lambda: model.learn(STEPS, reset_num_timesteps=False))


def bench_long_horizons(sizes: Sizes) -> Iterable[Row]:
    """Compare epochs with and without the penalty, with short and long horizons, and with PPO and RecurrentPPO."""
    for horizon in (500, 1000):
        yield compare(
            f"epoch of {STEPS} steps, horizon {horizon}: with the log-det penalty against without",
            epoch(horizon, horizon, beta=100.0),
            epoch(horizon, horizon),
            sizes.repetitions,
            goal=1 / 1.5,
        )
    yield compare(
        f"epoch of {STEPS} steps in episodes of 50: horizon 500 against horizon 50",
        epoch(500, 50),
        epoch(50, 50),
        sizes.repetitions,
        goal=0.8,
    )
    for name, algorithm, policy, goal in (
        ("PPO", PPO, "MlpPolicy", 1.0),
        ("RecurrentPPO", RecurrentPPO, "MlpLstmPolicy", 5.0),
    ):
        other = algorithm(policy, Walk(500, 500), n_steps=STEPS, seed=SEED, device="cpu")
        other.learn(STEPS)
        yield compare(
            f"epoch of {STEPS} steps, horizon 500, default settings: TDPG with the log-det penalty against {name}",
            epoch(500, 500, beta=100.0),
            lambda other=other: seconds(lambda: other.learn(STEPS, reset_num_timesteps=False)),
            sizes.loop_repetitions if name == "RecurrentPPO" else sizes.repetitions,
            goal=goal,
        )
