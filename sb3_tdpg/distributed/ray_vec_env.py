"""
Run environments on the machines of a Ray cluster, or on the cores of this machine.

Dimension key: N environments in the order of ``env_fns``; each actor runs B successive environments.
"""

import itertools
import os
import pickle
import uuid
import warnings
from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from typing import Any

import cloudpickle
import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space, concatenate, create_empty_array, iterate
from stable_baselines3.common.env_util import unwrap_wrapper
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvObs, VecEnvStepReturn

from sb3_tdpg.common.threads import set_threads, usable_cores
from sb3_tdpg.envs.checks import count as check_count

START_TIMEOUT = 120.0  # s; maximum time until all actors have made their environments
CLOSE_TIMEOUT = 10.0  # s; after this time an actor is killed even if its environments are not closed


class DeadActorError(RuntimeError):
    """An actor died or did not answer, and Ray does not restart it. The actor's running episodes are lost."""


class EnvActor:
    """Run B environments in a ``DummyVecEnv``. Each method returns the observations (or None) and all other results."""

    def __init__(self, env_fns: Sequence[Callable[[], gym.Env]]) -> None:
        set_threads(1)
        self._env_fns = list(env_fns)
        self._has_begun = False
        self._life = uuid.uuid4().hex  # changes when Ray restarts the actor

    @cached_property
    def _env(self) -> DummyVecEnv:
        # The first call makes the environments, because Ray does not forward exceptions of an actor's constructor.
        return DummyVecEnv(self._env_fns)

    def call(self, message: bytes) -> tuple[bytes, bytes]:
        """Call another method and pickle the results: Ray takes 0.1 ms longer for an array and makes it read-only."""
        name, *arguments = cloudpickle.loads(message)
        observations, rest = getattr(self, name)(*arguments)
        return pickle.dumps(observations, pickle.HIGHEST_PROTOCOL), cloudpickle.dumps((self._life, rest))

    def spaces(self, may_restart: bool) -> tuple[None, tuple[gym.Space, gym.Space]]:
        """Return the observation and the action space."""
        monitor = unwrap_wrapper(self._env.envs[0], Monitor)
        if may_restart and isinstance(monitor, Monitor) and monitor.results_writer is not None:
            raise ValueError(
                "max_restarts must be 0 if Monitor writes a file, because a restarted actor would overwrite it: leave "
                "out the file (monitor_dir) and wrap the RayVecEnv in VecMonitor(env, filename)"
            )
        return None, (self._env.observation_space, self._env.action_space)

    def reset(self, seeds: list[int | None], options: list[dict[str, Any]]) -> tuple[Any, list[dict[str, Any]]]:
        """Reset the environments."""
        self._env._seeds, self._env._options = seeds, options
        self._has_begun = True
        return self._env.reset(), self._env.reset_infos

    def step(self, actions: np.ndarray) -> tuple[Any, Sequence[Any]]:
        """Step the environments, or start new episodes if the running episodes were lost in a restart."""
        if self._has_begun:
            observations, *rest = self._env.step(actions)
            return observations, (*rest, self._env.reset_infos)
        n = len(actions)
        observations, reset_infos = self.reset([None] * n, [{}] * n)
        infos = [{"episode_lost": True, "TimeLimit.truncated": True} for _ in range(n)]
        return observations, (np.zeros(n, np.float32), np.ones(n, bool), infos, reset_infos)

    def ask(self, indices: list[int], method: str, args: Sequence[Any], kwargs: dict[str, Any]) -> tuple[None, Any]:
        """Call a method of the ``DummyVecEnv`` that takes ``indices``."""
        return None, getattr(self._env, method)(*args, indices=indices, **kwargs)

    def close(self) -> tuple[None, None]:
        """Close the environments."""
        self._env.close()
        return None, None


class RayVecEnv(VecEnv):
    """
    Run an SB3 ``VecEnv`` in Ray actors, with one ``DummyVecEnv`` per actor.

    For the same seeds the results are those of ``SubprocVecEnv``, but the cores can belong to several machines::

        make_vec_env("PandaGrasp-v0", n_envs=32, vec_env_cls=RayVecEnv, vec_env_kwargs=dict(n_actors=8))

    If Ray is not initialised (``ray.init``), this class joins the cluster that the environment variable ``RAY_ADDRESS``
    names. Without this variable, it starts Ray on this machine, and ends Ray when the last ``RayVecEnv`` is closed.
    Every machine of a cluster needs this package. Unless this class starts Ray, each actor reserves one CPU.

    An exception of an environment is raised unchanged. If an actor dies (killed, crashed, machine lost), the next call
    raises :class:`DeadActorError`. With ``max_restarts`` above 0, Ray restarts the actor instead, and the actor makes
    new environments. The running episodes are lost, and so are attributes set by ``set_attr``. The next step gives a
    warning and ends these episodes like a time limit, with reward 0 and ``info["episode_lost"]=True``.

    :param env_fns: Functions that make one environment each.
    :param n_actors: Number of actors. By default, one for each CPU of the cluster, but at most one per environment.
    :param max_restarts: Largest number of times that Ray restarts each actor.
    :param step_timeout: Seconds after which an actor that does not answer is killed. This time must be longer than a
        restart takes. ``None`` means no limit.
    :raises TimeoutError: if the actors do not start within two minutes, for instance because the cluster has too few
        CPUs.
    """

    # All objects share the connection to Ray. These attributes are the number of objects that use the connection,
    # whether this class made the connection, and whether Ray runs only on this machine.
    _n_users, _is_ours, _is_local = 0, False, False

    def __init__(
        self,
        env_fns: Iterable[Callable[[], gym.Env]],
        n_actors: int | None = None,
        *,
        max_restarts: int = 0,
        step_timeout: float | None = None,
    ) -> None:
        env_fns = list(env_fns)
        if not env_fns:
            raise ValueError("env_fns is empty: give one function for each environment")
        if n_actors is not None:
            check_count("n_actors", n_actors)
            if n_actors > len(env_fns):
                raise ValueError(f"n_actors={n_actors} must be at most the number of environments: {len(env_fns)}")
        if not (isinstance(max_restarts, (int, np.integer)) and max_restarts >= 0):
            raise ValueError(f"max_restarts={max_restarts!r} must be an integer of at least 0")
        if step_timeout is not None and not step_timeout > 0:
            raise ValueError(f"step_timeout={step_timeout!r} must be a positive number of seconds")
        self._max_restarts, self._step_timeout = max_restarts, step_timeout
        self._actors: list[Any] = []
        self._is_closed = False
        self._connect(n_actors or min(len(env_fns), usable_cores()))
        try:
            n_actors = n_actors or min(len(env_fns), max(1, int(self._ray.cluster_resources().get("CPU", 1))))
            bounds = [len(env_fns) * i // n_actors for i in range(n_actors + 1)]
            self._shares = list(itertools.starmap(slice, itertools.pairwise(bounds)))
            # Actors need no CPU if this class has started Ray: otherwise a second RayVecEnv would wait for free CPUs
            # for ever. Task events cost 0.1 ms per step.
            actor_class = self._ray.remote(EnvActor).options(
                num_cpus=0 if self._is_local else 1,
                max_restarts=max_restarts,
                max_task_retries=-1 if max_restarts else 0,
                enable_task_events=False,
            )
            self._actors = [actor_class.remote(env_fns[share]) for share in self._shares]
            self._lives: list[str | None] = [None] * n_actors
            super().__init__(len(env_fns), *self._wait_for_start())
        except BaseException:
            self.close()
            raise

    def _connect(self, n_cpus: int) -> None:
        """Connect to Ray, or start it on this machine if there is no cluster."""
        try:
            import ray
        except ImportError as e:
            raise ImportError("RayVecEnv needs Ray: pip install sb3_tdpg[ray]") from e
        self._ray: Any = ray
        if not ray.is_initialized():
            is_local = not os.environ.get("RAY_ADDRESS")
            RayVecEnv._n_users, RayVecEnv._is_ours, RayVecEnv._is_local = 0, True, is_local
            # By default Ray's processes have a low priority (nice 15).
            config = {} if "RAY_worker_niceness" in os.environ else {"worker_niceness": 0}
            local = dict(address="local", num_cpus=n_cpus, include_dashboard=False, _system_config=config)
            self._ray.init(**(local if is_local else {}))
        RayVecEnv._n_users += 1

    def _wait_for_start(self) -> tuple[gym.Space, gym.Space]:
        replies = [self._send(i, "spaces", self._max_restarts > 0) for i in range(len(self._actors))]
        made = [rest for _, rest in replies]
        _, late = self._ray.wait(made, num_returns=len(made), timeout=START_TIMEOUT)
        if late:
            raise TimeoutError(
                f"{len(late)} of {len(made)} actors did not start within {START_TIMEOUT:g} s; free are "
                f"{self._ray.available_resources()}: use fewer actors (n_actors), or add machines"
            )
        return self._receive_all(replies)[1][0]

    def _send(self, actor: int, method: str, *arguments: Any) -> list[Any]:
        """Call a method of an actor; return Ray's references to the observations and to the other results."""
        # Ray needs 1 ms longer for an object of more than 100 kB, so terminal images are not sent with the next images.
        return self._actors[actor].call.options(num_returns=2).remote(cloudpickle.dumps((method, *arguments)))

    def _receive_all(self, replies: Sequence[Any]) -> tuple[tuple[Any, ...], ...]:
        """Wait for the replies of all actors; return a tuple of the observations and a tuple of the other results."""
        return tuple(zip(*itertools.starmap(self._receive, enumerate(replies)), strict=True))

    def _receive(self, actor: int, reply: list[Any]) -> tuple[Any, Any]:
        share, timeout = self._shares[actor], self._step_timeout
        name = f"actor {actor} of {len(self._shares)} (environments {share.start} to {share.stop - 1})"
        while True:
            try:
                observations, rest = self._ray.get(reply, timeout=timeout)
                break
            except self._ray.exceptions.RayTaskError as error:
                # The caller expects the exception of the environment, for instance an AttributeError.
                raise (error.cause if isinstance(error.cause, Exception) else RuntimeError(str(error))) from error
            except self._ray.exceptions.GetTimeoutError:
                self._ray.kill(self._actors[actor], no_restart=False)
                timeout = START_TIMEOUT + (timeout or 0.0)
            except self._ray.exceptions.RayError as error:
                raise DeadActorError(
                    f"{name} has died, or did not answer within step_timeout={self._step_timeout}: "
                    f"{str(error).strip().partition(chr(10))[0]} Make a new RayVecEnv and continue from the last "
                    f"checkpoint; max_restarts={self._max_restarts} is how often Ray restarts an actor"
                ) from error
        life, result = cloudpickle.loads(rest)
        if self._lives[actor] not in (None, life):
            warnings.warn(f"Ray has restarted {name}: its running episodes and attributes are lost", stacklevel=2)
        self._lives[actor] = life
        return pickle.loads(observations), result

    def _ask(self, indices: VecEnvIndices, method: str, *args: Any, **kwargs: Any) -> list[Any]:
        """Call a method of the actors' ``DummyVecEnv`` for some environments; return one result per environment."""
        places = [(actor, i) for actor, share in enumerate(self._shares) for i in range(share.stop - share.start)]
        wanted = [places[i] for i in self._get_indices(indices)]
        replies = [(actor, self._send(actor, "ask", [i], method, args, kwargs)) for actor, i in wanted]
        return [(self._receive(actor, reply)[1] or [None])[0] for actor, reply in replies]

    def reset(self) -> VecEnvObs:
        """Start N episodes and return their observations, ``(N, *obs)``."""
        replies = [self._send(i, "reset", self._seeds[s], self._options[s]) for i, s in enumerate(self._shares)]
        parts, infos = self._receive_all(replies)
        self.reset_infos = list(itertools.chain(*infos))
        self._reset_seeds()  # seeds and options are used once
        self._reset_options()
        return self._join(parts)

    def step_async(self, actions: np.ndarray) -> None:
        """Send to each actor the actions of its environments; ``actions`` has a row for each environment."""
        if len(actions) != self.num_envs:
            raise ValueError(f"{len(actions)} actions were given: {self.num_envs} environments need as many")
        self._replies = [self._send(i, "step", actions[share]) for i, share in enumerate(self._shares)]

    def step_wait(self) -> VecEnvStepReturn:
        """Wait for the result of the step; see :class:`stable_baselines3.common.vec_env.VecEnv`."""
        parts, rests = self._receive_all(self._replies)
        rewards, dones, infos_of_actors, reset_infos = zip(*rests, strict=True)
        infos = list(itertools.chain(*infos_of_actors))
        for info, observation in zip(infos, self._last_observations, strict=True):
            if info.get("episode_lost"):
                info["terminal_observation"] = observation
        self.reset_infos = list(itertools.chain(*reset_infos))
        return self._join(parts), np.concatenate(rewards), np.concatenate(dones), infos

    def _join(self, parts: Sequence[Any]) -> VecEnvObs:
        """Join the observations of all actors; each has the shape ``(B, *obs)``."""
        space = self.observation_space
        self._last_observations = list(itertools.chain(*(iterate(batch_space(space), part) for part in parts)))
        out: Any = create_empty_array(space, self.num_envs)
        return concatenate(space, self._last_observations, out)

    def close(self) -> None:
        """Close the environments and end the actors; a second call does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._ray.is_initialized() and self._actors:
            replies = [self._send(i, "close")[1] for i in range(len(self._actors))]
            has_started = hasattr(self, "num_envs")  # otherwise an actor may still wait for its CPUs
            self._ray.wait(replies, num_returns=len(replies), timeout=CLOSE_TIMEOUT if has_started else 0)
            for actor in self._actors:
                self._ray.kill(actor)
        RayVecEnv._n_users -= 1
        if RayVecEnv._n_users == 0 and RayVecEnv._is_ours:
            self._ray.shutdown()
            RayVecEnv._is_ours = RayVecEnv._is_local = False

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each environment."""
        return self._ask(indices, "get_attr", attr_name)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of each environment."""
        self._ask(indices, "set_attr", attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of each environment."""
        return self._ask(indices, "env_method", method_name, *method_args, **method_kwargs)

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Return for each environment whether it has a wrapper of this class."""
        return self._ask(indices, "env_is_wrapped", wrapper_class)

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Render each environment."""
        return self.env_method("render")
