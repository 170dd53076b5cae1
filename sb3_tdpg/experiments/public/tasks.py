"""The public tasks, with the settings of rl-zoo3 that PPO and RecurrentPPO are trained with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import rl_zoo3
import rl_zoo3.import_envs  # registers CartPoleNoVel-v1 and PendulumNoVel-v1
import yaml

N_HOPPER_POSITIONS = 5  # of an observation; the other components are velocities


@dataclass(frozen=True)
class PublicTask:
    """
    A task that others made.

    :param env_id: Its registered id.
    :param block: Block of rl-zoo3's settings, where it is of an older version of the environment or of a similar one.
    :param n_timesteps: Length of a training, the same for all methods.
    :param hidden: Whether a memory is needed: the rival is RecurrentPPO instead of PPO.
    :param tuned: Block of ``hyperparams/tdpg.yml``.
    """

    env_id: str
    block: str
    n_timesteps: int = 100_000
    hidden: bool = False
    tuned: str | None = None

    @property
    def rival(self) -> str:
        """The method to compare with."""
        return "RecurrentPPO" if self.hidden else "PPO"

    def zoo_block(self) -> dict[str, Any]:
        """Read rl-zoo3's settings for the rival."""
        file = "ppo_lstm.yml" if self.hidden else "ppo.yml"
        block = dict(yaml.safe_load((Path(rl_zoo3.__file__).parent / "hyperparams" / file).read_text())[self.block])
        if isinstance(gym.spec(self.env_id).make().observation_space, gym.spaces.Discrete):
            block.pop("normalize")  # VecNormalize refuses it
        return block


TASKS = (
    PublicTask("CartPole-v1", "CartPole-v1"),
    PublicTask("Acrobot-v1", "Acrobot-v1", tuned="Acrobot-v1"),
    PublicTask("Pendulum-v1", "Pendulum-v1"),
    PublicTask("MountainCarContinuous-v0", "MountainCarContinuous-v0", 20_000),
    PublicTask("InvertedDoublePendulum-v5", "InvertedDoublePendulum-v2"),
    PublicTask("Reacher-v5", "Reacher-v2"),
    PublicTask("Hopper-v5", "Hopper-v4"),
    PublicTask("HalfCheetah-v5", "HalfCheetah-v4"),
    PublicTask("Swimmer-v5", "Swimmer-v4", tuned="Swimmer-v5"),
    PublicTask("CartPoleNoVel-v1", "CartPoleNoVel-v1", hidden=True),
    PublicTask("PendulumNoVel-v1", "PendulumNoVel-v1", hidden=True),
    PublicTask("HopperNoVel-v5", "Hopper-v4", hidden=True),
    # rl-zoo3 has no settings for POPGym: those of the nearest task.
    PublicTask("NoisyPositionOnlyCartPoleEasy-v0", "CartPoleNoVel-v1", hidden=True),
    PublicTask("RepeatPreviousEasy-v0", "CartPoleNoVel-v1", hidden=True),
)


def make_hopper_without_velocities(**kwargs: Any) -> gym.Env:
    """Make Hopper-v5 with the first components of its observation, the positions, only."""
    env = gym.make("Hopper-v5", **kwargs)
    full: Any = env.observation_space
    low, high = (bound[:N_HOPPER_POSITIONS] for bound in (full.low, full.high))
    space = gym.spaces.Box(low, high, dtype=np.float64)
    return gym.wrappers.TransformObservation(env, lambda y: y[:N_HOPPER_POSITIONS], space)


def register_tasks() -> None:
    """Register the ids that neither Gymnasium nor rl-zoo3 registers."""
    gym.register("HopperNoVel-v5", make_hopper_without_velocities, max_episode_steps=1000)
    # POPGym's environments end by themselves but declare no time limit, which TDPG needs.
    popgym = "popgym.envs.{0}:{1}Easy"
    cartpole = popgym.format("noisy_position_only_cartpole", "NoisyPositionOnlyCartPole")
    gym.register("NoisyPositionOnlyCartPoleEasy-v0", cartpole, max_episode_steps=200)
    previous = popgym.format("repeat_previous", "RepeatPrevious")
    gym.register("RepeatPreviousEasy-v0", previous, max_episode_steps=51)


register_tasks()
