"""Environments for the tests of perturbations, and functions that roll them out."""

import functools
from collections import namedtuple
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from small_problems import CountdownEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdpg import BatchedVecEnv, make_episodes_env
from sb3_tdpg.envs.ball_catch import BallCatchEnv
from sb3_tdpg.envs.textures import random_texture
from sb3_tdpg.robustness import PerturbedVecEnv, applicable

HORIZON = 8


class PictureEnv(gym.Env):
    """A camera that looks at another part of a picture at every step; an episode has ``8 + name`` steps."""

    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, name=0, layout="HWC", side=24):
        self.lengths = 8 + name
        self.horizon = 8  # horizon of the shortest episodes
        self.layout, self.side = layout, side
        shape = dict(HWC=(side, side, 3), CHW=(3, side, side), HW=(side, side))[layout]
        self.observation_space = spaces.Box(0, 255, shape, np.uint8)
        self.picture = random_texture(3)

    def _observe(self):
        at = int(self.x) % (128 - self.side)
        image = self.picture[at : at + self.side, 3 * self.t : 3 * self.t + self.side]
        return dict(HWC=image, CHW=image.transpose(2, 0, 1), HW=image[..., 0])[self.layout].copy()

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.x = 0, self.np_random.uniform(0, 100)
        return self._observe(), {"state": np.array([self.x])}

    def step(self, action):
        self.t += 1
        self.x += float(action[0]) + self.np_random.normal()
        info = {"state": np.array([self.x]), "cost": abs(self.x)}
        return self._observe(), -info["cost"], self.t == self.lengths, False, info


DICT = spaces.Dict(
    dict(
        camera=spaces.Box(0, 255, (3, 10, 10), np.uint8),
        gyro=spaces.Box(-10, 1000, (2,), np.float32),
        touch=spaces.Discrete(1000),
    )
)


class ClockEnv(gym.Env):
    """An environment whose observation is 10 plus the time step, in every component; it records its actions."""

    action_space = spaces.Box(-1, 1, (2,), np.float32)
    horizon = 12

    def __init__(self, space=DICT, name=0):
        self.observation_space, self.name = space, name

    def _observe(self):
        now = self.t + 10
        if isinstance(self.observation_space, spaces.Dict):
            parts = {
                key: np.full(part.shape, now, part.dtype) for key, part in self.observation_space.items() if part.shape
            }
            return {**parts, "touch": now}
        return np.full(self.observation_space.shape, now, self.observation_space.dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.actions = 0, []
        return self._observe(), {}

    def step(self, action):
        self.t += 1
        self.actions.append(action)
        return self._observe(), 0.0, self.t == self.horizon, False, {"actions": np.array(self.actions)}


def dummy(make, n):
    return DummyVecEnv([functools.partial(make, i) for i in range(n)])


def pendulum(_=0):
    return gym.make("Pendulum-v1", max_episode_steps=HORIZON)


PROBLEMS = {
    "colour": lambda n: BatchedVecEnv(BallCatchEnv(renderer="fast", horizon=HORIZON), n),
    "channels last": lambda n: dummy(PictureEnv, n),
    "grey": lambda n: dummy(lambda i: PictureEnv(i, "HW"), n),
    "depth": lambda n: make_episodes_env("PandaGrasp-v0", n, use_processes=False),
    "unbounded vector": lambda n: make_episodes_env("Lava-v0", n, env_kwargs=dict(horizon=HORIZON)),
    "bounded vector": lambda n: dummy(pendulum, n),
}


def applying():
    """Yield every problem with every perturbation that applies to it."""
    for problem, make in PROBLEMS.items():
        env = make(1)
        horizon = env.get_attr("horizon")[0] if env.has_attr("horizon") else None
        for name in applicable(env.observation_space, horizon):
            yield pytest.param(problem, name, id=f"{name}, {problem}")
        env.close()


APPLYING = list(applying())

Run = namedtuple("Run", "observations starts states rewards dones terminal")


def run(env, n_steps=None, seed=0):
    """Roll out fixed actions; return arrays ``(T + 1, N, ...)``, in which resets replace terminal observations."""
    if n_steps is None:  # two episodes and the beginning of a third
        n_steps = 2 if getattr(env.unwrapped, "env", None) is not None and env.unwrapped.env.horizon == 1 else 20
    env.seed(seed)
    rng = np.random.default_rng(1)
    observations, starts = [env.reset()], [np.ones(env.num_envs, dtype=bool)]
    kept = observations[0].copy()
    states = [[info.get("state") for info in env.unwrapped.reset_infos]]
    rewards, all_dones, terminal = [], [], []
    for _ in range(n_steps):
        actions = rng.uniform(-0.3, 0.3, (env.num_envs, *env.action_space.shape)).astype(np.float32)
        seen, reward, dones, infos = env.step(actions)
        observations.append(seen.copy())
        starts.append(dones)
        reset_infos = env.unwrapped.reset_infos
        states.append([(reset_infos if done else infos)[i].get("state") for i, done in enumerate(dones)])
        states.append([info.get("state") for info in infos])
        rewards.append(reward)
        all_dones.append(dones)
        terminal.extend((i, info["terminal_observation"]) for i, info in enumerate(infos) if dones[i])
    np.testing.assert_array_equal(observations[0], kept)  # a returned observation is not overwritten
    return Run(np.stack(observations), np.stack(starts), states, np.array(rewards), np.array(all_dones), terminal)


def countdown(lengths=((4, 3), (2, 4))):
    return DummyVecEnv([lambda i=i: CountdownEnv(i, lengths[i]) for i in range(len(lengths))])


def perturbed(env, name, severity=3, seed=5, **kwargs):
    return PerturbedVecEnv(env, name, severity, seed=seed, **kwargs)


def differs(first, second):
    """Return whether observations ``(T, N, *obs)`` differ: ``(T, N)``."""
    return (first != second).reshape(*first.shape[:2], -1).any(axis=2)


def episodes(starts):
    """Yield the steps of each complete episode of each environment: (environment, slice)."""
    for i in range(starts.shape[1]):
        begins = np.flatnonzero(starts[:, i])
        for begin, end in pairwise(begins):
            yield i, slice(begin, end)
