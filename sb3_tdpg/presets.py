"""The defaults of TDPG and its policy for each kind of problem."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, CombinedExtractor, FlattenExtractor
from torch import nn

from sb3_tdpg.envs.checks import count as check_count
from sb3_tdpg.features import TRVCnn, least_side, observation_kind

# A problem with vectors over at least this horizon counts as ordinary reinforcement learning, not as a problem like
# the paper's.
LONG_HORIZON = 50
EPOCH_STEPS = 2000


class Defaults(NamedTuple):
    """Arguments of :class:`~sb3_tdpg.tdpg.TDPG` that depend on the kind of problem, and the length of training."""

    beta: float | str
    learning_rate: str
    n_episodes: int | None = None
    epoch_steps: int | None = None
    n_epochs: int = 1
    batch_size: int | None = None
    batch_episodes: int | None = None  # batch_size as a number of episodes of T steps, for any T
    clip_range: float = float("inf")
    normalize_advantage: bool = False
    encoder_gradient: str = "pathwise"
    # On vectors, MINE takes 2.5 times as long as logdet and is no more robust against faults (docs/results/pays.md). On
    # images, MINE takes no longer, but a penalty on its estimate removes less information (docs/guide/algorithm.md).
    mi_estimator: str = "logdet"
    n_threads: int | None = 1
    total_epochs: int = 100  # policy epochs
    baseline: str = "regression"
    bptt_steps: int | None = None
    gamma: float | None = 1.0  # None: depends on the horizon
    gae_lambda: float = 0.95
    max_grad_norm: float = float("inf")
    target_kl: float = float("inf")
    share: str = "95%"  # default of cost_limit with beta="auto"

    def minibatch(self, horizon: int, epoch_size: int) -> int | None:
        """Return the default ``batch_size`` for a horizon T, at most the steps of an epoch."""
        size = self.batch_size if self.batch_episodes is None else self.batch_episodes * horizon
        return None if size is None else min(size, epoch_size)


# As in the paper, an epoch has one update without clipping. The falling learning rate improves the last epochs.
VECTOR = Defaults(
    beta=1 / 75,
    learning_rate="lin_2e-3_2e-5",
    n_episodes=500,
    encoder_gradient="score",
    total_epochs=400,
    gae_lambda=0.3,  # with 0.95, policies on Lava remain bad open-loop policies
)

# Images are expensive. An epoch therefore has few episodes and several passes, as in PPO, with the pathwise gradient,
# which has less variance than the score gradient. In ball catching, a policy costs 105 before training and 2 after it,
# so a policy with 95 % of the improvement would be bad.
IMAGE = Defaults(
    beta="auto",
    share="99.8%",
    learning_rate="lin_1e-3_5e-5",
    n_episodes=160,
    n_epochs=4,
    batch_episodes=40,
    clip_range=0.2,
    normalize_advantage=True,
    n_threads=None,
    total_epochs=75,
    baseline="value",
)

# Depth images are even more expensive, because the grasping environment simulates each trial. If nearly all trials
# succeed, the normalised advantages of the few failures are huge, and without target_kl one epoch can undo the
# training.
DEPTH = IMAGE._replace(
    share="95%", n_episodes=400, batch_episodes=200, total_epochs=100, baseline="regression", target_kl=0.05
)

# Problems over a long horizon use PPO's update, with minibatches of short segments and a value network.
LONG = Defaults(
    beta=float("inf"),
    learning_rate="lin_1e-3_1e-4",
    epoch_steps=EPOCH_STEPS,
    n_epochs=10,
    batch_size=250,
    clip_range=0.2,
    normalize_advantage=True,
    baseline="value",
    bptt_steps=5,
    gamma=None,
    max_grad_norm=0.5,
)

DEFAULTS = dict(vector=VECTOR, image=IMAGE, depth=DEPTH, long=LONG)


class PolicyDefaults(NamedTuple):
    """Arguments of :class:`~sb3_tdpg.TRVPolicy` that depend on the preset."""

    trv_dim: int
    encoder: Sequence[int]
    action_head: Sequence[int]
    encoder_activation_fn: type[nn.Module]
    action_head_activation_fn: type[nn.Module]
    encoder_log_var_init: float
    action_log_var_init: float
    features_extractor_class: type[BaseFeaturesExtractor]
    features_extractor_kwargs: dict[str, Any]
    encoder_var_floor: float = 1e-3
    is_long: bool = False
    gate: bool = False
    time_varying: bool | None = None  # None: depends on the horizon


# This is SB3's NatureCNN with half the channels and a layer norm. Pooling 2 x 2 pixels halves the kernel size and the
# stride of the first layer. The three convolutions and the linear layer generalise better to unseen walls than the
# paper's two convolutions (docs/results/ball_catch.md).
IMAGE_ENCODER = dict(
    pool=2, layers=((16, 4, 2), (32, 4, 2), (32, 3, 1)), activation_fn=nn.ReLU, features_dim=256, layer_norm=True
)

# Keypoints replace the paper's flattened convolutions. The robot then also grasps objects at places that were not seen
# in training (docs/results/panda_grasp.md).
DEPTH_ENCODER = dict(layers=((16, 6, 2), (16, 4, 2)), keypoints=True)

# With images, the TRVs start with little noise; with more noise, training takes twice as long.
POLICY_DEFAULTS = dict(
    vector=PolicyDefaults(2, (64, 64), (64, 64), nn.ELU, nn.ELU, 0.0, 0.0, FlattenExtractor, {}),
    image=PolicyDefaults(
        32, (32,), (), nn.Tanh, nn.Tanh, -3.0, -1.0, TRVCnn, IMAGE_ENCODER, gate=True, time_varying=False
    ),
    # 16 TRVs are added to those that keep the observation. The TRVs are nearly free of noise at the start, because a
    # velocity is a small difference between them.
    long=PolicyDefaults(
        16,
        (64, 64),
        (64, 64),
        nn.Tanh,
        nn.Tanh,
        -10.0,
        -2.0,
        FlattenExtractor,
        {},
        1e-5,
        is_long=True,
        time_varying=False,
    ),
    depth=PolicyDefaults(16, (128, 64), (64, 64), nn.Tanh, nn.ELU, -3.0, -2.0, TRVCnn, DEPTH_ENCODER),
    paper=PolicyDefaults(8, (32,), (), nn.Tanh, nn.Tanh, 0.0, 0.0, TRVCnn, {}),  # of ball catching
)


def preset_of(observation_space: spaces.Space | None, horizon: int | None, **keywords: bool) -> str:
    """
    Return the name of the defaults for a problem: ``"vector"``, ``"image"``, ``"depth"`` or ``"long"``.

    :param keywords: See :func:`~sb3_tdpg.features.observation_kind`.
    """
    kind = observation_kind(observation_space, **keywords)
    return "long" if kind == "vector" and horizon is not None and horizon >= LONG_HORIZON else kind


def discount_of(horizon: int) -> float:
    """Return the default discount factor gamma for a long horizon T: 1 / (1 - gamma) = T / 8, limited to [10, 200]."""
    return min(max(1 - 8 / horizon, 0.9), 0.995)


def implied(given: Mapping[str, Any]) -> dict[str, Any]:
    """
    Return the arguments that the given arguments imply, except those that are given themselves.

    A ``cost_limit`` implies ``beta="auto"``, and any other ``beta`` implies no ``cost_limit``. Each of ``n_episodes``
    and ``epoch_steps`` implies that the other is ``None``.

    :param given: Arguments by name; those that are None imply nothing.
    """
    given = {name: value for name, value in given.items() if value is not None}
    others: dict[str, Any] = {}
    if "cost_limit" in given:
        others["beta"] = "auto"
    elif given.get("beta", "auto") != "auto":
        others["cost_limit"] = None
    if "n_episodes" in given:
        others["epoch_steps"] = None
    if "epoch_steps" in given:
        others["n_episodes"] = None
    return {name: value for name, value in others.items() if name not in given}


def fill_in(
    given: Mapping[str, Any], preset: str, cost_limit: float | str | None, n_envs: int, horizon: int
) -> dict[str, Any]:
    """
    Replace arguments that are ``None`` by their defaults.

    The default of ``n_episodes`` is a multiple of ``n_envs``; that of ``gamma`` depends on the horizon.
    """
    defaults = DEFAULTS[preset]
    settings = {name: getattr(defaults, name) if value is None else value for name, value in given.items()}
    if settings["gamma"] is None:
        settings["gamma"] = discount_of(horizon)
    settings |= {"cost_limit": cost_limit, **implied({**given, "cost_limit": cost_limit})}
    if given["n_episodes"] is None and settings["n_episodes"] is not None:
        settings["n_episodes"] = math.ceil(settings["n_episodes"] / n_envs) * n_envs
    return settings


def default(value: Any, otherwise: Any) -> Any:
    """Return the value of an argument, or its default if there is none."""
    return otherwise if value is None else value


def fill_in_extractor(
    defaults: PolicyDefaults,
    space: spaces.Space,
    given: type[BaseFeaturesExtractor] | None,
    kwargs: dict[str, Any] | None,
) -> tuple[type[BaseFeaturesExtractor], dict[str, Any] | None]:
    """Return the class of the feature extractor and its keywords, with their defaults for an observation space."""
    if given is not None or isinstance(space, spaces.Dict):
        return given or CombinedExtractor, kwargs
    by_default = defaults.features_extractor_kwargs
    if by_default and min((space.shape or ())[1:]) < least_side(by_default["layers"], "keypoints" in by_default):
        by_default = {}  # smaller images use the paper's layers
    return defaults.features_extractor_class, {**by_default, **(kwargs or {})}


def fill_in_trvs(
    defaults: PolicyDefaults, n_features: int, trv_dim: int | None, skip: bool | None, skip_changes: bool | None
) -> tuple[int, bool, bool]:
    """
    Return ``trv_dim``, ``skip`` and ``skip_changes`` with their defaults.

    A ``ValueError`` is raised if there are fewer TRVs than features and changes that are added to them, or if
    ``skip_changes`` is True without ``skip``.
    """
    if trv_dim is not None:
        check_count("policy_kwargs: trv_dim", trv_dim)
    room = default(trv_dim, math.inf)
    skip = default(skip, defaults.is_long and room >= n_features)
    skip_changes = default(skip_changes, skip and defaults.is_long and room >= 2 * n_features)
    if skip_changes and not skip:
        raise ValueError("policy_kwargs: skip_changes=True needs skip=True: changes are those of the kept features")
    n_skipped = n_features * (skip + skip_changes)
    trv_dim = default(trv_dim, max(n_features + defaults.trv_dim, n_skipped) if skip else defaults.trv_dim)
    if n_skipped > trv_dim:
        raise ValueError(
            f"policy_kwargs: skip={skip} and skip_changes={skip_changes} add {n_skipped} features to as many TRVs, but "
            f"trv_dim={trv_dim}: give trv_dim={n_skipped} or more, or turn them off"
        )
    return trv_dim, skip, skip_changes
