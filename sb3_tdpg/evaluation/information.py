"""
The information in a policy's TRVs, measured alike for every policy: on fresh episodes, and with no fitted critic.

Dimension key: T horizon, N episodes, X state, Z TRVs.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
import torch as th
from stable_baselines3.common.vec_env import VecEnv

from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import check_env_fits, scenario_env
from sb3_tdpg.evaluation.figures import information_timeline, knowledge_map
from sb3_tdpg.evaluation.knowledge import state_knowledge
from sb3_tdpg.evaluation.randomness import evaluation_seeds
from sb3_tdpg.evaluation.rollout import rollout
from sb3_tdpg.information import InformationBatch, LogDet
from sb3_tdpg.information.loo import log_density_matrix
from sb3_tdpg.measurement import InformationInterval, TrustBadge, information_interval, trust_checks
from sb3_tdpg.policies import TRVPolicy
from sb3_tdpg.problem import read_problem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TINY = 1e-30
ESTIMATES = ("interval", "knowledge", "checks")
"""Of :func:`information_report`, in this order."""


class EncodedEpisodes(NamedTuple):
    """N episodes as the encoder saw them."""

    batch: InformationBatch  # (T, N, ...), on the CPU; episodes that ended early are not alive afterwards
    costs: np.ndarray  # (N,), of the whole episode


class InformationBounds(NamedTuple):
    """Sums over the time steps of an episode, in nats."""

    upper: float  # on I[x_t; x~_t]: the log-det bound
    lower: float  # on what the encoder's input tells of x~_t, which is I[x_t; x~_t] without memory and sensor noise


@dataclass(frozen=True)
class InformationReport:
    """What the TRVs of a policy know, and how far the numbers can be trusted."""

    interval: InformationInterval
    """Of I[x_t; x~_t], for each time step."""
    knowledge: pd.DataFrame
    """What the TRVs know of each component of the state: see
    :func:`~sb3_tdpg.evaluation.knowledge.state_knowledge`."""
    badge: TrustBadge
    """Checks of the interval."""
    costs: np.ndarray
    """``(N,)``: of the episodes."""

    @property
    def frame(self) -> pd.DataFrame:
        """The interval as a frame: see :func:`interval_frame`."""
        return interval_frame(self.interval)

    def figures(self) -> dict[str, Figure]:
        """Draw ``"timeline"``, the interval over time, and ``"knowledge"``, the map of the components."""
        return dict(timeline=information_timeline(self.frame), knowledge=knowledge_map(self.knowledge))

    def __str__(self) -> str:
        lower, upper = self.interval.total
        n_left_out = self.interval.n_left_out
        left_out = f", {n_left_out} steps with too few of them left out" if n_left_out else ""
        return (
            f"I[x_t; x~_t], summed over time: {lower:.2f} to {upper:.2f} nat "
            f"({self.interval.confidence:.0%} at each step, {len(self.costs)} episodes{left_out}); {self.badge}"
        )


def information_report(
    model: Any,
    env: VecEnv,
    n_episodes: int = 500,
    seed: int = 0,
    *,
    names: Sequence[str] | None = None,
    at_end: Callable[[], Any] | None = None,
) -> InformationReport:
    """
    Run fresh episodes, and tell what the policy's TRVs know of the state, when, and how sure that is.

    :param model: A :class:`~sb3_tdpg.tdpg.TDPG` with the spaces and the horizon of ``env``.
    :param env: Any number of environments.
    :param n_episodes: N; with fewer environments they are run in rounds.
    :param seed: Of the episodes, the policy's sampling and the estimates.
    :param names: Of the components of the state; default: the environment's ``state_names``, or ``x0``, ``x1``, ...
    :param at_end: Called at the end of each of the three ``ESTIMATES``.
    :raises ValueError: if model and environment do not fit, there are too few episodes for an interval at any time
        step, or the names do not fit.
    """
    if not isinstance(model.policy, TRVPolicy):
        raise ValueError(f"the model is of {type(model).__name__}, without task-relevant variables: give one of TDPG")
    check_env_fits(model, env)
    names = read_problem(env).state_names if names is None else names
    batch, costs = _encode_in_rounds(model, env, n_episodes, seed)
    at_end = at_end or (lambda: None)
    interval = information_interval(batch, seed=seed)
    at_end()
    known = state_knowledge(batch, names, seed=seed)
    at_end()
    badge = trust_checks(batch, interval, seed=seed)
    at_end()
    return InformationReport(interval, known, badge, costs)


def interval_frame(interval: InformationInterval) -> pd.DataFrame:
    """
    Make a frame with a row for each time step.

    Its columns are ``t``, the limits ``lower`` and ``upper`` in nats and the bounds ``lower_name`` and ``upper_name``
    that they come from, the estimate of each bound (``critic``, ``gaussian``, ``logdet``, ``loo``, ``marginal``) and
    ``n_episodes``.
    """
    return pd.DataFrame(
        dict(
            t=np.arange(len(interval.lower)),
            lower=interval.lower,
            upper=interval.upper,
            lower_name=interval.lower_name,
            upper_name=interval.upper_name,
            **interval.estimates,
            n_episodes=interval.n_episodes,
        )
    )


def _encode_in_rounds(model: Any, env: VecEnv, n_episodes: int, seed: int) -> EncodedEpisodes:
    """Run :func:`encode_episodes` until there are enough episodes, each round with a seed of its own."""
    if n_episodes < 1:
        raise ValueError(f"n_episodes={n_episodes} must be at least 1")
    n_rounds = -(-n_episodes // env.num_envs)
    seeds = [seed, *np.random.SeedSequence([seed, n_rounds]).generate_state(n_rounds)[1:].tolist()]
    rounds = [encode_episodes(model, env, seed=each) for each in seeds]
    batch = InformationBatch(*(th.cat(parts, dim=1) for parts in zip(*(each.batch for each in rounds), strict=True)))
    costs = np.concatenate([each.costs for each in rounds])
    return EncodedEpisodes(batch.select(th.arange(n_episodes)), costs[:n_episodes])


def encode_episodes(model: Any, env: VecEnv, *, seed: int = 0) -> EncodedEpisodes:
    """
    Run one episode in each environment, and keep the true states and the TRVs with their densities.

    :param model: A :class:`~sb3_tdpg.tdpg.TDPG` with the spaces and the horizon of ``env``.
    :param env: N environments, of which one episode each counts.
    :param seed: Seed of the environments and of the policy's sampling.
    """
    problem = read_problem(env)
    steps, costs = [], np.zeros(env.num_envs)
    episodes = rollout(model, env, seeds=evaluation_seeds(seed), problem=problem, encode=True)
    for step in islice(episodes, problem.horizon):
        assert step.encoded is not None
        alive = step.episode == 0  # what follows is another episode
        encoded = (x.cpu() for x in (step.encoded.trvs, step.encoded.means, step.encoded.stds))
        steps.append((th.as_tensor(step.states, dtype=th.float32), *encoded, th.as_tensor(alive)))
        costs -= step.rewards * alive
    return EncodedEpisodes(InformationBatch(*(th.stack(parts) for parts in zip(*steps, strict=True))), costs)


def rollout_information(model: Any, scenario: Scenario, n_episodes: int = 1000, *, seed: int = 0) -> InformationBatch:
    """
    Run :func:`encode_episodes` where a scenario says.

    :param model: A :class:`~sb3_tdpg.tdpg.TDPG`.
    :param scenario: Where.
    :param n_episodes: N, side by side.
    :param seed: Seed of the environment and of the policy's sampling.
    """
    with contextlib.closing(scenario_env(scenario, model, n_episodes=n_episodes, n_envs=n_episodes)) as env:
        return encode_episodes(model, env, seed=seed).batch


def information_bounds(batch: InformationBatch) -> InformationBounds:
    """
    Bound the information of a batch, summed over time.

    A step at which too few episodes live on for an estimate counts as much as the last one with enough: counted as
    nothing, it would make policies with many TRVs, which need more episodes, look as if they knew less.

    Both are estimates from the same episodes, and the one from below is never above the other: what the TRVs tell of
    which of these N encoder's inputs they were drawn from is not more than the log-det bound of these inputs. Only the
    estimate could be, since the TRVs are a sample, too: it is made precise where the bounds are close, and cut there.

    :param batch: From :func:`encode_episodes`, ``(T, N, ...)``.
    :raises ValueError: if there are too few episodes from the start.
    """
    n_episodes, trv_dim = batch.trvs.shape[1:]
    if n_episodes < trv_dim + 2:
        raise ValueError(
            f"the information of {trv_dim} TRVs cannot be estimated from {n_episodes} episodes: it takes at least "
            f"{trv_dim + 2}"
        )
    log_det = LogDet(1, batch.states.shape[2], trv_dim)
    at_step = InformationBounds(0.0, 0.0)
    total = np.zeros(2)
    for t in range(len(batch.trvs)):
        at_t = batch.at(t)
        if at_t.trvs.shape[1] >= trv_dim + 2:
            upper = log_det(at_t).item()
            at_step = InformationBounds(upper, min(_lower_bound(at_t), upper))
        if at_t.trvs.shape[1] > 0:
            total += at_step
    return InformationBounds(*total.tolist())


def _lower_bound(at_t: InformationBatch) -> float:
    r"""
    Estimate what :func:`~sb3_tdpg.information.own_sample_bound` estimates, with less of the TRVs' sampling noise.

    With the mean m and the covariance C of the mixture of the N encoder densities, the difference of
    :math:`|(\tilde x_i - \mu_i) / \sigma_i|^2` and :math:`(\tilde x_i - m)^T C^{-1} (\tilde x_i - m)` has mean 0
    given the encoder's inputs. It serves as a control variate: were the mixture Gaussian, it would be all of the noise.

    :param at_t: One step, ``(1, N, ...)``.
    """
    log_density = log_density_matrix(at_t)[0].double()
    own = log_density.diagonal() - log_density.logsumexp(dim=1) + math.log(len(log_density))  # (N,)
    trvs, means, stds = (x[0].double() for x in (at_t.trvs, at_t.means, at_t.stds))  # (N, Z)
    centre = means.mean(dim=0)
    covariance = (means - centre).T @ (means - centre) / len(means) + stds.square().mean(dim=0).diag()
    scaled = th.linalg.solve(covariance, (trvs - centre).T).T
    known = ((trvs - means) / stds).square().sum(dim=1) - ((trvs - centre) * scaled).sum(dim=1)
    weight = (own * (known - known.mean())).mean() / known.var(correction=0).clamp(min=TINY)
    return (own - weight * known).mean().item()
