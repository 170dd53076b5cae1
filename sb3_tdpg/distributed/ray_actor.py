"""
What runs in the actors of :class:`~sb3_tdpg.distributed.ray_vec_env.RayVecEnv`: environments, stepped one after the other.

Dimension key: B environments of one actor.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cloudpickle
import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.env_util import is_wrapped, unwrap_wrapper
from stable_baselines3.common.monitor import Monitor

from sb3_tdpg.common.threads import set_threads


class Start(NamedTuple):
    """What an episode began from."""

    seed: int | None
    options: Mapping[str, Any]
    generator: np.random.Generator | None  # ``np_random`` just before a reset that had no seed


class Taken(NamedTuple):
    """A step of the present episode."""

    action: Any
    reward: float


class Setting(NamedTuple):
    """A call of ``set_attr``."""

    name: str
    value: bytes  # pickled, since whoever has set it may go on changing it


@dataclass
class History:
    """
    What brings a new environment to where a lost one was, if its episodes depend on nothing but ``np_random``.

    :param settings: Those from before the present episode, by name.
    :param start: How the present episode began; None before the first ``reset``.
    :param events: What has happened in it, in order.
    """

    settings: dict[str, Setting] = field(default_factory=dict)
    start: Start | None = None
    events: list[Taken | Setting] = field(default_factory=list)

    def begin_episode(self, start: Start) -> None:
        """Forget the last episode but for the attributes that were set in it."""
        self.settings.update((event.name, event) for event in self.events if isinstance(event, Setting))
        self.start = start
        self.events = []


class Steps(NamedTuple):
    """What a step of B environments returns, beside the observations."""

    rewards: np.ndarray  # (B,)
    dones: np.ndarray  # (B,)
    infos: list[dict[str, Any]]
    reset_infos: dict[int, dict[str, Any]]  # of the environments whose episode has ended
    starts: dict[int, Start]  # likewise, if they are kept


class Resets(NamedTuple):
    """What a reset of B environments returns, beside the observations."""

    infos: list[dict[str, Any]]
    starts: list[Start]  # if they are kept


def join(
    parts: Sequence[Any], space: spaces.Space, function: Callable[[Sequence[Any]], np.ndarray]
) -> np.ndarray | dict[str, np.ndarray] | tuple[np.ndarray, ...]:
    """Join observations, or batches of them, array by array: a ``Dict`` or ``Tuple`` space has several."""
    if isinstance(space, spaces.Dict):
        return {key: function([part[key] for part in parts]) for key in space.spaces}
    if isinstance(space, spaces.Tuple):
        return tuple(function([part[i] for part in parts]) for i in range(len(space.spaces)))
    return function(parts)


class EnvActor:
    """
    B environments. All methods but :meth:`call` return the observations, or None, and what else there is to tell.

    Both are pickled here: Ray takes about 0.1 ms longer over an array than over bytes, and would make it read-only.
    """

    def __init__(self) -> None:
        set_threads(1)
        self._envs: list[gym.Env] = []
        self._keep_starts = False

    def call(self, message: bytes) -> tuple[bytes, bytes]:
        """Call a method: ``(name, arguments)``, pickled."""
        method, arguments = cloudpickle.loads(message)
        observations, rest = getattr(self, method)(*arguments)
        return pickle.dumps(observations, pickle.HIGHEST_PROTOCOL), cloudpickle.dumps(rest)

    def make(self, env_fns: Sequence[Callable[[], gym.Env]], keep_starts: bool) -> tuple[None, tuple]:
        """Make the environments and return their spaces. Not in the constructor, whose errors Ray does not hand on."""
        self._envs = [env_fn() for env_fn in env_fns]
        self._keep_starts = keep_starts
        monitor = unwrap_wrapper(self._envs[0], Monitor)
        if keep_starts and isinstance(monitor, Monitor) and monitor.results_writer is not None:
            raise ValueError(
                "max_restarts must be 0 for environments whose Monitor writes a file, which would be begun anew: "
                "leave out the file (monitor_dir) and wrap the RayVecEnv in VecMonitor(env, filename)"
            )
        return None, (self._envs[0].observation_space, self._envs[0].action_space)

    def reset(self, seeds: Sequence[int | None], options: Sequence[dict[str, Any]]) -> tuple[Any, Resets]:
        """Reset all environments."""
        observations, infos, starts = [], [], []
        for env, seed, each_options in zip(self._envs, seeds, options, strict=True):
            if self._keep_starts:
                starts.append(Start(seed, each_options, deepcopy(env.unwrapped.np_random) if seed is None else None))
            observation, info = _reset(env, seed, each_options)
            observations.append(observation)
            infos.append(info)
        return self._stack(observations), Resets(infos, starts)

    def step(self, actions: Sequence[Any]) -> tuple[Any, Steps]:
        """Step all environments, and reset those whose episode has ended."""
        rewards: list[Any] = []
        observations, dones, infos = [], [], []
        reset_infos, starts = {}, {}
        for i, (env, action) in enumerate(zip(self._envs, actions, strict=True)):
            observation, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            info["TimeLimit.truncated"] = truncated and not terminated
            if done:
                info["terminal_observation"] = observation
                if self._keep_starts:
                    starts[i] = Start(None, {}, deepcopy(env.unwrapped.np_random))
                observation, reset_infos[i] = env.reset()
            observations.append(observation)
            rewards.append(reward)
            dones.append(done)
            infos.append(info)
        return self._stack(observations), Steps(np.stack(rewards), np.stack(dones), infos, reset_infos, starts)

    def restore(self, histories: Sequence[History]) -> tuple[Any, bool]:
        """Bring new environments to where others were; tell whether all went as it did then."""
        observations, is_same = [], True
        for env, history in zip(self._envs, histories, strict=True):
            for setting in history.settings.values():
                _set(env, setting)
            observation = None
            if history.start is not None:
                if history.start.generator is not None:
                    env.unwrapped.np_random = history.start.generator
                observation, _ = _reset(env, history.start.seed, history.start.options)
            for event in history.events:
                if isinstance(event, Setting):
                    _set(env, event)
                    continue
                observation, reward, terminated, truncated, _ = env.step(event.action)
                is_same &= not (terminated or truncated) and np.array_equal(float(reward), event.reward, equal_nan=True)
            observations.append(observation)
        # All environments are reset together for the first time.
        return None if observations[0] is None else self._stack(observations), bool(is_same)

    def get_attr(self, indices: Sequence[int], name: str) -> tuple[None, list[Any]]:
        """Return an attribute of some environments, also through wrappers."""
        return None, [self._envs[i].get_wrapper_attr(name) for i in indices]

    def has_attr(self, indices: Sequence[int], name: str) -> tuple[None, list[bool]]:
        """Tell which of some environments have an attribute."""
        return None, [self._envs[i].has_wrapper_attr(name) for i in indices]

    def set_attr(self, indices: Sequence[int], setting: Setting) -> tuple[None, list[None]]:
        """Set an attribute of some environments."""
        for i in indices:
            _set(self._envs[i], setting)
        return None, [None] * len(indices)

    def env_method(
        self, indices: Sequence[int], name: str, args: Sequence[Any], kwargs: Mapping[str, Any]
    ) -> tuple[None, list[Any]]:
        """Call a method of some environments, also through wrappers."""
        return None, [self._envs[i].get_wrapper_attr(name)(*args, **kwargs) for i in indices]

    def env_is_wrapped(self, indices: Sequence[int], wrapper_class: type[gym.Wrapper]) -> tuple[None, list[bool]]:
        """Tell which of some environments have a wrapper of a class."""
        return None, [is_wrapped(self._envs[i], wrapper_class) for i in indices]

    def render(self, indices: Sequence[int]) -> tuple[None, list[Any]]:
        """Render some environments."""
        return None, [self._envs[i].render() for i in indices]

    def close(self) -> tuple[None, None]:
        """Close the environments."""
        for env in self._envs:
            env.close()
        return None, None

    def _stack(self, observations: Sequence[Any]) -> Any:
        return join(observations, self._envs[0].observation_space, np.stack)


def _reset(env: gym.Env, seed: int | None, options: Mapping[str, Any]) -> tuple[Any, dict[str, Any]]:
    # As SB3 does: not every environment's reset() takes options.
    return env.reset(seed=seed, **({"options": dict(options)} if options else {}))


def _set(env: gym.Env, setting: Setting) -> None:
    setattr(env, setting.name, cloudpickle.loads(setting.value))
