"""CPU time of the perturbations of images, in microseconds an image: ``python tests/benchmarks/perturbations.py``."""

import functools
import time

from sb3_tdpg import make_episodes_env
from sb3_tdpg.robustness import PERTURBATIONS, applicable
from sb3_tdpg.robustness.core import Perturber
from sb3_tdpg.robustness.sensor import Sensor

REPEATS = 5
BATCHES = {"BallCatch-v0": (200, dict(renderer="fast"), (3, 64, 64)), "PandaGrasp-v0": (50, {}, (1, 128, 128))}


def microseconds(function, n):
    """CPU time of the fastest of a few calls, by image."""
    times = []
    for _ in range(REPEATS):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return 1e6 * min(times) / n


def costs(name, images, space):
    """CPU time at the severities 1, 3 and 5."""
    n = len(images)
    perturbers = [Perturber(PERTURBATIONS[name], severity, Sensor(space), n, seed=0) for severity in (1, 3, 5)]
    return [microseconds(functools.partial(perturber, images), n) for perturber in perturbers]


def main():
    print(f"{'':16}" + "".join(f"{f'{n} x {shape}':>28}" for n, _, shape in BATCHES.values()))
    columns = []
    for env_id, (n, env_kwargs, _) in BATCHES.items():
        env = make_episodes_env(env_id, n, env_kwargs=env_kwargs, seed=0, use_processes=False)
        images, space = env.reset(), env.observation_space
        env.close()
        columns.append({name: costs(name, images, space) for name in applicable(space)})
    for name in columns[0]:
        cells = ["  ".join(f"{t:5.0f}" for t in column[name]) if name in column else "-" for column in columns]
        print(f"{name:16}" + "".join(f"{cell:>28}" for cell in cells))


if __name__ == "__main__":
    main()
