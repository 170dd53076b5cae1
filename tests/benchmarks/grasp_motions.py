"""
How often the fast motion of PandaGrasp-v0 and the paper's slow one agree: ``python tests/benchmarks/grasp_motions.py``.

Takes a minute or two.
"""

from __future__ import annotations

import numpy as np

from sb3_tdpg.envs.panda_grasp import ACTION_SCALE, NOMINAL_GRASP, PandaGraspEnv

N = 100  # grasps of each kind


def main() -> None:
    """Run the same grasps with both motions."""
    fast, slow = PandaGraspEnv(), PandaGraspEnv(motion="reference")
    fast.reset(seed=0)
    states = fast.initial_state(N)
    rng = np.random.default_rng(0)
    at_the_rim = np.tile(NOMINAL_GRASP, (N, 1))
    at_the_rim[:, :2] = states[:, :2] + [0.045, 0.01]
    exact = (at_the_rim - NOMINAL_GRASP) / ACTION_SCALE
    kinds = {
        "at the rim, exactly": exact,
        "around it, standard deviation 1 cm and 0.1 rad": exact + 0.1 * rng.normal(size=(N, 4)) * [1, 1, 1, 10],
        "around the nominal grasp, 3.7 cm": np.exp(-1) * rng.normal(size=(N, 4)),
    }
    print("| grasps | fast lifts | reference lifts | agree |\n|---|---:|---:|---:|")
    for name, actions in kinds.items():
        lifts, slow_lifts = (env.step_batch(states, actions, is_last=True).cost == 0 for env in (fast, slow))
        agree = (lifts == slow_lifts).mean()
        print(f"| {name} | {lifts.mean():.0%} | {slow_lifts.mean():.0%} | {agree:.0%} |", flush=True)


if __name__ == "__main__":
    main()
