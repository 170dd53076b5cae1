"""The grasping problem (Section IV-C of the paper): lift a mug by its rim, with one depth image as the only sensor."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces

from .base import POMDPEnv
from .panda_bullet import LIFTED, MOTIONS, Configuration, Motion
from .panda_camera import IMAGE_SIZE
from .panda_pool import GraspPool, GraspWorld
from .panda_scene import PandaScene
from .panda_view import PandaView

NOMINAL_GRASP = np.array([0.5, 0.0, 0.06, np.pi / 6])  # m and rad: the action 0
ACTION_SCALE = 0.1
# In units of the action. x and y: what the arm reaches and the table's mugs need. z, between 0.05 and 0.16 m: lower
# down the palm would press on the rim, which lifts nothing. yaw: 1 rad to either side.
LOWEST_ACTION = np.array([-1.5, -1.5, -0.1, -10.0], np.float32)
HIGHEST_ACTION = np.array([1.5, 1.5, 1.0, 10.0], np.float32)
# m; what the sensor tells apart. Table and mug are 0.31 to 0.61 m away.
MIN_DEPTH, MAX_DEPTH = 0.2, 0.7
MAX_CAMERA_SHIFT = 0.1  # m
WORKSPACE = np.array([0.5, 0.0])  # m, its middle


class PandaGraspEnv(POMDPEnv):
    r"""
    Grasp a mug that stands anywhere on a table, and lift it.

    State ``x = (x, y, z, yaw)`` of the mug's frame, in m and rad; with a ``camera_range`` also its height.
    Observation ``y``: a depth image in m, float32 ``(1, 128, 128)``. Action ``u``: where the hand grasps,
    ``(0.5, 0, 0.06, pi/6) + 0.1 u`` for its position in m and its yaw in rad. There is one control, ``T = 1``, and
    PyBullet simulates what comes of it:

    .. math::
        c_0 = 0, \qquad c_1 = \begin{cases} 0 & \text{if the mug's frame is more than 5 cm above the table},\\
        1 & \text{otherwise.} \end{cases}

    ``info`` has, after the step, ``success``, ``mug`` (its pose before the grasp), ``mug_height`` (m, after it),
    ``grasp`` (its pose, after clipping), ``contacts`` (points in which the fingers touch the mug in the end), and
    ``is_success``, the name under which Stable-Baselines3 looks for the success.

    An outcome is a function of state and action alone: it does not depend on the trials before it, nor on the process.

    :param xy_half_width: The mug starts uniformly within this distance of (0.5, 0) along x and along y, in m.
    :param yaw_range: Its yaw starts uniformly in ``(low, high)``, in rad; 0: the handle points to the left.
    :param camera_range: ``(low, high)``: the camera is higher than usual by another distance between these two in every
        trial, uniformly, in m. The distance is the fifth component of the state. ``None``: it is where it is.
    :param camera_shift: The camera is higher by so much, in m, in every trial, and the state does not tell.
    :param mug_scale: Size of the mug, as a multiple of the paper's (93 mm across, 81 mm high).
    :param frame_offset: Distance of the cup's axis from the origin of the mug's frame, away from the handle, in m.
    :param friction: Coefficient of friction of mug and fingers. (Bullet multiplies those of two bodies that touch.)
    :param solver_iterations: Of Bullet's contact solver in a time step; ``None``: 50 in the fast motion, 150 in the
        reference.
    :param motion: ``"fast"``, or ``"reference"``, the paper's slow one.
    :param depth_noise_std: Standard deviation of the noise on each pixel, in m.
    :param n_processes: Processes that share the grasps and the images of a batch; the results are the same.
    :param render_mode: ``None``, ``"rgb_array"`` (the scene beside the depth image) or ``"human"`` (PyBullet's window).
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"], "render_fps": 30}
    shares_work = True

    def __init__(
        self,
        *,
        xy_half_width: float = 0.05,
        yaw_range: tuple[float, float] = (-np.pi / 4, np.pi / 4),
        camera_range: tuple[float, float] | None = None,
        camera_shift: float = 0.0,
        mug_scale: float = 1.0,
        frame_offset: float = 0.012,
        friction: float = 0.5,
        solver_iterations: int | None = None,
        motion: str = "fast",
        depth_noise_std: float = 0.0,
        n_processes: int = 1,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(horizon=1, render_mode=render_mode)
        if not 0 <= xy_half_width <= 0.2:
            raise ValueError(f"xy_half_width={xy_half_width} must be between 0 and 0.2 m: what the arm reaches")
        low_high = np.asarray(yaw_range, dtype=np.float64)
        if low_high.shape != (2,) or not np.isfinite(low_high).all() or low_high[0] > low_high[1]:
            raise ValueError(f"yaw_range={yaw_range} must be (low, high) of finite numbers in rad, low <= high")
        if not 0.5 <= mug_scale <= 1.5:
            raise ValueError(f"mug_scale={mug_scale} must be between 0.5 and 1.5: it is a multiple of the paper's size")
        if not -0.05 <= frame_offset <= 0.05:
            raise ValueError(f"frame_offset={frame_offset} must be between -0.05 and 0.05 m")
        if not (np.isfinite(friction) and friction >= 0):
            raise ValueError(f"friction={friction} must be finite and not negative")
        if solver_iterations is not None and not (
            isinstance(solver_iterations, (int, np.integer)) and solver_iterations >= 1
        ):
            raise ValueError(f"solver_iterations={solver_iterations!r} must be None or an integer of at least 1")
        if motion not in MOTIONS:
            raise ValueError(f"motion={motion!r} must be one of {list(MOTIONS)}")
        if not (np.isfinite(depth_noise_std) and depth_noise_std >= 0):
            raise ValueError(f"depth_noise_std={depth_noise_std} must be finite and not negative (it is sigma, in m)")
        if not (isinstance(n_processes, (int, np.integer)) and n_processes >= 1):
            raise ValueError(f"n_processes={n_processes!r} must be an integer of at least 1")
        self.xy_half_width = float(xy_half_width)
        self.yaw_range = low_high
        self.scene = PandaScene(float(mug_scale), float(frame_offset), float(friction))
        self.camera_range = None if camera_range is None else _checked_camera(camera_range)
        self.camera_shift = _checked_shift(camera_shift, self.camera_range)
        self.solver_iterations = solver_iterations
        self.motion = motion
        self.depth_noise_std = float(depth_noise_std)
        self.n_processes = n_processes
        self.state_names = ("x (m)", "y (m)", "z (m)", "yaw (rad)")
        if camera_range is not None:
            self.state_names += ("camera height (m)",)
        self.state_space = spaces.Box(-np.inf, np.inf, (len(self.state_names),), np.float64)
        self.observation_space = spaces.Box(MIN_DEPTH, MAX_DEPTH, (1, IMAGE_SIZE, IMAGE_SIZE), np.float32)
        self.action_space = spaces.Box(LOWEST_ACTION, HIGHEST_ACTION, dtype=np.float32)
        self._last_details: list[dict[str, Any]] = []
        self._is_closed = False
        self._film: list[Configuration] = []  # of the last grasp, where something is rendered

    # -- Bullet worlds, each made when it is needed, and so in the process that uses it ------------------------------

    @cached_property
    def _world(self) -> GraspWorld:
        self._check_open()
        return GraspWorld(*self._world_arguments)

    @cached_property
    def _pool(self) -> GraspPool:
        self._check_open()
        return GraspPool(self.n_processes, *self._world_arguments)

    @property
    def _world_arguments(self) -> tuple[PandaScene, Motion, int | None]:
        return self.scene, MOTIONS[self.motion], self.solver_iterations

    def _workers(self, n: int) -> GraspWorld | GraspPool:
        """Return what a batch of n mugs is left to."""
        return self._pool if self.n_processes > 1 and n > 1 else self._world

    @cached_property
    def _view(self) -> PandaView:
        self._check_open()
        return PandaView(self.scene, gui=self.render_mode == "human")

    # -- the POMDP ----------------------------------------------------------------------------------------------------

    def _initial_state(self, n: int) -> np.ndarray:
        state = np.zeros((n, self.state_space.shape[0]))
        state[:, :2] = WORKSPACE + self.np_random.uniform(-self.xy_half_width, self.xy_half_width, (n, 2))
        state[:, 3] = self.np_random.uniform(self.yaw_range[0], self.yaw_range[1], n)
        if self.camera_range is not None:
            state[:, 4] = self.np_random.uniform(*self.camera_range, n)
        return state

    def _dynamics(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        poses = NOMINAL_GRASP + ACTION_SCALE * action
        mugs, camera = state[:, :4], state[:, 4:]
        if self.render_mode is not None and len(state) == 1:
            self._film = []
            outcomes = self._world.grasps(mugs, poses, self._film.append)
        else:
            outcomes = self._workers(len(state)).grasps(mugs, poses)
        next_state = np.concatenate([np.array([outcome.state for outcome in outcomes]), camera], axis=1)
        self._last_details = [
            dict(
                success=bool(after[2] > LIFTED),
                is_success=bool(after[2] > LIFTED),
                mug=mug,
                mug_height=float(after[2]),
                grasp=pose,
                contacts=outcome.contacts,
            )
            for mug, pose, after, outcome in zip(mugs, poses, next_state, outcomes, strict=True)
        ]
        return next_state

    def _details(self) -> Sequence[Mapping[str, Any]]:
        return self._last_details

    def _sensor(self, state: np.ndarray) -> np.ndarray:
        return self._with_noise(self._workers(len(state)).images(self._seen(state)), self.np_random)

    def _seen(self, state: np.ndarray) -> np.ndarray:
        """Return what an image is drawn of: the mug, and how much higher than usual the camera is, if it is."""
        if self.camera_shift == 0:
            return state
        raised = state[:, 4:] if self.camera_range is not None else np.zeros((len(state), 1))
        return np.concatenate([state[:, :4], raised + self.camera_shift], axis=1)

    def _cost(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        return np.zeros(len(state))

    def _terminal_cost(self, state: np.ndarray) -> np.ndarray:
        return np.where(state[:, 2] > LIFTED, 0.0, 1.0)

    def _with_noise(self, images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Add noise to depth images, ``(N, 1, 128, 128)``, and cut off what is outside the observation space."""
        if self.depth_noise_std > 0:
            for image in images:
                image += self.depth_noise_std * rng.standard_normal(image.shape)
        return np.clip(images, MIN_DEPTH, MAX_DEPTH, out=images)

    # -- pictures -----------------------------------------------------------------------------------------------------

    def render(self) -> np.ndarray | None:
        """
        Show the scene as it is: before the grasp, or after it.

        ``"rgb_array"``: the scene beside the depth image, ``(256, 644, 3)`` uint8, near points bright; see also
        :meth:`film`. ``"human"``: in PyBullet's window, where the grasp is played at its speed; ``None`` is returned.
        Sensor noise is drawn anew, so that drawing does not change an episode.
        """
        if self.render_mode is None:
            return None
        if self._state is None:
            raise ValueError("there is nothing to render before the first reset()")
        if self.render_mode == "human":
            for configuration in self._shown():
                self._view.place(configuration)
                time.sleep(1 / self.metadata["render_fps"])
            return None
        self._view.place(self._shown()[-1])
        return self._view.picture(self._depth_of(self._state[0]))

    def film(self) -> Iterator[np.ndarray]:
        """
        Draw the last grasp from beginning to end, 30 pictures for each second of it; see ``render``.

        The depth image beside it stays the one that the grasp was chosen by.

        :raises ValueError: if ``render_mode`` is not ``"rgb_array"``, or nothing has been grasped since ``reset``.
        """
        if self.render_mode != "rgb_array":
            raise ValueError(f"render_mode={self.render_mode!r} must be 'rgb_array' for a film")
        if self._time == 0:
            raise ValueError("there is no grasp to show before step()")
        assert self._state is not None
        _, _, to_z, to_w = self._film[0].mug_orientation
        camera = self._state[0, 4:].tolist()
        depth = self._depth_of([*self._film[0].mug_position, 2 * np.arctan2(to_z, to_w), *camera])
        for configuration in self._film:
            self._view.place(configuration)
            yield self._view.picture(depth)

    def _shown(self) -> list[Configuration]:
        """Return what there is to see: the last grasp, or the mug where it stands and the robot at rest."""
        assert self._state is not None
        if self._time > 0:
            return self._film
        x, y, z, yaw = self._state[0, :4].tolist()
        return [PandaView.at_rest((x, y, z), yaw)]

    def _depth_of(self, state: np.ndarray | list[float]) -> np.ndarray:
        (depth,) = self._with_noise(self._world.images(self._seen(np.array([state]))), np.random.default_rng(0))
        return depth

    def close(self) -> None:
        """Close the Bullet worlds and the window; closing twice is fine."""
        self._is_closed = True
        for name in ("_world", "_pool", "_view"):
            if name in self.__dict__:
                getattr(self, name).close()

    def _check_open(self) -> None:
        # BulletClient says the same of a world that has been closed, but here there may have been none yet.
        if self._is_closed:
            raise RuntimeError("this environment has been closed: make a new one")


def _checked_camera(camera_range: tuple[float, float]) -> tuple[float, float]:
    try:
        low, high = (float(height) for height in camera_range)
    except (TypeError, ValueError):
        low, high = np.nan, np.nan
    if not -MAX_CAMERA_SHIFT <= low <= high <= MAX_CAMERA_SHIFT:
        raise ValueError(
            f"camera_range={camera_range} must be None or (low, high) in m, {-MAX_CAMERA_SHIFT} <= low <= high <= "
            f"{MAX_CAMERA_SHIFT}: from further away the mug is out of sight"
        )
    return low, high


def _checked_shift(camera_shift: float, camera_range: tuple[float, float] | None) -> float:
    low, high = camera_range or (0.0, 0.0)
    if not (low + camera_shift >= -MAX_CAMERA_SHIFT and high + camera_shift <= MAX_CAMERA_SHIFT):
        raise ValueError(
            f"camera_shift={camera_shift} with camera_range={camera_range} must leave the camera within "
            f"{MAX_CAMERA_SHIFT} m of its usual height: from further away the mug is out of sight"
        )
    return float(camera_shift)
