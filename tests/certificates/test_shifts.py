"""Declared shifts: what they move in the TRVs, and certificates on the lava problem against what episodes cost."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from scipy.stats import beta as beta_distribution
from small_problems import ToyEnv, tiny_tdpg, train_epochs
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch.distributions import Normal, kl_divergence

from sb3_tdpg.certificates import shifts
from sb3_tdpg.certificates.certificate import CostDistribution, cost_distribution, worst_mean
from sb3_tdpg.certificates.shifts import Budget, Shift, TrainingEpisodes, _budget, _divergences, encode
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.envs.scenarios import Scenario

TRAINING = Scenario("Training", "Lava-v0")
CLIPPED = 315.0  # standing at the wall
SMALL = dict(cost_bound=CLIPPED, n_episodes=20_000, n_budget_episodes=2000)


def lava_shift(*, noise=0.01, bias=(0.0, 0.0), start=(1.0, 1.0)):
    """Declare another sensor and another start, whose divergences from those of the training have closed forms."""
    shifted, training = Normal(th.tensor(bias).double(), noise), Normal(th.zeros(2).double(), 0.01)
    return Shift(
        f"{noise=} {bias=} {start=}",
        env_kwargs=dict(sensor_noise_std=noise, sensor_bias=bias, start_beta=start),
        start_kl=-float(beta_distribution(*start).entropy()),
        sensor_kl=kl_divergence(shifted, training).sum().item(),
    )


@pytest.fixture(scope="module")
def model():
    """A policy that looks at its sensor."""
    return train_epochs(tiny_tdpg(beta=float("inf"), n_episodes=200), 15)


@pytest.fixture(scope="module")
def episodes(model):
    return TrainingEpisodes(model, TRAINING, **SMALL)


# -- the environment's part ---------------------------------------------------------------------------------------


def test_a_bias_of_the_sensor_changes_what_is_seen_and_nothing_else():
    env = LavaEnv(sensor_noise_std=0.0, sensor_bias=(0.5, -2.0))
    observation, info = env.reset(seed=0)
    np.testing.assert_allclose(observation - info["state"], (0.5, -2.0), atol=1e-6)
    plain = LavaEnv(sensor_noise_std=0.0)
    plain.reset(seed=0)
    for u in (1.0, -0.5):
        observation, *_, info = env.step(np.array([u]))
        np.testing.assert_allclose(observation - info["state"], (0.5, -2.0), atol=1e-6)
        np.testing.assert_array_equal(info["state"], plain.step(np.array([u]))[4]["state"])


def test_the_start_follows_the_beta_distribution():
    env = LavaEnv(start_beta=(2.0, 1.0))
    env.reset(seed=0)
    start = env.initial_state(20_000)
    assert start[:, 0].mean() == pytest.approx(5 * 2 / 3, abs=0.03)
    assert (start[:, 1] == 0).all()


# -- divergences ----------------------------------------------------------------------------------------------------


def test_no_shift_has_no_divergence_and_more_noise_more(episodes):
    means = [episodes.divergences(lava_shift(noise=std)).mean() for std in (0.01, 0.011, 0.03, 0.1)]
    assert means[0] == pytest.approx(0, abs=1e-12)  # rounding
    assert (np.diff(means) > 0).all()


def test_the_divergence_of_the_trvs_is_at_most_that_of_the_sensor(episodes):
    """Data processing; the coupling only makes the mean an upper bound, so the shift is taken large."""
    shift = lava_shift(noise=0.3)
    assert episodes.divergences(shift).mean(axis=1).max() < shift.sensor_kl


def test_what_the_encoder_does_not_see_does_not_move_it(model):
    blind = tiny_tdpg()
    blind.policy.load_state_dict(model.policy.state_dict())
    with th.no_grad():
        blind.policy.encoder.mlp.layers[0].weight[:, model.policy.trv_dim :] = 0
    episodes = TrainingEpisodes(blind, TRAINING, **SMALL)
    certified = episodes.certify(lava_shift(noise=5.0, bias=(3.0, 3.0)))
    assert certified.budget.kl == 0
    assert certified.through_trvs < certified.through_sensor == CLIPPED
    at_rest = episodes.certify(Shift("nothing")).through_trvs
    assert certified.bound == at_rest
    # What a sample cannot exclude costs something even so.
    assert at_rest > worst_mean(episodes.distribution, 0.0)


def test_the_divergence_is_that_of_the_shifted_density_from_the_other(model, episodes):
    shift = lava_shift(noise=0.2)
    shifted = encode(model, LavaEnv(sensor_noise_std=0.2), episodes.recorded)
    for p, q, divergence in zip(shifted, episodes.recorded.densities, episodes.divergences(shift), strict=True):
        (m, s, m_0, s_0) = (x.double() for x in (p.mean, p.stddev, q.mean, q.stddev))
        expected = (th.log(s_0 / s) + (s**2 + (m - m_0) ** 2) / (2 * s_0**2) - 0.5).sum(1)
        np.testing.assert_allclose(divergence, expected, rtol=1e-3, atol=1e-5)


def test_a_small_divergence_is_not_rounded_away():
    mean, std = th.zeros(3, 2), th.ones(3, 2)
    (divergence,) = _divergences([Normal(mean + 1e-4, std)], [Normal(mean, std)])
    np.testing.assert_allclose(divergence, 2 * 0.5e-8, rtol=1e-4)  # of two TRVs


def test_a_shifted_start_makes_room_for_worse_divergences_later(episodes):
    noise, both = lava_shift(noise=0.05), lava_shift(noise=0.05, start=(2.0, 1.0))
    pairs = zip(episodes.budgets(both), episodes.budgets(noise), strict=True)
    assert all(with_start.kl > both.start_kl + without.kl * 1.01 for with_start, without in pairs)


def test_the_budget_bounds_the_divergence_along_shifted_episodes(episodes):
    for shift in (lava_shift(noise=0.05), lava_shift(bias=(0.05, 0.0), start=(2.0, 1.0))):
        _, measured = episodes.measure(shift, 5000)
        budget = episodes.budgets(shift)[0]
        assert shift.start_kl < measured <= budget.kl
        assert budget.exceedance > 0


# -- certificates ---------------------------------------------------------------------------------------------------


def test_the_certificate_holds_under_random_shifts_and_says_something(episodes):
    random, bounds, costs = np.random.default_rng(1), [], []
    for i in range(40):
        noise, length, angle = 10.0 ** random.uniform(-3, 0), 10.0 ** random.uniform(-3, 0), random.uniform(0, 6.3)
        bias = (length * math.cos(angle), length * math.sin(angle))
        every = dict(noise=noise, bias=bias, start=tuple((2.0 ** random.uniform(-1, 1, 2)).tolist()))
        shift = lava_shift(**{name: every[name] for name in random.permutation(list(every))[: random.integers(1, 4)]})
        certified = episodes.certify(shift)
        assert certified.bound == min(certified.through_trvs, certified.through_sensor)
        bounds.append(certified.bound)
        costs.append(np.minimum(episodes.measure(shift, 2000, seed=i)[0], CLIPPED).mean())
    bounds, costs = np.array(bounds), np.array(costs)
    assert (costs <= bounds).all()
    assert (bounds < 0.9 * CLIPPED).sum() >= 5


def test_the_cost_of_the_worst_start_comes_near_the_bound(episodes):
    """A shift against which the bound has little slack: a test that a bound too low would fail."""
    costs = np.sort(np.minimum(episodes.costs, CLIPPED))
    rest, gaps = costs.mean(), []
    for start in ((1.0, 2.5), (2.5, 1.0), (0.4, 1.0), (1.0, 0.4)):
        shift = lava_shift(start=start)
        estimate = worst_mean(CostDistribution(costs, np.full(len(costs), 1 / len(costs))), shift.start_kl)
        cost = np.minimum(episodes.measure(shift, 20_000)[0], CLIPPED).mean()
        gaps.append((cost - rest) / (estimate - rest))
        assert cost <= episodes.certify(shift).bound
    assert 0.2 < max(gaps) <= 1.0


def test_bad_input_is_told(model):
    for wrong in (dict(confidence=1.5), dict(cost_bound=math.nan)):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))}={next(iter(wrong.values()))} must"):
            TrainingEpisodes(None, TRAINING, **{**SMALL, **wrong})  # before it looks at the model
    normalized = tiny_tdpg(VecNormalize(DummyVecEnv([LavaEnv]), norm_reward=False), n_episodes=2)
    with pytest.raises(ValueError, match="VecNormalize"):
        TrainingEpisodes(normalized, TRAINING, **SMALL)
    discrete = tiny_tdpg(ToyEnv(action_space=spaces.Discrete(2)), n_episodes=2)
    with pytest.raises(ValueError, match=r"the actions are Discrete\(2\): a certificate needs a Box"):
        TrainingEpisodes(discrete, TRAINING, **SMALL)
    with pytest.raises(ValueError, match="changes its sensor"):
        TrainingEpisodes(model, Scenario("x", "Lava-v0", sensor=lambda env: env), **SMALL)
    toy = tiny_tdpg(ToyEnv(), n_episodes=2)
    with pytest.raises(ValueError, match="CartPole-v1 is not an environment of this plugin"):
        TrainingEpisodes(toy, Scenario("x", "CartPole-v1"), **SMALL)


# -- what makes a certificate valid, number by number ------------------------------------------------------------


def test_the_divergence_of_the_sensor_counts_at_every_step(episodes):
    shift = lava_shift(bias=(0.02, 0.0), start=(2.0, 1.0))
    assert shift.sensor_kl > 0 < shift.start_kl
    expected = worst_mean(episodes.distribution, shift.start_kl + 5 * shift.sensor_kl)
    assert episodes.certify(shift).through_sensor == pytest.approx(expected)


def test_half_of_the_error_is_for_the_cost_and_half_for_all_divergences_together(model, monkeypatch):
    asked = []

    def record(values, cost_bound, confidence):
        asked.append(confidence)
        return cost_distribution(values, cost_bound, confidence)

    monkeypatch.setattr(shifts, "cost_distribution", record)
    episodes = TrainingEpisodes(model, TRAINING, **SMALL, confidence=0.9)
    assert asked == [pytest.approx(0.95)]
    asked.clear()
    episodes.budgets(lava_shift(noise=0.05))
    assert asked == [pytest.approx(1 - 0.1 / 12)] * 6  # five steps and the last action


def test_the_budget_with_the_lowest_bound_is_taken(episodes, monkeypatch):
    loose, tight = Budget(0.01, 0.5), Budget(0.02, 0.0)
    monkeypatch.setattr(TrainingEpisodes, "budgets", lambda *_: [loose, tight])
    assert episodes.certify(Shift("any")).budget == tight


def test_the_measured_divergence_adds_up_over_the_steps(episodes, monkeypatch):
    # The last action needs no step of its own: it or the last TRVs, whichever moved less.
    monkeypatch.setattr(shifts, "_divergences", lambda *_: np.array([[1.0], [10.0], [100.0], [1000.0], [7e4], [5e4]]))
    assert episodes.measure(lava_shift(bias=(0.01, 0.0)), 10)[1] == pytest.approx(51111.0)


def test_a_budget_has_the_divergence_of_every_step():
    steps = [CostDistribution(np.full(2, kl), np.array([1.0, 0.0])) for kl in (1.0, 10.0, 100.0, 1000.0, 7e4, 5e4)]
    assert _budget(steps, 0.5, 0.0).kl == pytest.approx(51111.5)
