"""Make a model that is ready to learn from a block of ``hyperparams/tdpg.yml``."""

from collections.abc import Mapping
from pkgutil import resolve_name
from typing import Any, NamedTuple

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from sb3_tdpg.callbacks import SelectionCallback
from sb3_tdpg.tdpg import TDPG
from sb3_tdpg.vec_env import make_episodes_env


class Training(NamedTuple):
    """A model, and the callbacks and the number of timesteps for its training."""

    model: TDPG
    callbacks: list[BaseCallback]
    n_timesteps: int

    @property
    def selection(self) -> SelectionCallback | None:
        """The callback that selects the policy, if the block has one."""
        return next((c for c in self.callbacks if isinstance(c, SelectionCallback)), None)


def make_training(env_id: str, block: Mapping[str, Any], **overrides: Any) -> Training:
    """
    Build model and callbacks from a block of settings, as rl-zoo3 does.

    ``n_timesteps``, ``n_envs``, ``env_kwargs``, ``vec_env_wrapper``, ``normalize`` and ``callback`` are keys of
    rl-zoo3. All other keys are arguments of :class:`~sb3_tdpg.tdpg.TDPG`. ``lin_1e-3`` is a learning rate that
    decreases linearly to zero.

    :param env_id: A registered id.
    :param block: The settings, for instance from :func:`sb3_tdpg.hyperparams.load_hyperparams`.
    :param overrides: Settings that replace those of the block or add to them.
    """
    settings = {**block, **overrides}
    n_timesteps = int(settings.pop("n_timesteps"))
    callbacks: list[BaseCallback] = [_make(BaseCallback, entry) for entry in settings.pop("callback", [])]
    env = take_env(env_id, settings)
    return Training(TDPG(settings.pop("policy"), env, **settings), callbacks, n_timesteps)


def take_env(env_id: str, settings: dict[str, Any]) -> VecEnv:
    """
    Make the environments of a training, and remove the settings of the environments from a block.

    These settings are ``n_envs``, ``env_kwargs``, ``vec_env_wrapper`` and ``normalize`` (a dict of keywords of
    ``VecNormalize``, to which this function adds ``gamma``, as the zoo does).
    """
    env = make_episodes_env(
        env_id,
        settings.pop("n_envs", None),
        n_episodes=settings.get("n_episodes"),
        epoch_steps=settings.get("epoch_steps"),
        env_kwargs=settings.pop("env_kwargs", {}),
        use_processes=False,  # each run already has its own process
    )
    for entry in settings.pop("vec_env_wrapper", []):
        env = _make(VecEnvWrapper, entry, env)
    normalize = settings.pop("normalize", None)
    return env if normalize is None else VecNormalize(env, **{**normalize, "gamma": settings.get("gamma", 0.99)})


def _make(kind: type, entry: str | Mapping[str, Mapping[str, Any]], *arguments: Any) -> Any:
    """Make a callback or a wrapper from ``{"package.module.Class": {keywords}}`` or ``"package.module.Class"``."""
    (path, keywords), *more = [(entry, {})] if isinstance(entry, str) else entry.items()
    if more:
        raise ValueError(f"a callback or a wrapper is one class with its keywords, not {entry}")
    cls = resolve_name(path)
    if not (isinstance(cls, type) and issubclass(cls, kind)):  # settings can come from others: call no other function
        raise ValueError(f"{path} is not a subclass of {kind.__name__}")
    return cls(*arguments, **keywords)
