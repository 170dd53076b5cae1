"""What every registered environment must satisfy, and what the constructors refuse."""

import copy
import math
import pickle
import re
import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from small_problems import LinearProblem, words
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_tdpg import TDPG, BatchedVecEnv, make_episodes_env
from sb3_tdpg.envs import ENTRY_POINTS
from sb3_tdpg.envs.ball_catch import BallCatchEnv
from sb3_tdpg.envs.bullet import BulletClient
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.envs.panda_grasp import PandaGraspEnv
from sb3_tdpg.envs.panda_squeeze import PandaSqueezeEnv
from sb3_tdpg.envs.peg_corner import PegCornerEnv
from sb3_tdpg.envs.scenarios import PANDA_CAMERA
from sb3_tdpg.envs.squeeze_insert import SqueezeInsertEnv

EVERY_ID = pytest.mark.parametrize("env_id", sorted(ENTRY_POINTS))


@EVERY_ID
@pytest.mark.parametrize("check_env", [gymnasium_check_env, sb3_check_env], ids=["gymnasium", "sb3"])
def test_every_registered_environment_passes_the_checkers(env_id, check_env):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # Our observations and Lava's velocity have no bounds; everything else must be without a warning.
        warnings.filterwarnings("ignore", message=".*Box observation space m(in|ax)imum value is.*infinity.*")
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*space.*")
        warnings.filterwarnings("ignore", message=".*Not able to test alternative render modes.*")
        # A depth image is in metres, not in bytes.
        warnings.filterwarnings("ignore", message="It seems that your observation.*is an image but")
        env = gym.make(env_id).unwrapped
        check_env(env)


@EVERY_ID
def test_every_registered_environment_is_reproducible_from_its_seed(env_id):
    def episode(seed):
        env = gym.make(env_id)
        env.action_space.seed(7)
        observations = [env.reset(seed=seed)[0]]
        for _ in range(env.unwrapped.horizon):
            observations.append(env.step(env.action_space.sample())[0])
        return np.stack([*observations, env.reset()[0]])

    np.testing.assert_array_equal(episode(3), episode(3))
    assert not np.array_equal(episode(3), episode(4))


@EVERY_ID
def test_an_episode_stays_in_the_state_space_pays_its_cost_and_is_terminated_at_the_horizon(env_id):
    env = gym.make(env_id)
    horizon, state_space = env.unwrapped.horizon, env.unwrapped.state_space
    assert (len(env.unwrapped.state_names),) == state_space.shape
    assert all(re.fullmatch(r".+ \(.+\)", name) for name in env.unwrapped.state_names)  # with a unit
    for seed in range(20):
        env.action_space.seed(seed)
        _, info = env.reset(seed=seed)
        ends = []
        for _ in range(horizon):
            assert state_space.contains(info["state"])
            _, reward, *end, info = env.step(env.action_space.sample())
            assert reward == -info["cost"]
            ends.append(end)
        assert state_space.contains(info["state"])
        assert ends == [[False, False]] * (horizon - 1) + [[True, False]]  # and never truncated


@EVERY_ID
def test_the_state_in_info_is_a_copy_that_may_be_overwritten(env_id):
    env, untouched = gym.make(env_id), gym.make(env_id)
    action = np.zeros(env.action_space.shape, np.float32)
    _, info = env.reset(seed=0)
    untouched.reset(seed=0)
    info["state"][:] = 99.0
    _, _, _, _, info = env.step(action)
    _, _, _, _, expected = untouched.step(action)
    np.testing.assert_array_equal(info["state"], expected["state"])
    kept = info["state"].copy()
    env.step(action) if env.unwrapped.horizon > 1 else env.reset()
    np.testing.assert_array_equal(info["state"], kept)


@EVERY_ID
def test_a_picture_needs_a_render_mode_and_a_reset_and_shows_the_episode_s_own_state(env_id):
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    assert env.render() is None
    drawing = gym.make(env_id, render_mode="rgb_array").unwrapped
    with pytest.raises(ValueError, match="before the first reset"):
        drawing.render()
    batch = BatchedVecEnv(drawing, 2)
    batch.seed(0)
    batch.reset()
    images = batch.get_images()
    assert not np.array_equal(*images)
    batch.close()


@EVERY_ID
def test_drawing_does_not_change_an_episode(env_id):
    noise = {"BallCatch-v0": dict(pixel_noise_std=0.1), "PandaGrasp-v0": dict(depth_noise_std=0.01)}.get(env_id, {})
    drawn, plain = (gym.make(env_id, render_mode=mode, **noise).unwrapped for mode in ("rgb_array", None))
    drawn.action_space.seed(0)
    np.testing.assert_equal(drawn.reset(seed=1), plain.reset(seed=1))
    pictures = [drawn.render()]
    for _ in range(drawn.horizon):
        action = drawn.action_space.sample()
        np.testing.assert_equal(drawn.step(action), plain.step(action))
        pictures.append(drawn.render())
    assert all(picture.dtype == np.uint8 and picture.shape == pictures[0].shape for picture in pictures)
    assert (pictures[0] != pictures[-1]).any()
    drawn.close()


@pytest.mark.parametrize("make", [
    lambda: BallCatchEnv(robot_range=(0.5, 0.5), pixel_noise_std=0.1),
    lambda: PandaGraspEnv(depth_noise_std=0.3, xy_half_width=0.0, yaw_range=(0.0, 0.0)),
], ids=["ball", "panda"])  # fmt: skip
def test_noise_follows_the_seed_differs_between_images_and_stays_in_the_space(make):
    env = make()
    first = env.reset(seed=1)[0]
    np.testing.assert_array_equal(env.reset(seed=1)[0], first)
    assert not np.array_equal(env.reset()[0], first)
    _, images = env.reset_batch(2)
    assert not np.array_equal(images[0], images[1])
    assert all(env.observation_space.contains(image) for image in images)
    env.close()


OF_SCENES = {
    LavaEnv: [(dict(sensor_noise_std=50.0), True), (dict(action_cost=1.0), False)],
    BallCatchEnv: [
        *((keywords, True) for keywords in (
            dict(ball_radius=1.0), dict(camera_height=1.5), dict(camera_pitch=20.0), dict(texture="random-3"),
            dict(pixel_noise_std=0.2), dict(pixel_noise_std=0.2, noise_mode="clip"),
        )),
        (dict(gravity=5.0), False),
    ],
    PandaGraspEnv: [
        (dict(frame_offset=0.0), True), (dict(depth_noise_std=0.01), True), (dict(motion="reference"), False),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("make", "keywords", "changes"), [(make, *row) for make, rows in OF_SCENES.items() for row in rows], ids=words
)
def test_a_keyword_of_the_scene_changes_the_observation_one_of_the_physics_does_not_and_neither_the_state(
    make, keywords, changes
):
    plain, other = make(), make(**keywords)
    (expected_image, expected), (image, info) = (env.reset(seed=0) for env in (plain, other))
    assert np.array_equal(image, expected_image) != changes
    np.testing.assert_array_equal(info["state"], expected["state"])
    plain.close(), other.close()


@pytest.mark.parametrize("make", [
    lambda: BallCatchEnv(renderer="pybullet", render_mode="rgb_array"),
    lambda: BallCatchEnv(renderer="pybullet", render_mode="rgb_array", n_processes=2),
    lambda: PandaGraspEnv(render_mode="rgb_array"),
], ids=["ball", "ball in processes", "panda"])  # fmt: skip
@pytest.mark.parametrize("is_used", [True, False])
def test_closing_twice_is_fine_and_a_closed_environment_says_so(make, is_used):
    env = make()
    if is_used:
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape))
        env.render()
    env.close()
    env.close()
    with pytest.raises(RuntimeError, match="has been closed: make a new one"):
        env.reset()


@pytest.mark.parametrize("make", [lambda: BallCatchEnv(renderer="pybullet"), PandaGraspEnv, PandaSqueezeEnv],
                         ids=["ball", "panda", "squeeze"])  # fmt: skip
def test_bullet_clients_are_given_back(make):
    def next_client():
        client = BulletClient()
        client.close()
        return client.client_id

    first = next_client()
    for i in range(20):
        env = make()
        env.reset(seed=0)
        env.step(np.zeros(env.action_space.shape))
        if i % 2:
            env.close()
        del env  # collected at once, also without a close
    assert next_client() == first


@pytest.mark.parametrize(("env_id", "keywords"), [
    ("BallCatch-v0", dict(renderer="pybullet", horizon=2)),
    ("PandaGrasp-v0", PANDA_CAMERA),
    ("PandaSqueeze-v0", dict(horizon=2)),
], ids=words)  # fmt: skip
def test_processes_give_the_same_episodes_and_end_with_the_environment(env_id, keywords):
    alone, shared = (make_episodes_env(env_id, 5, env_kwargs=dict(keywords, n_processes=n), seed=0) for n in (1, 2))
    np.testing.assert_array_equal(alone.reset(), shared.reset())
    shape = (5, *alone.action_space.shape)
    for actions in (np.ones(shape), np.linspace(-1, 1, np.prod(shape)).reshape(shape)):
        steps = [env.step(actions) for env in (alone, shared)]
        for info in (*steps[0][3], *steps[1][3]):
            info.get("episode", {}).pop("t", None)  # the time that has passed
        np.testing.assert_equal(*steps)
    assert vars(alone.env).get("_pool") is None
    assert vars(shared.env)["_pool"] is not None and "_world" not in vars(shared.env)
    for env in (alone, shared):
        env.close()
        env.close()
        with pytest.raises(RuntimeError, match="has been closed: make a new one"):
            env.step(np.ones(shape))


@EVERY_ID
def test_a_copy_goes_on_as_the_original_and_leaves_it_alone(env_id):
    """Worlds and processes cannot be copied: half-made copies of a pool's pipes closed those of the original."""
    env_kwargs = dict(n_processes=2) if gym.make(env_id).unwrapped.shares_work else {}
    original = make_episodes_env(env_id, 2, env_kwargs=env_kwargs, seed=0)
    original.reset()
    actions = np.zeros((2, *original.action_space.shape))
    copies = copy.deepcopy(original), pickle.loads(pickle.dumps(original))
    expected = original.step(actions)[:2]
    for other in copies:
        np.testing.assert_equal(other.step(actions)[:2], expected)
        other.close()
    original.step(actions)
    original.close()


@EVERY_ID
def test_actions_of_another_shape_are_refused_and_not_counted(env_id):
    env = gym.make(env_id).unwrapped
    env.reset(seed=0)
    (size,) = env.action_space.shape
    with pytest.raises(ValueError, match=rf"received actions of shape \(1, {size + 1}\): expected \(1, {size}\)"):
        env.step(np.zeros(size + 1))
    for _ in range(env.horizon):
        assert not env.step(np.zeros(size))[3]
    batch = BatchedVecEnv(env, 3)
    with pytest.raises(gym.error.ResetNeeded, match="call reset"):
        batch.step(np.zeros((3, size)))
    batch.reset()
    for shape in ((1, size), (3, size + 1), (3,)):
        with pytest.raises(ValueError, match=rf"expected \(3, {size}\)"):
            batch.step(np.zeros(shape))
    dones = [batch.step(np.zeros((3, size)))[2].all() for _ in range(env.horizon)]
    assert dones == [False] * (env.horizon - 1) + [True]


CAMERA_RANGE = r"camera_range=.* must be \(low, high\) of finite numbers in m, low <= high"
CAMERA_SHIFT = r"camera_range=.* and camera_shift=.* must leave the camera within 0.1 m of its usual height"
REFUSED = {
    LavaEnv: [
        (dict(sensor_noise_std=-0.1), "sensor_noise_std=-0.1 must be finite and not negative"),
        (dict(sensor_noise_std=np.nan), "sensor_noise_std=nan must be finite"),
        (dict(horizon=0), "horizon=0 must be an integer of at least 1"),
        (dict(max_action=0.0), "max_action=0.0 must be finite and positive"),
        *(({name: np.nan}, f"{name}=nan must be finite")
          for name in ("action_cost", "lava_stage_cost", "lava_terminal_cost")),
        (dict(sensor_bias=0.1), "sensor_bias=0.1 must be two finite numbers"),
        *((dict(start_beta=(1.0, b)), r"start_beta=\(1.0, .*\) must be two positive") for b in (0.0, np.inf, np.nan)),
        (dict(render_mode="human"), r"render_mode='human' must be None or one of \['rgb_array'\]"),
    ],
    BallCatchEnv: [
        (dict(pixel_noise_std=-0.1), "pixel_noise_std=-0.1 must be finite and not negative"),
        (dict(noise_mode="max"), r"noise_mode='max' must be one of \['minmax', 'clip'\]"),
        (dict(renderer="opengl"), r"renderer='opengl' must be one of \['pybullet', 'fast'\]"),
        (dict(n_processes=0), "n_processes=0 must be"),
        (dict(gravity=np.inf), "gravity=inf must be finite"),
        *(({name: 0.0}, f"{name}=0.0 must be finite and positive")
          for name in ("control_gain", "ball_radius", "camera_height")),
        (dict(robot_range=(1.0, -1.0)), r"robot_range=\(1.0, -1.0\) must be \(low, high\)"),
        (dict(ball_start_range=(8.0, 1.0)), r"ball_start_range=\(8.0, 1.0\) must be \(\(low_x, low_y\)"),
        (dict(ball_speed_range=((-4, 8), (-5, 8))), r"ball_speed_range=.* must be \(\(low_x, low_y\).* low <= high"),
        (dict(camera_pitch=90.0), "camera_pitch=90.0 must be between -89 and 89 degrees"),
        (dict(texture="bricks"), r"texture='bricks' is no file and no known name: use one of .*'red_planks'"),
        (dict(texture=np.zeros((8, 8), np.uint8)), r"shape \(8, 8\) and dtype uint8; expected \(height, width, 3\)"),
    ],
    PandaGraspEnv: [
        (dict(xy_half_width=-0.1), "xy_half_width=-0.1 must be between 0 and 0.15 m"),
        (dict(yaw_range=(1.0, -1.0)), r"yaw_range=\(1.0, -1.0\) must be \(low, high\) of finite numbers in rad"),
        (dict(frame_offset=1.0), "frame_offset=1.0 must be between -0.05 and 0.05 m"),
        (dict(n_processes=0), "n_processes=0 must be an integer of at least 1"),
        (dict(motion="slow"), r"motion='slow' must be one of \['fast', 'reference'\]"),
        (dict(depth_noise_std=-0.1), "depth_noise_std=-0.1 must be finite and not negative"),
        *((dict(camera_range=value), CAMERA_RANGE)
          for value in [(0.01, -0.01), (0.0, np.nan), 0.05]),
        (dict(camera_range=(-0.2, 0.0)), CAMERA_SHIFT),
        (dict(camera_shift=0.11), CAMERA_SHIFT),
        (dict(camera_shift=np.nan), CAMERA_SHIFT),
        (dict(camera_shift=0.08, camera_range=(-0.03, 0.03)), CAMERA_SHIFT),
    ],
    PandaSqueezeEnv: [
        (dict(friction=-0.1), "friction=-0.1 must be between 0 and 1"),
        (dict(centring_error=0.01), "centring_error=0.01 must be between 0 and 0.0035 m: else a jaw may come down"),
        (dict(tolerance=0.3), "tolerance=0.3 must be between 0 and 0.2 rad"),
        (dict(sensor_noise_std=-1.0), "sensor_noise_std=-1.0 must be finite and not negative"),
        (dict(n_processes=0), "n_processes=0 must be an integer of at least 1"),
    ],
    SqueezeInsertEnv: [
        (dict(turn=(0.9, 1.1)), r"turn\[1\]=1.1 must be between 0 and 1: a squeeze does not turn the part too far"),
        (dict(turn=(0.9, 0.8)), "low <= high"),
        (dict(basin=2.0), "basin=2.0 must be between 0 and 1.5708 rad"),
        (dict(tolerance=-0.1), "tolerance=-0.1 must be finite and not negative"),
        (dict(sensor_noise_std=np.nan), "sensor_noise_std=nan must be finite"),
    ],
    PegCornerEnv: [
        (dict(sensor_noise_std=-1.0), "sensor_noise_std=-1.0 must be finite"),
        (dict(actuator_gain=-1.0), "actuator_gain=-1.0 must be finite"),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("make", "keywords", "message"), [(make, *row) for make, rows in REFUSED.items() for row in rows], ids=words
)
def test_the_constructor_refuses_a_bad_keyword_and_names_the_mend(make, keywords, message):
    with pytest.raises(ValueError, match=message):
        make(**keywords)


def test_actions_may_have_two_dimensions_or_be_discrete():
    env = LinearProblem()
    env.action_space, env.cost = spaces.Box(-1, 1, (2, 2)), lambda state, action: action[:, 0, 1]
    env.dynamics, env.terminal_cost = lambda state, action: state, lambda state: np.zeros(len(state))
    env.reset()
    assert env.step(np.array([[0.0, 0.5], [0.0, 0.0]]))[1] == -0.5
    env.action_space, env.cost = spaces.Discrete(2), lambda state, action: (action != (state[:, 0] > 0)).astype(float)
    _, info = env.reset(seed=0)
    assert [env.step(action)[1] for action in (0, 1)] == [-1.0, 0.0] if info["state"] > 0 else [0.0, -1.0]
    env = BatchedVecEnv(env, 100)
    model = TDPG("TRVPolicy", env, n_episodes=100, beta=math.inf, learning_rate=1e-2, seed=0, device="cpu")
    model.learn(100 * 2 * 30)
    assert model.rollout_buffer.episode_costs.mean() < 0.5  # 1.0 by chance
