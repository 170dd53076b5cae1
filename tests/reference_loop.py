"""
Run one policy epoch of TDPG on the lava problem as a simple loop over samples, time steps and critics.

This code follows the paper's equations, not the package, and has a separate module for each time step. The batched code
must give the same numbers (``test_reference_loop.py``) in a fraction of the time (``benchmarks/run.py``). All random
numbers are arguments. Only :meth:`LoopTDPG.copy_of` and :func:`draw_randomness` use the package.

Dimension key: T horizon, N episodes, S gradient steps, B minibatch, X state, Z task-relevant variables (TRVs), U
action.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_tdpg import TDPG
from sb3_tdpg.common.networks import BatchedMLP

GOAL, WALL, LAVA = 3.0, 0.0, 5.0  # m
Tensors = list[th.Tensor]


class Minibatch(NamedTuple):
    """The episodes from which the samples of the joint distribution and of the product of its marginals come."""

    joint: list[int]
    marginal: list[tuple[int, int]]  # x_t of one episode with x~_t of another


class Randomness(NamedTuple):
    """All random numbers of an epoch; the first index of an array is the episode."""

    initial_distance: np.ndarray  # (N,)
    sensor_noise: np.ndarray  # (N, T, X), standard normal
    trv_noise: th.Tensor  # (N, T, Z), eps_t, standard normal
    action_noise: th.Tensor  # (N, T, U), standard normal
    minibatches: list[list[Minibatch]]  # T lists of S, to fit the critics
    pairings: list[Minibatch]  # T, for the estimate in the policy's loss


@dataclass
class Episode:
    """The record of an episode, with one entry for each time step."""

    states: Tensors = field(default_factory=list)  # (X,)
    observations: Tensors = field(default_factory=list)  # (X,)
    trvs: Tensors = field(default_factory=list)  # (Z,)
    actions: Tensors = field(default_factory=list)  # (U,)
    costs: list[float] = field(default_factory=list)


def bounded_exp(x: th.Tensor, log_maximum: float) -> th.Tensor:
    """Return an ``exp(x)`` that saturates at ``exp(log_maximum)``."""
    return 1 / (th.exp(-x) + math.exp(-log_maximum))


@dataclass
class LoopTDPG:
    """The modules and the optimisers of the loop."""

    encoders: list[nn.Sequential]  # T
    action_heads: list[nn.Sequential]  # T
    critics: list[nn.Sequential]  # T
    policy_learning_rate: float
    critic_learning_rate: float
    mi_coef: float
    encoder_var_floor: float
    action_var_floor: float
    sensor_noise_std: float
    max_action: float

    def __post_init__(self) -> None:
        self.horizon = len(self.encoders)
        self.trv_dim = self.encoders[0][-1].out_features // 2
        parameters = [p for network in self.encoders + self.action_heads for p in network.parameters()]
        self.optimizer = th.optim.Adam(parameters, lr=self.policy_learning_rate)
        self.critic_optimizers = [th.optim.Adam(c.parameters(), lr=self.critic_learning_rate) for c in self.critics]

    @classmethod
    def copy_of(cls, model: TDPG) -> LoopTDPG:
        """Copy networks and settings of a model for the lava problem whose policy has not been updated yet."""
        env = model.env.unwrapped.env
        return cls(
            encoders=unbatch(model.policy.encoder.mlp),
            action_heads=unbatch(model.policy.action_head.mlp),
            critics=unbatch(model.estimator.critic),
            policy_learning_rate=model.lr_schedule(1.0),
            critic_learning_rate=model.estimator.learning_rate,
            mi_coef=1 / model.beta,
            encoder_var_floor=model.policy.encoder_var_floor,
            action_var_floor=model.policy.action_var_floor,
            sensor_noise_std=env.sensor_noise_std,
            max_action=float(env.action_space.high[0]),
        )

    def epoch(self, randomness: Randomness) -> None:
        """Run one policy epoch."""
        episodes = self.rollouts(randomness)
        if self.mi_coef > 0:
            self.fit_critics(episodes, randomness.minibatches)
        self.update(episodes, randomness.trv_noise, randomness.pairings, mean_baseline(episodes))

    @th.no_grad()
    def rollouts(self, randomness: Randomness) -> list[Episode]:
        """Roll out each episode separately."""
        return [self.rollout(float(distance), *noise) for distance, *noise in zip(*randomness[:4], strict=True)]

    def rollout(
        self, distance: float, sensor_noise: np.ndarray, trv_noise: th.Tensor, action_noise: th.Tensor
    ) -> Episode:
        """Roll out one robot."""
        episode, velocity, trv = Episode(), 0.0, th.zeros(self.trv_dim)
        for t in range(self.horizon):
            noise = self.sensor_noise_std * sensor_noise[t]
            observation = th.tensor([to_float32(distance + noise[0]), to_float32(velocity + noise[1])])
            mean, variance = self.encode(t, trv, observation)
            trv = mean + th.sqrt(variance) * trv_noise[t]
            action_mean, action_variance = self.act(t, trv)
            action = action_mean + th.sqrt(action_variance) * action_noise[t]
            episode.states.append(th.tensor([distance, velocity]))
            episode.observations.append(observation)
            episode.trvs.append(trv)
            episode.actions.append(action)
            cost = math.hypot(distance - GOAL, velocity)
            control = min(max(action.item(), -self.max_action), self.max_action)
            distance, velocity = move(distance, velocity, control)
            if t == self.horizon - 1:
                cost += 100 * math.hypot(distance - GOAL, velocity)
            episode.costs.append(to_float32(cost))
        return episode

    def encode(self, t: int, prev_trv: th.Tensor, observation: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return mean and variance of q(x~_t | x~_{t-1}, y_t)."""
        mean, log_variance = self.encoders[t](th.cat([prev_trv, observation])).chunk(2)
        return th.tanh(mean), bounded_exp(log_variance, 4) + self.encoder_var_floor

    def act(self, t: int, trv: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Return mean and variance of pi(u_t | x~_t)."""
        mean, log_variance = self.action_heads[t](trv).chunk(2)
        return mean, bounded_exp(log_variance, 8) + self.action_var_floor

    def fit_critics(self, episodes: list[Episode], minibatches: list[list[Minibatch]]) -> None:
        """Fit the critics one after the other."""
        for t in range(self.horizon):
            states = [episode.states[t] for episode in episodes]
            trvs = [episode.trvs[t] for episode in episodes]
            for minibatch in minibatches[t]:
                loss = -self.donsker_varadhan(t, states, trvs, minibatch)
                self.critic_optimizers[t].zero_grad()
                loss.backward()
                self.critic_optimizers[t].step()

    def donsker_varadhan(self, t: int, states: Tensors, trvs: Tensors, minibatch: Minibatch) -> th.Tensor:
        """Estimate I[x_t; x~_t] in nats; the critic is called for one sample at a time."""
        joint = [self.critics[t](th.cat([states[i], trvs[i]]))[0] for i in minibatch.joint]
        marginal = [th.exp(self.critics[t](th.cat([states[i], trvs[j]]))[0]) for i, j in minibatch.marginal]
        return sum(joint) / len(joint) - th.log(sum(marginal) / len(marginal))

    def information(self, episodes: list[Episode], trvs: list[Tensors], pairings: list[Minibatch]) -> Tensors:
        """Estimate I[x_t; x~_t] for every t; ``trvs`` are those of each episode at each time step."""
        return [
            self.donsker_varadhan(t, [e.states[t] for e in episodes], [e[t] for e in trvs], pairings[t])
            for t in range(self.horizon)
        ]

    def update(
        self, episodes: list[Episode], trv_noise: th.Tensor, pairings: list[Minibatch], advantages: list[list[float]]
    ) -> None:
        """Make one optimiser step on the policy; the advantages weight the log-probabilities."""
        loss = 0.0
        for n, episode in enumerate(episodes):
            prev_trv = th.zeros(self.trv_dim)
            for t in range(self.horizon):
                log_q = log_density(episode.trvs[t], *self.encode(t, prev_trv, episode.observations[t]))
                log_pi = log_density(episode.actions[t], *self.act(t, episode.trvs[t]))
                loss = loss + advantages[n][t] * (log_q + log_pi) / len(episodes)
                prev_trv = episode.trvs[t]
        if self.mi_coef > 0:
            trvs = [self.rebuild_trvs(episode, trv_noise[n]) for n, episode in enumerate(episodes)]
            for information in self.information(episodes, trvs, pairings):
                # A critic's estimate can be negative, but mutual information cannot.
                if information > 0:
                    loss = loss + self.mi_coef * information
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()

    def rebuild_trvs(self, episode: Episode, noise: th.Tensor) -> Tensors:
        """Compute the TRVs of an episode again, as functions of the encoder's parameters."""
        trvs = [th.zeros(self.trv_dim)]
        for t in range(self.horizon):
            mean, variance = self.encode(t, trvs[-1], episode.observations[t])
            trvs.append(mean + th.sqrt(variance) * noise[t])
        return trvs[1:]


def move(distance: float, velocity: float, control: float) -> tuple[float, float]:
    """Move one robot of the lava problem for one time step."""
    if distance >= LAVA or distance + velocity >= LAVA:
        return LAVA, 0.0
    if distance + velocity < WALL:
        return WALL, 0.0
    return distance + velocity, velocity + control


def log_density(x: th.Tensor, mean: th.Tensor, variance: th.Tensor) -> th.Tensor:
    """Return the log-density of a diagonal Gaussian; the components are summed in a loop."""
    terms = zip(x, mean, variance, strict=True)
    return -0.5 * sum((value - m) ** 2 / v + th.log(2 * math.pi * v) for value, m, v in terms)


def mean_baseline(episodes: list[Episode]) -> list[list[float]]:
    """Return weights for all steps: the cost of the whole episode minus the mean over episodes."""
    mean = sum(sum(episode.costs) for episode in episodes) / len(episodes)
    return [[sum(episode.costs) - mean] * len(episode.costs) for episode in episodes]


def to_float32(x: float) -> float:
    """Round a number to float32, as Stable-Baselines3 rounds observations and rewards."""
    return float(np.float32(x))


@th.no_grad()
def unbatch(mlp: BatchedMLP) -> list[nn.Sequential]:
    """Copy a batched network into one ``nn.Sequential`` for each of its maps."""
    networks = []
    for m in range(mlp.n_maps):
        modules: list[nn.Module] = []
        for layer in mlp.layers:
            linear = nn.Linear(*layer.weight.shape[1:])
            linear.weight.copy_(layer.weight[m].T)
            linear.bias.copy_(layer.bias[m].flatten())
            modules += [linear, type(mlp.activation)()]
        networks.append(nn.Sequential(*modules[:-1]))
    return networks


def draw_randomness(model: TDPG, rng: np.random.Generator) -> Randomness:
    """Draw the random numbers for an epoch; minibatches have the form of :class:`~sb3_tdpg.information.mine.Mine`."""
    n, horizon, trv_dim = model.n_episodes, model.horizon, model.policy.trv_dim
    size = min(model.estimator.batch_size, n // 2)

    def minibatch() -> Minibatch:
        chosen = rng.permutation(n)[: 2 * size].tolist()
        return Minibatch(chosen[:size], list(zip(chosen[:size], chosen[size:], strict=True)))

    def pairing() -> Minibatch:
        order = rng.permutation(n).tolist()
        return Minibatch(list(range(n)), [(order[k], order[k - 1]) for k in range(n)])

    def normal(*shape: int) -> th.Tensor:
        return th.as_tensor(rng.standard_normal(shape), dtype=th.get_default_dtype())

    return Randomness(
        initial_distance=rng.uniform(WALL, LAVA, n),
        sensor_noise=rng.standard_normal((n, horizon, 2)),
        trv_noise=normal(n, horizon, trv_dim),
        action_noise=normal(n, horizon, 1),
        minibatches=[[minibatch() for _ in range(model.estimator.gradient_steps)] for _ in range(horizon)],
        pairings=[pairing() for _ in range(horizon)],
    )
