"""The policy acts step by step, encodes whole episodes, and supports many spaces."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import ToyEnv, parameters, same_parameters, tiny_tdpg, toy_vec_env, train_epochs
from stable_baselines3.common.torch_layers import FlattenExtractor

from sb3_tdpg import TDPG, TRVPolicy
from sb3_tdpg.buffers import RebuiltTRVs, each_part
from sb3_tdpg.policies import MAX_TIME_VARYING_HORIZON

T, N = 4, 6
VECTOR = spaces.Box(-np.inf, np.inf, (3,), np.float32)
CHW = spaces.Box(0, 255, (3, 20, 16), np.uint8)
HWC = spaces.Box(0, 255, (20, 16, 3), np.uint8)
DEPTH = spaces.Box(0.2, 0.7, (1, 24, 20), np.float32)
ACTION_SPACES = {
    "box": spaces.Box(-1, 1, (2,), np.float32),
    "matrix": spaces.Box(-1, 1, (2, 3), np.float32),
    "lopsided": spaces.Box(np.array([0.0, -5.0]), np.array([0.1, 3.0]), dtype=np.float32),
    "discrete": spaces.Discrete(4),
    "multi_discrete": spaces.MultiDiscrete([2, 3]),
    "multi_binary": spaces.MultiBinary(3),
    "scalar": spaces.Box(-1, 1, (), np.float32),
    "binary matrix": spaces.MultiBinary((2, 3)),
    "discrete matrix": spaces.MultiDiscrete(np.array([[2, 3], [4, 5]])),
}


def make_policy(observation_space=VECTOR, action_space=ACTION_SPACES["box"], **kwargs):
    return TRVPolicy(observation_space, action_space, lambda _: 1e-3, **{"horizon": T, **kwargs})


def step_through(policy, observations, deterministic):
    """Call predict T times; return actions and TRVs, ``(T, N, ...)``, and the results of ``policy.step``."""
    recorded, original = [], policy.step

    def record(*args):
        recorded.append(original(*args))
        return recorded[-1]

    policy.step = record
    state, actions, trvs = None, [], []
    for observation in observations:
        action, state = policy.predict(observation, state=state, deterministic=deterministic)
        actions.append(action)
        trvs.append(state[0])
    policy.step = original
    return np.stack(actions), np.stack(trvs), recorded


@pytest.mark.parametrize("gate", [True, False], ids=["gate", "no gate"])
@pytest.mark.parametrize("time_varying", [True, False])
@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("observation_space", [VECTOR, CHW, DEPTH], ids=["vector", "image", "depth"])
def test_predicting_step_by_step_equals_the_batched_pass_over_whole_episodes(
    observation_space, deterministic, time_varying, gate
):
    policy = make_policy(observation_space, time_varying=time_varying, gate=gate)
    observations = np.stack([[observation_space.sample() for _ in range(N)] for _ in range(T)])
    actions, trvs, steps = step_through(policy, observations, deterministic)
    noise = th.stack([step.noise for step in steps])
    assert (noise == 0).all() == deterministic

    features = policy.extract_features(th.as_tensor(observations).flatten(0, 1), policy.features_extractor)
    batch = SimpleNamespace(noise=noise, prev_trvs=th.zeros_like(noise))
    rebuilt = policy.rebuild_trvs(features.unflatten(0, (T, N)), batch)
    np.testing.assert_allclose(rebuilt.trvs.detach(), trvs, rtol=1e-4, atol=1e-6)
    for name in ("means", "stds"):
        stepwise = th.stack([getattr(step, name) for step in steps])
        th.testing.assert_close(getattr(rebuilt, name).detach(), stepwise, rtol=1e-4, atol=1e-6)
    if deterministic:
        means = policy.action_head(rebuilt.trvs).chunk(2, dim=-1)[0].detach().numpy()
        np.testing.assert_allclose(actions, np.clip(means, -1, 1), rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("n_steps", [1, 2, 3])
def test_segments_side_by_side_give_the_trvs_of_whole_episodes(n_steps):
    model = train_epochs(tiny_tdpg("Pendulum-v1", n_episodes=4, n_envs=2, beta=math.inf), 1)
    batch = model.rollout_buffer.episode_batch()
    batch = type(batch)(*(each_part(lambda v: v[:5], x) for x in batch))
    whole = model.policy.rebuild_trvs(model.policy.episode_features(batch), batch)
    trvs = whole.trvs.detach()
    parts = batch._replace(trvs=trvs, prev_trvs=th.cat([th.zeros_like(trvs[:1]), trvs[:-1]])).segments(n_steps)
    features = model.policy.episode_features(parts).detach().requires_grad_()
    rebuilt = model.policy.rebuild_trvs(features, parts)
    for name in RebuiltTRVs._fields:
        joined = getattr(rebuilt, name).unflatten(1, (-1, 4)).transpose(0, 1).flatten(0, 1)[:5]
        th.testing.assert_close(joined, getattr(whole, name), rtol=1e-4, atol=1e-5)
    # The gradient reaches the start of the segment.
    (gradient,) = th.autograd.grad(rebuilt.trvs[-1].sum(), features)
    assert (gradient.abs().sum(dim=(1, 2)) > 0).all()


def test_deterministic_predictions_repeat_and_stochastic_ones_do_not():
    policy = make_policy()
    policy.train()
    observation = np.ones((N, 3), np.float32)
    first, state = policy.predict(observation, deterministic=True)
    policy.predict(np.zeros((2, 3), np.float32))  # an evaluation in between, like that of EvalCallback
    second, _ = policy.predict(observation, deterministic=True)
    np.testing.assert_array_equal(first, second)
    assert isinstance(state, tuple)
    assert all(isinstance(x, np.ndarray) for x in state)
    assert len(np.unique(state[0], axis=0)) == 1
    (first, state), (second, _) = (policy.predict(observation, deterministic=False) for _ in range(2))
    assert not np.array_equal(first, second)
    assert len(np.unique(state[0], axis=0)) == N


def test_the_memory_matters_and_is_cleared_where_an_episode_starts():
    policy = make_policy(time_varying=False)
    observation = np.random.default_rng(0).normal(size=(N, 3)).astype(np.float32)
    fresh, fresh_state = policy.predict(observation, deterministic=True)
    _, memory = policy.predict(5 * observation, deterministic=True)
    kept, start = [x.copy() for x in memory], np.array([True, False] * 3)
    mixed, mixed_state = policy.predict(observation, memory, start, deterministic=True)
    for x, expected in zip(memory, kept, strict=True):  # predict does not change its arguments
        np.testing.assert_array_equal(x, expected)
    np.testing.assert_array_equal(mixed[start], fresh[start])
    np.testing.assert_array_equal(mixed_state[0][start], fresh_state[0][start])
    assert (np.abs(mixed_state[0] - fresh_state[0])[~start] > 1e-5).all()
    assert mixed_state[1].tolist() == [1, 2] * 3


def test_a_gate_keeps_the_last_trvs_where_it_is_closed_and_replaces_them_where_it_is_open():
    policy = make_policy(gate=True, trv_dim=2)
    prev_trv = th.tensor([[0.9, -5.0]])
    candidate, log_var = th.tensor([[0.3, -0.4]]), th.zeros(1, 2)

    def means(gate):
        parameters = th.cat([candidate, log_var, th.full((1, 2), gate)], dim=1)
        return policy._encoder_density(parameters, th.zeros(1, 3), prev_trv)[0]

    th.testing.assert_close(means(-30.0), prev_trv)
    th.testing.assert_close(means(30.0), th.tanh(candidate))
    th.testing.assert_close(means(0.0), (prev_trv + th.tanh(candidate)) / 2)
    assert make_policy(gate=False, trv_dim=2).encoder.sizes[-1] == 4
    with pytest.raises(ValueError, match="gate=True and skip=True"):
        make_policy(gate=True, skip=True, trv_dim=3)


@pytest.mark.parametrize("time_varying", [True, False])
def test_environments_at_different_time_steps_in_one_call_equal_separate_calls(time_varying):
    policy = make_policy(time_varying=time_varying)
    rng = np.random.default_rng(0)
    observation = rng.normal(size=(N, 3)).astype(np.float32)
    trv, t = rng.normal(size=(N, 2)).astype(np.float32), np.array([2, 0, 3, 2, 1, 0])
    together, (trvs, next_t) = policy.predict(observation, (trv, t), deterministic=True)
    for i in range(N):
        rows = slice(i, i + 1)
        alone, (alone_trv, _) = policy.predict(observation[rows], (trv[rows], t[rows]), deterministic=True)
        np.testing.assert_allclose(together[rows], alone, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(trvs[rows], alone_trv, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(next_t, t + 1)


@pytest.mark.parametrize("time_varying", [True, False])
def test_beyond_the_horizon_a_policy_goes_on_if_its_steps_share_their_weights(time_varying):
    policy, observation, state = make_policy(time_varying=time_varying), np.zeros((N, 3), np.float32), None
    for _ in range(T):
        _, state = policy.predict(observation, state)
    if time_varying:
        mend = rf"step {T + 1} of an episode.*{T} steps.*episode_start=True.*time_varying=Fa"
        with pytest.raises(ValueError, match=mend):
            policy.predict(observation, state)
        policy.predict(observation, state, np.ones(N, bool))
    else:
        assert policy.predict(observation, state)[1][1].tolist() == [T + 1] * N


@pytest.mark.parametrize("shape", [(4,), (N, 4), (2, 3, 3), ()])
def test_an_observation_of_a_wrong_shape_is_refused(shape):
    with pytest.raises(ValueError, match=r"(?i)observation.*\(3,\)"):
        make_policy().predict(np.zeros(shape, np.float32))


def test_a_state_for_another_number_of_environments_is_refused():
    policy = make_policy()
    _, state = policy.predict(np.zeros((N, 3), np.float32))
    with pytest.raises(ValueError, match="same number of environments"):
        policy.predict(np.zeros((2, 3), np.float32), state)


def test_weights_vary_in_time_up_to_a_horizon_and_are_shared_beyond():
    for horizon in (MAX_TIME_VARYING_HORIZON, MAX_TIME_VARYING_HORIZON + 1):
        policy = make_policy(horizon=horizon, net_arch=dict(encoder=[2], action_head=[2]))
        assert policy.time_varying == (horizon == MAX_TIME_VARYING_HORIZON)


@pytest.mark.parametrize("squash", [True, False])
def test_no_observation_drives_the_trv_means_out_of_the_unit_box_unless_asked_to(squash):
    far_off, policy = np.full((5, 3), 1e30, np.float32), make_policy(squash_trv_mean=squash)
    means = policy.step(th.as_tensor(far_off), th.zeros(5, 2), np.zeros(5, int)).means
    assert bool((means.abs() <= 1).all()) == squash
    actions, state = policy.predict(far_off)
    assert np.isfinite(policy.predict(far_off, state)[0]).all() and np.isfinite(actions).all()


def test_the_variances_have_the_floors_and_offsets_that_were_asked_for():
    kwargs = dict(encoder_var_floor=0.25, action_var_floor=0.09)
    policy = make_policy(encoder_log_var_init=-50.0, action_log_var_init=-50.0, **kwargs)
    step = policy.step(th.randn(N, 3), th.zeros(N, 2), np.zeros(N, int))
    th.testing.assert_close(step.stds, th.full((N, 2), 0.5))
    std = policy._action_distribution(policy.action_head.at(step.trvs, 0)).distribution.stddev
    th.testing.assert_close(std, th.full((N, 2), 0.3))
    louder = make_policy(encoder_log_var_init=4.0).step(th.randn(N, 3), th.zeros(N, 2), np.zeros(N, int))
    assert louder.stds.min() > 4


@pytest.mark.parametrize("scale_actions", [False, True])
def test_the_first_actions_are_those_asked_for(scale_actions):
    space = spaces.Box(-4.0, 4.0, (2,), np.float32)
    asked = np.array([0.25, -0.5], np.float32)
    policy = make_policy(action_space=space, action_mean_init=asked.tolist(), scale_actions=scale_actions)
    with th.no_grad():
        policy.action_head.mlp.layers[-1].weight.zero_()
        means = policy.action_gaussian(policy.action_head.at(th.zeros(N, 2), 1))[0].numpy()
    np.testing.assert_allclose(means, np.tile(asked * (4 if scale_actions else 1), (N, 1)), rtol=1e-6)


def test_sizes_and_activations_are_those_of_the_policy_kwargs():
    policy = make_policy(trv_dim=5, net_arch=dict(encoder=[7, 9], action_head=[]), activation_fn=th.nn.Tanh)
    assert [tuple(layer.weight.shape) for layer in policy.encoder.mlp.layers] == [(T, 8, 7), (T, 7, 9), (T, 9, 10)]
    assert [tuple(layer.weight.shape) for layer in policy.action_head.mlp.layers] == [(T, 5, 4)]
    assert isinstance(policy.encoder.mlp.activation, th.nn.Tanh)


def test_the_paper_s_convolutions_stand_before_the_encoder_of_small_images_and_of_the_preset_paper():
    big = spaces.Box(0, 255, (3, 64, 64), np.uint8)
    for space, preset, channels in ((CHW, None, [6, 6]), (big, "paper", [6, 6]), (big, None, [16, 32, 32])):
        policy = make_policy(space, preset=preset)
        convolutions = [layer for layer in policy.features_extractor.cnn if isinstance(layer, th.nn.Conv2d)]
        assert [layer.out_channels for layer in convolutions] == channels
        assert (policy.trv_dim, policy.gate, policy.time_varying) == ((8, False, True) if preset else (32, True, False))
    policy = make_policy(CHW)
    dark, bright = (policy.predict(np.full((1, *CHW.shape), x, np.uint8), deterministic=True)[1][0] for x in (0, 255))
    assert not np.allclose(dark, bright)


@pytest.mark.parametrize(("kwargs", "channels", "n_features"), [
    (None, 16, 32),
    (dict(layers=((6, 6, 2), (6, 4, 2)), keypoints=False), 6, 5400),  # the paper's network
])  # fmt: skip
def test_depth_images_have_the_papers_network_of_grasping_but_for_keypoints(kwargs, channels, n_features):
    space = spaces.Box(0.2, 0.7, (1, 128, 128), np.float32)
    policy = make_policy(space, horizon=1, features_extractor_kwargs=kwargs)
    convolutions = [layer for layer in policy.features_extractor.cnn if isinstance(layer, th.nn.Conv2d)]
    assert [(c.out_channels, c.kernel_size, c.stride) for c in convolutions] == [
        (channels, (6, 6), (2, 2)),
        (channels, (4, 4), (2, 2)),
    ]
    shapes = [tuple(layer.weight.shape[1:]) for layer in policy.encoder.mlp.layers]
    assert shapes == [(16 + n_features, 128), (128, 64), (64, 32)]
    assert [tuple(layer.weight.shape[1:]) for layer in policy.action_head.mlp.layers] == [(16, 64), (64, 64), (64, 4)]
    assert isinstance(policy.encoder.mlp.activation, th.nn.Tanh)
    assert isinstance(policy.action_head.mlp.activation, th.nn.ELU)


def test_a_saved_policy_predicts_the_same(tmp_path):
    policy = make_policy(trv_dim=3, encoder_var_floor=0.5, time_varying=False, action_log_var_init=1.0)
    policy.save(tmp_path / "policy.zip")
    loaded = TRVPolicy.load(tmp_path / "policy.zip", device="cpu")
    results = []
    for p in (policy, loaded):
        th.manual_seed(1)
        results.append(p.predict(np.ones((N, 3), np.float32))[0])
    np.testing.assert_array_equal(*results)


@pytest.mark.filterwarnings("ignore:.*Casting input x to numpy array")  # a scalar action
@pytest.mark.parametrize("encoder_gradient", ["score", "pathwise"])
@pytest.mark.parametrize("space", ACTION_SPACES.values(), ids=ACTION_SPACES)
def test_every_kind_of_action_space_trains_and_gives_valid_actions(space, encoder_gradient):
    # ToyEnv asserts that each action is in the space.
    model = tiny_tdpg(toy_vec_env(action_space=space), encoder_gradient=encoder_gradient, beta=0.1)
    before = parameters(model.policy)
    train_epochs(model, 2)
    assert not same_parameters(before, parameters(model.policy))
    observation = model.observation_space.sample()
    for deterministic in (True, False):
        action, _ = model.predict(observation, deterministic=deterministic)
        assert isinstance(action, np.ndarray)
        assert space.contains(action)
        batch, _ = model.predict(np.stack([observation] * 5), deterministic=deterministic)
        assert batch.shape == (5, *space.shape)
        assert not deterministic or np.allclose(batch, action, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", ["box", "discrete", "multi_discrete", "multi_binary"])
def test_the_log_probability_of_an_action_is_that_of_its_distribution(name):
    space = ACTION_SPACES[name]
    model = train_epochs(tiny_tdpg(toy_vec_env(action_space=space), beta=np.inf), 1)
    batch = model.rollout_buffer.episode_batch()
    log_probs = model.policy.action_log_prob(batch.trvs, batch).detach()
    assert log_probs.shape == (3, 20)
    outputs = model.policy.action_head(batch.trvs).detach()
    actions = batch.actions
    if name == "discrete":
        expected = th.distributions.Categorical(logits=outputs).log_prob(actions[..., 0])
    elif name == "multi_discrete":
        parts = [th.distributions.Categorical(logits=o) for o in outputs.split([2, 3], dim=-1)]
        expected = sum(part.log_prob(actions[..., i]) for i, part in enumerate(parts))
    elif name == "multi_binary":
        expected = th.distributions.Bernoulli(logits=outputs).log_prob(actions).sum(-1)
    else:
        mean, log_var = outputs.chunk(2, dim=-1)
        variance = 1 / ((-log_var).exp() + np.exp(-8)) + 1e-5  # exp(log_var) that saturates
        expected = th.distributions.Normal(mean, variance.sqrt()).log_prob(actions).sum(-1)
    th.testing.assert_close(log_probs, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("space", [CHW, HWC], ids=["CHW", "HWC"])
def test_images_train_in_either_layout(space, tmp_path):
    settings = dict(beta=0.1, mi_estimator="mine", policy_kwargs={}, nuisance=None)
    model = train_epochs(tiny_tdpg(toy_vec_env(observation_space=space), **settings), 2)
    assert model.rollout_buffer.observations.dtype == np.uint8
    assert model.rollout_buffer.observations.shape == (3, 20, 3, 20, 16)
    state = model.rollout_buffer.states[0, :, 0]
    shown = model.rollout_buffer.observations[0, :, 0, 0, 0]
    np.testing.assert_array_equal(shown, (127 * (state + 1)).astype(np.uint8))
    env = ToyEnv(observation_space=space)
    observation, _ = env.reset(seed=0)
    for batch in (observation, np.stack([observation] * 3)):  # in the format of the user's environment
        assert model.predict(batch)[0].shape == (*batch.shape[:-3], 1)
    model.save(tmp_path / "model")
    loaded = TDPG.load(tmp_path / "model", env=toy_vec_env(observation_space=space), device="cpu", nuisance="auto")
    train_epochs(loaded, 1)


@pytest.mark.parametrize("space", [VECTOR, spaces.Box(-1, 1, (4, 2), np.float32), spaces.Discrete(2)], ids=str)
def test_without_a_true_state_the_observation_is_taken_for_it(space):
    model = train_epochs(tiny_tdpg(toy_vec_env(observation_space=space, gives_state=False), beta=0.1), 2)
    states, observations = model.rollout_buffer.states, model.rollout_buffer.observations
    np.testing.assert_array_equal(states, observations.reshape(states.shape))
    assert model.predict(space.sample())[0].shape == (1,)


def test_an_action_with_a_single_value_keeps_it():
    space = spaces.Box(np.array([-1.0, 0.5], np.float32), np.array([1.0, 0.5], np.float32))
    model = TDPG(env=toy_vec_env(action_space=space, horizon=50), epoch_steps=100, batch_size=50, device="cpu", seed=0)
    model.learn(100)
    assert model.predict(np.zeros(2, np.float32))[0][1] == 0.5


def test_an_extractor_may_rely_on_the_layout_of_images():
    class Viewing(FlattenExtractor):
        def forward(self, observations):
            return observations.view(len(observations), -1)

    kwargs = dict(features_extractor_class=Viewing, net_arch=dict(encoder=[4], action_head=[]))
    env = toy_vec_env(observation_space=spaces.Box(0, 255, (3, 12, 12), np.uint8))
    train_epochs(TDPG(env=env, n_episodes=4, policy_kwargs=kwargs, device="cpu"), 1)
