"""What each perturbation does to observations, and the scale of those of vectors."""

import itertools

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from perturbed_problems import PictureEnv, countdown, dummy, pendulum, perturbed, run
from small_problems import lava_env, tiny_tdpg, toy_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_tdpg.robustness import PERTURBATIONS, PerturbedVecEnv, observation_scale


def of_images(name, shape, n, severity=3):
    """Return the perturbation of a batch of images as a function."""
    return perturbed(toy_vec_env(n, observation_space=spaces.Box(0, 255, shape, np.uint8)), name, severity)._perturber


def images_under(name, severity, images):
    return of_images(name, images.shape[1:], len(images), severity)(images)


GREY = np.full((2, 3, 32, 32), 100, np.uint8)


def test_noise_has_the_standard_deviation_of_its_severity():
    for severity, std in enumerate((0.05, 0.10, 0.15, 0.20, 0.25), start=1):
        residual = images_under("noise", severity, GREY.repeat(8, 0)).astype(float) - 100
        # What is cut off lies beyond the median.
        assert np.median(np.abs(residual)) / 0.6745 == pytest.approx(255 * std, rel=0.1)


@pytest.mark.parametrize("name", [name for name, row in PERTURBATIONS.items() if row.kind == "image"])
def test_what_it_is_given_stays_what_it_was_and_what_it_returns_is_new(name):
    images = np.random.default_rng(0).integers(0, 256, (4, 3, 20, 20), dtype=np.uint8)
    original = images.copy()
    perturb = of_images(name, (3, 20, 20), 4)
    for _ in range(4):
        shown = perturb(images)
        assert not np.shares_memory(shown, images)
        kept = shown.copy()
        perturb(images[::-1])
        np.testing.assert_array_equal(shown, kept)
    np.testing.assert_array_equal(images, original)


def test_a_large_batch_has_as_many_draws_as_images():
    images = images_under("occlusion", 3, np.zeros((150, 3, 32, 32), np.uint8))
    assert len(np.unique(images, axis=0)) == 150


def test_minmax_noise_stretches_each_image_to_the_bounds():
    images = images_under("noise_minmax", 1, GREY)
    assert (images.min(axis=(1, 2, 3)) == 0).all()
    assert (images.max(axis=(1, 2, 3)) == 255).all()


def test_a_change_of_brightness_is_one_offset_up_to_white():
    offsets = images_under("brightness", 3, GREY.repeat(8, 0)).astype(int) - 100
    assert set(np.unique(offsets)) == {-51, 51}
    assert (offsets == offsets[:, :1, :1, :1]).all()
    clipped = images_under("brightness", 5, np.full((12, 3, 8, 8), 250, np.uint8))
    assert set(np.unique(clipped)) == {250 - 102, 255}


def test_turning_hues_leaves_grey_as_it_is_and_takes_red_to_green():
    np.testing.assert_array_equal(images_under("hue", 4, GREY), GREY)
    red = np.zeros_like(GREY)
    red[:, 0] = 200
    turned = images_under("hue", 4, red)  # 120 degrees
    assert all((image.max(axis=(1, 2)) >= 199).sum() == 1 and image[0].max() <= 1 for image in turned)


def test_a_blur_keeps_the_mean_and_is_as_wide_for_any_resolution():
    for side in (40, 80):
        step = np.zeros((1, 3, side, side), np.uint8)
        step[..., side // 2 :] = 200
        blurred = images_under("blur", 5, step)
        assert blurred.mean() == pytest.approx(100, abs=1)
        variance = np.diff(blurred[0, 0, 0] / 200) @ (np.arange(1, side) - side / 2) ** 2
        assert np.sqrt(variance) == pytest.approx(0.06 * side, rel=0.05)


def test_dropped_pixels_are_black_in_all_channels():
    images = images_under("dropped_pixels", 5, GREY)
    assert (images == 0).all(axis=1).mean() == pytest.approx(0.4, abs=0.05)
    assert set(np.unique(images)) == {0, 100}


def test_a_shifted_image_is_the_image_elsewhere():
    original, _ = PictureEnv(layout="CHW", side=64).reset(seed=0)
    (shifted,) = images_under("camera_shift", 3, original[None])
    inside, moves = shifted[:, 8:-8, 8:-8], itertools.product(range(-6, 7), repeat=2)
    (move,) = (by for by in moves if (inside == original[:, 8 + by[0] : 56 + by[0], 8 + by[1] : 56 + by[1]]).all())
    assert np.hypot(*move) == pytest.approx(0.07 * 64, abs=1)


@pytest.mark.parametrize("name", ["noise", "hue", "blur", "occlusion", "texture_overlay", "camera_shift"])
def test_the_order_of_the_channels_makes_no_difference(name):
    envs = (DummyVecEnv([lambda layout=layout: PictureEnv(layout=layout)]) for layout in ("HWC", "CHW"))
    last, first = (run(perturbed(env, name)).observations for env in envs)
    np.testing.assert_array_equal(last, first.transpose(0, 1, 3, 4, 2))


def test_vectors_are_perturbed_in_multiples_of_their_scale():
    scale = np.array([0.0, 1.0, 10.0])
    shown = run(PerturbedVecEnv(countdown(), "vector_bias", 4, scale=scale, seed=0), 5).observations
    offsets = np.abs(shown - run(countdown(), 5).observations)
    np.testing.assert_allclose(offsets, np.broadcast_to([0.0, 0.4, 4.0], offsets.shape), atol=1e-5)


def test_bounds_give_the_scale_where_there_are_some():
    env = perturbed(dummy(pendulum, 2), "vector_bias", 1)
    np.testing.assert_allclose(env._perturber.sensor.scale, np.array([2, 2, 16]) / np.sqrt(12))


@pytest.mark.parametrize("is_seeded", [True, False])
@pytest.mark.parametrize("make", [lambda: lava_env(50), lambda: dummy(lambda i: gym.make("CartPole-v1"), 2)])
def test_without_bounds_the_scale_is_measured_and_the_episodes_stay_what_they_were(make, is_seeded):
    first, second = make(), make()
    for env in (first, second):
        env.seed(0)
        if not is_seeded:
            env.reset()  # uses the seed up
    scale = observation_scale(first)
    assert scale.shape == first.observation_space.shape
    assert (scale > 0).all()
    np.testing.assert_array_equal(first.reset(), second.reset())
    np.testing.assert_array_equal(observation_scale(first), scale)


def test_a_model_can_act_in_the_measurement():
    env = lava_env(50)
    model = tiny_tdpg(VecNormalize(lava_env(), norm_reward=False))
    calls = []
    predict = model.predict
    model.predict = lambda *args, **kwargs: calls.append(args) or predict(*args, **kwargs)
    scale = observation_scale(env, model)
    assert scale.shape == (2,)
    assert scale[0] == pytest.approx(1.7, abs=0.4)  # the robot is anywhere between 0 and 5 m
    assert len(calls) >= 5
    assert calls[1][1] is not None  # the recurrent state of the step before


def test_bounds_that_mean_none_are_none():
    vast = float(np.finfo(np.float32).max)
    env = toy_vec_env(observation_space=spaces.Box(-vast, vast, (2,), np.float32))
    scale = perturbed(env, "vector_noise")._perturber.sensor.scale
    assert (scale < 2).all()
