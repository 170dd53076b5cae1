"""SqueezeInsert-v0 with a simulated arm: a Franka Panda squeezes a part in PyBullet, and presses it into a slot."""

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np

from . import checks
from .base import BatchStep
from .panda_arm import Configuration
from .panda_view import SqueezeView
from .pool import SharedEnv
from .squeeze_bullet import SqueezeSimulation
from .squeeze_insert import SqueezeInsertEnv
from .squeeze_scene import SqueezeScene

MAX_CENTRING_ERROR = 0.0035  # m: further off, a jaw may come down on the part


class PandaSqueezeEnv(SharedEnv, SqueezeInsertEnv):
    r"""
    Squeeze a part with the arm until its orientation is known, then press it into a slot that is hardly wider.

    State, observation, action and cost are those of :class:`~sb3_tdpg.envs.squeeze_insert.SqueezeInsertEnv`: a policy
    for one acts in the other. Here PyBullet finds the yaw after a squeeze. In each control the hand comes down
    over the part with open jaws at the yaw ``u`` (modulo pi), closes them, opens them and moves up.

    The hand is centred on the part before each squeeze, up to a random ``centring_error``. Only the place of the part
    relative to the hand matters, so that every squeeze is simulated at the same place on the table, and the yaw alone
    is the state. After the last squeeze the part is laid on the mouth of the slot as it is turned, and the closed jaws
    press on it. The cost depends on the yaw before this, and not on whether the part goes in.

    After a step, ``info`` has ``offset`` (of the part from the middle of the hand, ``(2,)`` in m) and ``tilt`` (of the
    part's vertical axis, in rad); after the last one also ``success`` (``is_success`` for SB3: whether the part went
    into the slot) and ``height`` (of its lower side above the table, in m).

    A step is a function of the state, the action and the centring error alone: it depends neither on earlier steps nor
    on the process.

    :param friction: Coefficient of friction between part and jaws, and between part and slot.
    :param centring_error: The part lies uniformly within this distance of the middle of the hand, along x and along y,
        in m.
    :param tolerance: Angle in rad that the slot forgives; its chamfer is as wide as a part turned by it needs. (Below
        0.01 rad the slot is more forgiving, because of its clearance.)
    :param sensor_noise_std: Standard deviation of the noise of both components of the yaw.
    :param horizon: Number of squeezes T.
    :param n_processes: Number of processes that share a batch; the results are the same.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :raises ValueError: for a keyword out of its range.
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
        self._film: list[Configuration] = []  # of the last step, if there is a render_mode

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
        """Squeeze N parts, and after the last squeeze press them into the slot; see :class:`POMDPEnv`."""
        step = super().step_batch(state, action, is_last=is_last)
        if not is_last:
            return step
        outcomes = self._shared("inserts", self.yaw(step.state))
        insertions = [dict(success=push.success, is_success=push.success, height=push.height) for push in outcomes]
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
        if self.render_mode != "rgb_array":
            raise ValueError(f"render_mode={self.render_mode!r} must be 'rgb_array' for a video")
        if not self._film:
            raise ValueError("there is no squeeze to show before step()")
        yield from map(self._view.picture, list(self._film))
