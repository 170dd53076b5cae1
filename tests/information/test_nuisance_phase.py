"""The gradient steps that remove a nuisance: no divergence, however large, throws the policy far."""

import pytest
import torch as th
from small_problems import parameters, tiny_tdpg, train_epochs

from sb3_tdpg.robustness.nuisance import FunctionNuisance


def test_a_huge_divergence_moves_the_policy_by_a_bounded_step():
    nuisance = FunctionNuisance(lambda y, rng: y + 1000)
    model = tiny_tdpg("Lava-v0", nuisance=nuisance, nuisance_steps=1)
    model.train = lambda: None
    train_epochs(model, 1)
    with th.no_grad():  # a policy that reacts strongly to what it sees
        for parameter in model.policy.parameters():
            parameter.mul_(3.0)
    phase, batch = model.nuisance_phase, model.rollout_buffer.episode_batch()
    assert phase.divergence(batch, phase.perturbed(batch, nuisance)).max() > 100
    # Plain gradient descent, as Adam's own steps have about one length.
    phase.optimizer = th.optim.SGD(model.policy.parameters(), lr=1.0)
    before = parameters(model.policy)
    phase.remove(batch, nuisance, model._check_finite)
    after = parameters(model.policy)
    moved = th.cat([(after[name] - before[name]).flatten() for name in before]).norm()
    assert moved.item() == pytest.approx(1.0, rel=1e-3)
