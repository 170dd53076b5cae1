"""Statistics of the inputs: over several batches and epochs they are those of all together."""

import numpy as np
import pytest
import torch as th

from sb3_tdpg.common.running_norms import Changes, RunningNorm


def test_batches_of_different_means_have_the_mean_and_the_variance_of_all_together():
    rng = np.random.default_rng(0)
    batches = [rng.normal(mean, std, (n, 2)) for mean, std, n in ((-4, 1, 100), (3, 1, 1), (7, 2, 300), (1, 5, 50))]
    norm = RunningNorm(2)
    for k, batch in enumerate(batches):
        norm.update(th.as_tensor(batch, dtype=th.float32))
        seen = np.concatenate(batches[: k + 1])
        np.testing.assert_allclose(norm.mean, seen.mean(0), rtol=1e-4)
        np.testing.assert_allclose(norm.var, seen.var(0), rtol=1e-4)
        assert norm.count.item() == pytest.approx(len(seen), rel=1e-5)
    shown = np.concatenate([seen, seen[:1] + 1e3])
    expected = ((shown - seen.mean(0)) / seen.std(0)).clip(-10, 10)
    np.testing.assert_allclose(norm(th.as_tensor(shown, dtype=th.float32)), expected, rtol=1e-2, atol=1e-2)


def test_the_share_of_the_changes_is_the_mean_over_the_epochs():
    alive = th.ones(50, 40)
    straight = th.arange(50)[:, None, None] * th.randn(40, 1)
    epochs = [straight + noise_std * th.randn(50, 40, 1) for noise_std in (0.0, 0.3, 3.0)]
    shares = []
    for epoch in epochs:
        alone = Changes(1)
        alone.update(epoch, alive)
        shares.append(alone.share.item())
    assert (np.abs(np.diff(shares)) > 0.1).all()  # the epochs differ
    together = Changes(1)
    for n, epoch in enumerate(epochs, start=1):
        together.update(epoch, alive)
        assert together.share.item() == pytest.approx(np.mean(shares[:n]), abs=1e-6)
