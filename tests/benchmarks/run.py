"""
``make bench``: what batching is worth, as ratios measured in this run on one thread.

Every ratio compares two ways to do the same thing, run in turn (A B B A ...), by their CPU times; where several
processes work, by their elapsed times. It is the median of the ratios of neighbours: what slows down both for a while
drops out.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

# Before NumPy and PyTorch start their threads.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")
REPOSITORY = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(REPOSITORY))

import numpy as np  # noqa: E402
import torch as th  # noqa: E402
from sb3_contrib import RecurrentPPO  # noqa: E402
from scipy.stats import quantile_test  # noqa: E402
from stable_baselines3.common.base_class import BaseAlgorithm  # noqa: E402
from stable_baselines3.common.env_util import make_vec_env  # noqa: E402
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv  # noqa: E402
from torch import nn  # noqa: E402

from sb3_tdpg import TDPG, make_episodes_env  # noqa: E402
from sb3_tdpg.envs.ball_bullet import BulletRenderer  # noqa: E402
from sb3_tdpg.envs.ball_catch import BallCatchEnv  # noqa: E402
from sb3_tdpg.envs.ball_fast import FastRenderer  # noqa: E402
from sb3_tdpg.envs.ball_scene import Renderer  # noqa: E402
from sb3_tdpg.envs.panda_bullet import MOTIONS, GraspSimulation  # noqa: E402
from sb3_tdpg.envs.panda_camera import DepthCamera  # noqa: E402
from sb3_tdpg.envs.panda_grasp import (  # noqa: E402
    ACTION_SCALE,
    HIGHEST_ACTION,
    LOWEST_ACTION,
    NOMINAL_GRASP,
    PandaGraspEnv,
)
from sb3_tdpg.envs.panda_scene import TABLE_FILE, TABLE_POSITION  # noqa: E402
from sb3_tdpg.information import InformationBatch, Mine  # noqa: E402
from sb3_tdpg.training_batch import Member, TrainingBatch  # noqa: E402
from tests.reference_loop import LoopTDPG, draw_randomness, unbatch  # noqa: E402

PACKAGES = ("torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy")
SEED = 0


class Sizes(NamedTuple):
    """How much is measured."""

    n_episodes: int
    repetitions: int
    loop_repetitions: int  # of the per-sample loop, which takes many seconds
    process_repetitions: int  # of several processes: what else runs on the machine disturbs elapsed times
    epochs: int  # policy epochs in one measurement of a batched algorithm


FULL = Sizes(n_episodes=500, repetitions=7, loop_repetitions=3, process_repetitions=150, epochs=10)
QUICK = Sizes(n_episodes=100, repetitions=3, loop_repetitions=1, process_repetitions=10, epochs=3)


class Row(NamedTuple):
    """One line of the table; times are medians in seconds."""

    what: str
    ours: float
    reference: float
    ratio: float  # how many times faster ours is
    lowest: float  # of the interval of the ratio
    highest: float
    goal: float | None

    @property
    def met(self) -> str:
        """Whether the goal is met."""
        return "-" if self.goal is None else "yes" if self.ratio >= self.goal else "no"


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """
    Return two of the values that have the true median between them with a confidence of at least 95 %.

    It assumes no distribution (inverts a sign test), but independent values. There is no such pair of fewer than 6:
    then the lowest and the highest are returned; of n values they hold it with ``1 - 2**(1 - n)``.
    """
    low, high = quantile_test(values, p=0.5).confidence_interval(confidence_level=0.95)
    return (low, high) if np.isfinite([low, high]).all() else (min(values), max(values))


def compare(
    what: str,
    ours: Callable[[], float],
    reference: Callable[[], float],
    repetitions: int,
    goal: float | None = None,
) -> Row:
    """
    Measure two functions in turn, each as often the first of a pair, after one call of each that does not count.

    :param ours: returns its cost in seconds for each unit of work
    :param reference: likewise
    """
    ours()
    reference()
    our_times, reference_times = [], []
    for i in range(repetitions):
        for function, times in ((ours, our_times), (reference, reference_times))[:: 1 if i % 2 == 0 else -1]:
            times.append(function())
    ratios = [theirs / mine for mine, theirs in zip(our_times, reference_times, strict=True)]
    row = Row(
        what,
        statistics.median(our_times),
        statistics.median(reference_times),
        statistics.median(ratios),
        *median_interval(ratios),
        goal,
    )
    print(f"{row.what}: {format_interval(row)}", flush=True)
    return row


def seconds(function: Callable[[], object], units: int = 1) -> float:
    """CPU time of a call for each of the units of work that it does: not disturbed by other processes."""
    start = time.process_time()
    function()
    return (time.process_time() - start) / units


# -- (a) a policy epoch -----------------------------------------------------------------------------------------------


def make_tdpg(n_episodes: int, *, beta: float = 1 / 75, baseline: str = "value") -> TDPG:
    """TDPG on Lava with its default sizes."""
    return TDPG("TRVPolicy", "Lava-v0", beta=beta, baseline=baseline, n_episodes=n_episodes, seed=SEED, device="cpu")


def learner(model: BaseAlgorithm, epochs: int, steps_per_epoch: int) -> Callable[[], None]:
    """Return a function that trains a model on for some epochs; the first, with its warm-up, is made here."""
    model.learn(steps_per_epoch)
    return lambda: model.learn(epochs * steps_per_epoch, reset_num_timesteps=False)


def bench_epoch(sizes: Sizes) -> Iterable[Row]:
    """Compare an epoch of TDPG with the loop over samples, time steps and critics."""
    n = sizes.n_episodes
    # The mean baseline of the paper; the loop makes no regression.
    model = make_tdpg(n, baseline="mean")
    loop = LoopTDPG.copy_of(model)
    learn = learner(model, sizes.epochs, n * model.horizon)
    rng = np.random.default_rng(SEED)
    yield compare(
        f"policy epoch, N={n}, T={model.horizon}, {model.estimator.gradient_steps} MINE steps of "
        f"{model.estimator.batch_size}: TDPG against a loop over samples",
        lambda: seconds(learn, sizes.epochs),
        lambda: seconds(lambda: loop.epoch(draw_randomness(model, rng))),
        sizes.loop_repetitions,
        goal=100,
    )


def bench_batch(sizes: Sizes) -> Iterable[Row]:
    """Compare eight trainings as one batch with one alone, for each training; the critics' warm-up counts."""
    n_timesteps = 5 * sizes.n_episodes * 4 * sizes.epochs

    def models(n: int, estimator: str) -> list[TDPG]:
        return [
            TDPG("TRVPolicy", "Lava-v0", mi_estimator=estimator, n_episodes=sizes.n_episodes, seed=seed, device="cpu")
            for seed in range(n)
        ]

    for estimator in ("logdet", "mine"):
        yield compare(
            f"training on Lava, N={sizes.n_episodes}, {4 * sizes.epochs} epochs, {estimator}: eight seeds as one batch "
            "against one by one, for each seed",
            lambda name=estimator: seconds(
                TrainingBatch([Member(model, n_timesteps) for model in models(8, name)]).learn, units=8
            ),
            lambda name=estimator: seconds(lambda: models(1, name)[0].learn(n_timesteps)),
            sizes.loop_repetitions,
        )


# -- (b) the critics --------------------------------------------------------------------------------------------------


def correlated_gaussians(horizon: int, n: int, dim: int = 2) -> InformationBatch:
    """Make states and TRVs that tell of each other."""
    generator = th.Generator().manual_seed(SEED)
    means = th.randn(horizon, n, dim, generator=generator)
    stds = th.full_like(means, 0.5)
    return InformationBatch(means, means + stds * th.randn(means.shape, generator=generator), means, stds)


def fit_one_by_one(
    critics: list[nn.Sequential], optimizers: list[th.optim.Adam], batch: InformationBatch, size: int, n_steps: int
) -> None:
    """Fit critics in a loop: a network, a backward pass and an optimiser for each."""
    for _ in range(n_steps):
        chosen = th.randperm(batch.trvs.shape[1])
        own, other = chosen[:size], chosen[size : 2 * size]
        for t, (critic, optimizer) in enumerate(zip(critics, optimizers, strict=True)):
            states, trvs, others = batch.states[t, own], batch.trvs[t, own], batch.trvs[t, other]
            # One call for both distributions: the fastest loop.
            values = critic(th.cat([th.cat([states, trvs], 1), th.cat([states, others], 1)]))
            joint, marginal = values.chunk(2)
            loss = -(joint.mean() - marginal.exp().mean().log())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


def bench_critics(sizes: Sizes) -> Iterable[Row]:
    """Compare one batched network with a loop over T critics, at the sizes of Lava and of grasping."""
    n_steps = 20 * sizes.epochs
    for horizon, hidden, size in ((5, 32, 50), (25, 64, 20)):
        batch = correlated_gaussians(horizon, 500)
        mine = Mine(
            horizon,
            2,
            2,
            hidden_sizes=(hidden, hidden),
            batch_size=size,
            gradient_steps=n_steps,
            warmup_gradient_steps=n_steps,
        )
        critics = unbatch(mine.critic)
        optimizers = [th.optim.Adam(critic.parameters(), lr=mine.learning_rate) for critic in critics]

        def fit_batched(mine: Mine = mine, batch: InformationBatch = batch) -> float:
            return seconds(lambda: mine.fit(batch), n_steps)

        def fit_loop(
            critics: list[nn.Sequential] = critics,
            optimizers: list[th.optim.Adam] = optimizers,
            batch: InformationBatch = batch,
            size: int = size,
        ) -> float:
            return seconds(lambda: fit_one_by_one(critics, optimizers, batch, size, n_steps), n_steps)

        yield compare(
            f"gradient step of the critics, T={horizon}, hidden {hidden}-{hidden}, B={size}: "
            "batched against a loop over critics",
            fit_batched,
            fit_loop,
            sizes.repetitions,
            goal=10,
        )


# -- (c) training -----------------------------------------------------------------------------------------------------


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


# -- (d) the environment ----------------------------------------------------------------------------------------------


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


# -- (e) the camera ---------------------------------------------------------------------------------------------------


def bench_camera(sizes: Sizes) -> Iterable[Row]:
    """Compare the two renderers of the ball-catching camera over whole episodes of robots that drive to the ball."""
    n = sizes.n_episodes
    env = BallCatchEnv(renderer="fast")
    states = [env.reset_batch(n)[0]]
    for remaining in range(env.horizon, 0, -1):
        state = states[-1]
        lands = state[:, 1] + state[:, 3] * env.dt * remaining
        action = (lands - state[:, 0]) / (env.control_gain * remaining)
        states.append(env.step_batch(state, action[:, None], is_last=False).state)
    fast, reference = FastRenderer(env.scene), BulletRenderer(env.scene)
    some = max(1, n // 50)  # of the images by PyBullet, which draws them one by one anyway

    def draw(renderer: Renderer, n_images: int) -> None:
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


# -- (f) grasping -----------------------------------------------------------------------------------------------------


def some_grasps(states: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Poses and actions of an untrained policy's kind, half of which lift the mug: ``(N, 4)`` each."""
    poses = np.tile(NOMINAL_GRASP, (len(states), 1))
    poses[:, :2] = states[:, :2] + [0.045, 0.01]
    poses += rng.normal(size=poses.shape) * [0.03, 0.03, 0.01, 0.3]
    actions = np.clip((poses - NOMINAL_GRASP) / ACTION_SCALE, LOWEST_ACTION, HIGHEST_ACTION)
    return NOMINAL_GRASP + ACTION_SCALE * actions, actions


class GraspTrials:
    """Trials of an untrained policy's kind, half of which lift the mug, and what they are made of."""

    def __init__(self, n: int) -> None:
        self.n = n
        self.env = PandaGraspEnv()
        self.env.reset(seed=SEED)
        self.states = self.env._initial_state(n)
        self.poses, self.actions = some_grasps(self.states, np.random.default_rng(SEED))

    def run(self) -> None:
        """Whole trials, as in training: the image before and the one after the grasp among them."""
        self.env.reset_batch(self.n)
        self.env.step_batch(self.states, self.actions, is_last=True)

    def grasp(self, simulation: GraspSimulation) -> None:
        """The simulation alone."""
        for state, pose in zip(self.states, self.poses, strict=True):
            simulation.grasp(state, pose)

    def restore(self) -> None:
        """What brings the world back to its beginning."""
        for state in self.states:
            self.env._world.simulation._restore(state)

    def rebuild(self) -> None:
        """Make the world anew."""
        GraspSimulation(self.env.scene, MOTIONS["fast"]).close()

    def split(self, repetitions: int) -> str:
        """Trials in a second, and where the time goes: medians."""

        def median(function: Callable[[], object]) -> float:
            return statistics.median(seconds(function, self.n) for _ in range(repetitions))

        self.run()
        whole, restore = median(self.run), median(self.restore)
        depth = median(lambda: self.env._world.camera.images(self.states))
        simulation = median(lambda: self.grasp(self.env._world.simulation)) - restore
        return (
            f"PandaGrasp-v0, fast motion: {1 / whole:.0f} trials a second of CPU time. A trial takes "
            f"{format_time(whole)}: reset of the world {format_time(restore)}, two depth images "
            f"{format_time(2 * depth)}, simulation {format_time(simulation)}."
        )


def bench_grasp(sizes: Sizes) -> Iterable[Row]:
    """Compare the parts of a trial with what they replace."""
    trials = GraspTrials(max(10, sizes.n_episodes // 10))
    some = max(1, trials.n // 10)
    few = GraspTrials(some)
    slow = GraspSimulation(trials.env.scene, MOTIONS["reference"])
    yield compare(
        "grasp: the fast motion against the paper's",
        lambda: seconds(lambda: trials.grasp(trials.env._world.simulation), trials.n),
        lambda: seconds(lambda: few.grasp(slow), some),
        sizes.loop_repetitions,
    )
    yield compare(
        "start of a grasp: a saved state of the world against a new world",
        lambda: seconds(trials.restore, trials.n),
        lambda: seconds(trials.rebuild),
        sizes.repetitions,
    )
    with_table = DepthCamera(trials.env.scene)
    with_table.client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True)
    yield compare(
        "depth image: the mug drawn before a known table against mug and table",
        lambda: seconds(lambda: trials.env._world.camera.images(trials.states), trials.n),
        lambda: seconds(lambda: with_table.images(trials.states), trials.n),
        sizes.repetitions,
    )
    for each in (slow, with_table, trials.env, few.env):
        each.close()


# -- (g) several processes --------------------------------------------------------------------------------------------


def grasping_of_two(vec_env_class: Callable[..., VecEnv], n_steps: int) -> tuple[VecEnv, Callable[[], float]]:
    """Return two environments, and a function that carries out trials in them and returns the elapsed time of one."""
    env = make_vec_env("sb3_tdpg:PandaGrasp-v0", n_envs=2, seed=SEED, vec_env_cls=vec_env_class)  # type: ignore[arg-type]
    env.reset()
    rng = np.random.default_rng(SEED)

    def run() -> float:
        start = time.perf_counter()
        for _ in range(n_steps):
            states = np.array([info["state"] for info in env.reset_infos])
            env.step(some_grasps(states, rng)[1].astype(np.float32))
        return (time.perf_counter() - start) / (n_steps * env.num_envs)

    return env, run


def bench_processes(sizes: Sizes) -> Iterable[Row]:
    """Compare Ray's actors with SB3's processes, two of each, in the same trials."""
    try:
        from sb3_tdpg.ray_vec_env import RayVecEnv

        ours, run_ours = grasping_of_two(RayVecEnv, sizes.n_episodes // 100)
    except ImportError as e:
        print(f"left out: {e}")
        return
    reference, run_reference = grasping_of_two(SubprocVecEnv, sizes.n_episodes // 100)
    yield compare(
        "trial of PandaGrasp, elapsed time: RayVecEnv with 2 actors against SubprocVecEnv with 2 processes",
        run_ours,
        run_reference,
        sizes.process_repetitions,
        goal=0.9,
    )
    for env in (ours, reference):
        env.close()


# -- the table --------------------------------------------------------------------------------------------------------


def format_time(value: float) -> str:
    """Print seconds with a fitting unit and three digits."""
    for unit, scale in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6)):
        if value >= scale:
            return f"{value / scale:.3g} {unit}"
    return f"{value / 1e-9:.3g} ns"


def format_ratio(value: float) -> str:
    """Print a ratio, and one of about 1 with one digit more."""
    return f"{value:.2f}" if value < 2 else f"{value:.1f}"


def format_interval(row: Row) -> str:
    """Print the ratio of a row, and its interval."""
    return f"{format_ratio(row.ratio)}x ({format_ratio(row.lowest)}-{format_ratio(row.highest)})"


def format_table(rows: Iterable[Row]) -> str:
    """Lay out the rows as a Markdown table."""
    lines = ["| what | ours | reference | ratio (interval) | goal | met |", "|---|---|---|---|---|---|"]
    for row in rows:
        goal = "-" if row.goal is None else f"{row.goal:g}x"
        times = f"{format_time(row.ours)} | {format_time(row.reference)}"
        lines.append(f"| {row.what} | {times} | {format_interval(row)} | {goal} | {row.met} |")
    return "\n".join(lines)


def describe_machine() -> str:
    """One line for each of machine, versions, commit."""
    cpu_info = Path("/proc/cpuinfo")
    lines = cpu_info.read_text().splitlines() if cpu_info.exists() else []
    processor = next((line.split(": ")[1] for line in lines if line.startswith("model name")), platform.processor())
    versions = ", ".join(f"{package} {version(package)}" for package in PACKAGES)
    git = subprocess.run(
        ["git", "describe", "--always", "--dirty"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    return "\n".join(
        [
            f"- machine: {processor}, {os.cpu_count()} cores, {platform.system()}",
            f"- versions: Python {platform.python_version()}, {versions}",
            f"- commit: {git.stdout.strip() or 'unknown'}; torch threads: {th.get_num_threads()}",
        ]
    )


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that everything runs (seconds)")
    parser.add_argument("--out", type=Path, default=REPOSITORY / "results" / "bench.md", help="Markdown file to write")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    sizes = QUICK if arguments.quick else FULL

    start = time.perf_counter()
    benches = (
        bench_epoch,
        bench_batch,
        bench_critics,
        bench_training,
        bench_environment,
        bench_camera,
        bench_grasp,
        bench_processes,
    )
    rows = [row for bench in benches for row in bench(sizes)]
    split = GraspTrials(max(10, sizes.n_episodes // 5)).split(sizes.loop_repetitions)
    elapsed = time.perf_counter() - start
    title = "# Speed" + (" (--quick: not the paper's sizes)" if arguments.quick else "")
    notes = (
        "CPU time of one thread (elapsed time where the row says so), medians over repetitions in which both sides "
        "take turns; the ratio is the median of the ratios of neighbours, and its interval holds the true median with "
        "a confidence of at least 95 % (75 % with 3 repetitions, which have the lowest and the highest instead). The "
        "first policy epoch, with the critics' warm-up, is not counted. "
        f"{sizes.repetitions} repetitions ({sizes.loop_repetitions} of the loop over samples and of the paper's grasp, "
        f"{sizes.process_repetitions} of several processes), {elapsed:.0f} s in all."
    )
    report = "\n\n".join([title, describe_machine(), format_table(rows), split, notes]) + "\n"
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(report, encoding="utf-8")
    print(f"\n{report}\nwritten to {arguments.out}")


if __name__ == "__main__":
    main()
