"""Perturbations for training: images, each changed on its own, and noise of a strength that is drawn."""

import numpy as np
import pytest
from gymnasium import spaces
from perturbed_problems import perturbed

from sb3_tdpg import make_episodes_env
from sb3_tdpg.robustness.core import Perturber
from sb3_tdpg.robustness.sensor import Sensor
from sb3_tdpg.robustness.training import PATTERN_GROUP, PATTERN_SIZES, images, patterns

IMAGES = spaces.Box(0, 255, (3, 64, 64), np.uint8)
OFF = dict(color=0.0, pattern=0.0, patch=0.0, contrast=0.0, noise=0.0)


def of_the_ball(n=6):
    return make_episodes_env("BallCatch-v0", n, env_kwargs=dict(renderer="fast"), seed=0).reset()


def changed(seen, **strengths):
    sensor = Sensor(spaces.Box(0, 255, seen.shape[1:], np.uint8))
    return Perturber(images(**{**OFF, **strengths}), 1, sensor, len(seen), seed=0)(seen).astype(float)


def test_with_every_strength_at_zero_the_images_are_what_they_were():
    np.testing.assert_array_equal(changed(of_the_ball()), of_the_ball())


@pytest.mark.parametrize("strength", OFF)
def test_every_perturbation_changes_equal_images_in_different_ways(strength):
    equal = np.repeat(of_the_ball()[:1], 6, axis=0)
    result = changed(equal, **{strength: 0.7})
    different = [(result[i] != result[j]).mean() for i in range(6) for j in range(i)]
    # A pattern is left out of three images in ten; a patch may be small, and covers nothing but itself.
    assert np.median(different) > (0.01 if strength == "patch" else 0.3)
    if strength == "noise":
        residuals = (result - equal)[:, 0, 30:40].reshape(6, -1)
        assert np.abs(np.corrcoef(residuals)[np.triu_indices(6, 1)]).max() < 0.3


@pytest.mark.parametrize("held", [True, False])
def test_an_episode_keeps_its_changes_only_if_they_are_held(held):
    members = Perturber(images(held=held, noise=0.0), 1, Sensor(IMAGES), 4, seed=0)
    grey = np.full((4, *IMAGES.shape), 120, np.uint8)
    first, second = members(grey), members(grey)
    assert [(first[i] == second[i]).all() for i in range(4)] == [held] * 4
    members.begin(np.array([1, 3]))
    third = members(grey)
    assert [(first[i] == third[i]).all() for i in range(4)] == [held, False, held, False]


def test_mixing_colours_leaves_grey_as_it_is():
    """The rows of the mixing sum to 1, unless they would have to be blown up for it."""
    grey = np.full((6, *IMAGES.shape), 120, np.uint8)
    np.testing.assert_array_equal(changed(grey, color=0.1), grey)


def test_a_changed_contrast_is_affine_in_the_image():
    before, after = of_the_ball()[0].ravel(), changed(of_the_ball(), contrast=0.7)[0].ravel()
    slope, offset = np.polyfit(before, after, 1)
    assert 0.3 <= slope < 1
    assert np.abs(slope * before + offset - after).max() <= 1.0  # rounded to bytes


def test_a_patch_is_an_opaque_rectangle():
    after, before = changed(of_the_ball(), patch=1.0), of_the_ball()
    touched = (after != before).any(axis=1)  # (N, H, W)
    for mask in touched[touched.any(axis=(1, 2))]:
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        inside = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        assert inside.mean() > 0.95
        assert not mask[: rows[0]].any()


def test_three_images_of_ten_get_no_pattern():
    unchanged = (changed(np.full((3000, 3, 16, 16), 100, np.uint8), pattern=1.0) == 100).all(axis=(1, 2, 3)).mean()
    assert 0.26 < unchanged < 0.34


def test_the_strength_of_the_noise_is_drawn_for_each_image():
    stds = (changed(np.full((500, 3, 16, 16), 128, np.uint8), noise=0.2) / 255).std(axis=(1, 2, 3))
    # Uniform up to 0.2, a little less where it is clipped.
    assert stds.min() < 0.02
    assert 0.15 < stds.max() < 0.21
    assert 0.08 < stds.mean() < 0.12


def test_images_that_are_drawn_together_have_patterns_of_several_sizes():
    """Of changes that are held for an episode all episodes of an epoch are drawn together."""
    n = 12 * PATTERN_GROUP + 3
    drawn = patterns(np.random.default_rng(0), n, 1, 64, 64)
    n_colours = np.array([len(np.unique(pattern)) for pattern in drawn])
    with_edges = {size**2 for size in PATTERN_SIZES} & set(n_colours)
    assert len(with_edges) >= 3
    for start in range(0, n, PATTERN_GROUP):  # side by side of one size; bilinear colours coincide here and there
        part = n_colours[start : start + PATTERN_GROUP]
        assert np.ptp(part) <= 0.05 * part.max()


def episode(env):
    """The observations of one episode without actions, ``(T, N, D)``, and the first one of the next."""
    observations = [env.reset()]
    for _ in range(env.get_attr("horizon")[0]):
        observations.append(env.step(np.zeros((env.num_envs, *env.action_space.shape), np.float32))[0])
    return np.stack(observations)


def squeeze():
    return make_episodes_env("SqueezeInsert-v0", 4000, seed=3, env_kwargs=dict(sensor_noise_std=0.0))


def noisy(low, high):
    return perturbed(squeeze(), {"noise_range": dict(low=low, high=high)}, scale=1.0)


def test_the_noise_of_an_episode_has_one_strength_which_is_log_uniform_over_the_episodes():
    clean, seen = episode(squeeze()), episode(noisy(0.1, 10.0))
    noise = (seen - clean)[:4]
    log_std = np.log10(noise.std(axis=(0, 2)))
    # Eight samples estimate each of them.
    assert np.quantile(log_std, [0.1, 0.5, 0.9]) == pytest.approx([-0.8, 0.0, 0.8], abs=0.1)
    assert abs(np.corrcoef(np.abs(noise[0]).mean(1), np.abs(noise[3]).mean(1))[0, 1]) > 0.6
    # Another episode has another strength.
    assert abs(np.corrcoef(np.abs(noise[0]).mean(1), np.abs(seen[4] - clean[4]).mean(1))[0, 1]) < 0.1


def test_each_episode_draws_one_of_several_highest_strengths():
    clean, seen = episode(squeeze()), episode(noisy(0.1, [0.1, 1000.0]))
    std = (seen - clean)[:4].std(axis=(0, 2))
    assert (std < 0.2).mean() == pytest.approx(0.5 + 0.5 * np.log10(2) / 4, abs=0.03)
    assert (std > 10.0).mean() == pytest.approx(0.25, abs=0.03)
