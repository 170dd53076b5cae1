"""Define the ball-catching problem (Section IV-B of the paper), with a camera as the only sensor."""

import os
from functools import cached_property
from importlib import import_module
from typing import Any

import numpy as np
from gymnasium import spaces

from . import checks
from .ball_scene import IMAGE_SIZE, BallScene
from .noise import NOISE_MODES, noisy_pixels
from .pool import SharedEnv
from .textures import TRAINING_TEXTURE, load_texture

Range = tuple[float, float]  # lowest and highest
PlaneRange = tuple[tuple[float, float], tuple[float, float]]  # lowest and highest (x, y)

# Modules and classes are given by name, so that PyBullet is imported only if it renders.
RENDERERS = {"pybullet": ("ball_bullet", "BulletRenderer"), "fast": ("ball_fast", "FastRenderer")}
DT = 1 / 15  # s
MAX_ACTION = 20.0  # m/s


class BallCatchEnv(SharedEnv):
    r"""
    Drive along a line, in front of a brick wall, to the place where a ball lands.

    State ``x = (d, b_x, b_y, v_x, v_y)``: the robot's position, the ball's position (``b_y`` is the height) and the
    ball's velocity, in m and m/s. Observation ``y``: the image of a camera on the robot, uint8 ``(3, 64, 64)``. Action
    ``u``: the robot's speed in m/s. With ``T = 25`` controls, the dynamics and the costs are

    .. math::
        d_{t+1} &= d_t + k u_t, \quad k = \Delta t = 1/15\,\mathrm{s}, \qquad
        b_{t+1} = b_t + \Delta t\, v_t, \qquad v_{t+1} = v_t - (0, \Delta t\, g), \\
        c_t &= 0.01\, |u_t|, \qquad c_T = 100\, |d_T - b^x_T|.

    The defaults follow the paper's text. Other values of the control gain, gravity and horizon fit the published
    numbers better than the defaults: ``BallCatchEnv(**sb3_tdpg.envs.scenarios.BALL_PUBLISHED_READING)``. The paper's
    action space is unbounded, but SB3 needs bounds. The bounds of 20 m/s are large, because an action beyond a bound
    gives no gradient; the task needs speeds of about 2 m/s.

    :param control_gain: The robot moves by ``control_gain * u`` in each step.
    :param gravity: Gravitational acceleration in m/s^2.
    :param horizon: Number of controls T.
    :param robot_range: The robot's initial position is uniform in ``(low, high)``, in m.
    :param ball_start_range: The ball's initial position is uniform in ``((low_x, low_y), (high_x, high_y))``, in m.
    :param ball_speed_range: The ball's initial velocity is uniform in ``((low_x, low_y), (high_x, high_y))``, in m/s.
    :param ball_radius: Radius of the ball in m.
    :param camera_height: Height of the camera above the floor, in m.
    :param camera_pitch: Upward tilt of the camera in degrees, between -89 and 89.
    :param texture: Texture of the wall: a name, a path or an array (:func:`~sb3_tdpg.envs.textures.load_texture`).
    :param pixel_noise_std: Standard deviation of the noise on every pixel, for pixel values in [0, 1].
    :param noise_mode: How noisy images are mapped back to [0, 1]: ``"minmax"`` as in the paper, or ``"clip"``.
    :param wall_stands_still: Whether to draw wall, floor and sky as if the robot were at d = 0. Then only the ball
        shows where the robot is (for diagnosis).
    :param renderer: ``"fast"``, a batched ray caster, or ``"pybullet"``, the reference. Their images agree in 99.8 % of
        the pixels.
    :param n_processes: Number of processes that render a batch with PyBullet. This number does not change the results.
    :param render_mode: ``None`` or ``"rgb_array"`` (scene and camera image).
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 15}
    state_names = ("d (m)", "b_x (m)", "b_y (m)", "v_x (m/s)", "v_y (m/s)")

    def __init__(
        self,
        *,
        control_gain: float = DT,
        gravity: float = 9.81,
        horizon: int = 25,
        robot_range: Range = (-2.0, 2.0),
        ball_start_range: PlaneRange = ((8.0, 1.0), (8.0, 1.0)),
        ball_speed_range: PlaneRange = ((-4.5, 7.85), (-4.5, 7.85)),
        ball_radius: float = 0.235,
        camera_height: float = 2.0,
        camera_pitch: float = 30.0,
        texture: str | os.PathLike[str] | np.ndarray = TRAINING_TEXTURE,
        pixel_noise_std: float = 0.0,
        noise_mode: str = "minmax",
        wall_stands_still: bool = False,
        renderer: str = "fast",
        n_processes: int = 1,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(horizon=horizon, render_mode=render_mode)
        self.control_gain = checks.positive("control_gain", control_gain)
        self.gravity = checks.finite("gravity", gravity)
        self.robot_range = checks.low_high("robot_range", robot_range)
        corners = "((low_x, low_y), (high_x, high_y))"
        self.ball_start_range = checks.low_high("ball_start_range", ball_start_range, corners, (2, 2))
        self.ball_speed_range = checks.low_high("ball_speed_range", ball_speed_range, corners, (2, 2))
        sigma = " (it is sigma, for pixels in [0, 1])"
        self.pixel_noise_std = checks.not_negative("pixel_noise_std", pixel_noise_std, sigma)
        self.noise_mode = checks.one_of("noise_mode", noise_mode, NOISE_MODES)
        self.renderer = checks.one_of("renderer", renderer, RENDERERS)
        self.wall_stands_still = wall_stands_still
        self.scene = BallScene(
            texture=load_texture(texture),
            ball_radius=checks.positive("ball_radius", ball_radius),
            camera_height=checks.positive("camera_height", camera_height),
            camera_pitch=checks.between("camera_pitch", camera_pitch, -89.0, 89.0, " degrees"),
        )
        self.state_space = spaces.Box(-np.inf, np.inf, (5,), np.float64)
        self.observation_space = spaces.Box(0, 255, (3, IMAGE_SIZE, IMAGE_SIZE), np.uint8)
        self.action_space = spaces.Box(-MAX_ACTION, MAX_ACTION, (1,), np.float32)
        module, name = RENDERERS[renderer]
        self._renderer_class = getattr(import_module(f".{module}", __package__), name)
        n_processes = checks.count("n_processes", n_processes)
        self.n_processes = n_processes if renderer == "pybullet" else 1

    def _make_world(self) -> tuple[Any, ...]:
        return self._renderer_class, self.scene

    @cached_property
    def _view(self) -> Any:
        from .ball_bullet import SideView

        self.check_open()
        return SideView(self.scene)

    def initial_state(self, n: int) -> np.ndarray:
        state = np.empty((n, 5))
        state[:, 0] = self.np_random.uniform(self.robot_range[0], self.robot_range[1], n)
        state[:, 1:3] = self.np_random.uniform(self.ball_start_range[0], self.ball_start_range[1], (n, 2))
        state[:, 3:5] = self.np_random.uniform(self.ball_speed_range[0], self.ball_speed_range[1], (n, 2))
        return state

    def dynamics(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        d, ball_x, ball_y, speed_x, speed_y = state.T
        next_d = d + self.control_gain * action[:, 0]
        next_x, next_y = ball_x + DT * speed_x, ball_y + DT * speed_y
        return np.stack([next_d, next_x, next_y, speed_x, speed_y - DT * self.gravity], axis=1)

    def sensor(self, state: np.ndarray) -> np.ndarray:
        return self._with_noise(self._shared("images", self._seen_from(state)), self.np_random)

    def _seen_from(self, state: np.ndarray) -> np.ndarray:
        """Return the state that the camera image shows."""
        if not self.wall_stands_still:
            return state
        shown = state.copy()
        shown[:, 0], shown[:, 1] = 0.0, state[:, 1] - state[:, 0]
        return shown

    def cost(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        return 0.01 * np.abs(action[:, 0])

    def terminal_cost(self, state: np.ndarray) -> np.ndarray:
        return 100.0 * np.abs(state[:, 0] - state[:, 1])

    def _with_noise(self, images: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Add pixel noise to images, ``(N, 3, 64, 64)``."""
        if self.pixel_noise_std == 0:
            return images
        noisy = noisy_pixels(images / np.float32(255), self.pixel_noise_std, self.noise_mode, rng)
        return np.rint(255 * noisy).astype(np.uint8)

    def render(self) -> np.ndarray | None:
        """Return a picture of side view and camera image, ``(256, 772, 3)`` uint8."""
        if self.render_mode is None:
            return None
        state = self._current_state()
        self._view.place(state[0])
        images = self._world.images(self._seen_from(state))
        # The noise comes from a separate generator, so that rendering does not change an episode.
        (camera_image,) = self._with_noise(images, np.random.default_rng(0))
        return self._view.picture(camera_image)
