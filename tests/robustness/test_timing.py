"""What late, lost, frozen and failing observations and actions are, for vectors, images and Dict."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from perturbed_problems import DICT, ClockEnv, PictureEnv, dummy, perturbed
from small_problems import ToyEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdpg.robustness import PerturbedVecEnv, observation_scale
from sb3_tdpg.robustness.sensor import Sensor

HORIZON = ClockEnv.horizon


def clock(n=40, space=DICT):
    return DummyVecEnv([lambda: ClockEnv(space)] * n)


def times(name, severity=3, key="gyro", n=40):
    """The time of the step that is shown at each step of an episode, ``(T, N)``, with 0 for none."""
    env = PerturbedVecEnv(clock(n), name, severity, seed=0)
    env.seed(0)
    seen = [env.reset(), *(env.step(np.zeros((n, 2), np.float32))[0] for _ in range(HORIZON - 1))]
    shown = np.stack([observation[key].reshape(n, -1)[:, 0] for observation in seen]).astype(int) - 10
    return np.where(shown == -10, -1, shown)


NOW = np.arange(HORIZON)[:, None]


def test_a_blackout_is_one_burst_and_then_all_is_as_before():
    shown = times("blackout", 3)
    dark = shown == -1
    assert (np.where(dark, NOW, shown) == NOW).all()
    assert (dark.sum(axis=0) == 4).all()
    assert (np.abs(np.diff(dark.astype(int), axis=0)).sum(axis=0) <= 2).all()  # one burst
    starts = dark.argmax(axis=0)
    assert starts.min() == 1
    assert len(set(starts)) > 4


def test_a_frozen_sensor_shows_its_last_observation_to_the_end():
    shown = times("freeze", 3)
    start = (shown != NOW).argmax(axis=0)
    assert set(start) == {1, 2, 3, 4, 5, 6}  # 0.6 of the steps after the first one
    assert (shown == np.minimum(NOW, start - 1)).all()


def test_a_held_observation_is_the_one_shown_before_with_a_probability():
    shown = times("hold", 4, n=300)
    held = shown[1:] == shown[:-1]
    assert held.mean() == pytest.approx(0.6, abs=0.03)
    assert (held | (shown[1:] == NOW[1:])).all()
    assert held.mean(axis=1) == pytest.approx(0.6, abs=0.1)  # at any step


def test_a_lag_is_drawn_for_the_episode_and_jitters_by_a_step():
    age = NOW - times("lag", 3, n=300)
    assert (age >= 0).all()
    assert (np.diff(age, axis=0) <= 1).all()  # nothing is shown that is older than what was shown before
    settled = age[6:]
    assert settled.max() == 4
    assert (np.ptp(settled, axis=0) <= 2).all()
    middle = np.median(settled, axis=0)
    assert all((middle == delay).mean() > 0.1 for delay in (1, 2, 3, 4))
    assert (np.ptp(settled, axis=0) > 0).mean() > 0.8


def test_a_failed_group_shows_nothing_and_stays_dead():
    parts = {key: times("group_failure", 3, key) for key in ("camera", "gyro", "touch")}
    dead = {key: shown == -1 for key, shown in parts.items()}
    for key, shown in parts.items():
        assert (np.where(dead[key], NOW, shown) == NOW).all()
        assert (np.diff(dead[key].astype(int), axis=0) >= 0).all()
        assert 0.1 < dead[key][-1].mean() < 0.6
    assert (sum(each[-1].astype(int) for each in dead.values()) == 1).all()


@pytest.mark.parametrize("name", ["blackout", "freeze", "hold", "lag"])
def test_all_parts_of_an_observation_are_of_the_same_time(name):
    camera, gyro, touch = (times(name, key=key) for key in ("camera", "gyro", "touch"))
    np.testing.assert_array_equal(camera, gyro)
    np.testing.assert_array_equal(touch, gyro)
    assert (gyro != NOW).any()


def test_groups_have_the_names_of_the_environment(monkeypatch):
    monkeypatch.setattr(ClockEnv, "observation_groups", {"eyes": ["camera", "touch"]}, raising=False)
    camera, gyro, touch = (times("group_failure", key=key) for key in ("camera", "gyro", "touch"))
    np.testing.assert_array_equal(camera, touch)
    assert (camera[-1] == -1).all()
    assert (gyro == NOW).all()


def test_groups_of_vectors_and_images():
    def groups(space, named=None):
        return [group[""].tolist() for group in Sensor(space, named_groups=named).groups]

    vector, image = spaces.Box(-1, 1, (3,), np.float32), spaces.Box(0, 255, (4, 4, 3), np.uint8)
    assert groups(vector) == [[0], [1], [2]]
    assert groups(vector, {"imu": [0, 2]}) == [[0, 2]]
    assert groups(image) == [list(range(c, 48, 3)) for c in range(3)]
    with pytest.raises(ValueError, match=r"has \[3\]: use indices from 0 to 2"):
        groups(vector, {"imu": [0, 3]})
    with pytest.raises(ValueError, match=r"has \['nose'\]: use keys of the observation"):
        groups(DICT, {"face": ["nose"]})


def test_nothing_is_zero_or_black_as_far_as_the_bounds_allow():
    space = spaces.Box(np.array([-1, 2], np.float32), np.array([1, 20], np.float32))
    env = PerturbedVecEnv(clock(8, space), "blackout", 5, seed=0)
    env.reset()
    seen, *_ = env.step(np.zeros((8, 2), np.float32))
    np.testing.assert_array_equal(seen, np.tile([0.0, 2.0], (8, 1)))


def acted(name, severity, actions, n=40):
    """The actions that reach the environments in an episode, ``(N, T, 2)``, given ``(T, 2)``."""
    env = PerturbedVecEnv(clock(n), name, severity, seed=0)
    env.reset()
    for _ in range(2):  # the second episode is reset by itself
        for action in actions:
            *_, infos = env.step(np.tile(action, (n, 1)).astype(np.float32))
    return np.stack([info["actions"] for info in infos])


ACTIONS = np.linspace(0.1, 0.9, HORIZON)[:, None] * np.array([1, -1])


def test_a_delayed_actuator_applies_the_actions_of_before_and_first_none():
    expected = np.concatenate([np.zeros((3, 2)), ACTIONS[:-3]])
    np.testing.assert_allclose(acted("actuator_delay", 3, ACTIONS), np.tile(expected, (40, 1, 1)), rtol=1e-6)


def test_the_gain_of_an_actuator_is_a_factor_for_an_episode_within_the_bounds():
    factors = acted("actuator_gain", 4, ACTIONS) / ACTIONS
    clipped = ACTIONS * 1.5 > 1
    for component in range(2):
        of_component = factors[:, ~clipped.any(axis=1), component]
        np.testing.assert_allclose(of_component, of_component[:, :1].repeat(of_component.shape[1], axis=1), rtol=1e-5)
        assert set(np.round(of_component[:, 0], 3)) == {0.667, 1.5}
    assert (factors[:, 0, 0] != factors[:, 0, 1]).any()  # each actuator has its own
    assert np.abs(acted("actuator_gain", 4, ACTIONS)).max() == 1


@pytest.mark.parametrize(("name", "changed"), [("noise", "camera"), ("vector_noise", "gyro"), ("delay", "camera")])
def test_the_parts_of_a_dict_that_a_perturbation_is_for_are_perturbed(name, changed):
    env, plain = PerturbedVecEnv(clock(4), name, 5, seed=0), clock(4)
    env.reset(), plain.reset()
    for _ in range(HORIZON + 3):
        seen, _, _, infos = env.step(np.zeros((4, 2), np.float32))
        expected, _, dones, expected_infos = plain.step(np.zeros((4, 2), np.float32))
        for key in DICT:
            is_same = (seen[key] == expected[key]).all()
            assert is_same == (key != changed or (name == "delay" and expected[key].ravel()[0] == 10))
        if dones.any():
            last, expected_last = (each[0]["terminal_observation"] for each in (infos, expected_infos))
            assert (last[changed] != expected_last[changed]).any()
            assert last["touch"] == expected_last["touch"]
    assert DICT.contains({key: value[0] for key, value in seen.items()})


def test_the_vectors_in_a_dict_have_a_scale_and_each_part_its_own_noise():
    space = spaces.Dict({key: spaces.Box(-np.inf, np.inf, (2,), np.float32) for key in ("a", "b", "touch")})
    env = DummyVecEnv([lambda: ToyEnv(space)] * 30)
    scale = observation_scale(env)
    assert set(scale) == set(space)
    assert scale["a"] == pytest.approx(np.full(2, 0.58), abs=0.15)
    wrapped = PerturbedVecEnv(env, "vector_bias", 3, seed=0, scale={"a": 1.0, "b": 2.0, "touch": 0.0})
    env.seed(1)
    plain = env.reset()
    env.seed(1)
    shown = wrapped.reset()
    offsets = {key: shown[key] - plain[key] for key in space}
    np.testing.assert_allclose(np.abs(offsets["a"]), 0.2, atol=1e-6)
    np.testing.assert_allclose(np.abs(offsets["b"]), 0.4, atol=1e-6)
    assert not offsets["touch"].any()
    assert (np.sign(offsets["a"]) != np.sign(offsets["b"])).any()
    with pytest.raises(ValueError, match=r"has \['c'\]: use keys of the vectors"):
        PerturbedVecEnv(env, "vector_bias", scale={"c": 1.0})


def test_the_images_of_a_stack_are_perturbed_one_by_one():
    """As what the wrapper of one image shows, with the same square in all images of an episode."""

    def stack(_):
        return gym.wrappers.FrameStackObservation(PictureEnv(layout="CHW"), 3, padding_type="zero")

    env = perturbed(dummy(stack, 2), "occlusion", 3)
    assert env.observation_space.shape == (3, 3, 24, 24)
    single = perturbed(dummy(lambda _: PictureEnv(layout="CHW"), 2), "occlusion", 3)
    for each in (env, single):
        each.seed(0)
    seen = [single.reset()]
    env.reset()
    for _ in range(4):
        seen.append(single.step(np.zeros((2, 1), np.float32))[0])
        stacked = env.step(np.zeros((2, 1), np.float32))[0]
    np.testing.assert_array_equal(stacked, np.stack(seen[-3:], axis=1))
