"""The bounds given the last TRVs: what a memory keeps is charged once."""

import math

import numpy as np
import pytest
import torch as th
from information_problems import batch_of, gaussian_batch, random_batch
from small_problems import lava_env, tiny_tdpg

from sb3_tdpg.information import InformationBatch
from sb3_tdpg.information.directed import DirectedLeaveOneOut, DirectedLogDet
from sb3_tdpg.information.logdet import LogDet
from sb3_tdpg.information.loo import LeaveOneOut

ESTIMATORS = pytest.mark.parametrize(
    ("estimator", "undirected"), [(DirectedLogDet, LogDet), (DirectedLeaveOneOut, LeaveOneOut)]
)


def memory(n_steps, n, std=0.1):
    """A number that is seen at t = 0 and kept, with fresh noise at each step: ``(T, n, 1)``."""
    number = th.randn(n, 1)
    stds = th.full((n_steps, n, 1), std)
    means, trvs, previous = [], [], []
    last = th.zeros(n, 1)
    for t in range(n_steps):
        means.append(number if t == 0 else last)
        previous.append(last)
        last = means[-1] + std * th.randn(n, 1)
        trvs.append(last)
    means, trvs, previous = map(th.stack, (means, trvs, previous))
    return InformationBatch(number.expand(n_steps, n, 1), trvs, means, stds, prev_trvs=previous)


@ESTIMATORS
def test_what_a_memory_keeps_is_charged_once_and_not_at_every_step(estimator, undirected):
    batch = memory(5, 4000)
    at_start = 0.5 * math.log(1 + 1 / 0.1**2)
    directed = estimator(5, 1, 1)(batch)
    assert directed[0].item() == pytest.approx(at_start, rel=0.03)
    assert directed[1:].tolist() == pytest.approx([0.0] * 4, abs=0.01)
    assert undirected(5, 1, 1)(batch).sum().item() > 4 * at_start


@ESTIMATORS
def test_a_reading_that_is_fresh_is_charged_in_full(estimator, undirected):
    batch = gaussian_batch(4000, [[1.0, 0.5], [2.0, 0.0]])  # the past is independent
    th.testing.assert_close(estimator(2, 2, 2)(batch), undirected(2, 2, 2)(batch), atol=0.005, rtol=0.02)


def test_a_bit_costs_a_bit_however_far_its_values_are_apart():
    bit = th.randn(1, 2000, 1).sign()
    for distance in (6.0, 60.0):
        batch = batch_of(distance / 2 * bit, th.ones_like(bit))._replace(prev_trvs=th.zeros_like(bit))
        assert DirectedLeaveOneOut(1, 1, 1)(batch).item() == pytest.approx(math.log(2), abs=0.03)
    assert DirectedLogDet(1, 1, 1)(batch).item() > 3.0


def test_it_is_the_bound_of_what_a_linear_regression_on_the_past_leaves():
    batch = random_batch(horizon=2, n=40)
    batch = batch._replace(means=batch.means + 0.7 * batch.prev_trvs)
    means, stds, past = (x.double().numpy() for x in (batch.means, batch.stds, batch.prev_trvs))
    for t, estimate in enumerate(DirectedLogDet(2, 2, 2)(batch).tolist()):
        inputs = np.column_stack([past[t], np.ones(40)])
        rest = means[t] - inputs @ np.linalg.lstsq(inputs, means[t], rcond=None)[0]
        covariance = np.cov(rest.T) + np.diag((stds[t] ** 2).mean(0))
        expected = 0.5 * np.linalg.slogdet(covariance)[1] - np.log(stds[t]).sum(1).mean()
        assert estimate == pytest.approx(expected, rel=1e-3)


@ESTIMATORS
def test_the_gradient_reaches_the_past_and_is_that_of_finite_differences(estimator, undirected):
    batch = random_batch(horizon=2, n=12)
    inputs = [x.double().requires_grad_() for x in (batch.trvs, batch.means, batch.stds, batch.prev_trvs)]

    def estimate(trvs, means, stds, past):
        samples = batch._replace(trvs=trvs, means=means, stds=stds, prev_trvs=past)
        # Times zero: finite differences must exist for an estimator that does not use the samples.
        return estimator(2, 2, 2)(samples) + 0 * trvs.sum()

    assert th.autograd.gradcheck(estimate, inputs)


def test_without_the_past_it_says_what_is_missing():
    with pytest.raises(ValueError, match="needs the prev_trvs of the batch"):
        DirectedLogDet(4, 2, 2)(random_batch()._replace(prev_trvs=None))


def test_training_charges_the_rebuilt_memory():
    model = tiny_tdpg(lava_env(), mi_estimator="directed", mi_kwargs={}, beta=1.0).learn(1)
    batch = model.rollout_buffer.episode_batch()
    information = batch.information_batch()
    th.testing.assert_close(information.prev_trvs[1:], batch.trvs[:-1])
    assert not information.prev_trvs[0].any()
    assert model.information.sum().item() == pytest.approx(model.estimator(information).sum().item())
    rebuilt = batch._replace(trvs=batch.trvs.clone().requires_grad_())
    assert rebuilt.information_batch().prev_trvs.requires_grad
    pooled = batch.information_batch(pooled=True)
    assert pooled.prev_trvs.shape == pooled.trvs.shape == (1, batch.trvs[..., 0].numel(), 2)
