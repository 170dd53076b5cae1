"""The results of environments are checked before they reach a network, and errors name the problem."""

import re

import numpy as np
import pytest
from gymnasium import spaces
from small_problems import ToyEnv, tiny_tdpg, toy_vec_env, train_epochs, words
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_tdpg import TDPG, BatchedVecEnv
from sb3_tdpg.envs.lava import LavaEnv


class BrokenEnv(ToyEnv):
    """Return a wrong result at the second step of the third episode, or at the first reset."""

    def __init__(self, observation=None, reward=None, state=None, at_reset=False, gives_state=True):
        super().__init__(gives_state=gives_state)
        self.broken, self.state, self.at_reset = (observation, reward), state, at_reset

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        info = info if self.state is None else {"state": self.state}
        return (self.broken[0] if self.at_reset else observation), info

    def step(self, action):
        *result, terminated, truncated, info = super().step(action)
        if self.n_resets == 3 and self.t == 2:
            result = [old if new is None else new for new, old in zip(self.broken, result, strict=True)]
        return *result, terminated, truncated, info


def broken_model(*, gives_state=True, make=DummyVecEnv, **kwargs):
    envs = [lambda: ToyEnv(gives_state=gives_state), lambda: BrokenEnv(gives_state=gives_state, **kwargs)]
    return tiny_tdpg(make(envs), n_episodes=8, mi_estimator="mine")


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 3e38])
def test_a_number_that_no_network_can_take_is_named_with_environment_step_and_component(value):
    model = broken_model(observation=np.array([0.0, value], np.float32), gives_state=False)
    what = re.escape(f"environment 1 returned the observation {value:g} in component [1] at step 2 of its episode")
    with pytest.raises(ValueError, match=what):
        train_epochs(model, 1)
    for parameter in [*model.policy.parameters(), *model.estimator.parameters()]:
        assert np.isfinite(parameter.detach().numpy()).all()


def test_a_bad_state_is_named_as_well():
    env = LavaEnv()
    dynamics = env.dynamics
    env.dynamics = lambda state, action: np.where(np.arange(2) == 1, np.nan, dynamics(state, action))
    env.sensor = lambda state: np.zeros((len(state), 2), np.float32)
    env.terminal_cost = env.cost = lambda state, action=None: np.zeros(len(state))
    with pytest.raises(ValueError, match=r"environment 0 returned the state nan in component \[1\] at step 1"):
        train_epochs(tiny_tdpg(BatchedVecEnv(env, 4), n_episodes=4), 1)


@pytest.mark.parametrize("reward", [-1e30, 1e19, np.inf])
def test_a_reward_that_is_too_large_is_named_with_environment_and_step(reward):
    with pytest.raises(ValueError, match=r"environment 1 returned the reward [-+.\de]+ at step 1 of its episode"):
        train_epochs(broken_model(reward=reward), 1)


@pytest.mark.parametrize("shape", [(3,), (2, 2), (0,)])
def test_a_state_of_another_shape_is_named_with_its_environment(shape):
    what = rf'"state"\] of environment 1 has shape {re.escape(str(shape))}.* has 1 components: mend'
    with pytest.raises(ValueError, match=what):
        train_epochs(broken_model(state=np.zeros(shape)), 1)


@pytest.mark.parametrize("at_reset", [False, True])
@pytest.mark.parametrize("make", [DummyVecEnv, SubprocVecEnv, lambda envs: SubprocVecEnv(envs[1:] * 2)], ids=words)
def test_an_observation_of_a_wrong_shape_is_named(at_reset, make):
    model = broken_model(observation=np.zeros(3, np.float32), at_reset=at_reset, make=make)
    where = "environment 1 returned an observation of a " if make is DummyVecEnv else ""
    try:
        with pytest.raises(ValueError, match=rf"{where}(wrong shape|shape \(3,\)).*\(2,\)"):
            train_epochs(model, 1)
    finally:
        model.env.close()


def test_a_state_of_two_dimensions_is_flattened():
    class MatrixState(ToyEnv):
        def __init__(self):
            super().__init__()
            self.state_space = spaces.Box(-1, 1, (2, 3))

        def _info(self):
            return {"state": np.full((2, 3), self.x)}

    model = train_epochs(tiny_tdpg(DummyVecEnv([MatrixState]), n_episodes=4), 1)
    assert (model.state_dim, model.rollout_buffer.states.shape[2]) == (6, 6)


@pytest.mark.parametrize("space", [
    spaces.Discrete(5, start=1), spaces.MultiDiscrete([2, 3], start=[0, 1]), spaces.Dict(n=spaces.Discrete(2, start=1))
], ids=words)  # fmt: skip
def test_discrete_observations_that_do_not_begin_with_0_are_refused(space):
    with pytest.raises(ValueError, match=r"the observation space .* must begin with 0"):
        TDPG(env=toy_vec_env(observation_space=space))


def test_images_of_floats_are_images_if_the_policy_is_told_so():
    env = toy_vec_env(observation_space=spaces.Box(0, 1, (3, 24, 24), np.float32))
    model = TDPG(env=env, policy_kwargs=dict(normalize_images=False), n_episodes=4, device="cpu")
    assert (model.preset, type(model.policy.features_extractor).__name__) == ("image", "TRVCnn")
    blind = toy_vec_env(observation_space=env.observation_space, gives_state=False)
    with pytest.raises(ValueError, match=r"an image .* cannot stand in for it"):
        TDPG(env=blind, policy_kwargs=dict(normalize_images=False))


def test_an_environment_of_popgym_which_keeps_its_state_to_itself_can_be_trained_on():
    env = ToyEnv(gives_state=False)
    env.state_space, env.observability_level = spaces.Discrete(3), "partial"  # as POPGym's environments have them
    assert train_epochs(tiny_tdpg(DummyVecEnv([lambda: env]), n_episodes=2), 1).state_dim == 2  # the observation
