"""Small environments with known answers, and a quick TDPG model, for the tests."""

import re
from contextlib import contextmanager

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_tdpg import TDPG, BatchedVecEnv
from sb3_tdpg.callbacks import TrainingCheckpointCallback
from sb3_tdpg.cli import main
from sb3_tdpg.envs.base import POMDPEnv
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.experiments.runs import Run, complete_run

TINY_CRITIC = dict(hidden_sizes=(8,), batch_size=5, gradient_steps=2, warmup_gradient_steps=4, refit_gradient_steps=4)


def words(value):
    """Return a name for a test case without characters that tools which run single tests cannot handle."""
    return re.sub(r"\W+", " ", str(getattr(value, "__name__", value))).strip()


def tiny_tdpg(env="Lava-v0", **kwargs):
    """Make a TDPG model that trains an epoch in milliseconds."""
    estimator = kwargs.get("mi_estimator", "logdet")
    defaults = dict(
        n_episodes=20,
        mi_estimator=estimator,
        mi_kwargs={} if estimator in ("logdet", "loo", "vib") else dict(TINY_CRITIC),
        policy_kwargs=dict(net_arch=dict(encoder=[8], action_head=[8])),
        seed=0,
        device="cpu",
    )
    return TDPG("TRVPolicy", env, **{**defaults, **kwargs})


def train_epochs(model, n_epochs, **kwargs):
    """Train for a number of epochs; all episodes must last for the whole horizon."""
    return model.learn(n_epochs * model.n_episodes * model.horizon, **kwargs)


def parameters(module):
    """Return a copy of all parameters and buffers of a module."""
    return {name: value.detach().clone() for name, value in module.state_dict().items() if hasattr(value, "detach")}


def assert_same_parameters(first, second):
    assert first.keys() == second.keys()
    for name, value in first.items():
        # NaN means that a moving average has no value yet.
        np.testing.assert_array_equal(value.numpy(), second[name].numpy(), err_msg=name)


def same_parameters(first, second):
    return all(np.array_equal(value.numpy(), second[name].numpy(), equal_nan=True) for name, value in first.items())


class ToyEnv(gym.Env):
    """A number between -1 and 1 in any observation space; the cost is its square plus that of the first action."""

    def __init__(
        self,
        observation_space=None,
        action_space=None,
        *,
        horizon=3,
        gives_state=True,
        declares_horizon=True,
        nan_cost_in_episode=None,
        state_names=None,
    ):
        self.observation_space = observation_space or spaces.Box(-1, 1, (2,), np.float32)
        self.action_space = action_space or spaces.Box(-1, 1, (1,), np.float32)
        self._horizon = horizon
        if declares_horizon:
            self.horizon = horizon
        self.gives_state = gives_state
        if gives_state:
            self.state_space = spaces.Box(-1, 1, (1,), np.float64)
        self.nan_cost_in_episode = nan_cost_in_episode
        self.state_names = state_names
        self.n_resets = 0
        self.actions = []

    def _observe(self, space=None):
        space = self.observation_space if space is None else space
        if isinstance(space, spaces.Dict):
            return {name: self._observe(part) for name, part in space.items()}
        if isinstance(space, spaces.Discrete):
            return int(self.x > 0)
        if space.dtype == np.uint8:
            return np.full(space.shape, int(127 * (self.x + 1)), np.uint8)
        return np.full(space.shape, self.x, space.dtype)

    def _info(self):
        return {"state": np.array([self.x])} if self.gives_state else {}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_resets += 1
        self.t = 0
        self.x = float(self.np_random.uniform(-1, 1))
        return self._observe(), self._info()

    def step(self, action):
        assert self.action_space.contains(action), f"{action!r} is not in {self.action_space}"
        self.actions.append(action)
        self.t += 1
        cost = self.x**2 + 0.1 * float(np.ravel(action)[0]) ** 2
        if self.nan_cost_in_episode is not None and self.n_resets >= self.nan_cost_in_episode:
            cost = float("nan")
        return self._observe(), -cost, self.t == self._horizon, False, self._info()


class CountdownEnv(gym.Env):
    """
    Run episodes of the given lengths, one after the other; the cost of a step is ``100 * episode + t``.

    The observation is ``(name, episode, t)``, and the true state is its negative.
    """

    horizon = 4
    state_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, name, lengths):
        self.name = name
        self.lengths = lengths
        self.episode = -1

    def _observe(self):
        return np.array([self.name, self.episode, self.t], np.float32)

    def _info(self):
        return {"state": -self._observe().astype(np.float64)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode += 1
        self.t = 0
        return self._observe(), self._info()

    def step(self, action):
        cost = 100 * self.episode + self.t
        self.t += 1
        ended = self.t == self.lengths[self.episode % len(self.lengths)]
        return self._observe(), -float(cost), ended, False, self._info()


class LinearProblem(POMDPEnv):
    """The system ``x' = x + u`` for two controls, with a quadratic cost and a noisy sensor; all is differentiable."""

    sensor_noise_std = 0.3

    def __init__(self):
        super().__init__(horizon=2)
        self.state_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.action_space = spaces.Box(-1e6, 1e6, (1,), np.float32)

    def initial_state(self, n):
        return self.np_random.standard_normal((n, 1))

    def dynamics(self, state, action):
        return state + action

    def sensor(self, state):
        return (state + self.sensor_noise_std * self.np_random.standard_normal(state.shape)).astype(np.float32)

    def cost(self, state, action):
        return (state[:, 0] - 1) ** 2 + 0.3 * action[:, 0] ** 2

    def terminal_cost(self, state):
        return 2 * (state[:, 0] + 0.5) ** 2


class AtEveryStep(BaseCallback):
    """Call a function at every step of training."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def _on_step(self):
        return self.function(self) is not False


class AtEveryEpoch(BaseCallback):
    """Call a function at the end of every rollout."""

    def __init__(self, function):
        super().__init__()
        self.function = function

    def _on_step(self):
        return True

    def _on_rollout_end(self):
        self.function(self.model)


def toy_vec_env(n_envs=4, **kwargs) -> VecEnv:
    return DummyVecEnv([lambda: ToyEnv(**kwargs) for _ in range(n_envs)])


@contextmanager
def stopped_in_epoch(epoch):
    """Stop trainings with checkpoints at the start of an epoch, as Ctrl-C does."""
    begin = TrainingCheckpointCallback._on_rollout_start

    def stop(self):
        begin(self)
        if self.tdpg.epoch == epoch:
            raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(TrainingCheckpointCallback, "_on_rollout_start", stop)
        yield


def lava_env(n=20):
    return BatchedVecEnv(LavaEnv(), n)


def rollouts(model):
    """Roll out an epoch without an update; return the batch that the update would get."""
    model.train = lambda: None
    train_epochs(model, 1)
    return model.rollout_buffer.episode_batch()


def complete_runs_here(tasks, *, n_eval_episodes, jobs=None):
    """Complete runs in this process instead of workers, which would not have the patches of a test."""
    waiting, unfinished = list(tasks), {folder for _, folder, _ in tasks}
    while waiting:
        task = next(task for task in waiting if task[0].start not in unfinished)
        complete_run(*task, n_eval_episodes=n_eval_episodes)
        waiting.remove(task)
        unfinished.remove(task[1])


def give_settings(monkeypatch, more, cls=Run):
    """Replace settings of all runs with a dict, or with a function that returns a dict for a run."""
    settings = cls.settings.fget
    monkeypatch.setattr(cls, "settings", property(lambda run: settings(run) | (more(run) if callable(more) else more)))


def error_line(capsys, *command):
    """Run a command of the package that must fail with exit code 2 and an error in one line; return this line."""
    assert main([str(argument) for argument in command]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("error: ")
    return line
