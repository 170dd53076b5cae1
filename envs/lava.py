"""Define the lava problem (Section IV-A of the paper): a double integrator between a wall and a lava pit."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from . import checks
from .base import POMDPEnv

WALL = 0.0  # m
LAVA = 5.0  # m
GOAL = np.array([3.0, 0.0])  # m, m per step


class LavaEnv(POMDPEnv):
    r"""
    Reach ``d = 3 m`` and stop there, without falling into the lava at ``d = 5 m``.

    State ``x = (d, v)``: distance from the wall in metres, and velocity in metres per step. Observation
    ``y ~ N(x, sensor_noise_std^2 I)``. Action ``u``: the change of velocity. With ``T = 5`` controls, the dynamics
    and the costs are

    .. math::
        x_{t+1} = (d_t + v_t,\ v_t + u_t), \qquad
        c_t = \lVert x_t - g \rVert, \qquad c_T = 100 \lVert x_T - g \rVert, \qquad g = (3, 0).

    The robot starts with ``v = 0`` and ``d`` uniform in [0, 5] m. If it hits the wall, it stops (``v = 0``), and the
    control of that step has no effect. If it reaches 5 m, it falls into the lava and stays at ``(5, 0)``.

    The defaults follow the paper's text. Another cost definition fits the numbers of Table I better than the text does:
    ``LavaEnv(**sb3_tdpg.envs.scenarios.LAVA_TABLE_READING)``.

    :param sensor_noise_std: Standard deviation of the sensor noise (the paper's table prints variances).
    :param sensor_bias: Vector that is added to every observation, in m and m per step.
    :param start_beta: ``(a, b)``: the robot starts at 5 m times a random number from Beta(a, b). With ``None`` it
        starts uniformly in [0, 5] m.
    :param action_cost: Weight of ``|u_t|`` in the stage cost: 0 in the paper's text, 1 in the other cost definition.
    :param lava_stage_cost: Stage cost in the lava. The default is the distance from the goal.
    :param lava_terminal_cost: Terminal cost in the lava. The default is 100 times the distance from the goal.
    :param horizon: Number of controls T.
    :param max_action: Bound of the action space ``[-max_action, max_action]``. The paper's action space is unbounded,
        but SB3 needs bounds. The default bound is large, because an action beyond it gives no gradient.
    :param render_mode: ``None`` or ``"rgb_array"``.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 2}
    state_names = ("d (m)", "v (m/step)")

    def __init__(
        self,
        *,
        sensor_noise_std: float = 0.01,
        sensor_bias: Sequence[float] = (0.0, 0.0),
        start_beta: Sequence[float] | None = None,
        action_cost: float = 0.0,
        lava_stage_cost: float = 2.0,
        lava_terminal_cost: float = 200.0,
        horizon: int = 5,
        max_action: float = 100.0,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(horizon=horizon, render_mode=render_mode)
        sigma = " (it is sigma, not sigma^2)"
        self.sensor_noise_std = checks.not_negative("sensor_noise_std", sensor_noise_std, sigma)
        if not (np.shape(sensor_bias) == (2,) and np.isfinite(sensor_bias).all()):
            raise ValueError(f"sensor_bias={sensor_bias!r} must be two finite numbers, in m and m per step")
        if start_beta is not None and not (np.shape(start_beta) == (2,) and all(0 < a < np.inf for a in start_beta)):
            raise ValueError(f"start_beta={start_beta!r} must be two positive numbers, for instance (2, 1), or None")
        max_action = checks.positive("max_action", max_action)
        self.sensor_bias = np.array(sensor_bias, dtype=np.float64)
        self.start_beta = None if start_beta is None else (float(start_beta[0]), float(start_beta[1]))
        self.action_cost = checks.not_negative("action_cost", action_cost)
        self.lava_stage_cost = checks.finite("lava_stage_cost", lava_stage_cost)
        self.lava_terminal_cost = checks.finite("lava_terminal_cost", lava_terminal_cost)
        self.state_space = spaces.Box(np.array([WALL, -np.inf]), np.array([LAVA, np.inf]), dtype=np.float64)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Box(-max_action, max_action, (1,), np.float32)

    def initial_state(self, n: int) -> np.ndarray:
        state = np.zeros((n, 2))
        if self.start_beta is None:
            state[:, 0] = self.np_random.uniform(WALL, LAVA, n)
        else:
            state[:, 0] = WALL + (LAVA - WALL) * self.np_random.beta(*self.start_beta, n)
        return state

    def dynamics(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        d, v = state.T
        next_state = np.stack([d + v, v + action[:, 0]], axis=1)
        next_d = next_state[:, 0]
        # The wall stops only a robot strictly beyond it: a robot *at* the wall must be able to leave.
        next_state[next_d < WALL] = (WALL, 0.0)
        next_state[(d >= LAVA) | (next_d >= LAVA)] = (LAVA, 0.0)
        return next_state

    def sensor(self, state: np.ndarray) -> np.ndarray:
        noise = self.sensor_noise_std * self.np_random.standard_normal(state.shape)
        return (state + self.sensor_bias + noise).astype(np.float32)

    def cost(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        place_cost = np.where(state[:, 0] >= LAVA, self.lava_stage_cost, np.linalg.norm(state - GOAL, axis=1))
        return place_cost + self.action_cost * np.abs(action[:, 0])

    def terminal_cost(self, state: np.ndarray) -> np.ndarray:
        return np.where(state[:, 0] >= LAVA, self.lava_terminal_cost, 100.0 * np.linalg.norm(state - GOAL, axis=1))

    def render(self) -> np.ndarray | None:
        """Draw wall (grey), lava, goal (green) and robot (blue) with its velocity (dark): ``(96, 480, 3)`` uint8."""
        if self.render_mode is None:
            return None
        d, v = self._current_state()[0]
        height, width, margin = 96, 480, 40
        scale = (width - 2 * margin) / (LAVA - WALL)

        def column(distance: float) -> int:
            return int(np.clip(margin + scale * distance, 0, width - 1))

        image = np.full((height, width, 3), 245, np.uint8)
        image[72:] = (150, 140, 130)  # ground
        image[20:, : column(WALL)] = (110, 110, 115)
        image[72:, column(LAVA) :] = (235, 90, 20)
        goal, robot = column(GOAL[0]), column(d)
        image[40:72, goal - 2 : goal + 2] = (40, 150, 60)
        image[54:72, max(robot - 9, 0) : robot + 9] = (45, 90, 190)
        tip = column(d + v)
        image[61:65, min(robot, tip) : max(robot, tip)] = (20, 30, 70)
        return image
