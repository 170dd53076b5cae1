"""Trials of grasping: what they are made of, and in several processes."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable

import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_tdpg.envs.panda_bullet import MOTIONS, GraspSimulation
from sb3_tdpg.envs.panda_camera import DepthCamera
from sb3_tdpg.envs.panda_grasp import ACTION_SCALE, HIGHEST_ACTION, LOWEST_ACTION, NOMINAL_GRASP, PandaGraspEnv
from sb3_tdpg.envs.panda_scene import TABLE_FILE, TABLE_POSITION
from tests.benchmarks.speed.measure import SEED, Row, Sizes, compare, format_time, seconds


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
        self.states = self.env.initial_state(n)
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
        GraspSimulation(self.env.cup_origin, MOTIONS["fast"]).close()

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
    slow = GraspSimulation(trials.env.cup_origin, MOTIONS["reference"])
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
    with_table = DepthCamera(trials.env.cup_origin)
    with_table.client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True)
    yield compare(
        "depth image: the mug drawn before a known table against mug and table",
        lambda: seconds(lambda: trials.env._world.camera.images(trials.states), trials.n),
        lambda: seconds(lambda: with_table.images(trials.states), trials.n),
        sizes.repetitions,
    )
    for each in (slow, with_table, trials.env, few.env):
        each.close()


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
        from sb3_tdpg.distributed import RayVecEnv

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
