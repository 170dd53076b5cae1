"""
Endurance test: ``make soak``, ten minutes. It fails if it finds a leak, a difference or a lost trial.

Memory and open files of this process must not grow after the first tenth of each job. Trainings that are killed and
resumed must end with the same parameters as an uninterrupted training. A study must not lose a trial when its workers
are killed and its PostgreSQL server is restarted.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

# This must come before NumPy and PyTorch start their threads.
os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1")

import gymnasium as gym
from optuna.trial import TrialState
from postgres import Postgres
from study_workers import Workers, open_quick

from sb3_tdpg import TDPG, make_episodes_env
from sb3_tdpg.common.markdown import markdown_table

MEMORY_LIMIT = 8.0  # MB of growth; the allocator's noise is below 1 MB
TRAIN = ["train", "--env", "Lava-v0", "--block", "Lava-v0-logdet", "--eval-freq", "-1", "--verbose", "0"]
TRAIN += ["-params", "n_episodes:20", "-n", "100000"]
N_TRAININGS, N_KILLS = 5, 5  # each training is killed N_KILLS times
N_TRIALS, N_WORKERS, N_WORKER_KILLS, N_RESTARTS = 40, 3, 5, 2


def lava() -> Iterator[None]:
    """Reset the lava problem 1e5 times."""
    env = make_episodes_env("Lava-v0", n_episodes=500)
    for _ in range(200):
        env.reset()
        yield
    env.close()


def grasp() -> Iterator[None]:
    """Simulate 2,000 grasps."""
    yield from _episodes("PandaGrasp-v0", 2000)


def ball() -> Iterator[None]:
    """Run 300 episodes of ball catching with PyBullet."""
    yield from _episodes("BallCatch-v0", 300, renderer="pybullet")


def _episodes(env_id: str, n_episodes: int, **env_kwargs: Any) -> Iterator[None]:
    env = gym.make(env_id, **env_kwargs)
    env.action_space.seed(0)
    for seed in range(n_episodes):
        env.reset(seed=seed)
        is_over = False
        while not is_over:
            *_, terminated, truncated, _ = env.step(env.action_space.sample())
            is_over = terminated or truncated
        yield
    env.close()


def epochs() -> Iterator[None]:
    """Train 200 policy epochs with MINE."""
    model = TDPG("TRVPolicy", "Lava-v0", seed=0, device="cpu")
    for _ in range(200):
        model.learn(model.n_episodes * model.horizon, reset_num_timesteps=False)
        yield


LOOPS: dict[str, Callable[[], Iterator[None]]] = dict(lava=lava, grasp=grasp, ball=ball, epochs=epochs)


def no_leak(loop: Callable[[], Iterator[None]]) -> tuple[str, bool]:
    """Compare memory and open files after the first tenth of a loop with the values at its end."""
    sizes = [_resources() for _ in loop()]
    (memory, files), (last_memory, last_files) = sizes[len(sizes) // 10], sizes[-1]
    growth = last_memory - memory
    return f"{growth:+.1f} MB, {last_files - files:+d} files", growth <= MEMORY_LIMIT and last_files <= files


def _resources() -> tuple[float, int]:
    """Return the resident memory in MB, and the number of open files."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6, len(os.listdir("/proc/self/fd"))


def resumed() -> tuple[str, bool]:
    """Kill trainings at random times, resume them, and compare their parameters with uninterrupted trainings."""
    rng, n_equal, n_kills = random.Random(0), 0, 0
    for seed in range(N_TRAININGS):
        with tempfile.TemporaryDirectory() as folder:
            arguments = [*TRAIN, "--seed", str(seed)]
            logs = Path(folder, "logs", "tdpg")
            for _ in range(N_KILLS):
                n_kills += _killed(arguments, Path(folder), logs / "Lava-v0_1" / "checkpoint.zip", rng)
                arguments = ["train", "--resume", "logs/tdpg/Lava-v0_1"]
            _start(arguments, Path(folder)).wait()
            _start([*TRAIN, "--seed", str(seed)], Path(folder)).wait()
            ended = [_hash(logs / f"Lava-v0_{n}" / "Lava-v0.zip") for n in (1, 2)]
        n_equal += ended[0] == ended[1]
    expected = N_TRAININGS * N_KILLS
    text = f"{n_kills} of {expected} kills, {n_equal} of {N_TRAININGS} trainings equal"
    return text, (n_kills, n_equal) == (expected, N_TRAININGS)


def _start(arguments: list[str], folder: Path) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", "sb3_tdpg", *arguments]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _killed(arguments: list[str], folder: Path, checkpoint: Path, rng: random.Random) -> bool:
    """Kill a training shortly after it has written a new checkpoint; return whether it was still running."""
    before = checkpoint.stat().st_mtime_ns if checkpoint.exists() else 0
    process = _start(arguments, folder)
    while process.poll() is None and not (checkpoint.exists() and checkpoint.stat().st_mtime_ns > before):
        time.sleep(0.02)
    time.sleep(rng.uniform(0, 0.5))
    was_running = process.poll() is None
    process.kill()
    process.wait()
    return was_running


def _hash(path: Path) -> str:
    parameters = TDPG.load(path, device="cpu").policy.state_dict()
    return hashlib.sha256(b"".join(value.numpy().tobytes() for value in parameters.values())).hexdigest()


def study() -> tuple[str, bool]:
    """Kill workers of a study and restart its PostgreSQL; count the trials."""
    rng, server, folder = random.Random(0), Postgres(), Path(tempfile.mkdtemp())
    server.start()
    url = server.create_database("soak")
    team = Workers(folder, url, N_TRIALS)
    try:
        alive = team.start(*[1.0] * N_WORKERS)
        for worker in alive:
            team.wait_for("begin", worker)
        events = ["kill"] * N_WORKER_KILLS + ["restart"] * N_RESTARTS
        rng.shuffle(events)
        for event in events:
            time.sleep(rng.uniform(0.5, 2.0))
            if event == "restart":
                server.stop()
                time.sleep(1.0)
                server.start()
            else:
                victim = alive.pop(rng.randrange(len(alive)))
                team.send("SIGKILL", victim)
                victim.join()
                alive += team.start(1.0)
                team.wait_for("begin", alive[-1])
        team.join(alive)
        trials = open_quick(url).get_trials()
    finally:
        team.stop()
        server.close()
        shutil.rmtree(folder)
    finished = sum(trial.state == TrialState.COMPLETE for trial in trials)
    left = sum(not trial.state.is_finished() for trial in trials)
    text = f"{finished} trials finished of {N_TRIALS} (at most {N_TRIALS + N_WORKERS}), {left} left behind"
    return text, N_TRIALS <= finished <= N_TRIALS + N_WORKERS and left == 0


JOBS: dict[str, Callable[[], tuple[str, bool]]] = {
    **{name: lambda loop=loop: no_leak(loop) for name, loop in LOOPS.items()},  # type: ignore[misc]
    "resumed": resumed,
    "study": study,
}


def main() -> int:
    """Run the jobs; return 1 if a job failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("jobs", nargs="*", default=list(JOBS), help=f"default: {' '.join(JOBS)}")
    rows = []
    for name in parser.parse_args().jobs:
        begin = time.perf_counter()
        text, is_good = JOBS[name]()
        what = str((LOOPS.get(name) or JOBS[name]).__doc__).splitlines()[0]
        rows.append(dict(job=what, result=text, seconds=f"{time.perf_counter() - begin:.0f}", good=is_good))
        print(rows[-1], flush=True)
    print("\n" + markdown_table(rows))
    return int(not all(row["good"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
