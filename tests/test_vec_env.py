"""The batched VecEnv and the environment from gymnasium.make are the same."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
from small_problems import ToyEnv, tiny_tdpg, train_epochs
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from sb3_tdpg import BatchedVecEnv, make_episodes_env
from sb3_tdpg.envs.ball_catch import BallCatchEnv
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.envs.panda_grasp import PandaGraspEnv
from sb3_tdpg.envs.scenarios import LAVA_TABLE_READING
from sb3_tdpg.envs.squeeze_insert import SqueezeInsertEnv

N = 7


def lava_vec_env(n=N, **kwargs):
    return BatchedVecEnv(LavaEnv(**kwargs), n)


@pytest.mark.parametrize(("make", "n"), [
    (lambda: LavaEnv(sensor_noise_std=0.0, horizon=3), 20),
    (lambda: LavaEnv(sensor_noise_std=0.0, horizon=3, **LAVA_TABLE_READING), 20),
    (lambda: BallCatchEnv(renderer="pybullet", horizon=3), 20),
    (lambda: BallCatchEnv(horizon=3), 20),
    (PandaGraspEnv, 4),
], ids=["text", "table", "pybullet", "fast", "grasp"])  # fmt: skip
def test_every_row_is_what_the_single_environment_gives_for_the_same_state_and_action(make, n):
    rng = np.random.default_rng(0)
    vec_env, singles = BatchedVecEnv(make(), n), [make() for _ in range(n)]
    vec_env.seed(1)
    observations = vec_env.reset()
    for single, info, observation in zip(singles, vec_env.reset_infos, observations, strict=True):
        single.reset()
        single._state = info["state"][None].copy()
        np.testing.assert_array_equal(observation, single.sensor(single._state)[0])
    horizon = vec_env.env.horizon
    for t in range(horizon):
        actions = rng.uniform(-4, 4, (n, *vec_env.action_space.shape)).astype(np.float32)
        observations, rewards, dones, infos = vec_env.step(actions)
        for i, single in enumerate(singles):
            observation, reward, terminated, truncated, info = single.step(actions[i])
            np.testing.assert_equal({name: infos[i][name] for name in info}, info)
            assert rewards[i] == np.float32(reward)
            assert dones[i] == terminated == (t == horizon - 1)
            assert not truncated
            last = infos[i]["terminal_observation"] if dones[i] else observations[i]
            np.testing.assert_array_equal(last, observation)


def test_the_batch_draws_the_same_noise_as_a_single_environment_with_the_same_seed():
    vec_env, single = lava_vec_env(1, sensor_noise_std=0.5), LavaEnv(sensor_noise_std=0.5)
    vec_env.seed(5)
    np.testing.assert_array_equal(vec_env.reset()[0], single.reset(seed=5)[0])
    for _ in range(4):
        np.testing.assert_array_equal(vec_env.step(np.ones((1, 1)))[0][0], single.step(np.ones(1))[0])


def test_a_finished_episode_is_reset_at_once_and_its_last_observation_is_kept():
    vec_env = lava_vec_env(sensor_noise_std=0.0)
    vec_env.seed(0)
    vec_env.reset()
    first = np.array([info["state"] for info in vec_env.reset_infos])
    for _ in range(4):
        _, _, dones, infos = vec_env.step(np.zeros((N, 1)))
        assert not dones.any()
        assert all("terminal_observation" not in info and "episode" not in info for info in infos)
    observations, _, dones, infos = vec_env.step(np.zeros((N, 1)))
    assert dones.all()
    second = np.array([info["state"] for info in vec_env.reset_infos])
    assert not np.array_equal(first, second)
    np.testing.assert_array_equal(observations, second.astype(np.float32))
    for info, x_0 in zip(infos, first, strict=True):
        np.testing.assert_array_equal(info["state"], x_0)  # a robot at rest does not move without a control
        np.testing.assert_array_equal(info["terminal_observation"], x_0.astype(np.float32))
        assert info["TimeLimit.truncated"] is False


def test_the_episode_info_has_the_return_and_the_length_of_each_episode():
    vec_env = lava_vec_env()
    vec_env.reset()
    for _ in range(2):
        total = np.zeros(N)
        for _ in range(5):
            _, rewards, _, infos = vec_env.step(np.full((N, 1), 0.2))
            total += rewards
        np.testing.assert_allclose([info["episode"]["r"] for info in infos], total, rtol=1e-6)
        assert {info["episode"]["l"] for info in infos} == {5}


def test_states_that_went_out_belong_to_their_receiver():
    vec_env, untouched = lava_vec_env(), lava_vec_env()
    for env in (vec_env, untouched):
        env.seed(0)
        env.reset()
    x_0 = [info["state"] for info in vec_env.reset_infos]
    kept = np.array(x_0)
    x_1 = [info["state"] for info in vec_env.step(np.ones((N, 1)))[3]]
    np.testing.assert_array_equal(x_0, kept)
    for state in (*x_0, *x_1):
        state[:] = 4.9
    untouched.step(np.ones((N, 1)))
    states, expected = ([info["state"] for info in env.step(np.ones((N, 1)))[3]] for env in (vec_env, untouched))
    np.testing.assert_array_equal(states, expected)
    np.testing.assert_array_equal([*x_0, *x_1], 4.9)


def test_the_same_seed_gives_the_same_episodes_and_the_seed_is_used_once():
    def two_resets(seed):
        vec_env = lava_vec_env()
        vec_env.seed(seed)
        return np.concatenate([vec_env.reset(), vec_env.reset()])

    np.testing.assert_array_equal(two_resets(3), two_resets(3))
    assert not np.array_equal(two_resets(3), two_resets(4))
    first, second = np.split(two_resets(3), 2)
    assert not np.array_equal(first, second)


@pytest.mark.parametrize(("is_normalized", "wrap"), [
    (True, lambda env: VecNormalize(env, norm_reward=False)),
    (False, VecMonitor),
    (True, lambda env: VecMonitor(VecNormalize(env, norm_reward=False))),
], ids=["VecNormalize", "VecMonitor", "both"])  # fmt: skip
def test_the_model_sees_the_true_states_through_sb3s_wrappers(is_normalized, wrap):
    env = lava_vec_env(20, sensor_noise_std=0.0)
    model = tiny_tdpg(wrap(env))
    assert isinstance(model.get_vec_normalize_env(), VecNormalize) == is_normalized
    train_epochs(model, 2)
    states = model.rollout_buffer.states
    assert (states[0, :, 1] == 0).all()  # x_0, not the last state of the previous episode
    assert states[0, :, 0].min() >= 0
    assert len(np.unique(states[0, :, 0])) == 20
    observations = model.rollout_buffer.observations
    assert np.allclose(observations, states, rtol=1e-6) != is_normalized
    assert (abs(observations[..., 0].mean()) < 1) == is_normalized  # the mean of d is 2.5


def test_attributes_and_methods_of_the_environment_can_be_reached_and_reset_options_are_refused():
    vec_env = lava_vec_env()
    vec_env.set_options({"sensor_noise_std": 1.0})
    with pytest.raises(ValueError, match="pass variations to its constructor"):
        vec_env.reset()
    assert vec_env.get_attr("horizon") == [5] * N
    vec_env.set_attr("sensor_noise_std", 0.25)
    assert vec_env.get_attr("sensor_noise_std", indices=[0, 2]) == [0.25, 0.25]
    assert vec_env.has_attr("state_space")
    assert not vec_env.has_attr("no_such_attribute")
    assert vec_env.env_method("render", indices=0) == [None]
    assert vec_env.env_is_wrapped(gym.Wrapper) == [False] * N


@pytest.mark.parametrize(("env_id", "cls", "kwargs", "n"), [
    ("Lava-v0", BatchedVecEnv, dict(sensor_noise_std=0.2), 120),
    ("sb3_tdpg:Lava-v0", BatchedVecEnv, dict(sensor_noise_std=0.2), 120),
    ("Pendulum-v1", DummyVecEnv, dict(g=5.0), 40),  # the largest divisor of 120 up to 50
])  # fmt: skip
def test_an_environment_of_this_plugin_becomes_one_batch_and_any_other_a_dummy_vec_env(env_id, cls, kwargs, n):
    env, again = (make_episodes_env(env_id, n_episodes=120, env_kwargs=kwargs, seed=1) for _ in range(2))
    assert (type(env), env.num_envs) == (cls, n)
    ((name, value),) = kwargs.items()
    assert getattr(env.unwrapped.env if cls is BatchedVecEnv else env.envs[0].unwrapped, name) == value
    np.testing.assert_array_equal(env.reset(), again.reset())
    assert make_episodes_env(env_id, 3, n_episodes=120).num_envs == 3


def test_an_environment_without_pictures_is_not_asked_for_any(registry):
    gym.register("Blind-v0", ToyEnv)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # Gymnasium would warn once for each environment
        env = make_episodes_env("Blind-v0", 2, env_kwargs=dict(horizon=7), seed=1)
    assert env.get_attr("horizon") == [7, 7]
    assert make_episodes_env("Pendulum-v1", 2).render_mode == "rgb_array"


def test_a_time_limit_of_the_registration_is_kept(registry):
    gym.register("LavaShort-v0", "sb3_tdpg.envs.lava:LavaEnv", max_episode_steps=2)
    env = make_episodes_env("LavaShort-v0", 1, seed=0)
    env.reset()
    assert [env.step(np.zeros((1, 1)))[2].item() for _ in range(2)] == [False, True]


@pytest.mark.parametrize("name", ["n_envs", "n_episodes", "epoch_steps"])
@pytest.mark.parametrize("value", [0, -3, 2.5])
def test_a_number_of_environments_episodes_or_steps_below_one_is_refused(name, value):
    with pytest.raises(ValueError, match=f"{name}={value} must be an integer of at least 1"):
        make_episodes_env("Lava-v0", **{name: value})


class Window(LavaEnv):
    metadata = {**LavaEnv.metadata, "render_modes": ["human"]}

    def render(self):
        self.shown = self._current_state()


def test_a_window_shows_the_first_episode():
    env = BatchedVecEnv(Window(render_mode="human"), 3)
    env.reset()
    for mode in (None, "human"):
        assert env.render(mode) is None
        np.testing.assert_array_equal(env.env.shown[0], env.reset_infos[0]["state"])
    assert env.env._state is None


def test_pictures_of_a_batch_have_no_gripper():
    """Each episode has its own gripper, so that a picture of the batch must not show the first episode's gripper."""
    env = BatchedVecEnv(SqueezeInsertEnv(render_mode="rgb_array"), 2)
    env.reset()
    env.step(np.array([[0.0], [1.5]]))
    grey = [(image == (140, 140, 150)).all(-1).any() for image in env.get_images()]
    assert grey == [False, False]
