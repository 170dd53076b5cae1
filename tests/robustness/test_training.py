"""Perturbed images: each on its own, the same for the same seed, and nothing else is touched."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import tiny_tdpg, toy_vec_env, train_epochs
from stable_baselines3.common.vec_env import VecEnvWrapper

from sb3_tdpg import make_episodes_env
from sb3_tdpg.robustness.training import PATTERN_GROUP, PATTERN_SIZES, ImageMixture, VecImagePerturbation

IMAGES = spaces.Box(0, 255, (3, 16, 16), np.uint8)
OFF = dict(color=0.0, pattern=0.0, patch=0.0, contrast=0.0, noise=0.0)


def ball_env(n=6, **kwargs):
    return make_episodes_env("BallCatch-v0", n, env_kwargs=dict(renderer="fast", **kwargs), seed=0)


def images(n=6):
    return ball_env(n).reset()


def perturbed(**strengths):
    th.manual_seed(0)
    env = VecImagePerturbation(ball_env(), **{**OFF, **strengths})
    return env.perturb(images()).astype(float)


def test_with_every_strength_at_zero_the_images_are_what_they_were():
    np.testing.assert_array_equal(perturbed(), images())


@pytest.mark.parametrize("strength", OFF)
def test_every_perturbation_changes_equal_images_in_different_ways(strength):
    th.manual_seed(0)
    env = VecImagePerturbation(ball_env(), **{**OFF, strength: 0.7})
    equal = np.repeat(images()[:1], 6, axis=0)
    changed = env.perturb(equal).astype(int)
    different = [(changed[i] != changed[j]).mean() for i in range(6) for j in range(i)]
    # A pattern is left out of three images in ten; a patch may be small, and covers nothing but itself.
    assert np.median(different) > (0.01 if strength == "patch" else 0.3)
    if strength == "noise":
        residuals = (changed - equal)[:, 0, 30:40].reshape(6, -1)
        assert np.abs(np.corrcoef(residuals)[np.triu_indices(6, 1)]).max() < 0.3


@pytest.mark.parametrize("held", [True, False])
def test_an_episode_keeps_its_changes_only_if_they_are_held(held):
    class Ends(VecEnvWrapper):  # a camera that sees grey; the second environment begins anew at every step
        def reset(self):
            return np.full_like(self.venv.reset(), 120)

        def step_wait(self):
            images, rewards, _, infos = self.venv.step_wait()
            return np.full_like(images, 120), rewards, np.array([False, True]), infos

    th.manual_seed(0)
    env = VecImagePerturbation(Ends(ball_env(2)), held=held, noise=0.0)
    seen = [env.reset(), *(env.step(np.zeros((2, 1)))[0] for _ in range(4))]
    of_first, of_second = ([(seen[0][i] == later[i]).all() for later in seen[1:]] for i in (0, 1))
    assert of_first == [held] * 4
    assert not any(of_second)


def test_mixing_colours_leaves_grey_as_it_is():
    """The rows of the mixing sum to 1, unless they would have to be blown up for it."""
    env = VecImagePerturbation(ball_env(), **{**OFF, "color": 0.1})
    grey = np.full((6, 3, 64, 64), 120, np.uint8)
    np.testing.assert_array_equal(env.perturb(grey), grey)


def test_a_changed_contrast_is_affine_in_the_image():
    before, after = images()[0].ravel(), perturbed(contrast=0.7)[0].ravel()
    slope, offset = np.polyfit(before, after, 1)
    assert 0.3 <= slope < 1
    assert np.abs(slope * before + offset - after).max() <= 1.0  # rounded to bytes


def test_a_patch_is_an_opaque_rectangle():
    after, before = perturbed(patch=1.0), images()
    touched = (after != before).any(axis=1)  # (N, H, W)
    for mask in touched[touched.any(axis=(1, 2))]:
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        inside = mask[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        assert inside.mean() > 0.95
        assert not mask[: rows[0]].any()


def test_channels_may_come_last():
    space = spaces.Box(0, 255, (20, 16, 3), np.uint8)
    env = VecImagePerturbation(toy_vec_env(observation_space=space))
    result = env.reset()
    assert result.shape == (4, 20, 16, 3)
    assert result.dtype == np.uint8


def test_state_cost_and_the_end_of_an_episode_stay_as_they_are():
    plain, wrapped = ball_env(), VecImagePerturbation(ball_env())
    plain.reset()
    wrapped.reset()
    for _ in range(26):  # into the second episode
        actions = np.ones((6, 1), np.float32)
        (seen, *rest), (changed, *rest_of_wrapped) = plain.step(actions), wrapped.step(actions)
        assert (seen != changed).any()
        for ours, theirs in zip(rest[:2], rest_of_wrapped[:2], strict=True):
            np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(rest[2][0]["state"], rest_of_wrapped[2][0]["state"])


def test_the_same_seed_gives_the_same_training_on_perturbed_images():
    costs = []
    for _ in range(2):
        env = VecImagePerturbation(ball_env(8))
        model = tiny_tdpg(env, n_episodes=8, beta=1.0, policy_kwargs={})
        train_epochs(model, 2)
        costs.append(model.rollout_buffer.episode_costs)
    np.testing.assert_array_equal(*costs)


@pytest.mark.parametrize(("arguments", "fragment"), [
    (dict(color=-0.1), r"color=-0.1 must be between 0 and inf"),
    (dict(pattern=1.5), r"pattern=1.5 must be between 0 and 1"),
    (dict(patch=1.5), r"patch=1.5 must be between 0 and 1"),
    (dict(contrast=float("nan")), r"contrast=nan must be between 0 and 1"),
])  # fmt: skip
def test_a_strength_out_of_its_range_is_refused(arguments, fragment):
    with pytest.raises(ValueError, match=fragment):
        VecImagePerturbation(ball_env(), **arguments)


def test_vectors_are_refused():
    with pytest.raises(ValueError, match="images of bytes"):
        VecImagePerturbation(make_episodes_env("Lava-v0", 4))


def test_three_images_of_ten_get_no_pattern():
    env = VecImagePerturbation(toy_vec_env(observation_space=IMAGES), **{**OFF, "pattern": 1.0})
    th.manual_seed(0)
    images = np.full((3000, 3, 16, 16), 100, np.uint8)
    unchanged = (env.perturb(images) == 100).all(axis=(1, 2, 3)).mean()
    assert 0.26 < unchanged < 0.34


def test_the_strength_of_the_noise_is_drawn_for_each_image():
    env = VecImagePerturbation(toy_vec_env(observation_space=IMAGES), **{**OFF, "noise": 0.2})
    th.manual_seed(0)
    images = env.perturb(np.full((500, 3, 16, 16), 128, np.uint8)) / 255
    stds = images.std(axis=(1, 2, 3))  # uniform up to 0.2, a little less where it is clipped
    assert stds.min() < 0.02
    assert 0.15 < stds.max() < 0.21
    assert 0.08 < stds.mean() < 0.12


def test_images_that_are_drawn_together_have_patterns_of_several_sizes():
    """Of changes that are held for an episode all episodes of an epoch are drawn together."""
    th.manual_seed(0)
    n = 12 * PATTERN_GROUP + 3
    patterns = ImageMixture().draw(n, 1, 64, 64)["pattern"].numpy()
    assert patterns.shape == (n, 1, 64, 64)
    n_colours = np.array([len(np.unique(pattern)) for pattern in patterns])
    with_edges = {size**2 for size in PATTERN_SIZES} & set(n_colours)
    assert len(with_edges) >= 3
    for start in range(0, n, PATTERN_GROUP):  # side by side of one size; bilinear colours coincide here and there
        part = n_colours[start : start + PATTERN_GROUP]
        assert np.ptp(part) <= 0.02 * part.max()
