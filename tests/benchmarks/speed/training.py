"""An epoch of TDPG and a step of training."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_tdpg import TDPG, make_episodes_env
from tests.benchmarks.speed.measure import SEED, Row, Sizes, compare, seconds
from tests.reference_loop import LoopTDPG, draw_randomness


def make_tdpg(n_episodes: int, *, beta: float = 1 / 75, **kwargs: Any) -> TDPG:
    """TDPG on Lava with its default sizes."""
    return TDPG("TRVPolicy", "Lava-v0", beta=beta, n_episodes=n_episodes, seed=SEED, device="cpu", **kwargs)


def learner(model: BaseAlgorithm, epochs: int, steps_per_epoch: int) -> Callable[[], None]:
    """Return a function that trains a model on for some epochs; the first, with its warm-up, is made here."""
    model.learn(steps_per_epoch)
    return lambda: model.learn(epochs * steps_per_epoch, reset_num_timesteps=False)


def bench_epoch(sizes: Sizes) -> Iterable[Row]:
    """Compare an epoch of TDPG with the loop over samples, time steps and critics."""
    n = sizes.n_episodes
    # The mean baseline of the paper; the loop makes no regression.
    model = make_tdpg(n, baseline="mean", mi_estimator="mine")
    loop = LoopTDPG.copy_of(model)
    learn = learner(model, sizes.epochs, n * model.horizon)
    rng = np.random.default_rng(SEED)
    yield compare(
        f"policy epoch, N={n}, T={model.horizon}, {model.estimator.gradient_steps} MINE steps of "
        f"{model.estimator.batch_size}: TDPG against a loop over samples",
        lambda: seconds(learn, sizes.epochs),
        lambda: seconds(lambda: loop.epoch(draw_randomness(model, rng))),
        sizes.loop_repetitions,
        goal=150,
    )


def bench_training(sizes: Sizes) -> Iterable[Row]:
    """Compare the time of training for each environment step with that of RecurrentPPO."""
    n = sizes.n_episodes
    for name, beta in (("PG (beta=inf)", float("inf")), ("TDPG (penalty on)", 1 / 75)):
        model = make_tdpg(n, beta=beta)
        steps = n * model.horizon
        learn = learner(model, sizes.epochs, steps)
        # One pass over all samples at once, as TDPG makes one: smaller minibatches are slower.
        ppo = RecurrentPPO(
            "MlpLstmPolicy",
            make_episodes_env("Lava-v0", n),
            n_steps=model.horizon,
            batch_size=steps,
            n_epochs=1,
            seed=SEED,
            device="cpu",
        )
        learn_ppo = learner(ppo, 1, steps)
        yield compare(
            f"training, for each environment step, n_envs={n}, one pass: {name} against RecurrentPPO",
            lambda learn=learn, steps=steps: seconds(learn, sizes.epochs * steps),
            lambda learn=learn_ppo, steps=steps: seconds(learn, steps),
            sizes.repetitions,
            goal=3,
        )
