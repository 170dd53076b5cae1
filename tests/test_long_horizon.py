"""Environments with long horizons: epochs of steps, segments, value network, pooled information, dicts, defaults."""

import math
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import AtEveryEpoch, CountdownEnv, ToyEnv, assert_same_parameters, parameters, toy_vec_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdpg import TDPG, InformationCallback
from sb3_tdpg.advantages import ValueFunction, generalised_advantages
from sb3_tdpg.common.running_norms import Changes
from sb3_tdpg.information.logdet import LogDet


def tiny(env="CartPole-v1", **kwargs):
    """Make a model with the defaults for long horizons, and with few and small updates."""
    small = dict(epoch_steps=400, batch_size=100, n_epochs=2, seed=0, device="cpu")
    if "n_episodes" in kwargs:
        del small["epoch_steps"]
    return TDPG("TRVPolicy", env, **{**small, **kwargs})


def test_the_line_of_a_new_user_learns_cartpole():
    model = TDPG("TRVPolicy", "CartPole-v1", seed=0, device="cpu").learn(24_000)
    assert model.rollout_buffer.episode_costs.mean() < -150  # the untrained policy costs -20


def test_a_cost_limit_takes_information_out_and_keeps_the_return():
    reached = {}
    for limit in (None, -60.0):
        model = TDPG("TRVPolicy", "CartPole-v1", cost_limit=limit, seed=0, device="cpu").learn(30_000)
        batch = model.rollout_buffer.episode_batch().information_batch(pooled=True)
        estimator = LogDet(1, model.state_dim, model.policy.trv_dim)
        reached[limit] = float(estimator(batch)), model.rollout_buffer.episode_costs.mean()
    assert reached[-60.0][0] < 0.7 * reached[None][0]
    assert reached[-60.0][1] < -40


def test_an_epoch_of_steps_has_whole_episodes_and_stops_as_soon_as_there_are_enough():
    model = tiny(epoch_steps=300, n_envs=3).learn(300)
    batch = model.rollout_buffer.episode_batch(whole_horizon=False)
    lengths = batch.alive.sum(0)
    assert 300 <= lengths.sum() == model.rollout_buffer.alive.sum()
    # Without the last episode of each environment there are fewer than 300 steps.
    assert lengths.sum() - lengths.sort().values[-3:].sum() < 300
    assert len(lengths) > 3  # the buffer has grown
    assert len(batch.alive) == lengths.max()
    assert (batch.alive[0] == 1).all()
    assert not batch.prev_trvs[0].any()


@pytest.mark.parametrize("n_envs", [3, 8])
def test_any_number_of_environments_fits_the_defaults(n_envs):
    assert TDPG("TRVPolicy", make_vec_env("CartPole-v1", n_envs)).n_episodes is None
    short = make_vec_env(ToyEnv, n_envs)
    n_episodes = TDPG("TRVPolicy", short).n_episodes
    assert n_episodes % n_envs == 0
    assert 500 <= n_episodes < 500 + n_envs


def test_a_training_shorter_than_an_epoch_warns_with_the_number_to_change():
    with pytest.warns(UserWarning, match=r"learn\(50\) makes a single update.*400 steps.*total_timesteps=20000"):
        tiny().learn(50)


def test_a_time_limit_inside_the_function_behind_an_id_is_found(registry):
    gym.register("HiddenLimit-v0", lambda: gym.wrappers.TimeLimit(gym.make("Pendulum-v1").unwrapped, 70))
    assert TDPG("TRVPolicy", "HiddenLimit-v0").horizon == 70


def test_segments_leave_out_what_comes_after_the_end():
    model = tiny(epoch_steps=300).learn(300)
    batch = model.rollout_buffer.episode_batch(whole_horizon=False)
    parts = batch.segments(5)
    assert parts.alive.sum() == batch.alive.sum()
    assert parts.alive.shape[1] == sum(math.ceil(n / 5) for n in batch.alive.sum(0).tolist())
    assert (parts.alive[0] == 1).all()
    first = parts.prev_trvs[0]
    assert (first == 0).all(dim=1).sum() == batch.alive.shape[1]  # one segment of each episode starts with zeros
    living = parts.alive.bool()
    assert sorted(parts.costs[living].tolist()) == sorted(batch.costs[batch.alive.bool()].tolist())


def test_minibatches_count_steps(monkeypatch):
    model = tiny(epoch_steps=400, batch_size=100)
    evaluate = Mock(wraps=model.policy.evaluate_episodes)
    monkeypatch.setattr(model.policy, "evaluate_episodes", evaluate)
    model.learn(400)
    sizes = [int(call.args[0].alive.sum()) for call in evaluate.call_args_list]
    assert 60 < min(sizes) <= max(sizes) < 140


def test_the_first_ratio_of_an_epoch_is_one():
    """The statistics of the observations must not change between the rollouts and their gradients."""
    model = tiny(n_epochs=1, batch_size=400, normalize_advantage=False).learn(800)
    assert model.logger.name_to_value["train/approx_kl"] == pytest.approx(0.0, abs=1e-4)
    assert model.epoch >= 2


def test_generalised_advantages_are_the_discounted_sum_of_residuals():
    costs, values = th.tensor([[1.0], [2.0], [3.0]]), th.tensor([[0.5], [1.0], [1.5]])
    first, second, third = 1 + 0.9 * 1.0 - 0.5, 2 + 0.9 * 1.5 - 1.0, 3 - 1.5  # the residuals
    expected = [first + 0.45 * second + 0.45**2 * third, second + 0.45 * third, third]
    assert generalised_advantages(costs, values, 0.9, 0.5)[:, 0].tolist() == pytest.approx(expected)


@pytest.mark.parametrize("scale", [1.0, 1e4])
def test_the_value_network_learns_the_cost_to_come_on_any_scale(scale):
    th.manual_seed(0)
    value = ValueFunction(2, 20)
    explained = []
    for _ in range(15):
        states = th.randn(20, 50, 2)
        left = (20 - th.arange(20.0))[:, None]
        targets = scale * (3 * states[..., 0] + left + 7)
        explained.append(value.fit(states, targets, th.ones(20, 50), 1.0))
    assert explained[0] < 0.1
    assert explained[-1] > 0.95


def test_a_new_scale_of_the_targets_does_not_move_the_values():
    value = ValueFunction(2, 10)
    states = th.randn(10, 30, 2)
    before = value(states, 0.9)
    value._rescale(1000 + 100 * th.randn(300))
    th.testing.assert_close(value(states, 0.9), before, rtol=1e-4, atol=1e-3)


def test_observations_are_standardised_by_what_the_training_has_seen():
    model = tiny().learn(400)
    norm = model.policy.norm.norms["observation"]
    seen = model.rollout_buffer.observations[model.rollout_buffer.alive > 0]
    np.testing.assert_allclose(norm.mean, seen.mean(0), atol=1e-3)


def test_the_information_is_pooled_over_the_steps_of_all_times():
    model = tiny(beta=1e6).learn(400)
    batch = model.rollout_buffer.episode_batch()
    pooled = batch.information_batch(pooled=True)
    assert pooled.trvs.shape[:2] == (1, int(batch.alive.sum()))
    per_step = float(LogDet(1, model.state_dim, model.policy.trv_dim)(pooled))
    mean_length = float(batch.alive.sum(0).mean())
    assert model.information.tolist() == pytest.approx([per_step * mean_length], rel=1e-5)


def test_the_interval_of_pooled_information_takes_one_step_of_each_episode():
    model = tiny(toy_vec_env(10, horizon=50), n_episodes=40, beta=1e6, policy_kwargs=dict(encoder_log_var_init=-2.0))
    logged = {}
    interval = InformationCallback(eval_freq=1)
    model.learn(2000, callback=[interval, AtEveryEpoch(lambda m: logged.update(m.logger.name_to_value))])
    assert interval.interval.n_episodes.tolist() == [40]
    for limit, of_a_step in zip(("lower", "upper"), interval.interval.total, strict=True):
        assert logged[f"mi/{limit}"] == pytest.approx(50 * of_a_step)
    assert 0 <= logged["mi/lower"] < logged["mi/total"] < 2 * logged["mi/upper"]


def test_an_epoch_with_too_few_episodes_for_an_interval_is_passed_over():
    interval = InformationCallback(eval_freq=1)
    with pytest.warns(UserWarning, match=r"no interval of the information: the epoch has 8 episodes, and 18 TRVs need"):
        tiny(toy_vec_env(2, horizon=50)).learn(400, callback=interval)
    assert interval.interval is None


@pytest.mark.parametrize("mi_estimator", ["mine", "infonce", "loo", "vib"])
def test_every_estimator_penalises_pooled_steps(mi_estimator):
    model = tiny(beta=100.0, mi_estimator=mi_estimator, encoder_gradient="score").learn(400)
    assert model.estimator.horizon == 1
    assert np.isfinite(model.logger.name_to_value["train/mi_loss"])


def test_the_observation_and_its_change_are_in_the_first_trvs_from_the_start():
    policy = tiny("Pendulum-v1").policy
    policy.changes.share.copy_(th.tensor([1.0, 0.5, 0.0]))
    policy.changes.norm.var.copy_(th.tensor([0.04, 0.04, 0.04]))
    with th.no_grad():
        for parameter in policy.encoder.parameters():  # only the connections that skip the encoder are left
            parameter.zero_()
    shown, before = th.tensor([[0.3, -0.9, 0.2]]), th.zeros(1, policy.trv_dim)
    before[0, :3] = th.tensor([0.2, -0.8, 0.5])
    mean, _ = policy.encoder_density(shown, before, np.zeros(1, int))
    mean = mean.detach()
    np.testing.assert_allclose(mean[0, :3], shown[0], rtol=1e-6)
    np.testing.assert_allclose(mean[0, 3:6], [0.1 / 0.2, 0.5 * -0.1 / 0.2, 0.0], rtol=1e-4, atol=1e-6)
    assert not mean[0, 6:].any()
    first, _ = policy.encoder_density(shown, th.zeros_like(before), np.zeros(1, int))
    assert not first[0, 3:].detach().any()  # there are no changes at the first step


def test_what_skips_the_encoder_needs_as_many_trvs():
    for trv_dim, skip, skip_changes in ((2, False, False), (5, True, False), (6, True, True)):
        policy = tiny("Pendulum-v1", policy_kwargs=dict(trv_dim=trv_dim)).policy
        assert (policy.skip, policy.skip_changes) == (skip, skip_changes)
    for refused, message in (
        (dict(trv_dim=4, skip_changes=True), r"skip_changes=True add 6 features.*trv_dim=4.*trv_dim=6 or"),
        (dict(skip=False, skip_changes=True), "skip_changes=True needs skip=True"),
        (dict(trv_dim="4"), "trv_dim='4' must be an integer"),
    ):
        with pytest.raises(ValueError, match=message):
            tiny("Pendulum-v1", policy_kwargs=refused)


@pytest.mark.parametrize("shows_velocity", [True, False])
def test_changes_count_where_they_say_what_the_observation_does_not(shows_velocity):
    """A mass on a spring is pushed at random; its last displacement predicts the next unless its velocity is seen."""
    generator = np.random.default_rng(0)
    state, seen = generator.normal(size=(40, 2)), []
    for _ in range(50):
        seen.append(state if shows_velocity else state[:, :1])
        push = 0.05 * generator.normal(size=40)
        velocity = state[:, 1] - 0.1 * state[:, 0] + push
        state = np.stack([state[:, 0] + 0.3 * velocity, velocity], axis=1)
    x = th.as_tensor(np.array(seen), dtype=th.float32)
    changes = Changes(x.shape[-1])
    changes.update(x, th.ones(50, 40))
    assert changes.share[0] < 0.05 if shows_velocity else changes.share[0] > 0.8
    after_the_end = x.clone()
    after_the_end[25:] = th.randn_like(x[25:])
    shorter, alive = Changes(x.shape[-1]), th.zeros(50, 40)
    alive[:25] = 1
    shorter.update(after_the_end, alive)
    alone = Changes(x.shape[-1])
    alone.update(x[:25], th.ones(25, 40))
    np.testing.assert_allclose(shorter.share, alone.share)
    np.testing.assert_allclose(shorter.norm.var, alone.norm.var)
    too_few = Changes(30)
    too_few.update(th.randn(20, 4, 30), th.ones(20, 4))
    too_few.update(th.randn(20, 4, 30), th.zeros(20, 4))
    assert not too_few.share.any()


def test_the_value_network_sees_changes_where_observations_stand_in_for_the_state():
    shown = spaces.Box(-1, 1, (2,), np.float32)
    partial = tiny(
        DummyVecEnv([lambda: gym.wrappers.TransformObservation(gym.make("Pendulum-v1"), lambda y: y[:2], shown)])
    )
    with_state = TDPG("TRVPolicy", DummyVecEnv([lambda: CountdownEnv(0, [4, 2, 1])]), baseline="value")
    assert with_state.value_function.changes is None
    partial.learn(1000)
    for changes in (partial.value_function.changes, partial.policy.changes):
        assert (changes.share > 0.3).all()  # if velocities are shown, the share is below 0.05


def test_the_noise_of_the_actions_is_a_share_of_their_range():
    low, high = np.array([-2.0, 10.0], np.float32), np.array([2.0, 30.0], np.float32)
    env = ToyEnv(action_space=spaces.Box(low, high, dtype=np.float32), horizon=60)
    policy = tiny(env, policy_kwargs=dict(action_log_var_init=-2.0)).policy
    distribution = policy.action_density(th.zeros(4, policy.trv_dim), np.zeros(4, int)).distribution
    share = distribution.stddev / th.tensor([2.0, 10.0])
    assert share.detach().numpy() == pytest.approx(np.full((4, 2), np.exp(-1)), rel=0.4)
    assert ((distribution.mean - th.tensor([0.0, 20.0])).abs() < th.tensor([1.0, 5.0])).all()


def test_the_variance_of_the_actions_is_one_parameter_unless_asked_for():
    stds = {}
    for shared in (None, False):
        policy = tiny("Pendulum-v1", policy_kwargs=dict(shared_action_noise=shared)).policy
        distribution = policy.action_density(th.randn(50, policy.trv_dim), np.zeros(50, int)).distribution
        stds[shared] = distribution.stddev[:, 0]
    assert stds[None].unique().numel() == 1
    assert stds[False].unique().numel() > 10
    before = stds[None][0].item()
    model = tiny("Pendulum-v1").learn(800)
    after = model.policy.action_density(th.zeros(1, model.policy.trv_dim), np.zeros(1, int)).distribution.stddev
    assert after.item() != pytest.approx(before, rel=1e-4)  # the standard deviation is learnt
    assert not hasattr(tiny("CartPole-v1").policy, "action_log_var")  # discrete actions have no variance


def test_a_saved_model_predicts_and_continues_the_same(tmp_path):
    model = tiny().learn(400)
    model.save(tmp_path / "model")
    loaded = TDPG.load(tmp_path / "model", env=gym.make("CartPole-v1"), device="cpu")
    assert_same_parameters(parameters(model.policy), parameters(loaded.policy))
    assert_same_parameters(parameters(model.value_function), parameters(loaded.value_function))
    assert (loaded.preset, loaded.batch_size, loaded.epoch_steps) == ("long", 100, 400)
    loaded.learn(400, reset_num_timesteps=False)


IMAGE_VECTOR = spaces.Dict(camera=spaces.Box(0, 255, (3, 36, 36), np.uint8), joints=spaces.Box(-1, 1, (2,), np.float32))


@pytest.mark.parametrize("horizon", [4, 60])
def test_a_camera_beside_joints_is_learnt_from(horizon, tmp_path):
    env = ToyEnv(observation_space=IMAGE_VECTOR, horizon=horizon)
    model = TDPG("TRVPolicy", env, n_episodes=4, beta=10.0, seed=0).learn(2 * 4 * horizon)
    assert model.epoch == 2
    assert model.state_dim == 1  # the state from the environment, not the joints
    model.save(tmp_path / "model")
    observation, _ = env.reset(seed=0)
    models = (model, TDPG.load(tmp_path / "model"))
    np.testing.assert_array_equal(*(each.predict(observation, deterministic=True)[0] for each in models))


def test_a_dict_of_vectors_is_its_own_state_and_one_with_an_image_is_not():
    joints = spaces.Dict(angles=spaces.Box(-1, 1, (2,), np.float32), speed=spaces.Box(-1, 1, (1,), np.float32))
    env = ToyEnv(observation_space=joints, gives_state=False, horizon=60)
    model = tiny(env).learn(400)
    assert model.state_dim == 3
    assert set(model.policy.norm.norms) == {"angles", "speed"}
    camera = ToyEnv(observation_space=IMAGE_VECTOR, gives_state=False, horizon=60)
    with pytest.raises(ValueError, match="needs the true state"):
        tiny(camera)


def test_a_limit_that_no_epoch_meets_is_told_at_the_end():
    with pytest.warns(UserWarning, match=r"no epoch met cost_limit=-475, .*no penalty"):
        tiny(cost_limit=-475).learn(400)


def test_actions_in_double_precision_are_learnt_and_stay_in_their_bounds():
    space = spaces.Box(np.array([0.0, -5.0]), np.array([0.1, 3.0]), dtype=np.float64)
    tiny(toy_vec_env(action_space=space, horizon=50), epoch_steps=100).learn(200)  # the environment checks them
