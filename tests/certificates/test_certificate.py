"""The certificate: its arithmetic, its confidence, its counter-example, and whether it holds."""

import math

import numpy as np
import pytest
from scipy.special import logsumexp, rel_entr

from sb3_tdpg.certificates.certificate import (
    CostDistribution,
    certificate,
    cost_distribution,
    entropic_risk,
    worst_mean,
)


def kl(p, q):
    return float(rel_entr(p, q).sum())


def random_problem(random, n=6):
    """Two distributions on n points, and costs."""
    p, shifted = random.dirichlet(np.full(n, 0.7), 2)
    return p + 1e-12, shifted, random.normal(0, 10.0 ** random.uniform(-2, 2), n)


@pytest.mark.parametrize("beta", [1e-12, 1e-3, 1.0, 1e3, 1e9])
def test_entropic_risk_lies_between_mean_and_largest_cost_however_large_the_exponent(beta):
    costs = np.random.default_rng(0).exponential(1e4, 1000)
    risk = entropic_risk(costs, beta)
    assert costs.mean() * (1 - 1e-12) <= risk <= costs.max()
    if beta == 1e9:
        assert risk == pytest.approx(costs.max(), rel=1e-9)
    if beta == 1e-12:
        assert risk == pytest.approx(costs.mean() + beta * costs.var() / 2, rel=1e-9)


def test_entropic_risk_is_the_log_of_the_mean_exponential():
    costs, weights = np.array([-3.0, 0.0, 7.0]), np.array([0.2, 0.5, 0.3])
    assert entropic_risk(costs, 0.4, weights) == pytest.approx(logsumexp(0.4 * costs, b=weights) / 0.4)
    assert entropic_risk(costs, 0.0, weights) == pytest.approx(weights @ costs)


def test_the_bound_holds_in_random_problems_for_every_beta():
    random = np.random.default_rng(1)
    for _ in range(500):
        p, shifted, costs = random_problem(random)
        beta = 10.0 ** random.uniform(-4, 3)
        assert shifted @ costs <= entropic_risk(costs, beta, p) + kl(shifted, p) / beta + 1e-8


def test_the_best_beta_gives_the_worst_mean_within_the_divergence():
    random = np.random.default_rng(2)
    for _ in range(100):
        p, _, costs = random_problem(random)
        order = np.argsort(costs)
        p, costs = p[order] / p.sum(), costs[order]
        beta = random.uniform(0.1, 3) / costs.std()
        tilted = p * np.exp(beta * (costs - costs.max()))
        tilted /= tilted.sum()
        found = worst_mean(CostDistribution(costs, p), kl(tilted, p))
        assert found == pytest.approx(tilted @ costs, rel=1e-5, abs=1e-5 * np.ptp(costs))


def test_a_divergence_of_nothing_gives_the_mean_and_a_large_one_the_largest_cost():
    costs = np.array([1.0, 2.0, 6.0])
    exact = CostDistribution(costs, np.full(3, 1 / 3))
    assert worst_mean(exact, 0.0) == pytest.approx(3.0)
    assert worst_mean(exact, math.log(3) + 1e-9) == 6.0
    assert certificate(costs, math.inf, cost_bound=10.0) == 10.0
    assert worst_mean(exact, math.log(3) - 0.01) < 6.0
    assert worst_mean(CostDistribution(np.full(4, 2.5), np.full(4, 0.25)), 1.0) == 2.5


def test_the_printed_condition_is_met_where_the_printed_bound_fails():
    """A lamp is on or off, the TRV tells which, wrongly with some probability; acting on the wrong one costs."""

    def joint(error):
        return 0.5 * np.array([1 - error, error, error, 1 - error])

    p, shifted, costs, beta = joint(0.01), joint(0.99), np.array([0.0, 10.0, 10.0, 0.0]), 0.1
    information = kl(p, np.full(4, 0.25))
    assert beta * kl(shifted, p) <= information  # as the paper prints it
    assert shifted @ costs > 10 * (entropic_risk(costs, beta, p) + information)
    assert kl(shifted, p) > beta * information  # the corrected condition is not met


# Name -> (sampler, cost bound, cumulant generating function at beta).
KNOWN = {
    "uniform": (lambda random, n: random.uniform(0, 1, n), 1.0, lambda b: math.log(math.expm1(b) / b)),
    "rare disaster": (
        lambda random, n: 50.0 * (random.random(n) < 0.002),
        50.0,
        lambda b: math.log1p(0.002 * math.expm1(50 * b)),
    ),
    "coin": (lambda random, n: 1.0 * (random.random(n) < 0.5), 1.0, lambda b: math.log((1 + math.exp(b)) / 2)),
}


@pytest.mark.parametrize("name", KNOWN)
@pytest.mark.parametrize("n", [30, 1000])
def test_the_confidence_bound_covers_all_betas_at_once(name, n):
    sample, cost_bound, cumulant = KNOWN[name]
    betas = np.geomspace(1e-3, 10, 9) / cost_bound
    truth = np.array([cumulant(beta) / beta for beta in betas])
    random = np.random.default_rng(4)
    n_covered = 0
    for _ in range(200):
        distribution = cost_distribution(sample(random, n), cost_bound, confidence=0.9)
        risks = [worst_mean(distribution, 0.0)]
        risks += [entropic_risk(distribution.values, beta, distribution.probabilities) for beta in betas]
        n_covered += (np.array(risks) >= np.append(truth[0], truth) - 1e-9).all()
    assert n_covered >= 175  # 180 expected if the band were exact; it is wider


def test_the_band_is_narrow_in_the_tail():
    costs = np.random.default_rng(6).uniform(0, 1, 100_000)
    distribution = cost_distribution(costs, cost_bound=1000.0, confidence=0.95)
    assert distribution.probabilities.sum() == pytest.approx(1.0)
    assert (distribution.probabilities >= 0).all()
    assert 1 / len(costs) < distribution.probabilities[-1] < 15 / len(costs)
    assert worst_mean(distribution, 0.0) < 0.5 + 1000 * 15 / len(costs) + 0.02


def test_a_cap_cuts_off_no_more_than_the_level():
    costs = np.random.default_rng(7).exponential(1.0, 5000)
    distribution = cost_distribution(costs, 1e6)
    for level in (0.0, 1e-3, 0.1):
        capped, beyond = distribution.capped(level)
        assert capped.probabilities.sum() == pytest.approx(1.0)
        assert capped.values[-1] <= costs.max()
        assert (costs > capped.values[-1]).mean() <= beyond + 1e-12  # the band leaves more than the sample
        assert beyond <= max(level, 1 - distribution.probabilities[:-1].sum()) + 1e-12
    assert distribution.capped(0.1)[0].values[-1] < distribution.capped(1e-3)[0].values[-1]


def test_an_event_raises_the_lowest_costs_to_the_largest():
    distribution = CostDistribution(np.arange(4.0), np.full(4, 0.25))
    raised = distribution.with_largest(0.3)
    np.testing.assert_allclose(raised.probabilities, [0.0, 0.2, 0.25, 0.55])
    np.testing.assert_allclose(distribution.with_largest(0.0).probabilities, distribution.probabilities)
    np.testing.assert_allclose(distribution.with_largest(1.0).probabilities, [0, 0, 0, 1])


BAD = {
    "no cost bound": (dict(cost_bound=math.inf), "cost_bound=inf must be finite"),
    "cost above the bound": (dict(cost_bound=2.0), "a cost of 3 exceeds cost_bound=2"),
    "confidence": (dict(cost_bound=5.0, confidence=1.0), "confidence=1.0 must lie between 0 and 1"),
    "kl": (dict(cost_bound=5.0, kl=-0.1), "kl=-0.1 must be at least 0"),
    "nan": (dict(cost_bound=5.0, costs=np.array([1.0, np.nan])), "costs must be a vector of finite numbers"),
    "no costs": (dict(cost_bound=5.0, costs=np.array([])), "costs must be a vector of finite numbers"),
}


@pytest.mark.parametrize("given, message", BAD.values(), ids=BAD)
def test_bad_input_is_told(given, message):
    with pytest.raises(ValueError, match=message):
        certificate(**{"costs": np.array([1.0, 3.0]), "kl": 0.1, **given})


def test_the_band_at_a_rank_is_the_quantile_of_its_own_order_statistic():
    # F at the highest of n costs is Beta(n, 1), the lowest Beta(1, n): closed forms.
    n, confidence = 20, 0.95
    share = (1 - confidence) / n  # every rank is used
    costs = np.arange(1.0, n + 1)
    distribution = cost_distribution(costs, 100.0, confidence)
    assert distribution.values.tolist() == [*costs, 100.0]
    below = np.cumsum(distribution.probabilities)
    assert below[n - 1] == pytest.approx(share ** (1 / n))
    assert below[0] == pytest.approx(1 - (1 - share) ** (1 / n))
