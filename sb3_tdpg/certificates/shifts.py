r"""
Declare shifts of the sensor and of the start, and bound the divergence between shifted and training episodes.

The actions depend on the observations only through the encoder :math:`q(\tilde x_t | \tilde x_{t-1}, y_t)`. It is
therefore sufficient to bound the divergence of the TRVs, which can be computed because the encoder's density is known.
The derivation is in ``docs/guide/certificate.md``.

Dimension key: T horizon, N episodes, X state, Z TRVs.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import obs_as_tensor
from torch.distributions import Normal, kl_divergence

from sb3_tdpg.certificates.certificate import CostDistribution, check_allowance, cost_distribution, worst_mean
from sb3_tdpg.envs.base import POMDPEnv
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation.environments import scenario_env
from sb3_tdpg.evaluation.randomness import isolated_randomness
from sb3_tdpg.evaluation.rollout import act
from sb3_tdpg.robustness.core import Members
from sb3_tdpg.vec_env import BatchedVecEnv

EPISODES_AT_A_TIME = 100_000  # run side by side; a constant, because results depend on it
EXCEEDANCE_LEVELS = (0.0, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2)  # shares of episodes with a capped divergence that are tried

_START, _SENSOR, _DYNAMICS, _POLICY, _TEST, _BUDGET = range(6)  # streams of random numbers


@dataclass(frozen=True)
class Shift:
    """
    A declared change of the sensor and of the start distribution; dynamics and cost stay the same.

    :param name: Name for tables.
    :param env_kwargs: Keywords of the shifted environment in addition to those of the training.
    :param start_kl: D[shifted start || start in training] in nats.
    :param sensor_kl: Largest D[shifted sensor || sensor in training] of one observation over all states; inf if it is
        not known.
    :param nuisance: A further change of the observations: a function that draws a member for each of N episodes.
    """

    name: str
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    start_kl: float = 0.0
    sensor_kl: float = math.inf
    nuisance: Callable[[int], Members] | None = None


class Budget(NamedTuple):
    """Bound on how far a shift moves the TRVs; see :meth:`TrainingEpisodes.budgets`."""

    kl: float  #: divergence in nats
    exceedance: float  #: probability, in training, of episodes whose divergence is capped


class ShiftCertificate(NamedTuple):
    """Upper bounds on the expected cost under one shift."""

    bound: float  #: the lower of the following two
    through_trvs: float  #: from the divergence of the TRVs
    through_sensor: float  #: from the divergence of the sensor, which is the same for every policy
    budget: Budget  #: divergence of the TRVs for ``through_trvs``


class RecordedEpisodes(NamedTuple):
    """N episodes and the random numbers that drove their sensor."""

    costs: np.ndarray  # (N,)
    states: np.ndarray  # (T, N, X)
    prev_trvs: th.Tensor  # (T, N, Z), x~_{t-1}
    last_trv_noise: th.Tensor  # (N, Z), eps_{T-1}
    densities: list[Normal]  # of the TRVs at each step, (N, Z), and of the last actions, (N, U)
    seed: tuple[int, ...]  # of the sensor


class TrainingEpisodes:
    """
    Record training episodes of a policy; a shifted sensor then observes the recorded states.

    :param model: A :class:`~sb3_tdpg.tdpg.TDPG`.
    :param scenario: The training environment, which must be one of this package.
    :param cost_bound: Upper bound on the cost of an episode; the cost is clipped there. If an episode can cost more,
        the certificate is for the clipped cost.
    :param n_episodes: Number of episodes for the distribution of the cost.
    :param n_budget_episodes: Number of further episodes for the divergence of the TRVs.
    :param confidence: Confidence of each certificate. Half of the error probability is spent on the distribution of the
        cost, and half on the divergence.
    :param seed: Seed of the episodes.
    :raises ValueError: if the scenario or the model's own environment is unsuitable, or a number is invalid. No episode
        has been run then.
    """

    def __init__(
        self,
        model: Any,
        scenario: Scenario,
        *,
        cost_bound: float,
        n_episodes: int = 1_000_000,
        n_budget_episodes: int = 50_000,
        confidence: float = 0.95,
        seed: int = 0,
    ) -> None:
        check_allowance(confidence, cost_bound)
        self.model, self.scenario, self.confidence = model, scenario, confidence
        self._env = _pomdp(model, scenario)
        costs: list[np.ndarray] = []
        for i in range(math.ceil(n_episodes / EPISODES_AT_A_TIME)):
            n = min(EPISODES_AT_A_TIME, n_episodes - i * EPISODES_AT_A_TIME)
            costs.append(record_episodes(model, self._env, n, (seed, i)).costs)
        self.costs = np.concatenate(costs)
        self.distribution = cost_distribution(np.minimum(self.costs, cost_bound), cost_bound, (1 + confidence) / 2)
        self.recorded = record_episodes(model, self._env, n_budget_episodes, (seed, _BUDGET))

    def divergences(self, shift: Shift) -> np.ndarray:
        """
        Compute the divergence at each step of the recorded episodes, given the sensor noise that both sensors share.

        :return: ``(T + 1, N)``: for each step D[q(. | x~_{t-1}, shifted y_t) || q(. | x~_{t-1}, y_t)] of the TRVs in
            nats, and in the last row the divergence of the last actions
        """
        return _divergences(encode(self.model, self._shifted(shift), self.recorded), self.recorded.densities)

    def budgets(self, shift: Shift) -> list[Budget]:
        """
        Bound the divergence between episodes with and without the shift, from recorded episodes.

        An episode consists of its TRVs, states and actions. The divergence of the earlier steps is bounded first. The
        mean divergence of a step under the shift is then at most the largest mean under all distributions within that
        bound. In an episode with a divergence above a cap, the bound assumes that the step is not shifted and that the
        episode has the largest cost.

        :return: a budget for each of ``EXCEEDANCE_LEVELS``; all hold simultaneously
        """
        divergences = self.divergences(shift)
        share = 1 - (1 - self.confidence) / (2 * len(divergences))
        steps = [cost_distribution(divergence, float(divergence.max()), share) for divergence in divergences]
        return [_budget(steps, shift.start_kl, level) for level in EXCEEDANCE_LEVELS]

    def certify(self, shift: Shift) -> ShiftCertificate:
        """
        Bound the expected cost under a shift, clipped at ``cost_bound``.

        The bounds through the TRVs and through the sensor hold simultaneously, so the lower one is valid.
        """

        def bound_through_trvs(budget: Budget) -> float:
            return worst_mean(self.distribution.with_largest(budget.exceedance), budget.kl)

        budget = min(self.budgets(shift), key=bound_through_trvs)
        sensor_kl = shift.start_kl + len(self.recorded.states) * shift.sensor_kl
        through_trvs, through_sensor = bound_through_trvs(budget), worst_mean(self.distribution, sensor_kl)
        return ShiftCertificate(min(through_trvs, through_sensor), through_trvs, through_sensor, budget)

    def measure(self, shift: Shift, n_episodes: int = 2000, *, seed: int = 1) -> tuple[np.ndarray, float]:
        """Run shifted episodes; return their costs, ``(N,)``, and their mean divergence, summed over the steps."""
        shifted = record_episodes(self.model, self._shifted(shift), n_episodes, (seed, _TEST))
        by_step = _divergences(shifted.densities, encode(self.model, self._env, shifted)).mean(axis=1)
        return shifted.costs, shift.start_kl + float(by_step[:-2].sum() + by_step[-2:].min())

    def _shifted(self, shift: Shift) -> Any:
        kwargs = {**self.scenario.env_kwargs, **shift.env_kwargs}
        env: Any = _pomdp(self.model, Scenario(shift.name, self.scenario.env_id, kwargs))
        if shift.nuisance is not None:
            # The members are drawn once, since every call has the same number of episodes.
            plain, members = env.sensor, functools.cache(shift.nuisance)
            env.sensor = lambda state: members(len(state))(plain(state))
        return env


def record_episodes(model: Any, env: Any, n: int, seed: tuple[int, ...]) -> RecordedEpisodes:
    """Run n episodes whose start, sensor, dynamics and policy have separate random streams, for :func:`encode`."""
    env.np_random = np.random.default_rng([*seed, _START])
    state, costs = env.initial_state(n), np.zeros(n)
    trv = th.zeros(n, model.policy.trv_dim, device=model.device)
    states, prev_trvs, densities = [], [], []
    policy_seed = int(np.random.SeedSequence([*seed, _POLICY]).generate_state(1)[0])
    with isolated_randomness(policy_seed, model), th.no_grad():
        for t in range(env.horizon):
            env.np_random = np.random.default_rng([*seed, _SENSOR, t])
            step, action = act(model, env.sensor(state), trv, np.full(n, t))
            states.append(state)
            prev_trvs.append(trv)
            densities.append(Normal(step.means, step.stds))
            trv = step.trvs
            costs += env.cost(state, action)
            env.np_random = np.random.default_rng([*seed, _DYNAMICS, t])
            state = env.dynamics(state, action)
        last = _action_density(model.policy, trv)
    costs += env.terminal_cost(state)
    return RecordedEpisodes(costs, np.stack(states), th.stack(prev_trvs), step.noise, [*densities, last], seed)


def encode(model: Any, env: Any, recorded: RecordedEpisodes) -> list[Normal]:
    """
    Encode the recorded states as the sensor of another environment observes them, with the same random numbers.

    :return: the densities of the TRVs at each step, and of the last actions
    """
    policy, n = model.policy, recorded.states.shape[1]
    policy.set_training_mode(False)
    densities: list[Normal] = []
    with th.no_grad():
        for t, (state, prev_trv) in enumerate(zip(recorded.states, recorded.prev_trvs, strict=True)):
            env.np_random = np.random.default_rng([*recorded.seed, _SENSOR, t])
            observation = obs_as_tensor(env.sensor(state), model.device)
            densities.append(Normal(*policy.encoder_density(observation, prev_trv, np.full(n, t))))
        trvs = densities[-1].mean + densities[-1].stddev * recorded.last_trv_noise
        return [*densities, _action_density(policy, trvs)]


def _action_density(policy: Any, trvs: th.Tensor) -> Normal:
    return policy.action_density(trvs, np.full(len(trvs), policy.horizon - 1)).distribution


def _divergences(shifted: Sequence[Normal], training: Sequence[Normal]) -> np.ndarray:
    # In single precision, a small divergence, which is a difference of numbers near 1, would be rounded to 0.
    double = [[Normal(d.mean.double(), d.stddev.double()) for d in densities] for densities in (shifted, training)]
    return np.stack([kl_divergence(p, q).sum(dim=1).clamp(min=0).cpu().numpy() for p, q in zip(*double, strict=True)])


def _budget(steps: Sequence[CostDistribution], start_kl: float, level: float) -> Budget:
    """Add up the bounds of the steps, but of those of the last TRVs and the last action only the lower one."""

    def add(budget: Budget, step: CostDistribution) -> Budget:
        capped, exceedance = step.capped(level)
        return Budget(budget.kl + worst_mean(capped, budget.kl), budget.exceedance + exceedance)

    budget = Budget(start_kl, 0.0)
    for step in steps[:-2]:
        budget = add(budget, step)
    return min((add(budget, step) for step in steps[-2:]), key=lambda candidate: candidate.kl)


def _pomdp(model: Any, scenario: Scenario) -> POMDPEnv:
    """Make the unwrapped environment of a scenario, whose sensor can observe any state."""
    if model.get_vec_normalize_env() is not None:
        raise ValueError("the model's environment normalises observations (VecNormalize), which is not supported here")
    if not isinstance(model.action_space, spaces.Box):
        raise ValueError(f"the actions are {model.action_space}: a certificate needs a Box, whose density is Gaussian")
    if scenario.sensor is not None:
        raise ValueError(f"scenario {scenario.name!r} changes its sensor, which a certificate cannot: declare a Shift")
    env = scenario_env(scenario, model, n_episodes=1, n_envs=1).unwrapped
    if not isinstance(env, BatchedVecEnv):
        raise ValueError(f"{scenario.env_id} is not an environment of this plugin: a certificate needs a POMDPEnv")
    return env.env
