"""Sound intervals pass every check, and each kind of error fails the check made for it."""

import math

import numpy as np
import pytest
import torch as th
from information_problems import channel, gaussian_batch, generator, random_batch

from sb3_tdpg.evaluation import information_interval
from sb3_tdpg.evaluation import interval as interval_module
from sb3_tdpg.evaluation.trust_badge import TrustBadge, TrustCheck, _encoder_density, trust_checks
from sb3_tdpg.information.base import InformationBatch


def test_a_sound_batch_passes_every_check():
    badge = trust_checks(gaussian_batch(200, [[0.5, 0.5], [1.0, 2.0]], generator=generator()))
    assert badge.passed
    assert badge.capped_steps == ()
    assert [check.name for check in badge.checks] == ["shuffled pairs", "data processing", "encoder density"]
    assert str(badge) == "trusted: shuffled pairs ok, data processing ok, encoder density ok"
    assert badge.markdown().count("| ok |") == 3


def test_trvs_without_noise_fail_the_check_of_the_density():
    batch = gaussian_batch(100, [[1.0, 1.0]], generator=generator())
    badge = trust_checks(batch._replace(trvs=batch.means))
    assert not badge.passed
    assert "encoder density FAILED" in str(badge)


def test_few_episodes_of_sound_noise_raise_no_false_alarm():
    rng = np.random.default_rng(0)
    alarms = 0
    for _ in range(100):
        noise = th.as_tensor(rng.standard_normal((100, 20, 1)), dtype=th.float32)
        means, stds = th.zeros_like(noise), th.ones_like(noise)
        batch = InformationBatch(means, noise, means, stds, None)
        alarms += not _encoder_density(batch, np.arange(100), 0.01 / 200).passed
    assert alarms <= 5  # 1 is expected; with a Gaussian quantile 10


def test_a_lower_bound_that_finds_information_where_there_is_none_fails(monkeypatch):
    batch = gaussian_batch(100, [[1.0, 1.0]], generator=generator())
    assert trust_checks(batch).passed
    bounds = interval_module.critic_bounds

    def too_high(step, rng):
        lower, upper = bounds(step, rng)
        return lower._replace(value=lower.value + 1), upper

    monkeypatch.setattr(interval_module, "critic_bounds", too_high)
    assert "shuffled pairs FAILED" in str(trust_checks(batch))


def test_a_noisier_copy_that_knows_more_fails(monkeypatch):
    batch = gaussian_batch(300, [[1.0, 1.0]], generator=generator())
    bounds = interval_module.critic_bounds

    def upside_down(step, rng):
        lower, upper = bounds(step, rng)
        return lower._replace(value=lower.value * step.stds.mean() ** 4), upper

    monkeypatch.setattr(interval_module, "critic_bounds", upside_down)
    assert "data processing FAILED" in str(trust_checks(batch))


def test_noise_that_depends_on_the_state_raises_no_false_alarm():
    """TRVs that are N(0, 1.01) whatever the state: with the encoder's noise doubled, they would tell its sign."""
    rng = np.random.default_rng(0)
    states = rng.standard_normal((1, 400, 1))
    is_wide, means = states > 0, rng.standard_normal(states.shape)
    batch = channel(states, np.where(is_wide, 0.0, means), np.where(is_wide, math.sqrt(1.01), 0.1), rng)
    # What stands where an episode has ended may be anything.
    alive = th.arange(400)[None] < 300
    dead = {k: getattr(batch, k).masked_fill(~alive[..., None], math.nan) for k in ("states", "trvs", "means", "stds")}
    assert trust_checks(batch._replace(**dead, alive=alive)).passed


def test_a_critic_that_finds_nothing_raises_no_false_alarm():
    """Of two modes for one half of the states, and none for the other: worse than nothing for a critic of Gaussians."""
    rng = np.random.default_rng(0)
    states = rng.standard_normal((1, 300, 1))
    is_wide, sign = states > 0, rng.choice([-2.0, 2.0], states.shape)
    batch = channel(states, np.where(is_wide, 0.0, sign), np.where(is_wide, math.hypot(2, 0.4), 0.4), rng)
    assert information_interval(batch).estimates["critic"] < -0.1
    assert trust_checks(batch).passed


def test_an_estimate_at_the_cap_warns():
    badge = trust_checks(gaussian_batch(100, [[0.1, 0.1], [100.0, 100.0]], generator=generator()))
    assert badge.capped_steps == (1,)
    assert badge.passed
    assert "warning: at the ln N cap at t = 1" in str(badge)
    assert "Warning: at the ln N cap at t = 1" in badge.markdown()


def test_a_value_that_is_no_number_is_no_pass():
    assert not TrustBadge((TrustCheck("any", math.nan, 1.0, ""),), ()).passed


def test_nothing_to_be_checked_is_an_error():
    with pytest.raises(ValueError, match="no time step has an interval to check: at most 10 episodes"):
        trust_checks(random_batch(n=10))


def test_many_capped_steps_are_told_as_runs():
    badge = TrustBadge((), (0, 1, 2, 5, 8, 9))
    assert "at t = 0 to 2, 5, 8 to 9:" in str(badge)
