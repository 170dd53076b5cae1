"""Simulate SqueezeInsert-v0 with an arm: a Franka Panda in PyBullet squeezes a part and presses it into a slot."""

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from . import checks
from .base import BatchStep
from .panda_arm import Configuration
from .panda_view import SqueezeView
from .pool import SharedEnv
from .squeeze_bullet import INSERTED, SqueezeSimulation
from .squeeze_insert import SqueezeInsertEnv
from .squeeze_scene import SqueezeScene

MAX_CENTRING_ERROR = 0.0035  # m: with a larger error a jaw may come down on the part


class PandaSqueezeEnv(SharedEnv, SqueezeInsertEnv):
    r"""
    Squeeze a part with the arm until its orientation is known, then press it into a slot that is only slightly wider.

    State, observation, action and cost are those of :class:`~sb3_tdpg.envs.squeeze_insert.SqueezeInsertEnv` without a
    cue. So a policy for one environment can act in the other. Here PyBullet simulates the squeezes. In each step, the
    open jaws move down over the part at the yaw ``u`` (modulo pi), close, open and move up.

    Before each squeeze, the hand is centred on the part with a random error of up to ``centring_error``. Only the
    position of the part relative to the hand matters. So every squeeze is simulated at the same place on the table, and
    the yaw alone is the state. After the last squeeze, the part is placed on the mouth of the slot at its present yaw,
    and the closed jaws press on it. The cost depends on the yaw before this insertion, not on whether the part enters
    the slot.

    After a step, ``info`` has these entries, the last two only after the last step:

    - ``offset``: the vector from the middle of the hand to the part, ``(2,)`` in m
    - ``tilt``: the angle between the part's vertical axis and the vertical, in rad
    - ``success``, and ``is_success`` for SB3: whether the part entered the slot
    - ``height``: the height of the part's lower side above the table, in m

    A step depends only on the state, the action and the centring error, not on earlier steps or on the process that
    simulates it.

    :param friction: Friction coefficient between part and jaws, and between part and slot.
    :param centring_error: Largest offset of the part from the middle of the hand along x and along y, in m. The offset
        is drawn uniformly.
    :param tolerance: Largest angle between part and slot, in rad, at which the insertion costs nothing. The chamfer of
        the slot is just wide enough for this angle. (With a ``tolerance`` below 0.01 rad, the slot tolerates larger
        angles, because of its clearance.)
    :param sensor_noise_std: Standard deviation of the noise on each of the two observed components, sine and cosine of
        twice the yaw.
    :param horizon: Number of squeezes T.
    :param n_processes: Number of processes that share a batch. This number does not change the results.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :raises ValueError: if a keyword is out of its range.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(
        self,
        *,
        friction: float = 0.05,
        centring_error: float = 0.003,
        tolerance: float = 0.05,
        sensor_noise_std: float = 0.01,
        horizon: int = 4,
        n_processes: int = 1,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(
            tolerance=tolerance, sensor_noise_std=sensor_noise_std, horizon=horizon, render_mode=render_mode
        )
        checks.between("tolerance", self.tolerance, 0.0, 0.2, " rad: the slot would need a wider chamfer")
        self.scene = SqueezeScene(checks.between("friction", friction, 0.0, 1.0, ""), self.tolerance)
        self.centring_error = checks.between(
            "centring_error",
            centring_error,
            0.0,
            MAX_CENTRING_ERROR,
            " m: else a jaw may come down on the part",
        )
        self.n_processes = checks.count("n_processes", n_processes)
        self._film: list[Configuration] = []  # the last step, recorded only with a render_mode

    def _make_world(self) -> tuple[Any, ...]:
        return SqueezeSimulation, self.scene

    @cached_property
    def _view(self) -> SqueezeView:
        self.check_open()
        return SqueezeView(self.scene)

    def _shared(self, method: str, *arrays: np.ndarray, **here: Any) -> Any:
        watch = self._film.append if self.render_mode is not None and len(arrays[0]) == 1 else None
        return super()._shared(method, *arrays, watch=watch)

    def initial_state(self, n: int) -> np.ndarray:
        self._film = []
        return super().initial_state(n)

    def dynamics(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        self._film = []
        offsets = self.np_random.uniform(-self.centring_error, self.centring_error, (len(state), 2))
        outcomes = self._shared("squeezes", self.yaw(state), action[:, 0], offsets)
        self._details = [dict(offset=np.array(outcome.offset), tilt=outcome.tilt) for outcome in outcomes]
        return self._with_yaw(np.array([outcome.yaw for outcome in outcomes]), state[:, 2:])

    def step_batch(self, state: np.ndarray, action: np.ndarray, *, is_last: bool) -> BatchStep:
        """Squeeze N parts; after the last squeeze, press them into the slot. See :class:`POMDPEnv`."""
        step = super().step_batch(state, action, is_last=is_last)
        if not is_last:
            return step
        heights = self._shared("inserts", self.yaw(step.state))
        insertions = [dict(success=h < INSERTED, is_success=h < INSERTED, height=h) for h in heights]
        return step._replace(details=[{**more, **push} for more, push in zip(step.details, insertions, strict=True)])

    def render(self) -> np.ndarray | None:
        """Draw the scene before a squeeze, after it, or after the insertion: ``(256, 384, 3)`` uint8."""
        if self.render_mode is None:
            return None
        state = self._current_state()
        if self._film:
            return self._view.picture(self._film[-1])
        return self._view.picture(self._world.at_rest(float(self.yaw(state)[0])))

    def film(self) -> Iterator[np.ndarray]:
        """
        Yield the frames of the last squeeze, and of the insertion if there was one, at 30 frames per second.

        :raises ValueError: if ``render_mode`` is not ``"rgb_array"``, or there was no ``step`` since ``reset``.
        """
        if self.render_mode is None or not self._film:
            raise ValueError(f"film() shows the last step(), with render_mode='rgb_array', not {self.render_mode!r}")
        yield from map(self._view.picture, list(self._film))
