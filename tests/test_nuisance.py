"""The nuisance of a training: the wrappers that TDPG adds, and what the policy then observes and stores."""

import math
import subprocess
import sys

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import (
    assert_same_parameters,
    parameters,
    rollouts,
    same_parameters,
    tiny_tdpg,
    toy_vec_env,
    train_epochs,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from sb3_tdpg import TDPG, make_episodes_env
from sb3_tdpg.robustness import PerturbedVecEnv
from sb3_tdpg.robustness.nuisance import NuisanceVecEnv


def test_for_images_beside_a_vector_nothing_is_measured_and_the_environment_takes_no_step(monkeypatch):
    parts = dict(image=spaces.Box(0, 255, (3, 36, 36), np.uint8), goal=spaces.Box(-np.inf, np.inf, (2,), np.float32))
    env = toy_vec_env(2, observation_space=spaces.Dict(parts))
    monkeypatch.setattr(env, "step_wait", None)
    assert isinstance(TDPG(env=env, n_episodes=4, device="cpu").env, NuisanceVecEnv)


DEPTH = spaces.Box(0.2, 0.7, (1, 16, 16), np.float32)
IMAGES_AND_VECTOR = spaces.Dict(camera=spaces.Box(0, 255, (3, 64, 64), np.uint8), arm=spaces.Box(-1, 1, (2,)))


def ball_env(n=20):
    return make_episodes_env("BallCatch-v0", n, env_kwargs=dict(renderer="fast"), seed=0)


def wrappers(model):
    """Return the classes of the environment's wrappers, from the outermost to the innermost."""
    env, found = model.env, []
    while hasattr(env, "venv"):
        found.append(type(env))
        env = env.venv
    return found


def test_the_algorithm_is_imported_without_any_perturbation():
    code = "import sys, sb3_tdpg.tdpg; assert not [name for name in sys.modules if 'robustness' in name]"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_default_is_a_nuisance_for_images_and_none_for_vectors_and_depth_without_bounds():
    assert wrappers(tiny_tdpg("Lava-v0")) == []
    assert wrappers(tiny_tdpg(toy_vec_env(observation_space=DEPTH), beta=math.inf)) == [NuisanceVecEnv]
    boundless = spaces.Box(0.0, math.inf, DEPTH.shape, np.float32)
    assert wrappers(tiny_tdpg(toy_vec_env(observation_space=boundless), beta=math.inf)) == []
    assert wrappers(tiny_tdpg(ball_env())) == [NuisanceVecEnv]
    assert wrappers(tiny_tdpg(toy_vec_env(observation_space=IMAGES_AND_VECTOR))) == [NuisanceVecEnv]
    assert wrappers(tiny_tdpg(ball_env(), nuisance=None)) == []


def test_with_the_default_for_images_the_policy_sees_changed_ones_each_with_its_own_change():
    model = tiny_tdpg(ball_env(), policy_kwargs={})
    first, second = (model.env._perturber(np.full((20, 3, 64, 64), 120, np.uint8)) for _ in range(2))
    assert (np.abs(first.astype(int) - 120).mean(axis=(1, 2, 3)) > 3).mean() > 0.8
    assert (np.abs(first.astype(int) - second).mean(axis=(1, 2, 3)) > 5).mean() > 0.8  # larger than the noise


def test_by_default_depth_images_are_noisy_or_lack_pixels_in_three_episodes_of_four():
    model = tiny_tdpg(toy_vec_env(20, observation_space=DEPTH), beta=math.inf)
    plain = np.full((20, *DEPTH.shape), 0.45, np.float32)
    seen = np.concatenate([model.env._perturber(plain) for _ in range(2)])
    offset = seen - 0.45
    noisy, lacking = (offset > 0).any(axis=(1, 2, 3)), (seen == DEPTH.low.min()).mean(axis=(1, 2, 3))
    assert 0 < (noisy & (abs(offset).mean(axis=(1, 2, 3)) < 0.05)).mean() < 0.6  # 5 % of 0.5 m
    assert 0.2 < (~noisy & (lacking > 0)).mean() < 0.8
    assert lacking.max() < 0.15
    assert 0 < (offset == 0).all(axis=(1, 2, 3)).mean() < 0.6


def test_the_policy_acts_on_what_it_is_shown_and_the_states_stay_true():
    env = make_episodes_env("Lava-v0", 20, env_kwargs=dict(sensor_noise_std=0.0))
    model = tiny_tdpg(env, nuisance=[("vector_bias", 5, 10.0)])
    batch, policy = rollouts(model), model.policy
    offset = batch.observations - batch.states
    assert offset.abs().min() > 1.0
    th.testing.assert_close(offset, offset[:1].expand_as(offset), rtol=1e-3, atol=1e-5)  # one offset per episode
    trv = th.zeros(20, policy.trv_dim)
    for t in range(model.horizon):
        with th.no_grad():
            mean, std = policy.encoder_density(batch.observations[t], trv, np.full(20, t))
        th.testing.assert_close(mean + std * batch.noise[t], batch.trvs[t], rtol=1e-4, atol=1e-5)
        trv = batch.trvs[t]


def in_place(observations, rng):
    observations += rng.uniform(1.0, 2.0)
    return observations


NESTED = {
    "one": (lambda env: env, {"vector_bias": 5}),
    "one inside": (lambda env: PerturbedVecEnv(env, "vector_bias", 5), None),
    "two": (lambda env: PerturbedVecEnv(PerturbedVecEnv(env, "vector_bias", 5), "vector_noise"), None),
    "nuisance around another": (lambda env: PerturbedVecEnv(env, "vector_bias", 5), {"vector_noise": 1}),
    "inside a monitor": (lambda env: VecMonitor(PerturbedVecEnv(env, "vector_bias", 5)), None),
    "in place": (lambda env: env, in_place),
}


@pytest.mark.parametrize(("wrap", "nuisance"), NESTED.values(), ids=NESTED)
def test_where_the_observation_stands_in_for_the_state_it_is_the_unperturbed_one(wrap, nuisance):
    env = wrap(make_vec_env("CartPole-v1", 4, seed=0))
    batch = rollouts(tiny_tdpg(env, n_episodes=8, nuisance=nuisance))
    assert batch.states[0].abs().max() <= 0.05 < batch.observations[0].abs().max()  # a cart starts within 0.05
    now, following = batch.states[:-1], batch.states[1:]
    runs = batch.alive[1:] > 0
    moved = now[..., 0] + 0.02 * now[..., 1]  # the dynamics of the cart
    th.testing.assert_close(following[..., 0][runs], moved[runs], rtol=1e-4, atol=1e-6)


def test_the_nuisance_leaves_the_environment_alone_and_follows_the_seed():
    def train(nuisance, seed=0):
        model = train_epochs(tiny_tdpg("Lava-v0", nuisance=nuisance, seed=seed), 2)
        return parameters(model.policy)

    declared = {"vector_noise": (1, 5), "vector_dropout": 3}
    assert_same_parameters(train(declared), train(declared))
    assert not same_parameters(train(declared), train(declared, seed=1))
    assert not same_parameters(train(declared), train(None))
    first_states = [rollouts(tiny_tdpg("Lava-v0", nuisance=n, seed=0)).states[0] for n in (None, declared)]
    th.testing.assert_close(*first_states, rtol=0, atol=0)


def test_an_environment_that_comes_from_another_model_is_wrapped_once(tmp_path):
    model = train_epochs(tiny_tdpg("Lava-v0", nuisance={"vector_noise": 3}), 1)
    model.save(tmp_path / "model")
    assert TDPG.load(tmp_path / "model").nuisance == {"vector_noise": 3}  # without an environment
    assert wrappers(TDPG.load(tmp_path / "model", env=model.env)) == [NuisanceVecEnv]
    without = TDPG.load(tmp_path / "model", env=model.env, nuisance=None)
    assert wrappers(without) == []
    train_epochs(without, 1)
    own = PerturbedVecEnv(make_episodes_env("Lava-v0", 20), "vector_bias")
    model.set_env(own)
    model.set_env(model.env)
    assert wrappers(model) == [NuisanceVecEnv, PerturbedVecEnv]
    train_epochs(model, 1)


def test_a_nuisance_goes_inside_a_normalisation():
    normalized = VecNormalize(make_episodes_env("Lava-v0", 20), norm_reward=False)
    for env in (normalized, VecMonitor(normalized)):
        with pytest.raises(ValueError, match=r"nuisance='vector_noise': .*VecNormalize\(PerturbedVecEnv"):
            tiny_tdpg(env, nuisance="vector_noise")
    tiny_tdpg(VecMonitor(normalized), nuisance={"actuator_gain": 1})  # changes no observation
