"""How the critics are fitted: derangements, guards, episodes that are held out or have ended, saving."""

import io
import math

import numpy as np
import pytest
import torch as th
from information_problems import (
    CRITIC_FREE,
    CRITICS,
    GAINS,
    build,
    fresh_estimates,
    gaussian_batch,
    gaussian_information,
    half_dead,
    random_batch,
)
from small_problems import TINY_CRITIC, assert_same_parameters, parameters

from sb3_tdpg.information import ESTIMATORS, InformationBatch
from sb3_tdpg.information.critic import Scores
from sb3_tdpg.information.mine import Mine


def numbered(n):
    """Two steps of episodes whose states and TRVs are their number."""
    numbers = th.arange(float(n)).expand(2, n)[..., None]
    return InformationBatch(numbers, numbers, numbers, th.ones_like(numbers))


@pytest.mark.parametrize("name", [name for name in CRITICS if name != "infonce"])
@pytest.mark.parametrize("n", [10, 11])
def test_no_state_is_ever_paired_with_its_own_trvs_as_a_marginal_sample(name, n, monkeypatch):
    estimator, batch = build(name, 2, 1, 1, **TINY_CRITIC), numbered(n)
    pairs = []
    original = estimator._pair

    def spy(states, trvs, other_trvs):
        pairs.append((states, trvs, other_trvs))
        return original(states, trvs, other_trvs)

    monkeypatch.setattr(estimator, "_pair", spy)
    estimator.fit(batch)
    for _ in range(20):
        estimator(batch)
    assert len(pairs) > 20
    for states, trvs, other_trvs in pairs:
        assert (states == trvs).all()
        assert (states != other_trvs).all()
    states, _, other_trvs = pairs[-1]
    assert sorted(other_trvs[0, :, 0].tolist()) == sorted(states[0, :, 0].tolist())  # each once
    assert any(not th.equal(pairs[-1][2], pair[2]) for pair in pairs[-10:])  # and not always the same way


def test_the_first_fit_takes_the_warm_up_steps_and_the_later_ones_the_usual_number(monkeypatch):
    settings = {**TINY_CRITIC, "gradient_steps": 3, "warmup_gradient_steps": 11, "refit_below": -1e9}
    estimator, taken = Mine(4, 2, 2, **settings), []
    monkeypatch.setattr(estimator, "_ascend", lambda *args: taken.append(args[-1]))
    for _ in range(3):
        estimator.fit(random_batch())
    assert taken == [11, 3, 3]


@pytest.mark.parametrize("poison", [math.nan, math.inf, 1e6, -1e6])
@pytest.mark.parametrize("name", CRITICS)
def test_a_broken_critic_starts_anew_and_leaves_the_others_alone(name, poison):
    def fit(poisoned):
        th.manual_seed(0)
        estimator = build(name, 3, 2, 2, **{**TINY_CRITIC, "refit_gradient_steps": 50})
        batch = random_batch(horizon=3)
        estimator.fit(batch)
        if poisoned:
            with th.no_grad():
                for layer in estimator.critic.layers:
                    layer.weight[1] = poison
        th.manual_seed(1)
        return estimator, batch, estimator.fit(batch)

    sound, _, diagnostics = fit(poisoned=False)
    assert diagnostics == {"critic_refits": 0}  # nothing else, as nothing is held out
    mended, batch, diagnostics = fit(poisoned=True)
    assert diagnostics == {"critic_refits": 1}
    estimate = mended(batch)
    assert th.isfinite(estimate).all()
    assert (estimate > -0.5).all()
    assert (estimate < 4.5).all()  # ln N and a bit: there is no more to be seen in N samples
    for parameter, expected in zip(mended.critic.parameters(), sound.critic.parameters(), strict=True):
        assert th.isfinite(parameter).all()
        th.testing.assert_close(parameter[[0, 2]], expected[[0, 2]])
    # And it can be fitted on: no moment of the optimiser is left broken.
    mended.fit(batch)
    assert all(th.isfinite(parameter).all() for parameter in mended.critic.parameters())


def test_a_critic_that_the_policy_has_exploited_is_refitted():
    estimator = Mine(2, 2, 2, **{**TINY_CRITIC, "gradient_steps": 1, "refit_gradient_steps": 200, "refit_below": -0.5})
    batch = random_batch(horizon=2)
    estimator.fit(batch)
    with th.no_grad():
        estimator.critic.layers[-1].weight[0] *= 300.0  # a bound of a frozen critic has no lower limit
    assert estimator(batch)[0] < -5
    assert estimator.fit(batch)["critic_refits"] == 1
    assert estimator(batch)[0] > -0.5


def critic_gradient(estimator, joint, marginal):
    """What the gradient of the critic's outputs ascends, for the scores of one minibatch at one time step."""
    values = th.tensor([[*joint, *marginal]])[..., None]
    gradient = -estimator._objective_gradient(values, len(joint), slice(None), th.tensor([0]))[0, :, 0]
    return gradient[: len(joint)], gradient[len(joint) :]


def test_ema_decay_is_the_weight_on_the_past():
    estimator = Mine(1, 1, 1, ema_decay=0.9, **TINY_CRITIC)
    # The first value as it is; then 0.9 of the past and 0.1 of what is new.
    for mean_exp, average in ((2.0, 2.0), (12.0, 0.9 * 2.0 + 0.1 * 12.0), (5.0, 0.9 * 3.0 + 0.1 * 5.0)):
        critic_gradient(estimator, [0.0, 0.0], [math.log(mean_exp)] * 2)
        assert estimator.log_ema.exp().item() == pytest.approx(average, rel=1e-5)


def test_the_moving_average_stands_in_the_denominator_of_the_gradient():
    estimator = Mine(1, 1, 1, ema_decay=0.75, **TINY_CRITIC)
    critic_gradient(estimator, [0.0, 0.0], [math.log(2.0)] * 2)
    joint, marginal = critic_gradient(estimator, [0.3, -0.2], [0.0, 1.0])
    exp = th.tensor([0.0, 1.0]).exp()
    average = 0.75 * 2.0 + 0.25 * exp.mean()
    th.testing.assert_close(marginal, -exp / 2 / average)
    th.testing.assert_close(joint, th.full((2,), 0.5))


@pytest.mark.parametrize("ema_decay", [None, 0.0])
def test_without_memory_the_gradient_is_that_of_the_bound_itself(ema_decay):
    estimator = Mine(1, 1, 1, ema_decay=ema_decay, **TINY_CRITIC)
    critic_gradient(estimator, [0.0, 0.0], [3.0, 4.0])  # a past that must not count
    joint, marginal = critic_gradient(estimator, [0.3, -0.2], [0.0, 1.0])
    scores = Scores(th.tensor([[0.3, -0.2]], requires_grad=True), th.tensor([[[0.0], [1.0]]], requires_grad=True))
    estimator._bound(scores).sum().backward()
    th.testing.assert_close(joint, scores.joint.grad[0])
    th.testing.assert_close(marginal, scores.marginal.grad[0, :, 0])


def test_scores_that_would_overflow_still_have_a_gradient():
    for ema_decay in (None, 0.9):
        estimator = Mine(1, 1, 1, ema_decay=ema_decay, **TINY_CRITIC)
        for scale in (1.0, 1000.0):
            joint, marginal = critic_gradient(estimator, [scale, -scale], [scale, -scale])
            assert th.isfinite(joint).all()
            assert marginal[0] != 0


def test_a_fit_with_a_moving_average_finds_the_information_too():
    th.manual_seed(0)
    estimator = Mine(len(GAINS), 2, 2, ema_decay=0.99, batch_size=64, warmup_gradient_steps=1200, learning_rate=2e-3)
    estimator.fit(gaussian_batch(10_000, GAINS))
    np.testing.assert_allclose(fresh_estimates(estimator)[0], gaussian_information(GAINS), atol=0.1)


def test_standardising_makes_the_estimate_independent_of_the_states_unit():
    batch = random_batch()
    estimates = []
    for scale, shift in ((1.0, 0.0), (1e4, 7e4), (0.0, 3.0)):
        th.manual_seed(0)
        estimator = Mine(4, 2, 2, standardize=True, **TINY_CRITIC)
        moved = batch._replace(states=scale * batch.states + shift)
        estimator.fit(moved)
        estimates.append(estimator(moved))
    th.testing.assert_close(*estimates[:2], rtol=1e-2, atol=1e-3)
    assert th.isfinite(estimates[2]).all()  # of a state that is constant


@pytest.mark.parametrize("name", CRITICS)
def test_on_held_out_episodes_learning_by_heart_shows(name):
    batch = gaussian_batch(80, [[0.0, 0.0]] * 3)
    settings = dict(hidden_sizes=(64, 64), batch_size=20, learning_rate=1e-2, warmup_gradient_steps=600)
    unguarded = dict(refit_below=-math.inf, refit_above=math.inf)
    report = build(name, 3, 2, 2, **settings, **unguarded, held_out=0.5).fit(batch)
    assert report["trained_on"] > 0.1
    assert report["held_out"] < 0.05


@pytest.mark.parametrize("name", CRITICS)
def test_on_held_out_episodes_the_information_of_correlated_gaussians_is_found(name):
    batch_size = 16 if name == "infonce" else 64
    settings = dict(batch_size=batch_size, warmup_gradient_steps=1000, learning_rate=2e-3)
    report = build(name, len(GAINS), 2, 2, **settings, held_out=0.4).fit(gaussian_batch(10_000, GAINS))
    truth = gaussian_information(GAINS).sum()
    assert report["held_out"] == pytest.approx(truth, abs=0.2)
    assert report["trained_on"] == pytest.approx(report["held_out"], abs=0.2)


@pytest.mark.parametrize("name", CRITICS)
def test_the_critics_never_see_an_episode_that_is_held_out(name, monkeypatch):
    estimator = build(name, 2, 1, 1, **TINY_CRITIC, held_out=0.3, refit_above=-math.inf)  # and all are fitted again
    batch = numbered(20)
    seen, ascend = [], estimator._ascend

    def spy(critic, optimizer, batch, *args):
        assert th.equal(batch.states, batch.trvs)
        seen.append(frozenset(batch.states.unique().tolist()))
        ascend(critic, optimizer, batch, *args)

    estimated, estimate = [], estimator._estimate
    monkeypatch.setattr(estimator, "_ascend", spy)
    monkeypatch.setattr(estimator, "_estimate", lambda batch, t: (estimated.append(batch), estimate(batch, t))[1])
    for _ in range(3):
        estimator.fit(batch)
        first, again = seen[-2:]
        assert first == again
        assert len(first) == 14
        held_out = frozenset(estimated[-1].states.unique().tolist())
        assert held_out == set(range(20)) - first
    assert len(set(seen)) > 1, "the same episodes each time"


@pytest.mark.parametrize("name", CRITICS)
def test_one_episode_that_ends_early_leaves_the_estimates_of_the_others(name):
    numbers = th.randn(3, 60, 1)
    batch = InformationBatch(numbers, numbers + th.randn_like(numbers), numbers, th.ones_like(numbers))
    batch = batch._replace(alive=th.ones(3, 60, dtype=th.bool))
    batch.alive[1:, 0] = False
    estimator = build(name, 3, 1, 1, warmup_gradient_steps=50)
    estimator.fit(batch)
    assert (estimator(batch) != 0).all()
    assert (estimator(batch.select(th.arange(10)))[1:] != 0).all()  # nor those of a minibatch of the policy
    batch.alive[2, 5:] = False  # too few for a critic
    estimator.fit(batch)
    assert estimator(batch)[2] == 0


def test_steps_of_an_episode_are_held_out_together():
    estimator = build("mine", 1, 1, 1, **TINY_CRITIC, held_out=0.3)
    numbers = th.arange(40.0).view(1, 40, 1)
    batch = InformationBatch(numbers, numbers, numbers, numbers + 1, episode=th.arange(10).repeat_interleave(4)[None])
    trained_on, held_out = estimator._hold_out(batch)
    assert held_out.trvs.shape == (1, 12, 1)
    assert not set(trained_on.episode[0].tolist()) & set(held_out.episode[0].tolist())


@pytest.mark.parametrize("alive", [0, 1])
def test_with_hardly_an_episode_alive_there_is_no_information_to_report(alive):
    mask = th.zeros(4, 60, dtype=th.bool)
    mask[:, :alive] = True
    report = Mine(4, 2, 2, **TINY_CRITIC, held_out=0.4).fit(random_batch(alive=mask))
    assert report == dict(critic_refits=0.0, trained_on=0.0, held_out=0.0)


@pytest.mark.parametrize(("held_out", "n"), [(0.01, 60), (0.02, 60), (0.99, 60), (0.5, 3)])
def test_a_share_that_leaves_too_few_episodes_on_either_side_is_refused(held_out, n):
    message = rf"mi_kwargs: held_out={held_out} of {n} episodes .* at least 2; change the share, or use more episodes"
    with pytest.raises(ValueError, match=message):
        Mine(4, 2, 2, **TINY_CRITIC, held_out=held_out).fit(random_batch(n=n))


def with_garbage(batch, value):
    """Overwrite everything that belongs to dead episodes."""
    dead = ~batch.alive[..., None]
    samples = (x.masked_fill(dead, value) for x in (*batch[:4], batch.prev_trvs))
    return InformationBatch(*[next(samples) for _ in range(4)], batch.alive, next(samples))


@pytest.mark.parametrize(
    "settings", [{}, dict(standardize=True), dict(held_out=0.4)], ids=["plain", "standardized", "held_out"]
)
@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_what_stands_where_an_episode_has_ended_makes_no_difference_and_gets_no_gradient(name, settings):
    batch = random_batch(alive=half_dead())
    results, reports = [], []
    for garbage in (0.5, 1e4):
        samples = with_garbage(batch, garbage)
        th.manual_seed(0)
        estimator = build(name, 4, 2, 2, **{**TINY_CRITIC, **settings})
        for _ in range(2):
            reports.append(estimator.fit(samples))
        inputs = [x.requires_grad_() for x in samples[1:4]]
        results.append(estimator(samples))
        for gradient in th.autograd.grad(results[-1].sum(), inputs, allow_unused=True):
            if gradient is not None:
                assert gradient[~batch.alive].abs().sum() == 0 < gradient[batch.alive].abs().sum()
    assert th.isfinite(results[0]).all()
    assert results[0][3] == 0  # too few episodes
    th.testing.assert_close(results[0], results[1])
    assert np.isfinite([*reports[0].values(), *reports[1].values()]).all()
    assert reports[:2] == [pytest.approx(report) for report in reports[2:]]


@pytest.mark.parametrize("name", CRITIC_FREE)
def test_a_step_is_estimated_from_the_episodes_that_live(name):
    batch = random_batch(alive=half_dead())
    th.testing.assert_close(build(name, 4, 2, 2)(batch)[2:3], build(name, 1, 2, 2)(batch.at(2)))


@pytest.mark.parametrize("name", CRITICS)
def test_the_critics_of_steps_with_too_few_episodes_are_not_trained(name):
    estimator = build(name, 4, 2, 2, **TINY_CRITIC)
    before = [parameter.detach().clone() for parameter in estimator.critic.parameters()]
    estimator.fit(random_batch(alive=half_dead()))
    for parameter, old in zip(estimator.critic.parameters(), before, strict=True):
        th.testing.assert_close(parameter[3], old[3], rtol=0, atol=0)
    assert not th.equal(estimator.critic.layers[0].weight[0], before[0][0])


@pytest.mark.parametrize("reset_moments", [True, False])
@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_an_estimator_saved_and_loaded_goes_on_as_if_it_had_not_been(name, reset_moments):
    settings = {**TINY_CRITIC, "reset_moments": reset_moments}
    if name == "mine":
        settings["ema_decay"] = 0.9
    estimator = build(name, 4, 2, 2, **settings)
    batch = random_batch()
    estimator.fit(batch)
    file = io.BytesIO()
    th.save(estimator.state_dict(), file)
    file.seek(0)
    loaded = build(name, 4, 2, 2, **settings)
    loaded.load_state_dict(th.load(file, weights_only=True))
    results = []
    for e in (estimator, loaded):
        th.manual_seed(1)
        e.fit(batch)
        results.append((e(batch), parameters(e)))
    th.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=0)
    assert_same_parameters(results[0][1], results[1][1])


def test_a_refit_does_not_mix_with_the_moving_average_of_the_critic_before():
    estimator = Mine(3, 2, 2, ema_decay=0.99, **TINY_CRITIC)
    batch = random_batch(horizon=3)
    estimator.fit(batch)
    estimator.log_ema.fill_(50.0)
    with th.no_grad():
        estimator._refit(batch, th.tensor([1]))
    assert estimator.log_ema[1] < 5 < 50 == estimator.log_ema[0] == estimator.log_ema[2]
