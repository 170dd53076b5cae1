"""What TDPG does where an argument is left out: a vector and an image are not learnt from in the same way."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_tdpg.features import observation_kind


class Defaults(NamedTuple):
    """Arguments of :class:`~sb3_tdpg.tdpg.TDPG` that depend on the kind of observation, and the length of training."""

    beta: float | str
    learning_rate: Schedule
    n_episodes: int
    n_epochs: int
    batch_size: int | None
    clip_range: float
    normalize_advantage: bool
    encoder_gradient: str
    mi_estimator: str
    n_threads: int | None
    total_epochs: int  # policy epochs


# As in the paper, with one update an epoch: what the last epochs gain, they gain from a falling rate.
VECTOR = Defaults(
    beta=1 / 75,
    learning_rate=LinearSchedule(2e-3, 2e-5, 1.0),
    n_episodes=500,
    n_epochs=1,
    batch_size=None,
    clip_range=float("inf"),
    normalize_advantage=False,
    encoder_gradient="score",
    mi_estimator="mine",
    n_threads=1,
    total_epochs=400,
)

# Images are dear: PPO's passes over few episodes, and the gradient that varies least.
IMAGE = Defaults(
    beta="auto",
    learning_rate=LinearSchedule(1e-3, 5e-5, 1.0),
    n_episodes=160,
    n_epochs=4,
    batch_size=80,
    clip_range=0.2,
    normalize_advantage=True,
    encoder_gradient="pathwise",
    mi_estimator="logdet",
    n_threads=None,
    total_epochs=50,
)

# Depth images come from problems whose every trial is simulated: dearer still.
DEPTH = IMAGE._replace(n_episodes=400, batch_size=200, total_epochs=100)


def defaults_for(observation_space: spaces.Space | None) -> Defaults:
    """Return the defaults for the kind of an observation space (:func:`~sb3_tdpg.features.observation_kind`)."""
    return dict(vector=VECTOR, image=IMAGE, depth=DEPTH)[observation_kind(observation_space)]


def fill_in(given: Mapping[str, Any], observation_space: spaces.Space | None) -> dict[str, Any]:
    """
    Put the defaults in the place of what is ``None``.

    :param given: Arguments by their names.
    :param observation_space: Of the environment.
    """
    defaults = defaults_for(observation_space)
    settings = {name: getattr(defaults, name) if value is None else value for name, value in given.items()}
    if given["batch_size"] is None and defaults.batch_size is not None:
        # Whatever number of episodes is asked for, the default must fit.
        settings["batch_size"] = min(defaults.batch_size, settings["n_episodes"])
    return settings
