"""Run environments on many cores or machines."""

from sb3_tdpg.distributed.ray_vec_env import DeadActorError, RayVecEnv

__all__ = ["DeadActorError", "RayVecEnv"]
