"""Make grasps whose outcome is known, for the tests of the grasping problem."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from sb3_tdpg.envs.panda_grasp import NOMINAL_GRASP

REPOSITORY = Path(__file__).resolve().parents[1]


def random_states(n, seed=0, half_width=0.05):
    rng = np.random.default_rng(seed)
    states = np.zeros((n, 4))
    states[:, :2] = np.add((0.5, 0.0), rng.uniform(-half_width, half_width, (n, 2)))
    states[:, 3] = rng.uniform(-np.pi, np.pi, n)
    return states


def action_for(poses):
    """Return the action of a grasp at (x, y, z, yaw)."""
    return ((np.asarray(poses) - NOMINAL_GRASP) / 0.1).astype(np.float32)


def oracle_actions(states):
    """Return grasps of the rim at a side where one finger is inside the mug and the other finger outside."""
    poses = np.tile(NOMINAL_GRASP, (len(states), 1))
    poses[:, :2] = states[:, :2] + [0.045, 0.01]
    return action_for(poses)


def mixed_actions(states, seed=0):
    """Return grasps around the oracle's grasps, of which about half lift the mug."""
    noise = np.random.default_rng(seed).normal(size=(len(states), 4))
    return (oracle_actions(states) + noise * [0.3, 0.3, 0.2, 3.0]).astype(np.float32)


def run_python(*arguments, **kwargs):
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(
        [sys.executable, *arguments], env=environment, text=True, capture_output=True, timeout=120, **kwargs
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout
