"""
Run a policy for whole episodes, step by step; evaluations, reports and videos use this loop.

Dimension key: E environments, X state, Z TRVs, ``*obs`` and ``*action`` as in the spaces.
"""

import contextlib
import inspect
from collections.abc import Callable, Generator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import VecEnv, VecMonitor, is_vecenv_wrapped

from sb3_tdpg.buffers import PolicyStep
from sb3_tdpg.evaluation.randomness import EvaluationSeeds, isolated_randomness
from sb3_tdpg.problem import Problem


class Step(NamedTuple):
    """One step of E environments, which may be at different times of their episodes."""

    t: np.ndarray  # (E,): time step of each episode
    episode: np.ndarray  # (E,): number of the episode in its environment, from 0
    observations: Any  # (E, *obs): y_t, before `observe`
    states: np.ndarray | None  # (E, X): x_t, if the problem was given
    actions: np.ndarray  # (E, *action): u_t, as the environment gets it
    memory: Any  # of the policy after this step; of a TDPG model, memory[0] is x~_t, (E, Z)
    encoded: PolicyStep | None  # TRVs, means, standard deviations and noise, if asked for
    rewards: np.ndarray  # (E,)
    dones: np.ndarray  # (E,) bool
    infos: list[dict[str, Any]]  # of x_{t+1}, also where the episode has ended
    next_observations: Any  # (E, *obs): y_{t+1}, or y_0 of the next episode
    finished: np.ndarray  # (E,) bool: an episode of the quota ends with this step


def rollout(
    model: Any,
    env: VecEnv,
    n_episodes: int | None = None,
    *,
    seeds: EvaluationSeeds | None = None,
    deterministic: bool = False,
    problem: Problem | None = None,
    encode: bool = False,
    observe: Callable[[Any], Any] | None = None,
) -> Generator[Step, None, None]:
    """
    Run a policy and yield every step.

    As in SB3's ``evaluate_policy``, each environment has a quota of episodes, because the first episodes that finish
    would include too many short ones. After its quota an environment continues to run, and the policy's memory is
    cleared at every step. Only steps with ``finished`` end an episode that counts.

    With ``seeds`` the rollout uses the global random generators until it ends, so do not draw from them in the body of
    the loop. The generators are restored when the loop ends, also by ``break`` or an exception.

    :param model: An SB3 model, or an object with the same method ``predict``.
    :param env: E environments; they are reset first. MaskablePPO gets their ``action_masks()``.
    :param n_episodes: Number of episodes of all environments together; ``None``: run until the caller stops.
    :param seeds: Seeds of the environments and of the policy's sampling; ``None``: use the generators as they are.
    :param deterministic: Act without noise; see :meth:`~sb3_tdpg.TRVPolicy.predict`.
    :param problem: Result of ``read_problem(env)``. If given, the true states are yielded, too.
    :param encode: Whether to yield the TRVs with their densities, too (only for TDPG models and a stochastic policy).
    :param observe: Function that changes the observations before the policy gets them, for instance ``normalize_obs``.
    """
    n_envs = env.num_envs
    quota = np.full(n_envs, np.inf) if n_episodes is None else (n_episodes + np.arange(n_envs)) // n_envs
    monitored = is_monitored(env)
    is_masked = "action_masks" in inspect.signature(model.predict).parameters and env.has_attr("action_masks")
    memory, starts = None, np.ones(n_envs, dtype=bool)
    t, episode = np.zeros((2, n_envs), dtype=np.int64)
    states: np.ndarray | None = None
    encoded: PolicyStep | None = None
    with contextlib.nullcontext() if seeds is None else isolated_randomness(seeds.policy, model):
        if seeds is not None:
            env.seed(seeds.env)
            if getattr(model, "use_sde", False):  # SB3 draws this noise only at the start of a training
                model.policy.reset_noise(n_envs)
        observations: Any = env.reset()
        if problem is not None:
            states = problem.initial_states(env, observations)
        while (episode < quota).any():
            seen = observations if observe is None else observe(observations)
            if encode:
                trvs = th.zeros(n_envs, model.policy.trv_dim, device=model.device) if memory is None else memory[0]
                now = np.where(starts, 0, t)  # zero for environments that have run their quota
                encoded, actions = act(model, seen, trvs * th.as_tensor(~starts[:, None], device=model.device), now)
                memory = (encoded.trvs, now + 1)
            else:
                masks = {"action_masks": np.stack(env.env_method("action_masks"))} if is_masked else {}
                actions, memory = model.predict(seen, memory, starts, deterministic=deterministic, **masks)
            next_observations, rewards, dones, infos = env.step(actions)
            finished = dones & (episode < quota)
            if monitored:  # Atari wrappers also end an "episode" when a life is lost
                finished[[i for i in np.flatnonzero(finished) if "episode" not in infos[i]]] = False
            yield Step(
                t, episode, observations, states, actions, memory, encoded,
                rewards, dones, infos, next_observations, finished,
            )  # fmt: skip
            observations = next_observations
            if problem is not None:
                states = problem.next_states(env, observations, dones, infos)
            t, episode = np.where(dones, 0, t + 1), episode + finished
            starts = dones | (episode >= quota)


def is_monitored(env: VecEnv) -> bool:
    """Return whether ``info["episode"]`` reports the return and the length of each episode."""
    return is_vecenv_wrapped(env, VecMonitor) or env.env_is_wrapped(Monitor)[0]


def act(model: Any, observations: Any, prev_trvs: th.Tensor, t: np.ndarray) -> tuple[PolicyStep, np.ndarray]:
    """
    Sample one step of a TDPG model from y_t, ``(E, *obs)``, and x~_{t-1}, ``(E, Z)``, at the times t, ``(E,)``.

    :return: the step with the densities of the TRVs, and the actions, clipped to their bounds, ``(E, *action)``
    """
    model.policy.set_training_mode(False)
    with th.no_grad():
        step = model.policy.step(obs_as_tensor(observations, model.device), prev_trvs, t)
    return step, model.policy.clipped(step.actions.cpu().numpy())
