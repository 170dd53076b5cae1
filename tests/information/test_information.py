"""Every estimator against Gaussians whose mutual information is known. Runs over the registry of estimators."""

import inspect
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch as th
from information_problems import (
    CLASSES,
    CRITIC_FREE,
    CRITICS,
    GAINS,
    LOWER,
    UPPER,
    build,
    fresh_estimates,
    gaussian_batch,
    gaussian_information,
    half_dead,
    modes_batch,
    random_batch,
)
from small_problems import TINY_CRITIC

from sb3_tdpg.information import ESTIMATORS, InformationBatch, InformationEstimator, get_estimator_class
from sb3_tdpg.information.critic import Scores
from sb3_tdpg.information.logdet import LogDet
from sb3_tdpg.information.loo import LeaveOneOut, own_sample_bound


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


@pytest.mark.parametrize("name", CRITICS)
def test_a_fitted_critic_finds_the_information_of_correlated_gaussians(name, fitted):
    mean, _ = fresh_estimates(fitted[name])
    np.testing.assert_allclose(mean, gaussian_information(GAINS), atol=0.1)


@pytest.mark.parametrize("name", CRITIC_FREE)
def test_a_critic_free_bound_finds_the_information_of_correlated_gaussians(name):
    estimator = build(name, len(GAINS), 2, 2)
    estimator.fit(gaussian_batch(10_000, GAINS))
    mean, _ = fresh_estimates(estimator, n_batches=5)
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
        generator = th.Generator().manual_seed(seed)
        batch = gaussian_batch(400, gains, generator=generator)
        estimator = build(name, 1, dim, dim)
        estimator.fit(gaussian_batch(400, gains, generator=generator))  # what is fitted is a bound on fresh samples
        values.append(estimator(batch).item())
    error = np.std(values, ddof=1) / math.sqrt(len(values))
    assert np.mean(values) >= gaussian_information(gains)[0] - 3 * error


def test_leave_one_out_is_an_upper_bound_on_pooled_steps_of_episodes_that_stand_still():
    th.manual_seed(0)
    episode = th.arange(20)[None].expand(100, -1)
    means = 10 * th.randn(1, 20, 1).expand(100, -1, -1)
    batch = InformationBatch(means, means + th.randn_like(means), means, th.ones_like(means), episode=episode)
    truth = 0.5 * math.log1p(100)
    assert LeaveOneOut(1, 1, 1)(batch.pooled()).item() > truth
    alone = batch.select(th.zeros(1, dtype=th.long))  # no other episode to tell it from
    assert LeaveOneOut(1, 1, 1)(alone.pooled()).item() == 0


@pytest.mark.parametrize("name", UPPER)
def test_an_upper_bound_holds_where_the_encoder_sees_a_noisy_observation_only(name):
    # I[x; x~] < I[y; x~], and the bound is on the latter.
    state = th.randn(1, 4000, 1)
    means = 2 * (state + th.randn_like(state))
    stds = th.ones_like(means)
    batch = InformationBatch(state, means + th.randn_like(means), means, stds)
    estimator = build(name, 1, 1, 1)
    estimator.fit(batch)
    bound = estimator(batch).item()
    about_state, about_observation = (0.5 * math.log(r) for r in (9 / 5, 9.0))
    assert bound > about_state
    assert bound == pytest.approx(about_observation, abs=0.06)


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
    scaled = InformationBatch(batch.states, *(scale * x for x in batch[1:4]))
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


@pytest.mark.parametrize("gain", [0.3, 1.0, 2.0])
def test_where_the_encoder_sees_the_state_the_information_lies_between_the_known_density_bounds(gain):
    batch = gaussian_batch(2000, [[gain, gain]])
    (truth,) = gaussian_information([[gain, gain]])
    lower, upper = own_sample_bound(batch).item(), LeaveOneOut(1, 2, 2)(batch).item()
    assert lower - 0.05 <= truth <= upper + 0.05
    assert upper - lower < 0.1


def test_the_lower_bound_of_a_step_does_not_depend_on_the_other_steps():
    batch = gaussian_batch(200, [[0.3, 0.3], [4.0, 4.0]], generator=th.Generator().manual_seed(0))
    alone = [own_sample_bound(InformationBatch(*(x[[t]] for x in batch[:4]))).item() for t in range(2)]
    assert own_sample_bound(batch).tolist() == pytest.approx(alone, rel=1e-5)
    assert alone[1] > alone[0] + 1


def test_the_lower_bound_cannot_exceed_the_logarithm_of_the_number_of_samples():
    batch = gaussian_batch(100, [[1.0, 1.0]], noise_std=1e-6)
    assert own_sample_bound(batch).item() == pytest.approx(math.log(100), abs=1e-3)
    assert own_sample_bound(batch).item() <= math.log(100) + 1e-5


def test_with_several_modes_leave_one_out_is_tight_and_logdet_loose():
    batch = modes_batch(2000)
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


@pytest.mark.parametrize("name", sorted(ESTIMATORS))
def test_the_gradient_of_the_estimate_is_that_of_finite_differences(name):
    estimator = build(name, 2, 2, 2, **TINY_CRITIC).double()
    batch = random_batch(horizon=2, n=10)
    inputs = [x.double().requires_grad_() for x in (batch.trvs, batch.means, batch.stds)]

    def estimate(trvs, means, stds):
        th.manual_seed(1)  # the same derangement each time
        # Times zero: finite differences must exist for an estimator that does not use an input.
        samples = InformationBatch(batch.states.double(), trvs, means, stds, prev_trvs=batch.prev_trvs.double())
        return estimator(samples) + 0 * (trvs + means + stds).sum()

    assert th.autograd.gradcheck(estimate, inputs)


@pytest.mark.parametrize(("name", "reached"), [
    *((name, {"trvs"}) for name in CRITICS),
    ("logdet", {"means", "stds"}),
    ("directed", {"means", "stds"}),
    ("loo", {"trvs", "means", "stds"}),
    ("directed-loo", {"trvs", "means", "stds"}),
    ("vib", {"means", "stds"}),
])  # fmt: skip
def test_the_gradient_reaches_the_encoder_through_what_the_estimate_depends_on_and_not_in_a_fit(name, reached):
    batch = random_batch()
    inputs = {key: getattr(batch, key).requires_grad_() for key in ("trvs", "means", "stds")}
    estimator = build(name, 4, 2, 2, **TINY_CRITIC)
    estimator.fit(batch)
    assert all(x.grad is None for x in inputs.values())
    estimator(batch).sum().backward()
    assert {key for key, x in inputs.items() if x.grad is not None and x.grad.abs().sum() > 0} == reached


def test_every_estimator_says_which_kind_of_bound_it_is():
    assert {cls.bound for cls in CLASSES.values()} <= {"lower", "upper", "neither"}
    assert set(UPPER) == {"logdet", "loo", "vib"}
    assert set(LOWER) == {"mine", "nwj", "infonce"}


@pytest.mark.parametrize("estimator", ["mime", dict, None])
def test_what_is_no_estimator_is_refused_with_the_list(estimator):
    with pytest.raises(ValueError, match=re.escape(f"use one of {sorted(ESTIMATORS)}")):
        get_estimator_class(estimator)


@pytest.mark.parametrize(("name", "kwargs"), [
    ("mine", dict(ema_decay=1.0)),
    ("mine", dict(ema_decay=-0.1)),
    ("smile", dict(clip=0.0)),
    ("nwj", dict(learning_rate=0.0)),
    ("nwj", dict(learning_rate=math.nan)),
    ("nwj", dict(batch_size=0)),
    ("nwj", dict(gradient_steps=0)),
    ("nwj", dict(held_out=1.0)),
    ("nwj", dict(held_out=-0.1)),
    ("vib", dict(n_components=0)),
], ids=str)  # fmt: skip
def test_a_keyword_out_of_its_range_is_refused(name, kwargs):
    with pytest.raises(ValueError, match=f"mi_kwargs: {next(iter(kwargs))}="):
        CLASSES[name](4, 2, 2, **kwargs)


def test_information_knows_nothing_of_stable_baselines():
    files = list(Path(inspect.getfile(InformationEstimator)).parent.glob("*.py"))
    assert len(files) > 5
    for file in files:
        assert not re.search(r"^\s*(from|import) (stable_baselines3|gymnasium)", file.read_text(), re.MULTILINE), file


def test_an_own_estimator_needs_one_method_only():
    class Zero(InformationEstimator):
        bound = "neither"

        def _estimate(self, batch, t):
            return batch.trvs.new_zeros(batch.trvs.shape[0])

    assert get_estimator_class(Zero) is Zero
    estimator = Zero(4, 2, 2)
    assert estimator.fit(random_batch()) == {}
    assert estimator(random_batch(alive=half_dead())).tolist() == [0.0] * 4
