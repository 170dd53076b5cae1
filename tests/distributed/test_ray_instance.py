"""RayVecEnv without a cluster: it starts an instance of Ray for itself, and shuts it down."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("ray")

REPOSITORY = Path(__file__).resolve().parents[2]
OWN_INSTANCE = """
import os
import gymnasium as gym
import ray
from stable_baselines3.common.env_util import make_vec_env
from sb3_tdpg.distributed import RayVecEnv

class Polite(gym.Wrapper):
    niceness = property(lambda self: os.nice(0))

train = make_vec_env("Lava-v0", 2, wrapper_class=Polite, vec_env_cls=RayVecEnv, vec_env_kwargs=dict(n_actors=1))
assert train.get_attr("niceness") == [os.nice(0)] * 2  # as SubprocVecEnv's processes; Ray's default is 15
assert "RAY_worker_niceness" not in os.environ
assert ray.is_initialized() and ray.cluster_resources()["CPU"] == 1
evaluate = make_vec_env("Lava-v0", 1, vec_env_cls=RayVecEnv)  # is given a place, too
train.reset()
train.close()
assert evaluate.reset().shape == (1, 2)  # still in use
evaluate.close()
assert not ray.is_initialized()
print("shut down")
"""


@pytest.mark.slow
def test_an_instance_of_its_own_is_started_and_shut_down_by_the_last_that_uses_it():
    done = subprocess.run([sys.executable, "-c", OWN_INSTANCE], cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "shut down" in done.stdout
