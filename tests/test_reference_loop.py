"""
One policy epoch of TDPG equals the simple loop in ``reference_loop.py`` for the same random numbers.

The computation is in float64, so that rounding errors are far below the tolerance of 1e-5. The dimension key is that of
``reference_loop.py``.
"""

from __future__ import annotations

import math
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch as th
from gymnasium.utils import seeding

from sb3_tdpg import TDPG
from sb3_tdpg.advantages import get_baseline
from sb3_tdpg.buffers import STORED, EpisodeBatch, EpisodeBuffer
from tests.reference_loop import Episode, LoopTDPG, Minibatch, Randomness, mean_baseline, unbatch

SEED = 7
TOLERANCE = 1e-5
N_EPISODES = 12


class Case(NamedTuple):
    beta: float = 1 / 75
    baseline: str = "mean"
    gradient_steps: int = 40


class Recorded(NamedTuple):
    """A batched epoch and the loop's epoch with the same randomness."""

    model: TDPG
    batch: EpisodeBatch
    information: np.ndarray | None  # (T,), as logged after the fit
    critics: list[th.nn.Sequential]  # the batched critics after the fit, unbatched
    loop: LoopTDPG
    episodes: list[Episode]
    loop_information: list[float]


@pytest.fixture(autouse=True)
def float64(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Use float64 for all computations between the environment and the optimiser."""
    reset = EpisodeBuffer.reset

    def reset_in_float64(buffer: EpisodeBuffer) -> None:
        reset(buffer)
        for name in STORED:
            setattr(buffer, name, getattr(buffer, name).astype(np.float64))

    monkeypatch.setattr(EpisodeBuffer, "reset", reset_in_float64)
    th.set_default_dtype(th.float64)
    yield
    th.set_default_dtype(th.float32)


def make_model(case: Case) -> TDPG:
    return TDPG(
        "TRVPolicy",
        "Lava-v0",
        beta=case.beta,
        baseline=case.baseline,
        gae_lambda=1.0,
        n_episodes=N_EPISODES,
        seed=SEED,
        device="cpu",
        mi_estimator="mine",
        policy_kwargs=dict(net_arch=dict(encoder=[8, 8], action_head=[8, 8])),
        mi_kwargs=dict(
            hidden_sizes=(8, 8),
            batch_size=5,
            gradient_steps=case.gradient_steps,
            warmup_gradient_steps=0,
            learning_rate=3e-2,
            refit_below=-math.inf,  # the loop does not support a fit from scratch
        ),
    )


def run_both(case: Case) -> Recorded:
    """Run one epoch with the batched code, recover its random numbers, and run the same epoch with the loop."""
    model = make_model(case)
    loop = LoopTDPG.copy_of(model)
    critic_inputs: list[th.Tensor] = []
    critic = model.estimator.critic
    critic.register_forward_pre_hook(lambda _, args: critic_inputs.append(args[0].detach()))
    _, callback = model._setup_learn(total_timesteps=10**6)
    th.manual_seed(SEED)
    assert model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)
    batch = model.rollout_buffer.episode_batch()
    information = model.information
    n_estimates = len(critic_inputs)
    model.train()

    has_penalty = model.mi_coef > 0
    fits = [minibatches_of(inputs, batch) for inputs in critic_inputs[: case.gradient_steps]]
    logged = minibatches_of(critic_inputs[n_estimates - 1], batch) if has_penalty else []
    # The last call comes from the update, with rebuilt TRVs.
    pairings = minibatches_of(critic_inputs[-1], batch) if has_penalty else []
    randomness = replay_randomness(model)._replace(
        minibatches=[list(of_t) for of_t in zip(*fits, strict=True)], pairings=pairings
    )

    episodes = loop.rollouts(randomness)
    loop_information: list[float] = []
    if has_penalty:
        loop.fit_critics(episodes, randomness.minibatches)
        trvs = [episode.trvs for episode in episodes]
        loop_information = [value.item() for value in loop.information(episodes, trvs, logged)]
    advantages = mean_baseline(episodes)
    if case.baseline != "mean":
        advantages = get_baseline(case.baseline)(batch.costs, batch.states, batch.alive, 1.0).T.tolist()
    loop.update(episodes, randomness.trv_noise, randomness.pairings, advantages)
    critics = unbatch(model.estimator.critic)
    return Recorded(model, batch, information, critics, loop, episodes, loop_information)


def replay_randomness(model: TDPG) -> Randomness:
    """Draw the random numbers of the first epoch's rollouts again, from generators with the same state."""
    n, horizon = model.n_episodes, model.horizon
    env_rng, _ = seeding.np_random(SEED)
    initial_distance = env_rng.uniform(0.0, 5.0, n)
    sensor_noise = np.stack([env_rng.standard_normal((n, 2)) for _ in range(horizon)], axis=1)
    with th.random.fork_rng():
        th.manual_seed(SEED)
        steps = [(th.randn(n, model.policy.trv_dim), th.randn(n, 1)) for _ in range(horizon)]
    trv_noise, action_noise = (th.stack(noise, dim=1) for noise in zip(*steps, strict=True))
    return Randomness(initial_distance, sensor_noise, trv_noise, action_noise, [], [])


def minibatches_of(inputs: th.Tensor, batch: EpisodeBatch) -> list[Minibatch]:
    """
    Return one minibatch for each time step: the episodes from which the critics' inputs come.

    :param inputs: B joint samples, then B marginal samples, ``(T, 2 B, X + Z)``.
    """
    minibatches, x_dim = [], batch.states.shape[-1]
    for t, rows in enumerate(inputs):
        joint, marginal = rows.chunk(2)
        both = th.cat([batch.states[t], batch.trvs[t]], dim=-1)
        x_episodes = find_rows(marginal[:, :x_dim], batch.states[t])
        trv_episodes = find_rows(marginal[:, x_dim:], batch.trvs[t])
        minibatches.append(Minibatch(find_rows(joint, both), list(zip(x_episodes, trv_episodes, strict=True))))
    return minibatches


def find_rows(rows: th.Tensor, table: th.Tensor) -> list[int]:
    """Return the index in ``table`` of each row in ``rows``."""
    distance, index = (rows[:, None] - table[None]).abs().amax(dim=-1).min(dim=1)
    assert distance.max() < 1e-9, "the critic was shown a sample that is in no episode"
    return index.tolist()


def assert_same_networks(
    batched: list[th.nn.Sequential], loop: list[th.nn.Sequential], *, before: list[th.nn.Sequential]
) -> None:
    """Compare the parameters, and check that they have changed."""
    for ours, reference, initial in zip(batched, loop, before, strict=True):
        moved = 0.0
        for p, q, p0 in zip(ours.parameters(), reference.parameters(), initial.parameters(), strict=True):
            th.testing.assert_close(p, q, rtol=0, atol=TOLERANCE)
            moved = max(moved, (p - p0).abs().max().item())
        assert moved > 100 * TOLERANCE


def test_batched_rollouts_equal_the_loop() -> None:
    recorded = run_both(Case())
    batch, episodes = recorded.batch, recorded.episodes
    for name in ("states", "observations", "trvs", "actions"):
        reference = th.stack([th.stack(getattr(episode, name)) for episode in episodes], dim=1)
        th.testing.assert_close(getattr(batch, name), reference, rtol=0, atol=TOLERANCE)
    costs = th.tensor([episode.costs for episode in episodes]).T
    th.testing.assert_close(batch.costs, costs, rtol=0, atol=TOLERANCE)
    # Some rollouts reach the wall and the lava, so that the comparison covers these parts of the dynamics.
    assert (batch.states[..., 0] == 0.0).any() and (batch.states[..., 0] == 5.0).any()


def test_batched_critics_equal_the_loop_after_the_fit() -> None:
    recorded = run_both(Case())
    before = unbatch(make_model(Case()).estimator.critic)
    assert_same_networks(recorded.critics, recorded.loop.critics, before=before)
    np.testing.assert_allclose(recorded.information, recorded.loop_information, rtol=0, atol=TOLERANCE)
    assert recorded.information.max() > 0.05, "the penalty is clamped to nothing: the comparisons say nothing of it"


@pytest.mark.parametrize("case", [
    Case(beta=math.inf),
    Case(),
    Case(baseline="regression"),
    Case(gradient_steps=1),  # the critics are almost untrained, and some estimates are below zero
], ids=str)  # fmt: skip
def test_batched_update_of_the_policy_equals_the_loop(case: Case) -> None:
    recorded = run_both(case)
    policy, loop = recorded.model.policy, recorded.loop
    initial = make_model(case).policy
    for network, initial_network, reference in (
        (policy.encoder, initial.encoder, loop.encoders),
        (policy.action_head, initial.action_head, loop.action_heads),
    ):
        assert_same_networks(unbatch(network.mlp), reference, before=unbatch(initial_network.mlp))
        # Adam's first step does not depend on the gradient's scale, so the gradients are compared, too.
        per_step = [[p.grad for p in module.parameters()] for module in reference]
        # In the layout of nn.Linear: (T, O, I) and (T, O) for each layer.
        batched = [g for layer in network.mlp.layers for g in (layer.weight.grad.mT, layer.bias.grad.squeeze(1))]
        for ours, theirs in zip(batched, zip(*per_step, strict=True), strict=True):
            expected = th.stack(theirs)
            th.testing.assert_close(ours, expected, rtol=0, atol=TOLERANCE * expected.abs().max().item())


def test_every_topic_of_the_benchmark_is_run():
    folder = Path(__file__).parent / "benchmarks"
    written = set(re.findall(r"^def (bench_\w+)", "".join(p.read_text() for p in folder.glob("speed/*.py")), re.M))
    show = f"import runpy; print(*(b.__name__ for b in runpy.run_path({str(folder / 'run.py')!r})['BENCHES']))"
    printed = subprocess.check_output([sys.executable, "-c", show], text=True, cwd=folder.parents[1])
    assert written
    assert written <= set(printed.split())
