"""The bounds that the limits of the interval come from, and the critics in them."""

import math

import numpy as np
import pytest
import torch as th
from information_problems import channel, encoded, gaussian_batch, gaussian_channels, generator, random_batch
from scipy.stats import multivariate_normal

from sb3_tdpg.evaluation import density_critic, information_interval
from sb3_tdpg.evaluation import interval_bounds as bounds_module
from sb3_tdpg.evaluation.density_critic import DensityCritic, GaussianCritic, Regression
from sb3_tdpg.evaluation.interval_bounds import (
    Estimate,
    FreshPairs,
    critic_bounds,
    donsker_varadhan,
    draw_trvs,
    gaussian_bound,
    leave_one_out_bound,
    log_det_bound,
    noise_controls,
)
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.information.logdet import LogDet
from sb3_tdpg.information.loo import LeaveOneOut


def test_the_jackknife_of_the_log_det_bound_is_that_of_its_definition():
    batch = random_batch(horizon=1, n=30)
    whole = LogDet(1, 2, 2)(batch.select(th.arange(30))._replace(means=batch.means.double())).item()
    double = InformationBatch(*(x.double() for x in batch[:4]))
    without = [LogDet(1, 2, 2)(double.select(th.tensor([j for j in range(30) if j != i]))).item() for i in range(30)]
    bound = log_det_bound(encoded(batch))
    assert bound.value == pytest.approx(30 * whole - 29 * np.mean(without), rel=1e-5)
    assert bound.error == pytest.approx(math.sqrt(29 / 30 * np.square(without - np.mean(without)).sum()), rel=1e-5)


def test_the_leave_one_out_bound_is_that_of_its_estimator(monkeypatch):
    monkeypatch.setattr(Estimate, "less_noise", lambda self, controls: self)
    batch = random_batch(horizon=1, n=40)
    assert leave_one_out_bound(encoded(batch)).value == pytest.approx(LeaveOneOut(1, 2, 2)(batch).item())


@pytest.mark.parametrize("bound", [
    lambda step, rng: log_det_bound(step),
    lambda step, rng: leave_one_out_bound(step),
    lambda step, rng: critic_bounds(step, rng)[0],
    gaussian_bound,
], ids=["log_det", "leave_one_out", "critic", "gaussian"])  # fmt: skip
def test_the_standard_errors_are_those_of_repetitions(bound):
    batch = gaussian_batch(200, [[1.0, 1.0]] * 60, generator=generator())
    estimates = [bound(encoded(batch.at(t), n_draws=4), np.random.default_rng(t)) for t in range(60)]
    values, errors = np.transpose([(estimate.value, estimate.error) for estimate in estimates])
    assert 0.75 < errors.mean() / values.std(ddof=1) < 1.4


@pytest.mark.parametrize("n", [61, 303])
def test_what_an_episode_adds_is_told_at_its_place(n):
    # Of the bounds' means over episodes, an outlier is the largest part of each.
    batch = gaussian_channels(1.0, 2, n, 1, np.random.default_rng(0))
    batch.states[0, 7] *= 10
    batch.means[0, 7] *= 10
    batch.trvs[0, 7] += 0.9 * batch.means[0, 7]
    step = draw_trvs(batch.at(0), np.random.default_rng(0))
    rng = np.random.default_rng(0)
    for bound in (log_det_bound(step), leave_one_out_bound(step), *critic_bounds(step, rng), gaussian_bound(step, rng)):
        assert bound.parts.shape == (n,)
        assert bound.parts.argmax() == 7


def test_the_densities_of_the_critic_are_normalised_and_bend():
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (1, 200, 1))
    critic = DensityCritic(encoded(channel(states, np.sin(3 * states), 0.1, rng)))
    grid, at = np.linspace(-6, 6, 4001)[:, None], np.array([[-0.8], [0.1], [0.6]])
    step = grid[1, 0] - grid[0, 0]
    assert np.exp(critic.log_marginal(grid)).sum() * step == pytest.approx(1, abs=1e-6)
    density = np.exp(critic._log_conditional(at, grid))
    np.testing.assert_allclose(density.sum(axis=0) * step, 1, atol=1e-6)
    np.testing.assert_allclose(grid[density.argmax(axis=0)], np.sin(3 * at), atol=0.03)


@pytest.mark.parametrize("ridge", [1e-9, 1e-2])
def test_the_leave_one_out_residuals_are_those_of_fits_without_the_episode(ridge, monkeypatch):
    # A kernel that can interpolate: its residuals are about 0, those of fits without the episode are not.
    rng = np.random.default_rng(0)
    inputs, targets = rng.standard_normal((25, 2)), rng.standard_normal((25, 1))
    kernel = np.exp(-2 * np.square(inputs[:, None] - inputs).sum(axis=2))
    values, vectors = np.linalg.eigh(kernel)
    monkeypatch.setattr(density_critic, "RIDGES", (ridge,))
    _, residuals = density_critic._choose_ridge(vectors, values, targets, otherwise=np.full_like(targets, 1e9))
    for i in range(25):
        others = np.arange(25) != i
        weights = np.linalg.solve(kernel[np.ix_(others, others)] + 25 * ridge * np.eye(24), targets[others])
        assert residuals[i] == pytest.approx(targets[i] - kernel[i, others] @ weights, rel=1e-4)


def test_the_residuals_of_many_inputs_are_those_of_episodes_that_the_fit_has_not_seen():
    rng = np.random.default_rng(0)
    shares, fresh = [], []
    for _ in range(20):
        inputs, new = rng.standard_normal((2, 40, 16))
        targets, wanted = (x[:, :1] + rng.standard_normal((40, 1)) for x in (inputs, new))
        fit = Regression(inputs, targets)
        shares.append(np.square(fit.residuals).mean())
        fresh.append(np.square(wanted - fit.predict(new)).mean())
    assert np.mean(shares) == pytest.approx(np.mean(fresh), rel=0.1)


def test_a_constant_component_of_the_state_does_no_harm():
    batch = gaussian_batch(100, [[1.0, 0.0]], generator=generator())
    constant = batch._replace(states=batch.states * th.tensor([1.0, 0.0]) + th.tensor([0.0, 3.0]))
    alone = batch._replace(states=batch.states[..., :1])
    np.testing.assert_allclose(information_interval(constant).lower, information_interval(alone).lower, atol=1e-6)
    nothing = information_interval(batch._replace(states=th.zeros_like(batch.states)))
    assert nothing.lower[0] == 0
    assert nothing.lower_name == ("zero",)


def test_the_donsker_varadhan_bound_is_that_of_its_definition():
    scores = np.random.default_rng(0).standard_normal((6, 6))  # one draw each: of the TRVs of i with the state of j
    off_diagonal = np.exp(scores)[~np.eye(6, dtype=bool)]
    pairs = FreshPairs(6)
    pairs.log_clip = 0.0
    pairs.add(np.arange(6), scores)
    bound = pairs.bound()
    clipped = np.minimum(scores, 0)
    expected = np.diag(clipped).mean() - math.log(np.minimum(off_diagonal, 1).mean())
    assert bound.value == pytest.approx(expected, abs=0.1)  # but for the correction of its bias
    assert bound.value < expected


def test_the_pairs_of_several_critics_count_once_each():
    rng = np.random.default_rng(0)
    scores = rng.standard_normal((3, 6, 4, 6))  # of three critics and four draws
    fresh = [np.array(rng.permutation(9)[:6]) for _ in range(3)]
    fresh[2] = np.array([*np.setdiff1d(np.arange(9), np.union1d(*fresh[:2])), *fresh[0], *fresh[1]])[:6]
    pairs, joint, ratios = FreshPairs(9), [[] for _ in range(9)], {}
    for episodes, of_critic in zip(fresh, scores, strict=True):
        pairs.add(episodes, of_critic.reshape(24, 6))
        for a, i in enumerate(episodes):
            joint[i].append(of_critic[a, :, a].mean())
            for b, j in enumerate(episodes):
                if i != j:
                    ratios.setdefault((i, j), []).append(np.exp(of_critic[a, :, b]).mean())
    assert min(map(len, joint)) == 1
    assert max(map(len, ratios.values())) > 1
    matrix = np.zeros((9, 9))
    for pair, values in ratios.items():
        matrix[pair] = np.mean(values)
    expected = donsker_varadhan(np.array([np.mean(values) for values in joint]), matrix, len(ratios), pairs.log_clip)
    np.testing.assert_allclose(pairs.bound().parts, expected.parts)
    assert pairs.bound().value == pytest.approx(expected.value)


def test_the_gaussian_critic_is_the_ratio_of_two_gaussian_densities():
    rng = np.random.default_rng(0)
    gains, standard = rng.standard_normal((2, 3)), rng.standard_normal((1, 50_000, 3)) * [1.0, 1.0, 0.0]
    states, means = standard * [1.0, 20.0, 1.0] + [0.0, 5.0, 7.0], standard @ gains.T + [100.0, 0.0]
    stds = np.array([0.5, 2.0])
    critic = GaussianCritic(encoded(channel(states, means, stds, rng)))
    gains[:, 2] = 0  # of a component that does not vary
    at, trvs = states[0, :4], np.array([[100.0, 0.0], [101.0, 3.0]])
    conditional = np.stack([multivariate_normal(mean, np.diag(stds**2)).logpdf(trvs) for mean in means[0, :4]], axis=1)
    marginal = multivariate_normal([100.0, 0.0], gains @ gains.T + np.diag(stds**2)).logpdf(trvs)
    np.testing.assert_allclose(critic.scores(at, trvs), conditional - marginal[:, None], atol=0.05)


def test_a_gaussian_critic_sees_nothing_of_the_episodes_that_it_is_evaluated_on():
    # Of noise alone, 12 coefficients would find a lot in the 24 episodes that they were fitted to.
    rng = np.random.default_rng(0)
    values = []
    for _ in range(30):
        step = encoded(channel(*rng.standard_normal((2, 1, 24, 4)), 0.1, rng), n_draws=2)
        values.append(gaussian_bound(step, rng).value)
    assert np.mean(values) < 0


def test_the_first_draw_is_the_rollout_s_and_each_has_a_mirror_image():
    batch = random_batch(horizon=1, n=40)
    step = draw_trvs(batch.at(0), np.random.default_rng(0))
    assert step.trvs.shape == (40, bounds_module.MAX_DRAWS, 2)
    np.testing.assert_allclose(step.trvs[:, 0], batch.trvs[0])
    first, mirrored = np.split(step.trvs - step.means[:, None], 2, axis=1)
    np.testing.assert_allclose(first, -mirrored)


def test_control_variates_expect_nothing_and_take_off_the_noise_of_the_draws():
    rng = np.random.default_rng(0)
    n, dim = 60, 3
    stds = rng.uniform(0.2, 2.0, (1, n, dim))
    means = rng.standard_t(3, (1, n, 1)) * [1.0, 2.0, -1.0]  # far from a Gaussian, correlated
    controls, plain, controlled = [], [], []
    for _ in range(400):
        step = draw_trvs(channel(means, means, stds, rng).at(0), rng)
        controls.append(noise_controls(step))
        noise = (step.trvs - step.means[:, None]) / step.stds[:, None]
        parts = np.sin(step.means[:, 0]) - 0.5 * np.square(noise).sum(axis=2).mean(axis=1)
        plain.append(Estimate(parts.mean(), parts))
        controlled.append(plain[-1].less_noise(controls[-1]))
    controls = np.array(controls)
    errors = controls.std(axis=0) / 20
    assert (np.abs(controls.mean(axis=0)) < 5 * errors).all()
    truth = np.sin(means[0, :, 0]).mean() - 0.5 * dim
    spread, less = (np.std([e.value for e in estimates]) for estimates in (plain, controlled))
    assert less < 0.4 * spread
    assert np.mean([e.value for e in controlled]) == pytest.approx(truth, abs=5 * less / 20 + 1e-9)


def test_control_variates_make_a_bound_depend_less_on_the_draws():
    batch = gaussian_channels(2.0, 8, 60, 1, np.random.default_rng(0))
    steps = [draw_trvs(batch.at(0), np.random.default_rng(seed)) for seed in range(20)]
    fresh = [1, 2, 3, 7, 8, 9]  # beside the noise that was rolled out, which is the same in all
    steps = [step._replace(trvs=step.trvs[:, fresh]) for step in steps]
    spreads = []
    for less_noise in (Estimate.less_noise, lambda self, controls: self):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Estimate, "less_noise", less_noise)
            spreads.append(np.std([gaussian_bound(step, np.random.default_rng(0)).value for step in steps]))
    assert spreads[0] < 0.7 * spreads[1]


def test_where_no_pair_fits_the_bound_is_not_infinite():
    bound = donsker_varadhan(np.full(100, log_clip := 6.0), np.zeros((100, 100)), 100 * 99, log_clip)
    assert math.log(100**2 / 10) - 0.1 < bound.value < math.log(100**2 / 10)
    assert bound.error > 0.3


def test_an_episode_also_counts_as_a_component_of_the_others_mixture():
    # A broad density far from all draws adds to no other episode's mixture, a central one adds to all of them.
    batch = gaussian_batch(60, [[1.0, 1.0]], generator=generator())
    step = encoded(batch, n_draws=4)
    n, n_draws, dim = step.trvs.shape
    density = bounds_module.log_gaussians(step.trvs.reshape(-1, dim), step.means, np.square(step.stds))
    own = np.repeat(np.arange(n), n_draws)
    gaps = density[np.arange(n * n_draws), own].copy()
    density[np.arange(n * n_draws), own] = -np.inf
    total = np.exp(density).sum(axis=1)
    gaps = (gaps - np.log(total / (n - 1))).reshape(n, -1).mean(axis=1)
    shares = (np.exp(density) / total[:, None]).sum(axis=0) / n_draws
    whole = Estimate(float(gaps.mean()), gaps - shares).less_noise(bounds_module.noise_controls(step))
    assert leave_one_out_bound(step).error == pytest.approx(whole.error)
    assert abs(whole.error / Estimate(0.0, gaps).less_noise(bounds_module.noise_controls(step)).error - 1) > 0.01
