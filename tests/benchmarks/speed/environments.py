"""A step of many environments at once, and the images of a camera."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg import make_episodes_env
from sb3_tdpg.envs.ball_bullet import BulletRenderer
from sb3_tdpg.envs.ball_catch import DT, BallCatchEnv
from sb3_tdpg.envs.ball_fast import FastRenderer
from tests.benchmarks.speed.measure import SEED, Row, Sizes, compare, seconds


def bench_environment(sizes: Sizes) -> Iterable[Row]:
    """Compare the batched environment with SB3's loop over environments."""
    n = sizes.n_episodes

    def stepper(env: VecEnv, n_steps: int) -> Callable[[], float]:
        env.reset()
        actions = np.random.default_rng(SEED).standard_normal((n, 1)).astype(np.float32)

        def run() -> None:
            for _ in range(n_steps):
                env.step(actions)

        return lambda: seconds(run, n_steps * n)

    yield compare(
        f"environment step, n_envs={n}: BatchedVecEnv against DummyVecEnv",
        stepper(make_episodes_env("Lava-v0", n), 100),
        stepper(make_vec_env("Lava-v0", n_envs=n), 10),
        sizes.repetitions,
    )


def bench_camera(sizes: Sizes) -> Iterable[Row]:
    """Compare the two renderers of the ball-catching camera over whole episodes of robots that drive to the ball."""
    n = sizes.n_episodes
    env = BallCatchEnv(renderer="fast")
    states = [env.reset_batch(n)[0]]
    for remaining in range(env.horizon, 0, -1):
        state = states[-1]
        lands = state[:, 1] + state[:, 3] * DT * remaining
        action = (lands - state[:, 0]) / (env.control_gain * remaining)
        states.append(env.step_batch(state, action[:, None], is_last=False).state)
    fast, reference = FastRenderer(env.scene), BulletRenderer(env.scene)
    some = max(1, n // 50)  # of the images by PyBullet, which draws them one by one anyway

    def draw(renderer: FastRenderer | BulletRenderer, n_images: int) -> None:
        for state in states:  # as in a rollout, images are let go before the next ones are drawn
            renderer.images(state[:n_images])

    yield compare(
        f"camera image, {n} at a time: batched ray caster against PyBullet's TinyRenderer",
        lambda: seconds(lambda: draw(fast, n), n * len(states)),
        lambda: seconds(lambda: draw(reference, some), some * len(states)),
        sizes.repetitions,
        goal=50,
    )
    reference.close()
