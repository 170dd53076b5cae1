"""Information from pairs alone, against samples of the public benchmark whose information is known."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch as th
from copula_start import Start, _scatter, degrees_of_freedom
from information_problems import CRITICS
from pairs import (
    StartedMLP,
    _average,
    _Choice,
    _features,
    _ranks,
    _whiten,
    estimate_information,
)
from scipy import stats

from sb3_tdpg.information.critic import CriticEstimator
from sb3_tdpg.networks import flatten_parameters

BENCHMARK = Path(__file__).parent
EASY = (  # of these the benchmark's CCA or KSG is within 10 % of the truth
    "1v1-bimodal-0.75",
    "half_cube-1v1-normal-0.75",
    "multinormal-dense-5-5-0.5",
    "normal_cdf-multinormal-sparse-3-3-2-2.0",
)
SHORT = dict(max_gradient_steps=100)


def task(name, n=500):
    samples = np.load(BENCHMARK / "ranks.npz")
    theirs = pd.read_csv(BENCHMARK / "theirs.csv").query("task == @name and n == @n")
    return samples[f"{name}/x"][:, :n], samples[f"{name}/z"][:, :n], theirs


@pytest.mark.parametrize("name", EASY)
def test_where_cca_or_ksg_is_within_10_percent_of_the_truth_mine_is_too(name):
    x, z, theirs = task(name)
    truth = theirs["truth"].iloc[0]
    reference = theirs[theirs["estimator"].isin(["cca", "ksg"])].groupby("estimator")["estimate"].mean()
    assert (abs(reference / truth - 1) <= 0.1).any()
    assert estimate_information(x, z, **SHORT).estimate.mean() == pytest.approx(truth, rel=0.1)


def test_heavy_tails_that_come_together_are_found():
    x, z, theirs = task("student-identity-5-5-2", 1000)  # a Gaussian's ratio and the network find two thirds of it
    truth = theirs["truth"].iloc[0]
    assert estimate_information(x, z, max_gradient_steps=1).estimate.mean() == pytest.approx(truth, rel=0.1)


def test_a_relation_that_has_no_covariance_is_found():
    x, z, theirs = task("swissroll_x-normal_cdf-1v1-normal-0.75")
    found = estimate_information(x, z, max_gradient_steps=300)
    assert found.estimate.mean() > 0.9 * theirs["truth"].iloc[0]
    assert (found.held_out < found.trained_on).all()  # it takes a critic that also learns its samples


def test_the_edge_of_a_narrow_relation_is_found():
    x, z, theirs = task("1v1-additive-0.1")
    found = estimate_information(x[:2], z[:2], max_gradient_steps=300)
    assert found.estimate.mean() > 0.88 * theirs["truth"].iloc[0]


def test_nothing_is_found_where_the_start_has_less_than_nothing_to_say():
    x, z = np.random.default_rng(0).normal(size=(2, 4, 200, 5))
    found = estimate_information(x, z, max_gradient_steps=50)  # a Gaussian's ratio reads below -0.05 on held-out pairs
    assert (found.held_out > -0.01).all() and (found.estimate < 0.05).all()


def test_training_ends_early_where_the_start_cannot_be_bettered(monkeypatch):
    steps = []
    ascend = CriticEstimator._ascend
    monkeypatch.setattr(CriticEstimator, "_ascend", lambda *args: (steps.append(args[-1]), ascend(*args)))
    x, z, _ = task("multinormal-dense-5-5-0.5")
    estimate_information(x[0], z[0])
    assert sum(steps) < 400


@pytest.mark.parametrize("name", CRITICS)
def test_every_critic_starts_at_the_information_of_gaussians_and_at_none_of_independent_variables(name):
    generator = th.Generator().manual_seed(0)
    x, noise = th.randn(2, 1, 600, 2, generator=generator)
    both = th.cat([x + noise, noise])  # ln 2 nats, and none
    found = estimate_information(x.repeat(2, 1, 1), both, name, max_gradient_steps=10)
    np.testing.assert_allclose(found.estimate, [np.log(2), 0], atol=0.1)
    np.testing.assert_allclose(found.estimate, (found.held_out + found.trained_on) / 2)


def test_many_problems_at_once_give_what_each_gives_alone():
    x, z, _ = task("swissroll_x-normal_cdf-1v1-normal-0.75", n=200)
    together = estimate_information(x, z, **SHORT)
    alone = [estimate_information(a, b, **SHORT) for a, b in zip(x, z, strict=True)]
    np.testing.assert_allclose(together, np.transpose(alone), atol=1e-2)


def test_a_monotone_map_of_a_component_changes_nothing():
    x, z, _ = task("1v1-normal-0.75", n=200)
    assert estimate_information(x[0], z[0], **SHORT) == estimate_information(np.exp(x[0] / 100), z[0], **SHORT)


def test_the_seed_decides_and_the_global_random_state_stays():
    x, z, _ = task("swissroll_x-normal_cdf-1v1-normal-0.75", n=200)
    state = th.random.get_rng_state()
    first, same, other = (estimate_information(x[0], z[0], seed=seed, **SHORT) for seed in (0, 0, 1))
    assert first == same != other
    assert th.equal(state, th.random.get_rng_state())


@pytest.mark.parametrize("kind", ["constant", "copies", "ties", "function", "heavy"])
def test_difficult_samples_never_give_nan(kind):
    rng = np.random.default_rng(0)
    x, z = rng.normal(size=(2, 60, 2))
    if kind == "constant":
        x[:] = 3.0
    elif kind == "copies":
        x[:, 1] = x[:, 0]
    elif kind == "ties":
        x, z = np.sign(x), np.sign(z)
    elif kind == "function":
        z = x.copy()
    elif kind == "heavy":
        x, z = rng.standard_cauchy(size=(2, 60, 2)) ** 9
    found = estimate_information(x, z, **SHORT)
    assert np.isfinite(found).all()
    assert found.estimate > 1 if kind == "function" else abs(found.estimate) < 0.2


def test_a_critic_that_diverges_is_not_chosen():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(100, 1))
    found = estimate_information(x, x + rng.normal(size=(100, 1)), learning_rate=1e6, **SHORT)
    assert np.isfinite(found).all() and 0 < found.estimate < 1


def draw_t(nu, n=2000, seed=0):
    """Samples (n, 3) of a multivariate t with correlated components, and their distribution."""
    shape = [[1, 0.5, 0.3], [0.5, 1, -0.2], [0.3, -0.2, 1]]
    distribution = stats.multivariate_t(shape=shape, df=nu)
    return distribution.rvs(n, random_state=seed), np.array(shape)


@pytest.mark.parametrize("nu", [1.5, 5.0, 100.0])
def test_the_degrees_of_freedom_are_those_of_the_sample(nu):
    y, _ = draw_t(nu)
    found = degrees_of_freedom(_ranks(th.as_tensor(np.exp(y / 1e4)))[None])  # of the copula: the marginals are others
    assert (found > 20) if nu == 100 else (nu / 1.6 < found < nu * 1.6)


def test_the_start_is_the_log_density_ratio_of_a_multivariate_t():
    y, shape = draw_t(3.0)
    nu = th.tensor([3.0], dtype=th.double)
    samples = th.as_tensor(y)[None]
    fitted = _scatter(samples, nu)[0].numpy()
    np.testing.assert_allclose(fitted, shape, atol=0.1)

    def log_density(part):
        return stats.multivariate_t(shape=fitted[part, part], df=3.0).logpdf(y[:, part])

    expected = log_density(slice(3)) - log_density(slice(2)) - log_density(slice(2, 3))
    everything = th.arange(len(y))
    start = Start.fit(samples, everything[None], 2, nu, level=0.5)
    own = th.stack([everything, everything + len(y)], -1)[None]  # x and z of the same pair
    np.testing.assert_allclose(start(own)[0, :, 0], 0.5 + expected, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(start.flat_like(0.5)(own)[0, :, 0], 0.5)
    shifted = th.stack([everything, everything.roll(1) + len(y)], -1)[None]
    y[:, 2] = np.roll(y[:, 2], 1)
    expected = log_density(slice(3)) - log_density(slice(2)) - log_density(slice(2, 3))
    np.testing.assert_allclose(start(shifted)[0, :, 0], 0.5 + expected, rtol=1e-4, atol=1e-4)


def test_the_averaged_critic_follows_the_trained_one():
    critic = StartedMLP(1, (1, 1))
    weights = flatten_parameters(critic)
    optimizer = th.optim.Adam([weights], lr=0.1)
    averaged, (weight, _) = _average(critic, optimizer), critic.parameters()
    expected = weight.item()
    for step in range(1, 600):
        weights.grad.fill_((-1.0) ** (step // 3))
        with th.no_grad():
            optimizer.step()
        past = min(0.98, step / (step + 10))
        expected = past * expected + (1 - past) * weight.item()
        assert next(averaged.parameters()).item() == pytest.approx(expected, abs=1e-5)
    assert weight.item() != next(averaged.parameters()).item()


def test_whitened_features_have_covariance_1():
    x = th.randn(2, 500, 1, generator=th.Generator().manual_seed(0), dtype=th.double)
    both = th.cat([x, x + th.linspace(-0.3, 0.3, 500)[:, None]], -1)
    features = _features(_ranks(both))
    mean, axes = _whiten(features)
    white = th.einsum("rnjd,rjde->rnje", features - mean, axes)
    covariance = th.einsum("rnjd,rnje->rjde", white, white) / 500
    np.testing.assert_allclose(covariance, th.eye(2).expand_as(covariance), atol=1e-6)


def consider(*checks, training=True):
    """What is chosen of a start that reads 0 everywhere and of checks, each held out and trained on, ``(K,)``."""
    n_folds = len(checks[0][0])
    choice = _Choice(-2.0, 10.0, th.zeros(1, n_folds), th.zeros(1, n_folds))
    for held_out, trained_on in checks:
        choice.consider(th.tensor([held_out]), lambda seen=trained_on: th.tensor([seen]), th.tensor([training]))
    return choice.held_out[0].tolist(), choice.trained_on[0].tolist()


def test_a_fold_does_not_choose_by_its_own_luck():
    # Fold 0 is told by the others to stay with the start; these are told by fold 0, which was lucky, to leave it.
    held_out, trained_on = consider(([5.0, -1.0, -1.0], [6.0, 7.0, 8.0]))
    assert held_out == [0, -1, -1] and trained_on == [0, 7, 8]
    assert consider(([5.0, -1.0, -1.0], [6.0, 7.0, 8.0]), training=False) == ([0, 0, 0], [0, 0, 0])


@pytest.mark.parametrize("bad", [th.nan, th.inf, 11.0, -3.0])
def test_a_critic_out_of_bounds_in_one_fold_is_not_chosen_in_any(bad):
    good = [2.0, 3.0, 4.0]
    for check in ((good, [5.0, 5.0, bad]), ([5.0, 5.0, bad], good)):
        assert consider(check) == ([0, 0, 0], [0, 0, 0])
        assert consider(check, (good, good)) == consider((good, good), check) == (good, good)


def test_seen_pairs_are_read_only_where_a_critic_may_be_chosen():
    choice = _Choice(-2.0, 10.0, th.ones(1, 3), th.ones(1, 3))
    choice.consider(th.zeros(1, 3), lambda: pytest.fail("read"), th.tensor([True]))
    assert (choice.held_out == 1).all()


@pytest.mark.parametrize(
    ("x", "z", "kwargs", "message"),
    [
        (np.zeros((60, 1)), np.zeros((50, 1)), {}, "row i"),
        (np.zeros((2, 2, 60, 1)), np.zeros((2, 2, 60, 1)), {}, "expected"),
        (np.full((60, 1), np.nan), np.zeros((60, 1)), {}, "not finite"),
        (np.zeros((20, 1)), np.zeros((20, 1)), {}, "too few"),
        (np.zeros((60, 10)), np.zeros((60, 10)), {}, "too few"),
        (np.zeros((60, 1)), np.zeros((60, 1)), {"n_folds": 1}, "n_folds"),
        (np.zeros((60, 1)), np.zeros((60, 1)), {"max_gradient_steps": 0}, "max_gradient_steps"),
        (np.zeros((60, 1)), np.zeros((60, 1)), {"estimator": "logdet"}, "density"),
        (np.zeros((60, 1)), np.zeros((60, 1)), {"estimator": "ksg"}, "unknown"),
    ],
)
def test_bad_input_is_refused(x, z, kwargs, message):
    with pytest.raises(ValueError, match=message):
        estimate_information(x, z, **kwargs)
