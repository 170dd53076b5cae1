"""
Measure the information in the TRVs of a policy on fresh episodes, independently of its training.

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

from sb3_tdpg.common.threads import threads
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.density_critic import Regression
from sb3_tdpg.evaluation.environments import check_env_fits, scenario_env
from sb3_tdpg.evaluation.figures import information_timeline, knowledge_map
from sb3_tdpg.evaluation.interval import CONFIDENCE, InformationInterval, component_estimates, information_interval
from sb3_tdpg.evaluation.interval_bounds import MAX_TRAINING
from sb3_tdpg.evaluation.randomness import evaluation_seeds
from sb3_tdpg.evaluation.rollout import rollout
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.information.logdet import LogDet
from sb3_tdpg.information.loo import log_density_matrix
from sb3_tdpg.policies import TRVPolicy
from sb3_tdpg.problem import read_problem

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TINY = 1e-30
ESTIMATES = ("interval", "knowledge")  # the parts of an information report, in this order


class InformationBounds(NamedTuple):
    """Bounds on the information, summed over the time steps of an episode, in nats."""

    upper: float  # upper bound on I[x_t; x~_t]: the log-det bound
    lower: float  # lower bound on I[encoder input; x~_t], which equals I[x_t; x~_t] without memory and sensor noise


@dataclass(frozen=True)
class InformationReport:
    """The information in the TRVs of a policy."""

    interval: InformationInterval
    """Interval for I[x_t; x~_t] at each time step."""
    knowledge: pd.DataFrame
    """Information about each component of the state, capped at the upper limit of the interval; see
    :func:`~sb3_tdpg.evaluation.state_knowledge`."""
    costs: np.ndarray
    """Costs of the episodes, ``(N,)``."""

    @property
    def frame(self) -> pd.DataFrame:
        """
        The interval as a frame with a row for each time step.

        The columns are ``t``, the limits ``lower`` and ``upper`` in nats, the names of the bounds that give them,
        ``lower_name`` and ``upper_name``, the estimate of each bound (``critic``, ``gaussian``, ``logdet``, ``loo``,
        ``marginal``) and ``n_episodes``.
        """
        interval = self.interval
        columns = {name: getattr(interval, name) for name in ("lower", "upper", "lower_name", "upper_name")}
        t = np.arange(len(interval.lower))
        return pd.DataFrame(dict(t=t, **columns, **interval.estimates, n_episodes=interval.n_episodes))

    def figures(self) -> dict[str, Figure]:
        """Draw the interval over time (``"timeline"``) and the map of the components (``"knowledge"``)."""
        return dict(timeline=information_timeline(self.frame), knowledge=knowledge_map(self.knowledge))

    def __str__(self) -> str:
        lower, upper = self.interval.total
        n_left_out = self.interval.n_left_out
        left_out = f", {n_left_out} steps with too few of them left out" if n_left_out else ""
        return (
            f"I[x_t; x~_t], summed over time: {lower:.2f} to {upper:.2f} nat "
            f"({CONFIDENCE:.0%} at each step, {len(self.costs)} episodes{left_out})"
        )


def information_report(
    model: Any, env: VecEnv, n_episodes: int = 500, seed: int = 0, *, at_end: Callable[[], Any] = lambda: None
) -> InformationReport:
    """
    Run fresh episodes and estimate the information of the policy's TRVs about the state at each time step.

    :param model: A :class:`~sb3_tdpg.tdpg.TDPG` with the spaces and the horizon of ``env``.
    :param env: A ``VecEnv`` with any number of environments.
    :param n_episodes: Number of episodes N; if there are fewer environments, the episodes are run in rounds.
    :param seed: Seed of the episodes, of the policy's sampling and of the estimates.
    :param at_end: Called at the end of each part of the report (``ESTIMATES``).
    :raises ValueError: if model and environment do not fit, or there are too few episodes for an interval.
    """
    if not isinstance(model.policy, TRVPolicy):
        raise ValueError(f"the model is of {type(model).__name__}, without task-relevant variables: pass a TDPG model")
    check_env_fits(model, env)
    if n_episodes < 1:
        raise ValueError(f"n_episodes={n_episodes} must be at least 1")
    n_rounds = -(-n_episodes // env.num_envs)
    seeds = [seed, *np.random.SeedSequence([seed, n_rounds]).generate_state(n_rounds)[1:].tolist()]
    batches, costs = zip(*(encode_episodes(model, env, seed=each) for each in seeds), strict=True)
    batch = InformationBatch(*(th.cat(parts, dim=1) for parts in zip(*(each[:5] for each in batches), strict=True)))
    batch = batch.select(th.arange(n_episodes))
    interval = information_interval(batch, seed=seed)
    if not np.isfinite(interval.upper).any():
        raise ValueError(
            f"no time step has an interval: at most {interval.n_episodes.max(initial=0)} episodes are alive"
        )
    at_end()
    known = state_knowledge(batch, read_problem(env).state_names, seed=seed)
    at_end()
    # No component is known better than the whole state.
    limited = {name: np.minimum(known[name], interval.upper[known["t"]]) for name in ("nats", "nats_lower")}
    return InformationReport(interval, known.assign(**limited), np.concatenate(costs)[:n_episodes])


@threads(1)
def state_knowledge(batch: InformationBatch, names: Sequence[str] | None = None, *, seed: int = 0) -> pd.DataFrame:
    """
    Estimate the information of the TRVs about each component of the state at each time step.

    Components may share information, so their sum is not the information about the whole state.

    :param batch: Rollouts ``(T, N, ...)``, for instance from :func:`~sb3_tdpg.evaluation.information.encode_episodes`.
    :param names: Names of the X components; default: ``x0``, ``x1``, ...
    :return: A row for each time step and component. The columns are ``t``, ``component``, ``nats`` (estimate of a lower
        bound on I[x^k_t; x~_t]), ``nats_lower`` (lower 95 % confidence limit of this bound) and ``r2`` (of a
        leave-one-out regression of the component on the TRVs). The last three are clipped at 0. Values are NaN where a
        component is constant and where too few episodes are alive. Components that are constant at all time steps are
        left out.
    """
    horizon, _, n_components = batch.states.shape
    names = [f"x{k}" for k in range(n_components)] if names is None else list(names)
    if len(names) != n_components:
        raise ValueError(f"names={names} must have a name for each of the {n_components} components of the state")
    nats, limits = component_estimates(batch, seed=seed)
    r2 = np.full_like(nats, np.nan)
    for t in range(horizon):
        known = np.isfinite(nats[t])
        if known.any():
            at_t = batch.at(t)
            trvs, states = (x[0, :MAX_TRAINING].cpu().numpy().astype(np.float64) for x in (at_t.trvs, at_t.states))
            targets = states[:, known] - states[:, known].mean(axis=0)
            residuals = Regression(trvs, targets).residuals
            r2[t, known] = 1 - np.square(residuals).sum(axis=0) / np.square(targets).sum(axis=0)
    shown = np.flatnonzero(np.isfinite(nats).any(axis=0))
    values = {name: x[:, shown].clip(min=0).ravel() for name, x in (("nats", nats), ("nats_lower", limits), ("r2", r2))}
    return pd.DataFrame(
        dict(t=np.repeat(np.arange(horizon), len(shown)), component=[names[k] for k in shown] * horizon, **values)
    )


def encode_episodes(model: Any, env: VecEnv, *, seed: int = 0) -> tuple[InformationBatch, np.ndarray]:
    """
    Run one episode in each environment, and keep the true states and the TRVs with their densities.

    :param model: A :class:`~sb3_tdpg.tdpg.TDPG` with the spaces and the horizon of ``env``.
    :param env: N environments.
    :return: the samples ``(T, N, ...)``, on the CPU, with ``alive`` False after the end of an episode, and the costs of
        the episodes, ``(N,)``
    """
    problem = read_problem(env)
    steps, costs = [], np.zeros(env.num_envs)
    episodes = rollout(model, env, seeds=evaluation_seeds(seed), problem=problem, encode=True)
    for step in islice(episodes, problem.horizon):
        assert step.encoded is not None
        alive = step.episode == 0  # later steps belong to another episode
        encoded = (x.cpu() for x in (step.encoded.trvs, step.encoded.means, step.encoded.stds))
        steps.append((th.as_tensor(step.states, dtype=th.float32), *encoded, th.as_tensor(alive)))
        costs -= step.rewards * alive
    return InformationBatch(*(th.stack(parts) for parts in zip(*steps, strict=True))), costs


def rollout_information(model: Any, scenario: Scenario, n_episodes: int = 1000, *, seed: int = 0) -> InformationBatch:
    """Run :func:`encode_episodes` in the environment of a scenario, with ``n_episodes`` episodes side by side."""
    with contextlib.closing(scenario_env(scenario, model, n_episodes=n_episodes, n_envs=n_episodes)) as env:
        return encode_episodes(model, env, seed=seed)[0]


def information_bounds(batch: InformationBatch) -> InformationBounds:
    """
    Return an upper and a lower bound on the information of a batch, summed over time.

    A step with living episodes, but too few for an estimate, counts as much as the last step with enough episodes.
    Policies with many TRVs need more episodes for an estimate. If the step counted as 0, they would seem to have less
    information. The estimate of the lower bound can exceed that of the upper bound, because the TRVs are sampled. It is
    therefore clipped at the upper bound.

    :param batch: Result of :func:`encode_episodes`, ``(T, N, ...)``.
    """
    n_episodes, trv_dim = batch.trvs.shape[1:]
    if n_episodes < trv_dim + 2:
        raise ValueError(
            f"the information of {trv_dim} TRVs cannot be estimated from {n_episodes} episodes: it takes at least "
            f"{trv_dim + 2}"
        )
    log_det = LogDet(1, batch.states.shape[2], trv_dim)
    at_step = total = np.zeros(2)
    for t in range(len(batch.trvs)):
        at_t = batch.at(t)
        if at_t.trvs.shape[1] >= trv_dim + 2:
            upper = log_det(at_t).item()
            at_step = np.array([upper, min(_lower_bound(at_t), upper)])
        if at_t.trvs.shape[1] > 0:
            total = total + at_step
    return InformationBounds(*total.tolist())


def _lower_bound(at_t: InformationBatch) -> float:
    r"""
    Estimate the bound of :func:`~sb3_tdpg.information.loo.own_sample_bound`, with less noise from sampling the TRVs.

    With the mean m and the covariance C of the mixture of the N encoder densities, the difference of
    :math:`|(\tilde x_i - \mu_i) / \sigma_i|^2` and :math:`(\tilde x_i - m)^T C^{-1} (\tilde x_i - m)` has mean 0 given
    the encoder's inputs, on average over the episodes i. This difference is the control variate. If the mixture were
    Gaussian, the control variate would remove all of the noise.
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
