"""Declared shifts: what they move in the TRVs, and certificates on the lava problem against what episodes cost."""

import json
import math

import numpy as np
import pandas as pd
import pytest
import torch as th
from gymnasium import spaces
from scipy.integrate import quad
from scipy.stats import beta as beta_distribution
from small_problems import ToyEnv, tiny_tdpg, train_epochs
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch.distributions import Normal, kl_divergence

from sb3_tdpg.certificates import shifts
from sb3_tdpg.certificates.certificate import cost_distribution, worst_mean
from sb3_tdpg.certificates.models import load_models
from sb3_tdpg.certificates.shifts import (
    Budget,
    Shift,
    TrainingEpisodes,
    _budget,
    _divergences,
    beta_kl,
    encode,
    gaussian_kl,
    lava_shift,
    random_lava_shifts,
)
from sb3_tdpg.cli import main
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.envs.scenarios import LAVA_TABLE_READING, Scenario
from sb3_tdpg.evaluation.information import information_bounds, rollout_information
from sb3_tdpg.experiments.runs import Run, complete_run
from sb3_tdpg.tdpg import TDPG

TRAINING = Scenario("Training", "Lava-v0")
CLIPPED = 315.0  # standing at the wall
SMALL = dict(cost_bound=CLIPPED, n_episodes=20_000, n_budget_episodes=2000)


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


@pytest.mark.parametrize("reading", [{}, LAVA_TABLE_READING], ids=["text", "table"])
def test_no_episode_costs_more_than_the_bound_and_some_come_near(reading):
    env = LavaEnv(max_action=3.0, **reading)
    env.reset(seed=0)
    random = np.random.default_rng(0)
    state, costs = env.initial_state(200_000), np.zeros(200_000)
    for t in range(env.horizon):
        step = env.step_batch(state, random.choice([-3.0, 0.0, 3.0], (200_000, 1)), is_last=t == env.horizon - 1)
        state, costs = step.state, costs + step.cost
    assert 0.5 * env.cost_bound < costs.max() <= env.cost_bound


# -- divergences ----------------------------------------------------------------------------------------------------


def test_divergences_in_closed_form():
    expected = kl_divergence(Normal(th.tensor([0.1, -0.3]), 0.5), Normal(th.zeros(2), 0.2)).sum()
    assert gaussian_kl(np.array([0.1, -0.3]), 0.5, 0.2) == pytest.approx(expected.item(), rel=1e-5)
    assert gaussian_kl(np.zeros(2), 0.2, 0.2) == 0
    assert gaussian_kl(np.zeros(2), 0.0, 0.2) == math.inf
    for a, b in ((2.0, 0.7), (1.0, 1.0), (0.5, 0.5)):
        density = beta_distribution(a, b).pdf
        expected, _ = quad(lambda x, f=density: f(x) * math.log(f(x)), 0, 1)
        assert beta_kl(a, b) == pytest.approx(expected, abs=1e-4)


def test_random_shifts_depend_on_the_seed_alone_and_change_something():
    shifts = random_lava_shifts(200, seed=3)
    assert shifts == random_lava_shifts(200, seed=3)
    assert shifts != random_lava_shifts(200, seed=4)
    assert all(shift.env_kwargs and np.isfinite(shift.start_kl + shift.sensor_kl) for shift in shifts)
    assert {len(shift.env_kwargs) for shift in shifts} == {1, 2, 3}


def test_no_shift_has_no_divergence_and_more_noise_more(episodes):
    means = [episodes.divergences(lava_shift("", sensor_noise_std=std)).mean() for std in (0.01, 0.011, 0.03, 0.1)]
    assert means[0] == pytest.approx(0, abs=1e-12)  # rounding
    assert (np.diff(means) > 0).all()


def test_the_divergence_of_the_trvs_is_at_most_that_of_the_sensor(episodes):
    """Data processing; the coupling only makes the mean an upper bound, so the shift is taken large."""
    shift = lava_shift("", sensor_noise_std=0.3)
    assert episodes.divergences(shift).mean(axis=1).max() < shift.sensor_kl


def test_what_the_encoder_does_not_see_does_not_move_it(model):
    blind = tiny_tdpg()
    blind.policy.load_state_dict(model.policy.state_dict())
    with th.no_grad():
        blind.policy.encoder.mlp.layers[0].weight[:, model.policy.trv_dim :] = 0
    episodes = TrainingEpisodes(blind, TRAINING, **SMALL)
    certified = episodes.certify(lava_shift("", sensor_noise_std=5.0, sensor_bias=(3.0, 3.0)))
    assert certified.budget.kl == 0
    assert certified.through_trvs < certified.through_sensor == CLIPPED
    at_rest = episodes.certify(Shift("nothing")).through_trvs
    assert certified.bound == at_rest
    # What a sample cannot exclude costs something even so.
    assert at_rest > worst_mean(episodes.distribution, 0.0).bound


def test_the_divergence_is_that_of_the_shifted_density_from_the_other(model, episodes):
    shift = lava_shift("", sensor_noise_std=0.2)
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
    noise = lava_shift("", sensor_noise_std=0.05)
    both = lava_shift("", sensor_noise_std=0.05, start_beta=(2.0, 1.0))
    pairs = zip(episodes.budgets(both), episodes.budgets(noise), strict=True)
    assert all(with_start.kl > both.start_kl + without.kl * 1.01 for with_start, without in pairs)


def test_the_budget_bounds_the_divergence_along_shifted_episodes(episodes):
    for shift in (lava_shift("", sensor_noise_std=0.05), lava_shift("", sensor_bias=(0.05, 0.0), start_beta=(2, 1))):
        _, measured = episodes.measure(shift, 5000)
        in_full = episodes.budgets(shift)[0]
        assert measured <= in_full.kl
        without_allowance = episodes.allowing(None).budgets(shift)[0]
        assert shift.start_kl < without_allowance.kl < in_full.kl
        assert without_allowance.exceedance == pytest.approx(0, abs=1e-9) and in_full.exceedance > 0


# -- certificates ---------------------------------------------------------------------------------------------------


def test_the_certificate_holds_under_random_shifts_and_says_something(episodes):
    bounds, costs = [], []
    for i, shift in enumerate(random_lava_shifts(40, seed=1)):
        certified = episodes.certify(shift)
        assert certified.bound == min(certified.through_trvs, certified.through_sensor, certified.trivial)
        bounds.append(certified.bound)
        costs.append(np.minimum(episodes.measure(shift, 500, seed=i)[0], CLIPPED).mean())
    bounds, costs = np.array(bounds), np.array(costs)
    assert (costs <= bounds).all()
    assert (bounds < 0.9 * CLIPPED).sum() >= 5


def test_the_cost_of_the_worst_start_comes_near_the_bound(episodes):
    """A shift against which the bound has little slack: a test that a bound too low would fail."""
    gaps = []
    for start in ((1.0, 2.5), (2.5, 1.0), (0.4, 1.0), (1.0, 0.4)):
        shift = lava_shift("", start_beta=start)
        without_allowance = episodes.allowing(None).certify(shift).through_sensor
        cost = np.minimum(episodes.measure(shift, 20_000)[0], CLIPPED).mean()
        rest = np.minimum(episodes.costs, CLIPPED).mean()
        gaps.append((cost - rest) / (without_allowance - rest))
        assert cost <= episodes.certify(shift).bound
    assert 0.2 < max(gaps) <= 1.0


def test_the_theorem_with_its_own_beta_is_never_better_than_the_best_beta(episodes):
    fixed = episodes.fixed_beta(0.02, information=5.0)
    assert fixed.kl == pytest.approx(0.1)
    assert fixed.bound == pytest.approx(fixed.risk + 5.0)
    best = min(episodes.fixed_beta(b, 0.1 / b).bound for b in np.geomspace(1e-4, 1, 30))
    assert best <= fixed.bound


def test_the_information_is_that_of_the_log_det_bound(model, episodes):
    bounds = information_bounds(rollout_information(model, TRAINING, 4000))
    assert episodes.information == pytest.approx(bounds.upper, rel=0.05)


def test_bad_input_is_told(model):
    with pytest.raises(ValueError, match="n_budget_episodes=50 must be at least 1 and at most n_episodes=20"):
        TrainingEpisodes(model, TRAINING, cost_bound=1.0, n_episodes=20, n_budget_episodes=50)
    assert np.isfinite(TrainingEpisodes(model, TRAINING, cost_bound=1.0, n_episodes=4, n_budget_episodes=4).information)
    with pytest.raises(ValueError, match="n_episodes=2 must be at least 4, to estimate the information of 2 TRVs"):
        TrainingEpisodes(model, TRAINING, cost_bound=1.0, n_episodes=2, n_budget_episodes=1)
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


# -- the command ----------------------------------------------------------------------------------------------------


def test_certify_on_the_command_line(model, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    model.save(tmp_path / "model.zip")
    out = tmp_path / "out"
    arguments = ["certify", str(tmp_path / "model.zip"), "--env", "Lava-v0", "--n-episodes", "3000", "--out", str(out)]
    assert main([*arguments, "--random-shifts", "3", "--n-test-episodes", "50"]) == 0
    assert "## Random shifts" in capsys.readouterr().out
    paper, random = pd.read_csv(out / "paper.csv"), pd.read_csv(out / "random.csv")
    assert (len(paper), len(random)) == (5, 3)
    assert (random["clipped_cost"] <= random["bound"] + 3 * random["standard_error"]).all()
    assert (paper["estimate"] <= paper["bound"]).all() and (paper["bound"] <= paper["unclipped_bound"]).all()
    config = json.loads((out / "config.json").read_text())
    assert (config["cost_bound"], config["n_random_shifts"]) == (CLIPPED, 3)
    assert (out / "certificate.png").stat().st_size > 0
    assert "Made by" in (out / "summary.md").read_text()


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["nothing.zip"], "nothing.zip cannot be read"),
        (["nothing.zip", "--env", "sb3_tdpg:Lava-v0"], "nothing.zip cannot be read"),
        (["nothing.zip", "--env", "BallCatch-v0"], "certify has declared shifts for Lava-v0 only"),
        (["model.zip", "model.zip"], "model.zip is given twice"),
        (["model.zip", "--seed", "-1"], "seed=-1 must be at least 0"),
        (["model.zip", "--n-test-episodes", "1"], "n_test_episodes=1 must be at least 2"),
        (["model.zip", "--confidence", "1.5"], "confidence=1.5 must lie between 0 and 1"),
        (["model.zip", "--cost-bound", "nan"], "cost_bound=nan must be finite"),
        (["model.zip", "--cost-bound", "-1"], "cost_bound=-1.0 must be finite and above 0"),
        # The shifts' divergences are from a uniform start and no bias.
        (["model.zip", "--env-kwargs", "start_beta=[2,2]"], "leave start_beta out"),
        (["model.zip", "--env-kwargs", "sensor_bias=[1,0]"], "leave sensor_bias out"),
        (["model.zip", "--out", "model.zip"], "File exists"),
    ],
)
def test_bad_input_to_the_command_is_told_in_a_line(arguments, message, model, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sb3_tdpg.certificates.shifts.record_episodes", None)  # by then, nothing has been run
    model.save("model.zip")
    assert main(["certify", "--env", "Lava-v0", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line


def test_a_model_of_normalised_observations_is_refused(tmp_path):
    env = VecNormalize(DummyVecEnv([LavaEnv]), norm_reward=False)
    tiny_tdpg(env, n_episodes=2).save(tmp_path / "model.zip")
    env.save(tmp_path / "vecnormalize.pkl")
    with pytest.raises(ValueError, match="acts on normalised observations"):
        load_models([tmp_path / "model.zip"], TRAINING)


def test_models_from_folders_of_one_name_are_all_certified(tmp_path):
    paths = [tmp_path / name / "model.zip" for name in ("a", "b", "c/a")]
    for path in paths:
        path.parent.mkdir(parents=True)
        tiny_tdpg().save(path)
    assert list(load_models(paths, TRAINING)) == ["TDPG", "TDPG (b/model)", "TDPG (a/model)"]
    beside = tmp_path / "d" / "a" / "model.zip"
    beside.parent.mkdir(parents=True)
    tiny_tdpg().save(beside)
    assert list(load_models([*paths, beside], TRAINING))[3] == f"TDPG ({beside})"


@pytest.mark.slow
def test_the_certificates_hold_in_a_thousand_random_shifts_and_the_bottleneck_makes_them_tight(tmp_path):
    medians = {}
    for block in ("Lava-v0-pg", "Lava-v0-logdet"):
        complete_run(Run(block, "Lava-v0", block, 0), tmp_path / block, [TRAINING], n_eval_episodes=100)
        trained = TDPG.load(tmp_path / block / "model.zip", device="cpu")
        episodes = TrainingEpisodes(trained, TRAINING, cost_bound=CLIPPED, n_episodes=200_000, n_budget_episodes=5_000)
        shifts = random_lava_shifts(1000)
        bounds = np.array([episodes.certify(shift).bound for shift in shifts])
        costs = np.array([episodes.measure(shift, 500, seed=i)[0].mean() for i, shift in enumerate(shifts)])
        # Where next to nothing is shifted, the bound is within the sampling error of 500 episodes: look again.
        for i in np.flatnonzero(costs > bounds):
            costs[i] = episodes.measure(shifts[i], 50_000, seed=1000 + int(i))[0].mean()
        assert (costs <= bounds).all()
        medians[block] = np.median(bounds)
    assert medians["Lava-v0-logdet"] < 0.3 * medians["Lava-v0-pg"]


# -- what makes a certificate valid, number by number ------------------------------------------------------------


def test_the_divergence_of_the_sensor_counts_at_every_step(episodes):
    shift = lava_shift("", sensor_bias=(0.02, 0.0), start_beta=(2.0, 1.0))
    assert shift.sensor_kl > 0 < shift.start_kl
    assert episodes.certify(shift).sensor_kl == pytest.approx(shift.start_kl + 5 * shift.sensor_kl)


def test_half_of_the_error_is_for_the_cost_and_half_for_all_divergences_together(episodes, monkeypatch):
    asked = []

    def record(values, cost_bound, confidence):
        asked.append(confidence)
        return cost_distribution(values, cost_bound, confidence)

    monkeypatch.setattr(shifts, "cost_distribution", record)
    allowed = episodes.allowing(0.9)
    assert asked == [pytest.approx(0.95)]
    asked.clear()
    allowed.budgets(lava_shift("", sensor_noise_std=0.05))
    assert asked == [pytest.approx(1 - 0.1 / 12)] * 6  # five steps and the last action


def test_the_cost_bound_has_a_stage_cost_for_every_control():
    one, two = LavaEnv(horizon=1, max_action=3.0, action_cost=2.0), LavaEnv(horizon=2, max_action=3.0, action_cost=2.0)
    farthest = math.hypot(3.0, 5.0 + 3.0)
    assert one.cost_bound == pytest.approx(farthest + 2.0 * 3.0 + 100 * farthest)
    assert two.cost_bound - one.cost_bound == pytest.approx(farthest + 2.0 * 3.0)


def test_a_bound_below_a_cost_in_training_is_refused(model, tmp_path, capsys):
    model.save(tmp_path / "model.zip")
    arguments = ["certify", str(tmp_path / "model.zip"), "--env", "Lava-v0", "--n-episodes", "3000"]
    assert main([*arguments, "--cost-bound", "1", "--out", str(tmp_path / "out")]) == 2
    assert "is below a cost of" in capsys.readouterr().err


def test_the_budget_with_the_lowest_bound_is_taken(episodes, monkeypatch):
    loose, tight = Budget(0.01, 0.5), Budget(0.02, 0.0)
    monkeypatch.setattr(TrainingEpisodes, "budgets", lambda *_: [loose, tight])
    assert episodes.certify(Shift("any")).budget == tight


def test_the_measured_divergence_adds_up_over_the_steps(episodes, monkeypatch):
    # The last action needs no step of its own: it or the last TRVs, whichever moved less.
    monkeypatch.setattr(shifts, "_divergences", lambda *_: np.array([[1.0], [10.0], [100.0], [1000.0], [7e4], [5e4]]))
    shift = lava_shift("any", sensor_bias=(0.01, 0.0))
    assert shift.name == "any"
    assert episodes.measure(shift, 10)[1] == pytest.approx(51111.0)


def test_a_budget_has_the_divergence_of_every_step():
    steps = [cost_distribution(np.full(50, kl), confidence=None) for kl in (1.0, 10.0, 100.0, 1000.0, 7e4, 5e4)]
    assert _budget(steps, 0.5, 0.0).kl == pytest.approx(51111.5)
