"""Capture and restore the state of all random number generators, for checkpoints."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize


@dataclass(frozen=True)
class RandomState:
    """A snapshot of all generators (Python, NumPy, torch, environments) and of ``VecNormalize.obs_rms``."""

    python: tuple[Any, ...]
    numpy: dict[str, Any]
    torch: th.Tensor
    cuda: list[th.Tensor]  # one for each device
    env: list[np.random.Generator]
    obs_rms: Any  # None without VecNormalize

    @classmethod
    def capture(cls, env: VecEnv) -> RandomState:
        """Take a snapshot, which shares the environments' generators until it is pickled."""
        normalize = unwrap_vec_normalize(env)
        return cls(
            random.getstate(),
            np.random.get_state(legacy=False),  # noqa: NPY002  (third-party environments may still use it)
            th.get_rng_state(),
            th.cuda.get_rng_state_all() if th.cuda.is_available() else [],
            env.get_attr("np_random"),
            None if normalize is None else normalize.obs_rms,
        )

    def restore(self, env: VecEnv) -> None:
        """Restore all generators; raise a ``ValueError`` if the number of environments differs."""
        if len(self.env) != env.num_envs:
            raise ValueError(
                f"the checkpoint was made with {len(self.env)} environments, the model now has {env.num_envs}: "
                "resume with the same number"
            )
        random.setstate(self.python)
        np.random.set_state(self.numpy)  # noqa: NPY002
        th.set_rng_state(self.torch)
        if th.cuda.is_available() and self.cuda:
            th.cuda.set_rng_state_all(self.cuda)
        for i, generator in enumerate(self.env):
            env.set_attr("np_random", generator, indices=i)
        normalize = unwrap_vec_normalize(env)
        if normalize is not None and self.obs_rms is not None:
            normalize.obs_rms = self.obs_rms
