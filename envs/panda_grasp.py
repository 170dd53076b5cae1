"""Define the grasping problem (Section IV-C of the paper): lift a mug by its rim, given one depth image."""

from collections.abc import Iterator
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium import spaces

from . import checks
from .panda_arm import FINGER_OPEN, HOME, Configuration, Watch
from .panda_bullet import LIFTED, MOTIONS, GraspSimulation, Motion, Outcome
from .panda_camera import IMAGE_SIZE, DepthCamera
from .panda_view import PandaView
from .pool import SharedEnv

NOMINAL_GRASP = np.array([0.5, 0.0, 0.06, np.pi / 6])  # m and rad: the action 0
ACTION_SCALE = 0.1
# Bounds in units of the action. x and y: the reach of the arm. z: 0.05 to 0.16 m, because at lower heights the palm
# presses on the rim. yaw: 1 rad to either side.
LOWEST_ACTION = np.array([-1.5, -1.5, -0.1, -10.0], np.float32)
HIGHEST_ACTION = np.array([1.5, 1.5, 1.0, 10.0], np.float32)
# Range of the sensor in m. In training, table and mug are 0.27 to 0.61 m away.
MIN_DEPTH, MAX_DEPTH = 0.2, 0.7
MAX_CAMERA_SHIFT = 0.1  # m
WORKSPACE = np.array([0.5, 0.0])  # m, middle of the workspace


class GraspWorld:
    """The simulation and the camera of one process."""

    def __init__(self, cup_origin: np.ndarray, motion: Motion) -> None:
        self.simulation, self.camera = GraspSimulation(cup_origin, motion), DepthCamera(cup_origin)

    def grasps(self, states: np.ndarray, poses: np.ndarray, watch: Watch | None = None) -> list[Outcome]:
        """Grasp each mug in ``states``, ``(N, 4)``, with the hand at the pose in ``poses``, ``(N, 4)``."""
        return [self.simulation.grasp(mug, pose, watch) for mug, pose in zip(states, poses, strict=True)]

    def images(self, states: np.ndarray) -> np.ndarray:
        """Draw the depth images; see :meth:`~sb3_tdpg.envs.panda_camera.DepthCamera.images`."""
        return self.camera.images(states)

    def close(self) -> None:
        """Close the Bullet worlds."""
        self.simulation.close()
        self.camera.close()


class PandaGraspEnv(SharedEnv):
    r"""
    Grasp a mug on a table, and lift it.

    State ``x = (x, y, z, yaw)``: the pose of the mug's frame in m and rad. With a ``camera_range``, a fifth component
    is the distance by which the camera is raised. Observation ``y``: a depth image in m, float32 ``(1, 128, 128)``.
    Action ``u``: the hand grasps at the pose ``(0.5, 0, 0.06, pi/6) + 0.1 u`` (position in m, yaw in rad). An episode
    has one control, ``T = 1``. PyBullet simulates its result:

    .. math::
        c_0 = 0, \qquad c_1 = \begin{cases} 0 & \text{if the mug's frame is more than 5 cm above the table},\\
        1 & \text{otherwise.} \end{cases}

    After the step, ``info`` has these entries:

    - ``success``, and ``is_success`` for SB3: whether the mug is lifted
    - ``mug``: the mug's pose before the grasp
    - ``mug_height``: the height of the mug's frame after the grasp, in m
    - ``grasp``: the clipped pose of the hand
    - ``contacts``: the number of points in which the fingers touch the mug at the end

    The outcome depends only on state and action, not on earlier trials or on the process that simulates the grasp.

    :param xy_half_width: Half the side of the square in which the mug starts uniformly, in m. The square's middle is
        (0.5, 0).
    :param yaw_range: The mug's initial yaw is uniform in ``(low, high)``, in rad. At yaw 0 the handle points to the
        robot's left.
    :param camera_range: In each trial, the camera is raised by a distance that is uniform in ``(low, high)``, in m.
        This distance is the fifth state component.
    :param camera_shift: Constant distance by which the camera is raised in all trials, in m. This distance is not part
        of the state.
    :param frame_offset: Distance from the origin of the mug's frame to the cup's axis, in m. Positive values are away
        from the handle.
    :param motion: ``"fast"``, or ``"reference"`` for the paper's slow motion.
    :param depth_noise_std: Standard deviation of the noise on each pixel, in m.
    :param n_processes: Number of processes that share a batch. This number does not change the results.
    :param render_mode: ``None`` or ``"rgb_array"`` (the scene and the depth image).
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}

    def __init__(
        self,
        *,
        xy_half_width: float = 0.05,
        yaw_range: tuple[float, float] = (-np.pi / 4, np.pi / 4),
        camera_range: tuple[float, float] | None = None,
        camera_shift: float = 0.0,
        frame_offset: float = 0.012,
        motion: str = "fast",
        depth_noise_std: float = 0.0,
        n_processes: int = 1,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(horizon=1, render_mode=render_mode)
        self.xy_half_width = checks.between(
            "xy_half_width", xy_half_width, 0.0, 0.15, " m: further out the mug leaves the image"
        )
        self.yaw_range = checks.low_high("yaw_range", yaw_range, unit=" in rad")
        frame_offset = checks.between("frame_offset", frame_offset, -0.05, 0.05, " m")
        self.cup_origin = np.array([0.0, -frame_offset, 0.0])  # in the mug's frame
        self.camera_range, self.camera_shift = camera_range, float(camera_shift)
        heights = np.full(2, self.camera_shift)
        if camera_range is not None:
            heights += checks.low_high("camera_range", camera_range, unit=" in m")
        if not (abs(heights) <= MAX_CAMERA_SHIFT).all():
            raise ValueError(
                f"camera_range={camera_range} and camera_shift={camera_shift} must leave the camera within "
                f"{MAX_CAMERA_SHIFT} m of its usual height: from further away the mug is not visible"
            )
        self.motion = checks.one_of("motion", motion, MOTIONS)
        self.depth_noise_std = checks.not_negative("depth_noise_std", depth_noise_std, " (it is sigma, in m)")
        self.n_processes = checks.count("n_processes", n_processes)
        self.state_names = ("x (m)", "y (m)", "z (m)", "yaw (rad)")
        if camera_range is not None:
            self.state_names += ("camera height (m)",)
        self.state_space = spaces.Box(-np.inf, np.inf, (len(self.state_names),), np.float64)
        self.observation_space = spaces.Box(MIN_DEPTH, MAX_DEPTH, (1, IMAGE_SIZE, IMAGE_SIZE), np.float32)
        self.action_space = spaces.Box(LOWEST_ACTION, HIGHEST_ACTION, dtype=np.float32)
        self._film: list[Configuration] = []  # the last grasp, recorded only with a render_mode

    def _make_world(self) -> tuple[Any, ...]:
        return GraspWorld, self.cup_origin, MOTIONS[self.motion]

    @cached_property
    def _view(self) -> PandaView:
        self.check_open()
        return PandaView(self.cup_origin)

    def initial_state(self, n: int) -> np.ndarray:
        self._film = []
        state = np.zeros((n, self.state_space.shape[0]))
        state[:, :2] = WORKSPACE + self.np_random.uniform(-self.xy_half_width, self.xy_half_width, (n, 2))
        state[:, 3] = self.np_random.uniform(self.yaw_range[0], self.yaw_range[1], n)
        if self.camera_range is not None:
            state[:, 4] = self.np_random.uniform(*self.camera_range, n)
        return state

    def dynamics(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        poses = NOMINAL_GRASP + ACTION_SCALE * action
        mugs, camera = state[:, :4], state[:, 4:]
        self._film = []
        watch = self._film.append if self.render_mode is not None and len(state) == 1 else None
        outcomes = self._shared("grasps", mugs, poses, watch=watch)
        next_state = np.concatenate([np.array([state for state, _ in outcomes]), camera], axis=1)
        heights, success = next_state[:, 2].tolist(), (next_state[:, 2] > LIFTED).tolist()
        self._details = [
            dict(success=lifted, is_success=lifted, mug=mug, mug_height=height, grasp=pose, contacts=contacts)
            for mug, pose, height, lifted, (_, contacts) in zip(mugs, poses, heights, success, outcomes, strict=True)
        ]
        return next_state

    def sensor(self, state: np.ndarray) -> np.ndarray:
        return self._with_noise(self._shared("images", self._seen(state)), self.np_random)

    def _seen(self, state: np.ndarray) -> np.ndarray:
        """Return the states for the depth camera: the mug's pose and, if the camera is raised, by which distance."""
        if self.camera_shift == 0:
            return state
        raised = state[:, 4:] if self.camera_range is not None else np.zeros((len(state), 1))
        return np.concatenate([state[:, :4], raised + self.camera_shift], axis=1)

    def cost(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        return np.zeros(len(state))

    def terminal_cost(self, state: np.ndarray) -> np.ndarray:
        return np.where(state[:, 2] > LIFTED, 0.0, 1.0)

    def _with_noise(self, images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Add noise to depth images, ``(N, 1, 128, 128)``, and clip them to the observation space."""
        if self.depth_noise_std > 0:
            for image in images:
                image += self.depth_noise_std * rng.standard_normal(image.shape)
        return np.clip(images, MIN_DEPTH, MAX_DEPTH, out=images)

    def render(self) -> np.ndarray | None:
        """
        Draw the scene before or after the grasp, and the depth image beside it: ``(256, 644, 3)`` uint8.

        Near points of the depth image are bright. The sensor noise in the picture comes from a separate generator, so
        that rendering does not change an episode. For a video, see :meth:`film`.
        """
        if self.render_mode is None:
            return None
        state = self._current_state()[0]
        if self._film:
            configuration = self._film[-1]
        else:
            *position, yaw = state[:4].tolist()
            upright = (0.0, 0.0, float(np.sin(yaw / 2)), float(np.cos(yaw / 2)))
            configuration = Configuration((*HOME, FINGER_OPEN, FINGER_OPEN), tuple(position), upright)
        self._view.place(configuration)
        return self._view.picture(self._depth_of(state))

    def film(self) -> Iterator[np.ndarray]:
        """
        Yield the frames of the last grasp, at 30 frames per second, beside the depth image before the grasp.

        :raises ValueError: if ``render_mode`` is not ``"rgb_array"``, or there was no ``step`` since ``reset``.
        """
        if self.render_mode is None or not self._film:
            raise ValueError(f"film() shows the last step(), with render_mode='rgb_array', not {self.render_mode!r}")
        depth = self._depth_of(np.append(self._details[0]["mug"], self._current_state()[0, 4:]))
        for configuration in self._film:
            self._view.place(configuration)
            yield self._view.picture(depth)

    def _depth_of(self, state: np.ndarray) -> np.ndarray:
        (depth,) = self._with_noise(self._world.images(self._seen(state[None])), np.random.default_rng(0))
        return depth
