"""Squeeze a part with a parallel gripper until its orientation is known, then insert it."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from . import checks
from .base import POMDPEnv
from .drawing import paint_box

RIGHT_ANGLE = math.pi / 2


def wrap(angle: np.ndarray) -> np.ndarray:
    """Return an angle modulo pi, in [-pi/2, pi/2) rad: a rectangle looks the same after half a turn."""
    return (angle + RIGHT_ANGLE) % math.pi - RIGHT_ANGLE


class SqueezeInsertEnv(POMDPEnv):
    r"""
    Turn a rectangular part with the fingers of a gripper, then push it into a slot that is only slightly wider.

    The part lies on a table with an unknown yaw :math:`\theta`. The action is the yaw ``u`` at which a parallel gripper
    closes. A part whose angle to the fingers is below ``basin`` turns towards the fingers; any other part turns until
    it lies across them. With :math:`r = \theta_t - u_t`, wrapped to :math:`[-\pi/2, \pi/2)`, a squeeze results in

    .. math::
        \theta_{t+1} = \theta_t + \alpha_t (r^* - r), \qquad
        r^* = 0 \text{ if } |r| < \text{basin, else } \operatorname{sgn}(r)\, \pi/2, \qquad
        \alpha_t \sim U[\text{turn}].

    Let :math:`e_t` be the angle between the part and the slot in rad. Each step costs :math:`c_t = 5 |e_t|`, and the
    insertion at the end costs :math:`c_T = 100 \max(0, |e_T| - \text{tolerance})`. A policy that uses the sensor can
    turn the part directly. An open-loop policy can squeeze every part at the same angles. The first squeeze is at about
    25 degrees to the slot; after it, nearly all parts are within ``basin`` of the slot. The next squeezes are almost
    along the slot.

    The state is ``(sin 2 theta, cos 2 theta)``. With a cue, a third component is the kind of the part, -1 or 1. The
    observation is the state with noise on the first two components.

    :param cue: Whether the kind of the part decides how the part must lie: along the slot (1) or across it (-1).
        Without a cue every part must lie along the slot.
    :param turn: ``(low, high)``: range of :math:`\alpha_t`, the fraction of the way to :math:`r^*` that a squeeze turns
        the part. The fraction is drawn uniformly for each squeeze.
    :param basin: The largest angle between part and fingers, in rad, at which the part turns towards the fingers.
    :param tolerance: Largest angle between part and slot, in rad, at which the insertion costs nothing.
    :param sensor_noise_std: Standard deviation of the noise on ``sin 2 theta`` and on ``cos 2 theta``.
    :param horizon: Number of squeezes T.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :raises ValueError: if a keyword is out of its range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 2}

    def __init__(
        self,
        *,
        cue: bool = False,
        turn: Sequence[float] = (0.85, 0.85),
        basin: float = math.radians(65.0),
        tolerance: float = 0.05,
        sensor_noise_std: float = 0.01,
        horizon: int = 4,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(horizon=horizon, render_mode=render_mode)
        self.cue = bool(cue)
        self.turn = checks.low_high("turn", turn)
        checks.between("turn[0]", float(self.turn[0]), 0.0, 1.0, "")
        checks.between("turn[1]", float(self.turn[1]), 0.0, 1.0, ": a squeeze does not turn the part too far")
        self.basin = checks.between("basin", basin, 0.0, RIGHT_ANGLE, " rad")
        self.tolerance = checks.not_negative("tolerance", tolerance)
        self.sensor_noise_std = checks.not_negative("sensor_noise_std", sensor_noise_std)
        self.state_names = ("sin 2 yaw (1)", "cos 2 yaw (1)", "kind (-1 or 1)")[: 2 + self.cue]
        n = len(self.state_names)
        self.state_space = spaces.Box(-1.0, 1.0, (n,), np.float64)
        self.observation_space = spaces.Box(-np.inf, np.inf, (n,), np.float32)
        self.action_space = spaces.Box(-math.pi, math.pi, (1,), np.float32)
        self._fingers: float | None = None  # yaw of the last squeeze, for render()

    def yaw(self, state: np.ndarray) -> np.ndarray:
        """Return the yaw of the part in [-pi/2, pi/2] rad: ``(N,)`` from ``(N, X)``."""
        return 0.5 * np.arctan2(state[:, 0], state[:, 1])

    def error(self, state: np.ndarray) -> np.ndarray:
        """Return the absolute angle between the part and the slot in rad: ``(N,)`` from ``(N, X)``."""
        yaw = self.yaw(state)
        return np.abs(wrap(yaw - np.where(state[:, 2] > 0, 0.0, RIGHT_ANGLE))) if self.cue else np.abs(yaw)

    def _with_yaw(self, yaw: np.ndarray, kind: np.ndarray) -> np.ndarray:
        return np.column_stack([np.sin(2 * yaw), np.cos(2 * yaw), kind])

    def initial_state(self, n: int) -> np.ndarray:
        self._fingers = None
        yaw = self.np_random.uniform(-RIGHT_ANGLE, RIGHT_ANGLE, n)
        kind = self.np_random.choice([-1.0, 1.0], (n, 1)) if self.cue else np.empty((n, 0))
        return self._with_yaw(yaw, kind)

    def dynamics(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        self._fingers = float(action[0, 0]) if len(action) == 1 else None  # render() draws only one gripper
        yaw = self.yaw(state)
        away = wrap(yaw - action[:, 0])
        rest = np.where(np.abs(away) < self.basin, 0.0, np.sign(away) * RIGHT_ANGLE)
        turn = self.np_random.uniform(self.turn[0], self.turn[1], len(state))
        return self._with_yaw(yaw + turn * (rest - away), state[:, 2:])

    def sensor(self, state: np.ndarray) -> np.ndarray:
        observation = state.copy()
        observation[:, :2] += self.sensor_noise_std * self.np_random.standard_normal((len(state), 2))
        return observation.astype(np.float32)

    def cost(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        return 5.0 * self.error(state)

    def terminal_cost(self, state: np.ndarray) -> np.ndarray:
        return 100.0 * np.maximum(0.0, self.error(state) - self.tolerance)

    def render(self) -> np.ndarray | None:
        """Draw the table from above: slot (dark), part (orange; with a cue one kind is blue), fingers (grey)."""
        if self.render_mode is None:
            return None
        state = self._current_state()
        yaw = float(self.yaw(state)[0])
        image = np.full((200, 200, 3), 245, np.uint8)
        paint_box(image, (0.0, 0.0), (0.86, 0.3), 0.0, (205, 200, 190))
        paint_box(image, (0.0, 0.0), (0.80, 0.24), 0.0, (90, 90, 95))
        is_across = self.cue and state[0, 2] < 0
        paint_box(image, (0.0, 0.0), (0.72, 0.2), yaw, (45, 90, 190) if is_across else (235, 130, 30))
        if self._fingers is not None:
            for side in (-1.0, 1.0):
                middle = (-side * 0.5 * math.sin(self._fingers), side * 0.5 * math.cos(self._fingers))
                paint_box(image, middle, (0.6, 0.06), self._fingers, (140, 140, 150))
        return image
