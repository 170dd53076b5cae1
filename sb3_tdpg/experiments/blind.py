"""
Train an open-loop policy, which observes only the time.

Dimension key: E environments, W waves.
"""

from __future__ import annotations

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_tdpg.problem import read_problem

N_WAVES = 8


class BlindVecEnv(VecEnvWrapper):
    r"""
    Replace every observation by the time :math:`t`, as :math:`\cos(\pi k t / T)` for k = 1 to 8.

    An SB3 algorithm that trains in this wrapper learns an open-loop policy. The wrapper does not change states and
    rewards.

    :param venv: Environments with a horizon T.
    :raises ValueError: if the environments have no horizon.
    """

    def __init__(self, venv: VecEnv) -> None:
        self.horizon = read_problem(venv).horizon
        super().__init__(venv, observation_space=spaces.Box(-1.0, 1.0, (N_WAVES,)))

    def reset(self) -> np.ndarray:
        """Start all episodes; return the observations for t = 0, ``(E, W)``."""
        self.venv.reset()
        self._time = np.zeros(self.num_envs)
        return self._observe(self._time)

    def step_wait(self) -> VecEnvStepReturn:
        """Finish a step; the terminal observation of an episode is the observation for t = T."""
        _, rewards, dones, infos = self.venv.step_wait()
        self._time += 1
        last = self._observe(self._time)
        infos = [
            {**info, "terminal_observation": seen} if done else info
            for info, seen, done in zip(infos, last, dones, strict=True)
        ]
        self._time[dones] = 0
        return self._observe(self._time), rewards, dones, infos

    def _observe(self, time: np.ndarray) -> np.ndarray:
        waves = np.pi * np.arange(1, N_WAVES + 1) / self.horizon  # (W,)
        return np.cos(time[:, None] * waves).astype(np.float32)  # (E, W)
