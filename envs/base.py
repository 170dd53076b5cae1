"""Define the base class of the environments, a finite-horizon POMDP in batched NumPy.

Dimension key: N parallel episodes, X state, U action; observations have shape ``(N, *obs)``.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from . import checks


class BatchStep(NamedTuple):
    """The results of one step of N episodes."""

    state: np.ndarray  # (N, X), x_{t+1}
    observation: np.ndarray  # (N, *obs), y_{t+1}
    cost: np.ndarray  # (N,), c_t, plus c_T on the last step
    details: Sequence[Mapping[str, Any]] = ()  # additional entries of the info: one mapping per episode, or nothing


class POMDPEnv(gym.Env[np.ndarray, np.ndarray]):
    """
    A finite-horizon POMDP (Section II of the paper) as a Gymnasium environment.

    A subclass sets ``state_space``, ``observation_space`` and ``action_space``. It implements five methods, each for N
    episodes at once: :meth:`initial_state`, :meth:`dynamics`, :meth:`sensor`, :meth:`cost`, :meth:`terminal_cost`.
    All random numbers must come from ``self.np_random``.

    This class uses these methods to provide ``reset`` and ``step`` for one episode.
    :class:`sb3_tdpg.vec_env.BatchedVecEnv` uses them to provide an SB3 ``VecEnv`` for many episodes. The horizon is
    part of the problem. So the last step returns ``terminated=True``, and algorithms do not bootstrap from its
    observation. The reward is the negative cost; subclasses return costs.

    ``info["state"]`` is a copy of the true state: x_0 after ``reset``, and x_{t+1} after ``step``. ``info["cost"]`` is
    the cost of the step. A subclass can add entries to the info of a step with :attr:`_details`.

    :param horizon: Number of controls T in an episode.
    :param render_mode: ``None`` or one of ``metadata["render_modes"]``.
    """

    metadata: dict[str, Any] = {"render_modes": [], "render_fps": 4}

    state_space: spaces.Box
    action_space: spaces.Box
    #: Names of the state's components in figures, with units: ``("d (m)", "v (m/s)")``. Optional.
    state_names: tuple[str, ...]
    #: Whether the constructor has a keyword ``n_processes``, the number of processes that share the work of a batch.
    shares_work: bool = False
    #: Additional entries of each episode's info after the last call of :meth:`dynamics`; the sequence can be empty.
    _details: Sequence[Mapping[str, Any]] = ()

    def __init__(self, *, horizon: int, render_mode: str | None = None) -> None:
        self.horizon = checks.count("horizon", horizon, ": the number of controls in an episode")
        if render_mode is not None and render_mode not in self.metadata["render_modes"]:
            raise ValueError(f"render_mode={render_mode!r} must be None or one of {self.metadata['render_modes']}")
        self.render_mode = render_mode
        self._state: np.ndarray | None = None  # (1, X)
        self._time = 0

    @abstractmethod
    def initial_state(self, n: int) -> np.ndarray:
        """Draw the initial states x_0, ``(N, X)``."""

    @abstractmethod
    def dynamics(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        """
        Draw the next states x_{t+1} ~ p(. | x_t, u_t) as a new array: ``(N, X)`` from ``(N, X)`` and ``(N, U)``.

        Actions of a ``Discrete`` space have the shape ``(N,)``, here and in :meth:`cost`.
        """

    @abstractmethod
    def sensor(self, state: np.ndarray) -> np.ndarray:
        """Draw the observations y_t ~ s(. | x_t): ``(N, *obs)``, in the dtype of the observation space."""

    @abstractmethod
    def cost(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        """Return the stage cost c_t(x_t, u_t): ``(N,)``."""

    @abstractmethod
    def terminal_cost(self, state: np.ndarray) -> np.ndarray:
        """Return the terminal cost c_T(x_T): ``(N,)``."""

    def _current_state(self) -> np.ndarray:
        """Return the state to render, ``(1, X)``."""
        if self._state is None:
            raise ValueError("there is nothing to render before the first reset()")
        return self._state

    def reset_batch(self, n: int) -> tuple[np.ndarray, np.ndarray]:
        """Start N episodes; return x_0 ``(N, X)`` and y_0 ``(N, *obs)``."""
        state = self.initial_state(n)
        return state, self.sensor(state)

    def step_batch(self, state: np.ndarray, action: np.ndarray, *, is_last: bool) -> BatchStep:
        """
        Advance N episodes by one control.

        :param state: The states x_t, ``(N, X)``.
        :param action: The actions u_t, ``(N, U)``, which are clipped to the action space.
        :param is_last: Whether this is the last control (t = T - 1), whose cost includes the terminal cost.
        :raises ValueError: if the actions have a wrong shape, or an action is NaN or infinite.
        """
        action, expected = np.asarray(action, dtype=np.float64), (len(state), *self.action_space.shape)
        if action.shape != expected:
            raise ValueError(f"{type(self).__name__} received actions of shape {action.shape}: expected {expected}")
        if not np.all(np.isfinite(action)):
            bad = action[~np.isfinite(action).all(-1)][0]
            raise ValueError(
                f"{type(self).__name__} received an action that is not finite: {bad}; the policy has probably diverged"
            )
        if isinstance(self.action_space, spaces.Box):
            action = np.clip(action, self.action_space.low, self.action_space.high)
        cost = self.cost(state, action)
        next_state = self.dynamics(state, action)
        if is_last:
            cost = cost + self.terminal_cost(next_state)
        return BatchStep(next_state, self.sensor(next_state), cost, self._details)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode; see :class:`gymnasium.Env`."""
        super().reset(seed=seed)
        self._time = 0
        self._state, observation = self.reset_batch(1)
        return observation[0], {"state": self._state[0].copy()}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Apply one control; see :class:`gymnasium.Env`."""
        if self._state is None or self._time >= self.horizon:
            raise gym.error.ResetNeeded(
                f"the episode has not begun or is over (horizon={self.horizon}): call reset() first"
            )
        terminated = self._time + 1 == self.horizon
        action, shape = np.asarray(action, dtype=np.float64), self.action_space.shape
        if action.size == np.prod(shape):  # step_batch raises an error for other sizes
            action = action.reshape(shape)
        self._state, observation, cost, details = self.step_batch(self._state, action[None], is_last=terminated)
        self._time += 1
        info = {"state": self._state[0].copy(), "cost": float(cost[0])}
        for more in details:
            info.update(more)
        return observation[0], -float(cost[0]), terminated, False, info
