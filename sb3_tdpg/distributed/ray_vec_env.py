"""
Environments that are spread over the machines of a Ray cluster, or over the cores of this one.

Dimension key: N environments, in the order of ``env_fns``; each actor has a contiguous share of them.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_tdpg.distributed.ray_actor import Resets, Setting, Start, Steps, Taken, join
from sb3_tdpg.distributed.ray_pool import ActorPool, Call, DeadActorError
from sb3_tdpg.settings import check_count

__all__ = ["DeadActorError", "RayVecEnv"]


class RayVecEnv(VecEnv):
    """
    An SB3 ``VecEnv`` over Ray actors, each of which steps a batch of environments one after the other.

    It takes what ``SubprocVecEnv`` takes, and gives the same numbers for the same seeds; for where one machine has too
    few cores, or a process for each environment is too many::

        make_vec_env("PandaGrasp-v0", n_envs=32, vec_env_cls=RayVecEnv, vec_env_kwargs=dict(n_actors=8))

    If Ray has not been initialised (``ray.init``), the cluster that the variable ``RAY_ADDRESS`` names is joined;
    without one, an instance is started on this machine, and shut down with the last ``RayVecEnv`` that uses it. Its
    actors have the priority of this process, unless the variable ``RAY_worker_niceness`` is set; elsewhere Ray lets
    all other programs go first (nice 15). Every machine of a cluster needs this package.

    An exception of an environment is raised here as it is. An actor that dies (killed, crashed, its machine lost) never
    makes a call wait for ever: it is reported by a :class:`DeadActorError`, or, with ``max_restarts``, replaced, of
    which a warning tells. The new actor makes its environments anew, and each repeats its unfinished episode from the
    ``np_random`` at its beginning, with the attributes set so far and the same actions. So come the numbers that would
    have come without the loss, provided that an episode depends on nothing else. Rewards and last observations are
    compared; if they differ, or if ``env_method`` may have changed the environments, the death is reported after
    all. (Ray's own restart would make new episodes pass for the old ones.)

    :param env_fns: Each makes an environment.
    :param n_actors: Number of actors, each with about as many environments; default: one for each CPU of the cluster,
        but not more than environments.
    :param max_restarts: How often each actor may be replaced. Not for environments that carry something from one
        episode to the next, as a curriculum does: it is lost.
    :param actor_options: Options of Ray for each actor, ``dict(num_cpus=2)`` or ``dict(num_gpus=0.1)`` for instance;
        default: one CPU. On an instance started here CPUs are not counted unless they are asked for.
    :param start_timeout: Seconds to wait for the actors to start, and for their environments to be made.
    :param step_timeout: Seconds to wait for an answer after which an actor counts as dead; None: as long as it lives.
    :raises ValueError: if an argument is out of its range.
    :raises TimeoutError: if the actors did not start in time, for instance because the cluster has too few CPUs.
    :raises ImportError: without Ray (``pip install sb3_tdpg[ray]``).
    """

    def __init__(
        self,
        env_fns: Iterable[Callable[[], gym.Env]],
        n_actors: int | None = None,
        *,
        max_restarts: int = 0,
        actor_options: Mapping[str, Any] | None = None,
        start_timeout: float = 120.0,
        step_timeout: float | None = None,
    ) -> None:
        env_fns = list(env_fns)
        options = dict(actor_options or {})
        _check_arguments(len(env_fns), n_actors, max_restarts, options)
        for name, timeout in (("start_timeout", start_timeout), ("step_timeout", step_timeout)):
            if timeout is not None and not timeout > 0:
                raise ValueError(f"{name}={timeout!r} must be a positive number of seconds")
        self._pool = ActorPool(
            env_fns,
            n_actors,
            max_restarts=max_restarts,
            actor_options=options,
            start_timeout=start_timeout,
            step_timeout=step_timeout,
        )
        self._keeps_histories = max_restarts > 0
        self._actions: Any = None
        self._calls: list[Call] = []
        try:
            super().__init__(len(env_fns), *self._pool.spaces)
        except BaseException:
            self.close()
            raise

    def reset(self) -> VecEnvObs:
        """Start N episodes: observations, ``(N, *obs)``."""
        calls = [
            self._pool.send(i, "reset", self._seeds[share.start : share.stop], self._options[share.start : share.stop])
            for i, share in enumerate(self._pool.shares)
        ]
        rests: list[Resets] = self._pool.observe(calls)
        self.reset_infos = [info for rest in rests for info in rest.infos]
        for i, start in enumerate(start for rest in rests for start in rest.starts):
            self._pool.histories[i].begin_episode(start)
        # Seeds and options are used once.
        self._reset_seeds()
        self._reset_options()
        return self._observations()

    def step_async(self, actions: np.ndarray) -> None:
        """Send each actor the actions of its environments, ``(N, U)`` in all."""
        if len(actions) != self.num_envs:
            raise ValueError(f"{len(actions)} actions were given: {self.num_envs} environments need as many")
        self._actions = copy.deepcopy(actions) if self._keeps_histories else actions
        self._calls = [
            self._pool.send(i, "step", self._actions[share.start : share.stop])
            for i, share in enumerate(self._pool.shares)
        ]

    def step_wait(self) -> VecEnvStepReturn:
        """Gather what the actors return; see :class:`stable_baselines3.common.vec_env.VecEnv`."""
        rests: list[Steps] = self._pool.observe(self._calls)
        rewards = np.concatenate([rest.rewards for rest in rests])
        dones = np.concatenate([rest.dones for rest in rests])
        infos = [info for rest in rests for info in rest.infos]
        reset_infos, starts = list(self.reset_infos), {}
        for share, rest in zip(self._pool.shares, rests, strict=True):
            for i, info in rest.reset_infos.items():
                reset_infos[share[i]] = info
            starts.update({share[i]: start for i, start in rest.starts.items()})
        self.reset_infos = reset_infos
        if self._keeps_histories:
            self._record_step(rewards, starts)
        return self._observations(), rewards, dones, infos

    def _record_step(self, rewards: np.ndarray, starts: Mapping[int, Start]) -> None:
        for i, (history, action, reward) in enumerate(zip(self._pool.histories, self._actions, rewards, strict=True)):
            if i in starts:
                history.begin_episode(starts[i])
            else:
                history.events.append(Taken(action, reward))

    def _observations(self) -> VecEnvObs:
        # A copy, also of one: what comes from Ray's object store cannot be written to.
        return join(self._pool.last_observations, self.observation_space, np.concatenate)

    def close(self) -> None:
        """Close the environments and end the actors; closing twice is fine."""
        self._pool.close()

    # -- single environments ------------------------------------------------------------------------------------------

    def _indices(self, indices: VecEnvIndices) -> list[int]:
        return [range(self.num_envs)[i] for i in self._get_indices(indices)]

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each environment."""
        return self._pool.ask(self._indices(indices), "get_attr", attr_name)

    def has_attr(self, attr_name: str) -> bool:
        """Tell whether all environments have an attribute."""
        return all(self._pool.ask(self._indices(None), "has_attr", attr_name))

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of each environment."""
        setting = Setting(attr_name, cloudpickle.dumps(value))
        self._pool.ask(self._indices(indices), "set_attr", setting)
        if self._keeps_histories:
            for i in self._indices(indices):
                self._pool.histories[i].events.append(setting)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each environment."""
        results = self._pool.ask(self._indices(indices), "env_method", method_name, method_args, method_kwargs)
        if method_name != "render":
            self._pool.unrecorded = method_name
        return results

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Tell of each environment whether it has a wrapper of this class."""
        return self._pool.ask(self._indices(indices), "env_is_wrapped", wrapper_class)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Render each environment."""
        if self.render_mode != "rgb_array":
            warnings.warn(f"render_mode={self.render_mode!r} must be 'rgb_array' for images", stacklevel=2)
            return [None] * self.num_envs
        return self._pool.ask(self._indices(None), "render")


def _check_arguments(n_envs: int, n_actors: int | None, max_restarts: int, options: Mapping[str, Any]) -> None:
    if n_envs == 0:
        raise ValueError("env_fns is empty: give one function for each environment")
    if n_actors is not None:
        check_count("n_actors", n_actors)
        if n_actors > n_envs:
            raise ValueError(f"n_actors={n_actors} must be at most the number of environments: {n_envs}")
    if not (isinstance(max_restarts, (int, np.integer)) and max_restarts >= 0):
        raise ValueError(f"max_restarts={max_restarts!r} must be an integer of at least 0")
    if taken := {"max_restarts", "max_task_retries"} & set(options):
        raise ValueError(f"actor_options has {sorted(taken)}: give max_restarts to RayVecEnv itself")
