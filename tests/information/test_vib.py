"""The variational bottleneck: priors of one Gaussian and of several, how they are fitted, and what stays frozen."""

import math

import numpy as np
import pytest
import torch as th
from information_problems import batch_of, half_dead, modes_batch, random_batch
from small_problems import tiny_tdpg, train_epochs

from sb3_tdpg import TDPG
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.information.vib import VariationalBottleneck


def fitted(batch, **kwargs):
    horizon, _, trv_dim = batch.trvs.shape
    estimator = VariationalBottleneck(horizon, batch.states.shape[2], trv_dim, **kwargs)
    estimator.fit(batch)
    return estimator


def test_before_the_first_fit_the_prior_is_the_standard_normal():
    batch = random_batch()
    expected = (0.5 * (batch.means.square() + batch.stds.square() - 1) - batch.stds.log()).sum(-1).mean(1)
    for n_components in (1, 3):
        th.testing.assert_close(VariationalBottleneck(4, 2, 2, n_components=n_components)(batch), expected)


def test_the_estimate_is_the_mean_divergence_from_a_gaussian_with_the_moments_of_the_trvs_and_none_is_better():
    batch = random_batch()
    random_state = th.get_rng_state()
    estimator = fitted(batch)
    assert th.equal(th.get_rng_state(), random_state)
    prior = th.distributions.Normal(estimator.prior_mean, estimator.prior_var.sqrt())
    divergence = th.distributions.kl_divergence(th.distributions.Normal(batch.means, batch.stds), prior).sum(-1)
    th.testing.assert_close(estimator(batch), divergence.mean(1))
    means, stds = batch.means.numpy(), batch.stds.numpy()
    np.testing.assert_allclose(estimator.prior_mean[:, 0], means.mean(1), rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(estimator.prior_var[:, 0], means.var(1) + (stds**2).mean(1), rtol=1e-4)
    best = estimator(batch)
    for buffer in (estimator.prior_mean, estimator.prior_var):
        for step in (-0.1, 0.1):
            buffer += step
            assert (estimator(batch) > best).all()
            buffer -= step


def test_with_several_modes_several_gaussians_are_tight_and_one_is_loose():
    batch = modes_batch()
    assert fitted(batch, n_components=4)(modes_batch()).item() == pytest.approx(math.log(4), abs=0.02)
    assert fitted(batch)(modes_batch()).item() > 3


@pytest.mark.parametrize("n_components", [2, 3, 5])
def test_on_the_samples_of_the_fit_several_gaussians_are_not_looser_than_one(n_components):
    for seed in range(5):
        th.manual_seed(seed)
        for batch in (random_batch(n=40), random_batch(n=40, alive=half_dead()[:, :40]), modes_batch(40)):
            assert (fitted(batch, n_components=n_components)(batch) <= fitted(batch)(batch) + 1e-2).all()


def test_more_gaussians_than_episodes_do_no_harm():
    batch = random_batch(n=5)
    estimator = fitted(batch, n_components=8)
    assert th.isfinite(estimator(batch)).all()
    assert all(th.isfinite(value).all() for value in estimator.state_dict().values())
    th.testing.assert_close(estimator.prior_log_weight.exp().sum(1), th.ones(4))


def test_trvs_that_are_all_alike_have_no_information():
    means = th.full((2, 50, 2), 0.7)
    batch = batch_of(means, th.full_like(means, 0.1))
    for n_components in (1, 3):
        np.testing.assert_allclose(fitted(batch, n_components=n_components)(batch), 0.0, atol=1e-4)


@pytest.mark.parametrize("n_components", [1, 3])
def test_the_unit_and_the_origin_of_the_trvs_make_no_difference(n_components):
    batch = random_batch()
    moved = InformationBatch(batch.states, 50 * batch.trvs + 3000, 50 * batch.means + 3000, 50 * batch.stds)
    estimates = [fitted(b, n_components=n_components)(b) for b in (batch, moved)]
    th.testing.assert_close(*estimates, rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize("n_components", [1, 3])
@pytest.mark.parametrize(("origin", "std"), [(0.0, 1.0), (3000.0, 0.01)])  # dead episodes cost no digits far away
def test_dead_episodes_and_steps_with_too_few_of_them_do_not_reach_the_prior(n_components, origin, std):
    batch = random_batch(alive=half_dead())
    batch = batch._replace(means=batch.means + origin, trvs=batch.trvs + origin, stds=std * batch.stds)
    alone = InformationBatch(*(x[2:3, batch.alive[2]] for x in batch[:4]))
    estimator, expected = fitted(batch, n_components=n_components), fitted(alone, n_components=n_components)
    th.testing.assert_close(estimator.prior_var[2:3], expected.prior_var, rtol=1e-3, atol=0)
    th.testing.assert_close(estimator.prior_mean[2:3], expected.prior_mean, rtol=1e-3, atol=1e-5)
    assert (estimator.prior_mean[3] == 0).all()
    assert (estimator.prior_var[3] == 1).all()
    nan = batch._replace(means=batch.means.masked_fill(~batch.alive[..., None], math.nan))
    th.testing.assert_close(fitted(nan, n_components=n_components)(nan), estimator(batch))


@pytest.mark.parametrize("n_components", [1, 3])
def test_the_gradient_is_that_of_the_bound_with_the_prior_held_fixed(n_components):
    batch = random_batch(n=12)
    estimator = fitted(batch, n_components=n_components).double()
    inputs = [x.double().requires_grad_() for x in (batch.means, batch.stds)]

    def estimate(means, stds):
        return estimator(InformationBatch(batch.states, batch.trvs, means, stds))

    before = {name: value.clone() for name, value in estimator.state_dict().items()}
    assert th.autograd.gradcheck(estimate, inputs)
    for name, value in estimator.state_dict().items():
        assert th.equal(value, before[name]), f"{name} is fitted by fit() alone"


def test_a_policy_trains_under_it_with_a_prior_of_every_epoch_and_the_file_keeps_it(tmp_path):
    model = train_epochs(tiny_tdpg(mi_estimator="vib", mi_kwargs=dict(n_components=2), beta=0.1), 1)
    first = model.estimator.prior_mean.clone()
    assert first.abs().sum() > 0
    train_epochs(model, 1, reset_num_timesteps=False)
    assert not th.equal(model.estimator.prior_mean, first)
    assert np.isfinite(model.information).all()
    model.save(tmp_path / "model")
    loaded = TDPG.load(tmp_path / "model", device="cpu").estimator
    assert isinstance(loaded, VariationalBottleneck)
    assert th.equal(loaded.prior_mean, model.estimator.prior_mean)
    assert loaded.prior_log_weight.shape == (5, 2)
