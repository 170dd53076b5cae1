"""Push a peg into the corner of a fence, then move it over a hole, which is possible without a sensor."""

from typing import Any

import numpy as np
from gymnasium import spaces

from . import checks
from .base import POMDPEnv
from .drawing import paint_box

SIZE = 6.0  # cm, side of the square table
START = (2.0, 6.0)  # cm, range of both coordinates
HOLE = np.array([1.2, 1.2])  # cm
TOLERANCE = 0.4  # cm, distance from the hole up to which the terminal cost is zero
FRICTION = 0.2  # coefficient of the fence
MAX_ACTION = 2.5  # cm in each direction


class PegCornerEnv(POMDPEnv):
    r"""
    Slide a peg on a fenced table until it is over a hole near one corner.

    State ``x = (x, y)``: position of the peg on a table of 6 cm by 6 cm. The peg starts uniformly in [2, 6]^2 cm.
    Action ``u``: at most 2.5 cm in each direction. The peg moves by ``actuator_gain`` times the action. The fence stops
    the peg. If a displacement would cross one side of the fence by a distance ``b``, friction subtracts ``0.2 b`` from
    the component of the displacement along that side. With :math:`d_t = \lVert x_t - g \rVert`, ``g = (1.2, 1.2)`` cm,
    and T = 4 controls, the costs are

    .. math::
        c_t = d_t, \qquad c_T = 30 \max(0, d_T - 0.4).

    A policy that uses the sensor can move the peg straight to the hole. From any start, an open-loop policy can push
    the peg into the corner with three moves, and move it to the hole with the fourth.

    :param sensor_noise_std: Standard deviation of the sensor noise in cm.
    :param actuator_gain: Ratio of the peg's displacement to the action.
    :param horizon: Number of controls T.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :raises ValueError: if a keyword is out of its range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 2}
    state_names = ("x (cm)", "y (cm)")

    def __init__(
        self,
        *,
        sensor_noise_std: float = 0.01,
        actuator_gain: float = 1.0,
        horizon: int = 4,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(horizon=horizon, render_mode=render_mode)
        self.sensor_noise_std = checks.not_negative("sensor_noise_std", sensor_noise_std)
        self.actuator_gain = checks.positive("actuator_gain", actuator_gain)
        self.state_space = spaces.Box(0.0, SIZE, (2,), np.float64)
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
        self.action_space = spaces.Box(-MAX_ACTION, MAX_ACTION, (2,), np.float32)

    def initial_state(self, n: int) -> np.ndarray:
        return self.np_random.uniform(*START, (n, 2))

    def dynamics(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        move = self.actuator_gain * action
        aim = state + move
        beyond = np.abs(aim - np.clip(aim, 0.0, SIZE))
        # A push against one side slows the motion along this side, which is the other component.
        move = np.sign(move) * np.maximum(0.0, np.abs(move) - FRICTION * beyond[:, ::-1])
        return np.clip(state + move, 0.0, SIZE)

    def sensor(self, state: np.ndarray) -> np.ndarray:
        return (state + self.sensor_noise_std * self.np_random.standard_normal(state.shape)).astype(np.float32)

    def _distance(self, state: np.ndarray) -> np.ndarray:
        return np.linalg.norm(state - HOLE, axis=1)

    def cost(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        return self._distance(state)

    def terminal_cost(self, state: np.ndarray) -> np.ndarray:
        return 30.0 * np.maximum(0.0, self._distance(state) - TOLERANCE)

    def render(self) -> np.ndarray | None:
        """Draw the table from above: fence (grey), hole (dark), peg (blue): ``(200, 200, 3)`` uint8."""
        if self.render_mode is None:
            return None
        x, y = self._current_state()[0]
        span = (-0.7, SIZE + 0.7, -0.7, SIZE + 0.7)
        image = np.full((200, 200, 3), 245, np.uint8)
        middle = SIZE / 2
        paint_box(image, (middle, middle), (SIZE + 1.2, SIZE + 1.2), 0.0, (140, 140, 150), span)
        paint_box(image, (middle, middle), (SIZE + 0.7, SIZE + 0.7), 0.0, (245, 245, 245), span)
        paint_box(image, (HOLE[0], HOLE[1]), (0.8, 0.8), 0.0, (90, 90, 95), span)
        paint_box(image, (x, y), (0.6, 0.6), 0.0, (45, 90, 190), span)
        return image
