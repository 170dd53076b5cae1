"""Environments on many cores or machines."""

from sb3_tdpg.distributed.ray_vec_env import RayVecEnv

__all__ = ["RayVecEnv"]
