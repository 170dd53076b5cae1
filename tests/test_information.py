"""Every estimator against Gaussians whose mutual information is known. Runs over the registry of estimators."""

import io
import math

import numpy as np
import pytest
import torch as th
from small_problems import TINY_CRITIC, assert_same_parameters, parameters

from sb3_tdpg.information import (
    ESTIMATORS,
    CriticEstimator,
    InformationBatch,
    InformationEstimator,
    LeaveOneOut,
    LogDet,
    Mine,
    get_estimator_class,
)
from sb3_tdpg.information.critic import Scores

CRITICS = sorted(name for name, cls in ESTIMATORS.items() if issubclass(cls, CriticEstimator))
CRITIC_FREE = sorted(set(ESTIMATORS) - set(CRITICS))
UPPER = sorted(name for name, cls in ESTIMATORS.items() if cls.bound == "upper")
LOWER = sorted(name for name, cls in ESTIMATORS.items() if cls.bound == "lower")

# One time step for each: gains a of ``trv = a * state + noise`` in each of two dimensions.
GAINS = ((0.0, 0.0), (0.8, 0.0), (1.0, 1.0))


def gaussian_batch(n, gains, noise_std=1.0, generator=None):
    """Samples whose information is ``sum log(1 + (a / noise_std)^2) / 2`` nats: one time step per row of gains."""
    gains = th.as_tensor(gains)[:, None, :]  # (T, 1, Z)
    states = th.randn(gains.shape[0], n, gains.shape[2], generator=generator)
    means = gains * states
    stds = th.full_like(means, noise_std)
    return InformationBatch(states, means + stds * th.randn(means.shape, generator=generator), means, stds)


def gaussian_information(gains, noise_std=1.0):
    return 0.5 * np.log1p(np.square(np.asarray(gains) / noise_std)).sum(axis=1)


def build(name, horizon, state_dim, trv_dim, **kwargs):
    kwargs = kwargs if name in CRITICS else {}
    return ESTIMATORS[name](horizon, state_dim, trv_dim, **kwargs)


def random_batch(horizon=4, n=60, alive=None):
    states, means = th.randn(horizon, n, 2), th.randn(horizon, n, 2)
    stds = 0.5 + th.rand(horizon, n, 2)
    return InformationBatch(states, means + stds * th.randn_like(means), means, stds, alive)


@pytest.fixture(scope="module")
def fitted():
    """Each critic, fitted once to many samples of GAINS."""
    estimators = {}
    for name in CRITICS:
        th.manual_seed(0)
        # InfoNCE scores every pair of a minibatch.
        batch_size = 16 if name == "infonce" else 64
        settings = dict(batch_size=batch_size, warmup_gradient_steps=1000, learning_rate=2e-3)
        estimators[name] = build(name, len(GAINS), 2, 2, **settings)
        estimators[name].fit(gaussian_batch(10_000, GAINS))
    return estimators


def fresh_estimates(estimator, n_batches=20, n=1000):
    """Estimates on samples that the critic has not seen: mean and standard error for each time step."""
    with th.no_grad():
        values = np.stack([estimator(gaussian_batch(n, GAINS)).numpy() for _ in range(n_batches)])
    return values.mean(0), values.std(0, ddof=1) / math.sqrt(n_batches)


# -- known answers --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", CRITICS)
def test_a_fitted_critic_finds_the_information_of_correlated_gaussians(name, fitted):
    mean, _ = fresh_estimates(fitted[name])
    np.testing.assert_allclose(mean, gaussian_information(GAINS), atol=0.1)


@pytest.mark.parametrize("name", CRITIC_FREE)
def test_a_critic_free_bound_finds_the_information_of_correlated_gaussians(name):
    mean, _ = fresh_estimates(build(name, len(GAINS), 2, 2), n_batches=5)
    np.testing.assert_allclose(mean, gaussian_information(GAINS), atol=0.03)


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_independent_variables_have_no_information(name, fitted):
    estimator = fitted[name] if name in CRITICS else build(name, len(GAINS), 2, 2)
    mean, _ = fresh_estimates(estimator)
    assert abs(mean[0]) < 0.03


@pytest.mark.parametrize("name", sorted(set(LOWER) & set(CRITICS)))
def test_a_lower_bound_on_fresh_samples_is_not_above_the_truth(name, fitted):
    mean, error = fresh_estimates(fitted[name], n_batches=40)
    assert (mean - 3 * error <= gaussian_information(GAINS)).all(), (mean, error)


@pytest.mark.parametrize("name", UPPER)
@pytest.mark.parametrize("dim", [1, 2, 4])
@pytest.mark.parametrize("gain", [0.3, 1.0, 3.0])
def test_an_upper_bound_is_not_below_the_truth(name, dim, gain):
    gains = [[gain] * dim]
    values = []
    for seed in range(30):
        batch = gaussian_batch(400, gains, generator=th.Generator().manual_seed(seed))
        values.append(build(name, 1, dim, dim)(batch).item())
    error = np.std(values, ddof=1) / math.sqrt(len(values))
    assert np.mean(values) >= gaussian_information(gains)[0] - 3 * error


@pytest.mark.parametrize("name", UPPER)
def test_an_upper_bound_holds_where_the_encoder_sees_a_noisy_observation_only(name):
    # I[x; x~] < I[y; x~], and the bound is on the latter.
    state = th.randn(1, 4000, 1)
    means = 2 * (state + th.randn_like(state))
    stds = th.ones_like(means)
    bound = build(name, 1, 1, 1)(InformationBatch(state, means + th.randn_like(means), means, stds)).item()
    about_state, about_observation = (0.5 * math.log(r) for r in (9 / 5, 9.0))
    assert bound > about_state
    assert bound == pytest.approx(about_observation, abs=0.06)


@pytest.mark.parametrize("dim", [1, 2, 8])
def test_logdet_is_exact_for_gaussians_up_to_its_small_bias(dim):
    gains = [[1.0] * dim, [5.0] * dim]
    estimate = LogDet(2, dim, dim)(gaussian_batch(50_000, gains)).numpy()
    np.testing.assert_allclose(estimate, gaussian_information(gains), rtol=0.01)


def test_logdet_is_half_the_log_determinant_of_the_total_covariance_less_the_mean_log_std():
    batch = random_batch(horizon=2, n=30)
    means, stds = batch.means.double().numpy(), batch.stds.double().numpy()
    for t, estimate in enumerate(LogDet(2, 2, 2)(batch).tolist()):
        covariance = np.cov(means[t].T) + np.diag((stds[t] ** 2).mean(0))
        expected = 0.5 * np.linalg.slogdet(covariance)[1] - np.log(stds[t]).sum(1).mean()
        assert estimate == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_logdet_does_not_depend_on_the_unit_of_the_trvs(scale):
    batch = random_batch()
    scaled = batch._replace(trvs=scale * batch.trvs, means=scale * batch.means, stds=scale * batch.stds)
    th.testing.assert_close(LogDet(4, 2, 2)(scaled), LogDet(4, 2, 2)(batch), rtol=1e-3, atol=1e-4)


def test_leave_one_out_equals_its_definition_summed_by_hand():
    batch = random_batch(horizon=2, n=7)
    trvs, means, stds = (x.double() for x in (batch.trvs, batch.means, batch.stds))
    for t, estimate in enumerate(LeaveOneOut(2, 2, 2)(batch).tolist()):
        terms = []
        for i in range(7):
            density = th.distributions.Normal(means[t], stds[t]).log_prob(trvs[t, i]).sum(-1).exp()  # of each j
            others = th.cat([density[:i], density[i + 1 :]]).mean()
            terms.append((density[i] / others).log().item())
        assert estimate == pytest.approx(np.mean(terms), rel=1e-4)


def test_leave_one_out_keeps_its_digits_far_from_the_origin():
    batch = random_batch()
    shifted = batch._replace(trvs=batch.trvs + 1000, means=batch.means + 1000)
    th.testing.assert_close(LeaveOneOut(4, 2, 2)(shifted), LeaveOneOut(4, 2, 2)(batch), rtol=1e-2, atol=1e-2)


def test_with_several_modes_leave_one_out_is_tight_and_logdet_loose():
    modes = 10.0 * th.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    states = modes[th.randint(4, (2000,))][None]
    stds = th.ones_like(states)
    batch = InformationBatch(states, states + th.randn_like(states), states, stds)
    assert LeaveOneOut(1, 2, 2)(batch).item() == pytest.approx(math.log(4), abs=0.02)
    assert LogDet(1, 2, 2)(batch).item() > 3


def test_infonce_never_exceeds_the_logarithm_of_its_minibatch():
    th.manual_seed(0)
    estimator = build("infonce", 1, 1, 1, batch_size=8, warmup_gradient_steps=600, learning_rate=5e-3)
    batch = gaussian_batch(1000, [[1.0]], noise_std=0.01)  # 4.6 nats
    estimator.fit(batch)
    assert 1.2 < estimator(batch).item() <= math.log(8)


def test_smile_clips_the_scores_of_the_marginal_samples_and_no_others():
    estimator = build("smile", 1, 1, 1, clip=2.0, **TINY_CRITIC)
    scores = Scores(th.tensor([[7.0, -7.0, 9.0]]), th.tensor([[[5.0], [-5.0], [1.0]]]))
    expected = 3.0 - math.log((math.exp(2) + math.exp(-2) + math.exp(1)) / 3)
    assert estimator._bound(scores).item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("alive", [False, True], ids=["all_alive", "some_dead"])
@pytest.mark.parametrize("name", CRITICS)
def test_the_critics_gradient_by_hand_is_that_of_autograd(name, alive):
    class SameELU(th.nn.ELU):
        """Not nn.ELU itself, so that the short cut for it is not taken."""

    batch = random_batch(alive=half_dead() if alive else None)
    fitted = []
    for activation_fn in (th.nn.ELU, SameELU):
        th.manual_seed(0)
        estimator = build(name, 4, 2, 2, **{**TINY_CRITIC, "hidden_sizes": (8, 6)}, activation_fn=activation_fn)
        estimator.fit(batch)
        fitted.append(parameters(estimator.critic))
    for key, value in fitted[0].items():
        if (name, key) != ("infonce", "layers.2.bias"):  # a constant that cancels: Adam makes steps of rounding errors
            th.testing.assert_close(value, fitted[1][key], rtol=1e-4, atol=1e-5)


# -- gradients ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_the_gradient_of_the_estimate_is_that_of_finite_differences(name):
    estimator = build(name, 2, 2, 2, **TINY_CRITIC).double()
    batch = random_batch(horizon=2, n=10)
    inputs = [x.double().requires_grad_() for x in (batch.trvs, batch.means, batch.stds)]

    def estimate(trvs, means, stds):
        th.manual_seed(1)  # the same derangement each time
        # Times zero: finite differences must exist for an estimator that does not use an input.
        return estimator(InformationBatch(batch.states.double(), trvs, means, stds)) + 0 * (trvs + means + stds).sum()

    assert th.autograd.gradcheck(estimate, inputs)


@pytest.mark.parametrize(("name", "reached"), [
    *((name, {"trvs"}) for name in CRITICS),
    ("logdet", {"means", "stds"}),
    ("loo", {"trvs", "means", "stds"}),
])  # fmt: skip
def test_the_gradient_reaches_the_encoder_through_what_the_estimate_depends_on(name, reached):
    batch = random_batch()
    inputs = {key: getattr(batch, key).requires_grad_() for key in ("trvs", "means", "stds")}
    build(name, 4, 2, 2, **TINY_CRITIC)(batch).sum().backward()
    assert {key for key, x in inputs.items() if x.grad is not None and x.grad.abs().sum() > 0} == reached


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_fitting_leaves_no_gradient_in_the_policys_samples(name):
    batch = random_batch()
    trvs = batch.trvs.requires_grad_()
    build(name, 4, 2, 2, **TINY_CRITIC).fit(batch)
    assert trvs.grad is None


# -- critics: derangements, warm-up, guards, moving average ---------------------------------------------------


@pytest.mark.parametrize("name", [name for name in CRITICS if name != "infonce"])
@pytest.mark.parametrize("n", [10, 11])
def test_no_state_is_ever_paired_with_its_own_trvs_as_a_marginal_sample(name, n, monkeypatch):
    estimator = build(name, 2, 1, 1, **TINY_CRITIC)
    numbers = th.arange(float(n)).expand(2, n)[..., None]  # states and TRVs carry the episode's number
    batch = InformationBatch(numbers, numbers, numbers, th.ones_like(numbers))
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


@pytest.mark.parametrize("name", CRITICS)
def test_the_first_fit_takes_the_warm_up_steps_and_the_later_ones_the_usual_number(name, monkeypatch):
    estimator = build(
        name, 4, 2, 2, **{**TINY_CRITIC, "gradient_steps": 3, "warmup_gradient_steps": 11, "refit_below": -1e9}
    )
    taken = []
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
    assert diagnostics["critic_refits"] == 0
    mended, batch, diagnostics = fit(poisoned=True)
    assert diagnostics["critic_refits"] == 1
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


def test_a_refitted_critic_forgets_its_moving_average():
    estimator = Mine(3, 2, 2, ema_decay=0.9, **{**TINY_CRITIC, "refit_gradient_steps": 0})
    batch = random_batch(horizon=3)
    estimator.fit(batch)
    assert th.isfinite(estimator.log_ema).all()
    with th.no_grad():
        estimator.critic.layers[0].weight[1] = math.nan
    estimator.fit(batch)
    assert th.isnan(estimator.log_ema).tolist() == [False, True, False]


def test_a_fit_with_a_moving_average_finds_the_information_too():
    th.manual_seed(0)
    estimator = Mine(len(GAINS), 2, 2, ema_decay=0.99, batch_size=64, warmup_gradient_steps=1200, learning_rate=2e-3)
    estimator.fit(gaussian_batch(10_000, GAINS))
    np.testing.assert_allclose(fresh_estimates(estimator)[0], gaussian_information(GAINS), atol=0.1)


def test_standardising_makes_the_estimate_independent_of_the_states_unit():
    batch = random_batch()
    estimates = []
    for scale, shift in ((1.0, 0.0), (1e4, 7e4)):
        th.manual_seed(0)
        estimator = Mine(4, 2, 2, standardize=True, **TINY_CRITIC)
        moved = batch._replace(states=scale * batch.states + shift)
        estimator.fit(moved)
        estimates.append(estimator(moved))
    th.testing.assert_close(*estimates, rtol=1e-2, atol=1e-3)


def test_a_component_of_the_state_that_is_constant_does_no_harm_when_standardised():
    batch = random_batch()
    batch.states[..., 1] = 3.0
    estimator = Mine(4, 2, 2, standardize=True, **TINY_CRITIC)
    estimator.fit(batch)
    assert th.isfinite(estimator(batch)).all()


# -- episodes that are held out -------------------------------------------------------------------------------


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
    numbers = th.arange(20.0).expand(2, 20)[..., None]  # states and TRVs carry the episode's number
    batch = InformationBatch(numbers, numbers, numbers, th.ones_like(numbers))
    seen, ascend = [], estimator._ascend

    def spy(critic, optimizer, states, trvs, *args):
        assert th.equal(states, trvs)
        seen.append(frozenset(states.unique().tolist()))
        ascend(critic, optimizer, states, trvs, *args)

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
def test_holding_out_nothing_reports_nothing_and_draws_no_number(name):
    results = []
    for settings in ({}, dict(held_out=0.0)):
        th.manual_seed(0)
        estimator = build(name, 4, 2, 2, **TINY_CRITIC, **settings)
        assert set(estimator.fit(random_batch())) == {"critic_refits"}
        results.append((parameters(estimator), th.rand(3)))
    assert_same_parameters(results[0][0], results[1][0])
    assert th.equal(results[0][1], results[1][1])


@pytest.mark.parametrize("name", CRITICS)
def test_dead_episodes_count_neither_as_held_out_nor_as_trained_on(name):
    batch = random_batch(alive=half_dead())
    reports = []
    for garbage in (0.5, 1e4):
        th.manual_seed(0)
        reports.append(build(name, 4, 2, 2, **TINY_CRITIC, held_out=0.4).fit(with_garbage(batch, garbage)))
    assert reports[0] == pytest.approx(reports[1])
    assert np.isfinite(list(reports[0].values())).all()


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


# -- episodes that have ended ---------------------------------------------------------------------------------


def with_garbage(batch, value):
    """Overwrite everything that belongs to dead episodes."""
    dead = ~batch.alive[..., None]
    return InformationBatch(*(x.masked_fill(dead, value) for x in batch[:4]), batch.alive)


def half_dead():
    alive = th.ones(4, 60, dtype=th.bool)
    alive[1:, 50:] = False
    alive[2:, ::2] = False
    alive[3:, 3:] = False  # too few are left at the last step
    return alive


@pytest.mark.parametrize(
    "settings", [{}, dict(standardize=True), dict(held_out=0.2)], ids=["plain", "standardized", "held_out"]
)
@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_what_stands_where_an_episode_has_ended_makes_no_difference(name, settings):
    batch = random_batch(alive=half_dead())
    results = []
    for garbage in (0.5, 1e4):
        th.manual_seed(0)
        estimator = build(name, 4, 2, 2, **{**TINY_CRITIC, **settings})
        for _ in range(2):
            estimator.fit(with_garbage(batch, garbage))
        results.append(estimator(with_garbage(batch, garbage)))
    assert th.isfinite(results[0]).all()
    th.testing.assert_close(results[0], results[1])


@pytest.mark.parametrize("name", CRITIC_FREE)
def test_a_step_is_estimated_from_the_episodes_that_live(name):
    batch = random_batch(alive=half_dead())
    living = batch.alive[2]
    alone = InformationBatch(*(x[2:3, living] for x in batch[:4]))
    th.testing.assert_close(build(name, 4, 2, 2)(batch)[2:3], build(name, 1, 2, 2)(alone))


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_a_step_with_too_few_living_episodes_counts_as_zero(name):
    estimator = build(name, 4, 2, 2, **TINY_CRITIC)
    batch = random_batch(alive=half_dead())
    estimator.fit(batch)
    assert estimator(batch)[3] == 0


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_no_gradient_flows_into_dead_episodes(name):
    batch = random_batch(alive=half_dead())
    inputs = [getattr(batch, key).requires_grad_() for key in ("trvs", "means", "stds")]
    build(name, 4, 2, 2, **TINY_CRITIC)(batch).sum().backward()
    for x in inputs:
        if x.grad is not None:
            assert x.grad[~batch.alive].abs().sum() == 0
            assert x.grad[batch.alive].abs().sum() > 0


@pytest.mark.parametrize("name", CRITICS)
def test_the_critics_of_steps_with_too_few_episodes_are_not_trained(name):
    estimator = build(name, 4, 2, 2, **TINY_CRITIC)
    before = [parameter.detach().clone() for parameter in estimator.critic.parameters()]
    estimator.fit(random_batch(alive=half_dead()))
    for parameter, old in zip(estimator.critic.parameters(), before, strict=True):
        th.testing.assert_close(parameter[3], old[3], rtol=0, atol=0)
    assert not th.equal(estimator.critic.layers[0].weight[0], before[0][0])


# -- saving ---------------------------------------------------------------------------------------------------


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


# -- the registry ---------------------------------------------------------------------------------------------


def test_every_estimator_says_which_kind_of_bound_it_is():
    assert {cls.bound for cls in ESTIMATORS.values()} <= {"lower", "upper", "neither"}
    assert set(UPPER) == {"logdet", "loo"}
    assert set(LOWER) == {"mine", "nwj", "infonce"}


def test_an_estimator_is_found_by_its_name_or_given_as_a_class():
    class Own(LogDet):
        pass

    assert get_estimator_class("mine") is Mine
    assert get_estimator_class(Own) is Own


@pytest.mark.parametrize("estimator", ["mime", dict, 3, None, InformationBatch])
def test_anything_else_is_refused_with_the_list(estimator):
    with pytest.raises(ValueError, match=r"use one of \['infonce', 'logdet', 'loo', 'mine', 'nwj', 'smile'\]"):
        get_estimator_class(estimator)


@pytest.mark.parametrize(("name", "kwargs"), [
    ("mine", dict(ema_decay=1.0)),
    ("mine", dict(ema_decay=-0.1)),
    ("mine", dict(ema_decay=math.nan)),
    ("smile", dict(clip=0.0)),
    ("nwj", dict(learning_rate=0.0)),
    ("nwj", dict(learning_rate=math.nan)),
    ("nwj", dict(batch_size=0)),
    ("nwj", dict(gradient_steps=0)),
    ("nwj", dict(held_out=1.0)),
    ("nwj", dict(held_out=-0.1)),
    ("nwj", dict(held_out=math.nan)),
], ids=str)  # fmt: skip
def test_a_keyword_out_of_its_range_is_refused(name, kwargs):
    with pytest.raises(ValueError, match=f"mi_kwargs: {next(iter(kwargs))}="):
        ESTIMATORS[name](4, 2, 2, **kwargs)


def test_information_knows_nothing_of_stable_baselines():
    import ast
    from pathlib import Path

    import sb3_tdpg.information

    for file in Path(sb3_tdpg.information.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.startswith(("stable_baselines3", "gymnasium")) for name in names), file


def test_an_own_estimator_needs_one_method_only():
    class Zero(InformationEstimator):
        bound = "neither"

        def _estimate(self, batch, t):
            return batch.trvs.new_zeros(batch.trvs.shape[0])

    estimator = Zero(4, 2, 2)
    assert estimator.fit(random_batch()) == {}
    assert estimator(random_batch(alive=half_dead())).tolist() == [0.0] * 4
