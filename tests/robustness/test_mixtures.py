"""Perturbations in training: noise of a drawn strength, and a mixture of several."""

import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg import make_episodes_env
from sb3_tdpg.robustness.mixtures import MixedVecEnv, NoisyVecEnv


def episode(env):
    """The observations of one episode without actions, ``(T, N, D)``, and the first one of the next."""
    observations = [env.reset()]
    for _ in range(env.get_attr("horizon")[0]):
        observations.append(env.step(np.zeros((env.num_envs, *env.action_space.shape), np.float32))[0])
    return np.stack(observations)


def squeeze(n, **kwargs):
    return make_episodes_env("SqueezeInsert-v0", n, seed=3, env_kwargs=dict(sensor_noise_std=0.0, **kwargs))


def test_the_noise_of_an_episode_has_one_strength_which_is_log_uniform_over_the_episodes():
    clean, noisy = episode(squeeze(4000)), episode(NoisyVecEnv(squeeze(4000), 0.1, 10.0, seed=0))
    noise = (noisy - clean)[:4]
    log_std = np.log10(noise.std(axis=(0, 2)))
    # Eight samples estimate each of them.
    assert np.quantile(log_std, [0.1, 0.5, 0.9]) == pytest.approx([-0.8, 0.0, 0.8], abs=0.1)
    assert abs(np.corrcoef(np.abs(noise[0]).mean(1), np.abs(noise[3]).mean(1))[0, 1]) > 0.6
    # Another episode has another strength.
    assert abs(np.corrcoef(np.abs(noise[0]).mean(1), np.abs(noisy[4] - clean[4]).mean(1))[0, 1]) < 0.1


def test_a_component_without_a_scale_has_no_noise():
    clean = episode(squeeze(100, cue=True))
    noisy = episode(NoisyVecEnv(squeeze(100, cue=True), 1.0, 1.0, seed=0, scale=np.array([2.0, 1.0, 0.0])))
    difference = noisy - clean
    assert not difference[..., 2].any()
    assert difference[..., :2].std(axis=(0, 1)) == pytest.approx([2.0, 1.0], rel=0.15)


def test_each_episode_of_a_mixture_has_one_of_the_perturbations_or_none():
    rows = [("vector_bias", 5), ("vector_scale", 5)]
    clean, mixed = episode(squeeze(3000)), episode(MixedVecEnv(squeeze(3000), rows, seed=0, scale=1.0))
    difference, ratio = (mixed - clean)[:4], (mixed / clean)[:4]
    is_plain = (difference == 0).all(axis=(0, 2))
    is_biased = np.isclose(np.abs(difference), 0.8, atol=1e-4).all(axis=(0, 2))
    is_scaled = (np.isclose(ratio, 2.0, rtol=1e-3) | np.isclose(ratio, 0.5, rtol=1e-3)).all(axis=(0, 2))
    assert (is_plain ^ is_biased ^ is_scaled).all()
    assert np.mean([is_plain, is_biased, is_scaled], axis=1) == pytest.approx([1 / 3] * 3, abs=0.03)
    changed = (mixed[4] != clean[4]).any(1)  # the next episode draws anew
    assert 0.3 < (changed != ~is_plain).mean() < 0.6


def test_a_mixture_is_reproducible_from_the_seed():
    make = lambda seed: MixedVecEnv(squeeze(50), [("vector_noise", 3), ("freeze", 3)], seed=seed)  # noqa: E731
    np.testing.assert_array_equal(episode(make(1)), episode(make(1)))
    assert not np.array_equal(episode(make(1)), episode(make(2)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda env: MixedVecEnv(env, []), "is empty: give names with severities"),
        (lambda env: MixedVecEnv(env, [("vector_noise", 3), ("actuator_gain", 3)]), r"\['actuator_gain'\] perturb act"),
        (lambda env: MixedVecEnv(env, [("image_noise", 3)]), "'image_noise' is unknown"),
        (lambda env: NoisyVecEnv(env, 2.0, 1.0), "low=2.0 and high=1.0 must be positive, low <= high"),
        (lambda env: NoisyVecEnv(env, 0.0, 1.0), "low=0.0"),
    ],
)
def test_bad_arguments_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make(squeeze(2))


def test_the_space_stays_the_same():
    assert isinstance(NoisyVecEnv(squeeze(2)).observation_space, spaces.Box)


def test_each_episode_draws_one_of_several_highest_strengths():
    clean, noisy = episode(squeeze(4000)), episode(NoisyVecEnv(squeeze(4000), 0.1, [0.1, 1000.0], seed=0))
    std = (noisy - clean)[:4].std(axis=(0, 2))
    assert (std < 0.2).mean() == pytest.approx(0.5 + 0.5 * np.log10(2) / 4, abs=0.03)
    assert (std > 10.0).mean() == pytest.approx(0.25, abs=0.03)


def test_a_perturbation_of_a_mixture_can_have_a_scale_of_its_own():
    rows = [("vector_bias", 5, 10.0), ("freeze", 5)]
    clean, mixed = episode(squeeze(300)), episode(MixedVecEnv(squeeze(300), rows, seed=0, scale=[1.0, 0.0]))
    difference = (mixed - clean)[0]
    assert set(np.round(np.abs(difference[:, 0]), 4)) == {0.0, 8.0}
    assert not difference[:, 1].any()


@pytest.mark.parametrize("make", [NoisyVecEnv, lambda env: MixedVecEnv(env, [("vector_noise", 3)])])
def test_normalised_observations_and_images_are_refused(make):
    with pytest.raises(ValueError, match="before they are normalised"):
        make(VecNormalize(squeeze(2)))
    with pytest.raises(ValueError, match="it is for vectors"):
        make(make_episodes_env("BallCatch-v0", 2))
