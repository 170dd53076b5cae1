"""The actors of :class:`~sb3_tdpg.distributed.ray_vec_env.RayVecEnv`: how they are started, asked and replaced."""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import pickle
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import cloudpickle
import gymnasium as gym

from sb3_tdpg.common.processes import usable_cores
from sb3_tdpg.distributed.ray_actor import EnvActor, History

CLOSE_TIMEOUT = 10.0  # s, after which an actor is ended without its environments having been closed


class DeadActorError(RuntimeError):
    """An actor has died, or gives no answer, and is not replaced: the episodes that it was running are lost."""


class Call(NamedTuple):
    """What an actor has been asked."""

    actor: int
    message: bytes
    reply: list[Any]  # Ray's references to the observations and to the rest


class ActorPool:
    """
    N environments in actors, each with a contiguous share of them. For the parameters see ``RayVecEnv``.

    :param env_fns: N functions.
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gym.Env]],
        n_actors: int | None,
        *,
        max_restarts: int,
        actor_options: Mapping[str, Any],
        start_timeout: float,
        step_timeout: float | None,
    ) -> None:
        self._ray = import_ray()
        self._env_fns = env_fns
        self.max_restarts = max_restarts
        self._start_timeout = start_timeout
        self._step_timeout = step_timeout
        self.histories = [History() for _ in env_fns]
        self.unrecorded: str | None = None
        """A method that may have changed the environments in a way that the histories do not know."""
        self._actors: list[Any] = []
        self._is_closed = False
        SESSION.enter(n_actors or min(len(env_fns), usable_cores()), actor_options.get("num_cpus", 1))
        try:
            # Ray counts CPUs so that a machine is not given too much; of an instance of our own this is the user's
            # choice, and the actors of a second RayVecEnv, for evaluation, would wait for ever.
            self._options = {"num_cpus": 0 if SESSION.is_local else 1, **actor_options}
            n_actors = n_actors or min(len(env_fns), max(1, int(self._ray.cluster_resources().get("CPU", 1))))
            # Two objects, since Ray sends one of up to 100 kB with the answer itself, and a larger one by a detour
            # through the object store, which takes about 1 ms longer.
            self._ray.method(num_returns=2)(EnvActor.call)
            # Ray's own restart would give an actor without environments. Task events tell Ray's dashboard of every
            # step, which costs each about 0.1 ms.
            self._actor_class = self._ray.remote(EnvActor).options(
                **{"enable_task_events": False, **self._options}, max_restarts=0, max_task_retries=0
            )
            bounds = [len(env_fns) * i // n_actors for i in range(n_actors + 1)]
            self.shares = [range(*pair) for pair in itertools.pairwise(bounds)]
            self._n_restarts = [0] * n_actors
            self.last_observations: list[Any] = [None] * n_actors
            """What each actor gave last, ``(B, *obs)``; read-only."""
            try:
                self._actors, self.spaces = self._start(range(n_actors))
            except self._ray.exceptions.RayError as error:
                raise DeadActorError(f"an actor died while it made its environments: {_reason(error)}") from error
        except BaseException:
            self.close()
            raise

    # -- asking -------------------------------------------------------------------------------------------------------

    def send(self, actor: int, method: str, *arguments: Any) -> Call:
        """Call a method of an actor."""
        message = cloudpickle.dumps((method, arguments))
        return Call(actor, message, self._actors[actor].call.remote(message))

    def result(self, call: Call) -> tuple[Any, Any]:
        """
        Wait for an answer; should the actor have died, ask the one that takes its place.

        :return: the observations, or None, and the rest
        :raises DeadActorError: if nothing takes its place.
        """
        reply = call.reply
        while True:
            try:
                return self._received(reply, self._step_timeout)
            except self._ray.exceptions.RayError as error:
                self._replace(call.actor, error)
                reply = self._actors[call.actor].call.remote(call.message)

    def observe(self, calls: Sequence[Call]) -> list[Any]:
        """Wait for the answers of all actors; return what they tell beside the observations, which are kept."""
        observations, rests = zip(*[self.result(call) for call in calls], strict=True)
        self.last_observations = list(observations)
        return list(rests)

    def ask(self, indices: Sequence[int], method: str, *arguments: Any) -> list[Any]:
        """Call a method of the actors for some of the N environments; return an answer for each."""
        asked = [[i for i in share if i in set(indices)] for share in self.shares]
        calls = [
            self.send(actor, method, [i - share.start for i in these], *arguments)
            for actor, (share, these) in enumerate(zip(self.shares, asked, strict=True))
            if these
        ]
        answers = itertools.chain.from_iterable(self.result(call)[1] for call in calls)
        by_index = dict(zip(itertools.chain.from_iterable(asked), answers, strict=True))
        return [by_index[i] for i in indices]

    def _received(self, reply: list[Any], timeout: float | None = None) -> tuple[Any, Any]:
        try:
            observations, rest = self._ray.get(reply, timeout=timeout)
        except self._ray.exceptions.RayTaskError as error:
            # What an environment raised, as itself: callers look for AttributeError, say.
            raise (error.cause if isinstance(error.cause, Exception) else RuntimeError(str(error))) from error
        return pickle.loads(observations), cloudpickle.loads(rest)

    # -- starting, replacing, ending ----------------------------------------------------------------------------------

    def _start(self, which: Sequence[int]) -> tuple[list[Any], Any]:
        """Start actors and make their environments; return them and the spaces."""
        actors = [self._actor_class.remote() for _ in which]
        try:
            replies = []
            for actor, i in zip(actors, which, strict=True):
                share = self.shares[i]
                env_fns = self._env_fns[share.start : share.stop]
                replies.append(actor.call.remote(cloudpickle.dumps(("make", (env_fns, self.max_restarts > 0)))))
            made = [rest for _, rest in replies]
            _, late = self._ray.wait(made, num_returns=len(made), timeout=self._start_timeout)
            if late:
                raise TimeoutError(self._why_late(len(late), len(which)))
            env_spaces = [self._received(reply)[1] for reply in replies]
        except BaseException:
            self._kill(actors)
            raise
        return actors, env_spaces[0]

    def _why_late(self, n_late: int, n: int) -> str:
        there, free = (
            {name: found.get(name, 0) for name in ("CPU", "GPU")}
            for found in (self._ray.cluster_resources(), self._ray.available_resources())
        )
        return (
            f"{n_late} of {n} actors did not start within start_timeout={self._start_timeout:g} s. Each asks for "
            f"{self._options}; Ray has {there}, of which {free} are free: use fewer actors (n_actors), let each ask "
            "for less (actor_options), add machines, or wait longer (start_timeout)"
        )

    def _replace(self, actor: int, error: Exception) -> None:
        """
        Put a new actor where one has died, with its environments as they were.

        :raises DeadActorError: if that is not allowed or not possible.
        """
        share = self.shares[actor]
        mend = "Make a new RayVecEnv and go on from the last checkpoint"
        while True:
            self._kill([self._actors[actor]])  # it may only be silent
            dead = f"actor {actor} of {len(self.shares)} (environments {share[0]} to {share[-1]}) has died, or is lost"
            dead = f"{dead}: {_reason(error)}"
            if self._n_restarts[actor] >= self.max_restarts:
                raise DeadActorError(f"{dead}. {mend}; max_restarts={self.max_restarts} replaces it") from error
            if self.unrecorded is not None:
                why = f"env_method({self.unrecorded!r}) may have changed its environments"
                raise DeadActorError(f"{dead}. It is not replaced, since {why}. {mend}") from error
            self._n_restarts[actor] += 1
            count = f"restart {self._n_restarts[actor]} of at most {self.max_restarts}"
            warnings.warn(f"{dead}. It is replaced ({count})", stacklevel=2)
            try:
                (replacement,), _ = self._start([actor])
                is_same = self._restore(replacement, actor)
            except self._ray.exceptions.RayError as another:
                error = another
                continue
            if is_same:
                self._actors[actor] = replacement
                return
            self._kill([replacement])
            why = "its new environments differ from the old ones: they depend on more than np_random and the actions"
            raise DeadActorError(f"{dead}. It cannot be replaced, since {why}. {mend}") from error

    def _restore(self, replacement: Any, actor: int) -> bool:
        """Bring the environments of a new actor to where those of the old one were; tell whether that worked."""
        share = self.shares[actor]
        message = cloudpickle.dumps(("restore", (self.histories[share.start : share.stop],)))
        observations, is_same = self._received(replacement.call.remote(message))
        return is_same and (observations is None or _are_equal(observations, self.last_observations[actor]))

    def _kill(self, actors: Sequence[Any]) -> None:
        for actor in actors:
            self._ray.kill(actor)

    def close(self) -> None:
        """Close the environments and end the actors; closing twice is fine."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._ray.is_initialized() and self._actors:
            replies = [self.send(i, "close").reply[1] for i in range(len(self._actors))]
            self._ray.wait(replies, num_returns=len(replies), timeout=CLOSE_TIMEOUT)
            self._kill(self._actors)
        SESSION.leave()


class Session:
    """The connection of this process to Ray: made where the user has made none, and ended by the last who needs it."""

    def __init__(self) -> None:
        self.is_ours = self.is_local = False
        self.n_users = 0

    def enter(self, n_actors: int, num_cpus: float) -> None:
        """Connect, and start an instance with enough CPUs where there is none to connect to."""
        ray = import_ray()
        if not ray.is_initialized():
            self.n_users, self.is_ours, self.is_local = 0, True, not os.environ.get("RAY_ADDRESS")
            if self.is_local:
                # Ray would give the actors nice 15: next to other programs they would hardly run. As SubprocVecEnv's
                # processes they are as nice as this one, unless the user has said otherwise.
                with _default_variable("RAY_worker_niceness", "0"):
                    ray.init("local", num_cpus=max(1, math.ceil(n_actors * num_cpus)), include_dashboard=False)
            else:
                ray.init()
        elif self.n_users == 0:
            self.is_ours = self.is_local = False
        self.n_users += 1

    def leave(self) -> None:
        """Disconnect, if nobody else needs the connection."""
        self.n_users -= 1
        if self.n_users == 0 and self.is_ours:
            import_ray().shutdown()


SESSION = Session()


@contextlib.contextmanager
def _default_variable(name: str, value: str) -> Iterator[None]:
    """Set an environment variable that is not set, for a while."""
    if name in os.environ:
        yield
        return
    os.environ[name] = value
    try:
        yield
    finally:
        del os.environ[name]


def import_ray() -> Any:
    """Import Ray, or say how to get it."""
    try:
        import ray
    except ImportError as e:
        raise ImportError("RayVecEnv needs Ray: pip install sb3_tdpg[ray]") from e
    return ray


def _reason(error: Exception) -> str:
    return str(error).strip().partition("\n")[0].rstrip(".") or type(error).__name__


def _are_equal(first: Any, second: Any) -> bool:
    """Compare batches of observations bit for bit."""
    if isinstance(first, dict):
        return all(_are_equal(first[key], second[key]) for key in first)
    if isinstance(first, tuple):
        return all(itertools.starmap(_are_equal, zip(first, second, strict=True)))
    return first.tobytes() == second.tobytes()
