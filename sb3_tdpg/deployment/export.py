"""
Write one step of a policy to a file that runs without this package: ONNX or TorchScript.

Dimension key: N robots, Z task-relevant variables (TRVs), U action components, I inputs and O outputs of a network.
"""

from __future__ import annotations

import json
import logging
import os
import warnings
from pathlib import Path
from typing import Any, cast

import numpy as np
import stable_baselines3
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import DiagGaussianDistribution
from stable_baselines3.common.save_util import load_from_pkl
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

import sb3_tdpg
from sb3_tdpg.common.files import replaced_atomically
from sb3_tdpg.common.networks import TimeMLP
from sb3_tdpg.evaluation.environments import check_statistics
from sb3_tdpg.evaluation.loading import statistics_beside
from sb3_tdpg.policies import TRVPolicy
from sb3_tdpg.tdpg import TDPG

FORMATS = {"onnx": ".onnx", "torchscript": ".pt"}
METADATA = "sb3_tdpg"  # key of the metadata in the file
OPSET = 18


class ExportedStep(nn.Module):
    """
    Compute one step of a policy as a pure function of tensors; the noise is an input.

    ``forward(*observation, memory, [time_step], trv_noise, action_noise)`` returns ``(action, memory)``. An observation
    has the format of the environment: bytes, or numbers that are not standardised. A ``Dict`` has one input for each
    key, in the order of the space. If both noises are zero, the result is that of ``predict(deterministic=True)``.

    :param policy: The policy, on the CPU.
    :param normalization: The statistics with which the training standardised the observations.
    """

    def __init__(self, policy: TRVPolicy, normalization: VecNormalize | None = None) -> None:
        super().__init__()
        self.policy = policy
        space = policy.observation_space
        self.keys = list(space.spaces) if isinstance(space, spaces.Dict) else []
        self.clip = np.inf if normalization is None else float(normalization.clip_obs)
        self.scales: dict[str, tuple[th.Tensor, th.Tensor]] = {}  # mean and standard deviation by key
        if normalization is not None and normalization.norm_obs:
            statistics = cast(Any, normalization.obs_rms)
            for key, rms in statistics.items() if isinstance(statistics, dict) else [("", statistics)]:
                if rms.mean.shape != (shape := cast(Any, space)[key].shape if self.keys else space.shape):
                    raise ValueError(
                        f"observations {rms.mean.shape} were normalised before they were stacked to {shape}, which a "
                        "file cannot repeat: train with VecNormalize around VecFrameStack"
                    )
                std = np.sqrt(rms.var + normalization.epsilon)
                self.scales[key] = th.as_tensor(rms.mean), th.as_tensor(std)
        action_space = policy.action_space
        if isinstance(action_space, spaces.Box):
            self.register_buffer("low", th.as_tensor(action_space.low.reshape(-1), dtype=th.float32))
            self.register_buffer("high", th.as_tensor(action_space.high.reshape(-1), dtype=th.float32))

    low: th.Tensor
    high: th.Tensor

    @property
    def input_names(self) -> list[str]:
        """The names of the inputs, in order."""
        observations = [f"observation.{key}" for key in self.keys] or ["observation"]
        return [*observations, "memory", *["time_step"] * self.policy.time_varying, "trv_noise", "action_noise"]

    @property
    def n_action_noises(self) -> int:
        """The number of components of the action noise for one robot."""
        distribution = self.policy.action_dist
        if isinstance(distribution, DiagGaussianDistribution):
            return distribution.action_dim
        return self.policy._n_action_parameters()

    def example(self, n: int = 2) -> tuple[th.Tensor, ...]:
        """Return inputs for N robots: sampled observations, and zeros for all other inputs."""
        space = self.policy.observation_space
        parts = list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]
        observations = [th.as_tensor(np.stack([part.sample() for _ in range(n)])) for part in parts]
        time_step = [th.zeros(n, dtype=th.int64)] * self.policy.time_varying
        return (
            *(x if x.dtype != th.float64 else x.float() for x in observations),
            th.zeros(n, self.policy.trv_dim),
            *time_step,
            th.zeros(n, self.policy.trv_dim),
            th.zeros(n, self.n_action_noises),
        )

    def forward(self, *inputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Compute the action and the new memory; the inputs are those of :attr:`input_names`."""
        policy = self.policy
        n_parts = len(self.keys) or 1
        parts, (memory, *time_step, trv_noise, action_noise) = inputs[:n_parts], inputs[n_parts:]
        t = time_step[0] if time_step else None
        named = {key: self._prepared(part, key) for key, part in zip(self.keys or [""], parts, strict=True)}
        features = policy._features(named if self.keys else named[""])
        mean, std = policy._encoder_density(
            _at_time_steps(policy.encoder, th.cat([memory, features], dim=1), t), features, memory
        )
        trv = mean + std * trv_noise
        return self._action(_at_time_steps(policy.action_head, trv, t), action_noise), trv

    def _prepared(self, observation: th.Tensor, key: str) -> th.Tensor:
        """Standardise an observation; convert bytes to floats, because ONNX cannot pool bytes."""
        if key in self.scales:
            mean, std = self.scales[key]
            return ((observation.double() - mean) / std).clamp(-self.clip, self.clip).float()
        return observation.float() if observation.dtype == th.uint8 else observation

    def _action(self, parameters: th.Tensor, noise: th.Tensor) -> th.Tensor:
        """Return the action for the outputs of the action head. Without noise, it is the mode of the distribution."""
        space = self.policy.action_space
        if isinstance(space, spaces.Box):
            mean, log_std = self.policy.action_gaussian(parameters)
            action = th.minimum(th.maximum(mean + log_std.exp() * noise, self.low), self.high)
        elif isinstance(space, spaces.MultiBinary):
            action = (parameters + noise > 0).long()
        else:  # with Gumbel noise the largest logit is a sample (the Gumbel-max trick)
            sizes = space.nvec.flatten().tolist() if isinstance(space, spaces.MultiDiscrete) else [parameters.shape[1]]
            logits = (parameters + noise).split(sizes, dim=1)
            action = th.stack([x.argmax(dim=1) for x in logits], dim=1)
        return action.reshape(-1, *(space.shape or ()))


def _at_time_steps(network: TimeMLP, x: th.Tensor, t: th.Tensor | None) -> th.Tensor:
    """Evaluate a network, ``(N, I) -> (N, O)``, at each robot's time step, ``(N,)``. None means shared weights."""
    if t is None:
        return network.at(x, 0)
    return network.mlp.through(x, lambda layer, x: (x[:, None, :] @ layer.weight[t] + layer.bias[t])[:, 0])


def metadata_of(step: ExportedStep) -> dict[str, Any]:
    """Return the metadata that the user of an exported file needs."""
    policy, space = step.policy, step.policy.action_space
    noise = "gumbel"
    if isinstance(space, (spaces.Box, spaces.MultiBinary)):
        noise = "normal" if isinstance(space, spaces.Box) else "logistic"
    example = dict(zip(step.input_names, step.example(1), strict=True))
    inputs = {name: dict[str, Any](shape=list(x.shape[1:]), dtype=str(x.dtype)[6:]) for name, x in example.items()}
    observation = policy.observation_space
    for name, part in observation.items() if isinstance(observation, spaces.Dict) else [("", observation)]:
        if isinstance(part, spaces.Box) and part.dtype != np.uint8 and len(part.shape) == 1:
            bounds = {
                key: [float(x) if np.isfinite(x) else None for x in getattr(part, key)] for key in ("low", "high")
            }
            inputs[f"observation.{name}".rstrip(".")].update(bounds)
    return dict(
        inputs=inputs,
        observation_space=str(policy.observation_space),
        action_space=str(space),
        horizon=policy.horizon,
        action_noise=noise,
        versions=dict(
            sb3_tdpg=sb3_tdpg.__version__, stable_baselines3=stable_baselines3.__version__, torch=th.__version__
        ),
    )


def export_policy(
    policy: TRVPolicy,
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    normalization: VecNormalize | None = None,
) -> Path:
    """
    Write one step of a policy to a file.

    :param policy: The policy.
    :param path: The file; a missing suffix is added. If the file exists, it is replaced when the new file is complete.
    :param format: ``"onnx"`` (needs the extra ``export``) or ``"torchscript"``. By default the suffix of ``path``,
        ``.onnx`` or ``.pt``, determines the format.
    :param normalization: The statistics with which ``VecNormalize`` standardised the observations in training.
    :return: The file.
    :raises ValueError: if the format is unknown, or the statistics are those of observations before their stacking.
    :raises ImportError: if the packages for ONNX are missing.
    """
    path = Path(path)
    by_suffix = {suffix: name for name, suffix in FORMATS.items()}
    format = format or by_suffix.get(path.suffix)
    if format not in FORMATS:
        raise ValueError(
            f"{path}: format={format!r} is none of {list(FORMATS)}: give one, or a file name with .onnx or .pt"
        )
    if path.suffix != FORMATS[format]:
        path = path.with_name(path.name + FORMATS[format])
    device, was_training = policy.device, policy.training
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        policy.cpu().set_training_mode(False)
        step = ExportedStep(policy, normalization).eval()
        metadata = json.dumps(metadata_of(step))
        with th.no_grad(), warnings.catch_warnings(), replaced_atomically(path) as partial:
            # Hide torch's warnings about deprecated parts of torch, and about image sizes, which are fixed.
            warnings.filterwarnings("ignore", category=FutureWarning)
            warnings.filterwarnings("ignore", category=DeprecationWarning)
            warnings.filterwarnings("ignore", category=th.jit.TracerWarning)
            if format == "onnx":
                _write_onnx(step, partial, metadata)
            else:
                traced = th.jit.trace(step, step.example(), check_trace=False)
                th.jit.save(traced, str(partial), _extra_files={METADATA: metadata})
    finally:
        policy.to(device).set_training_mode(was_training)
    return path


def export_model(
    model: str | os.PathLike[str], out: str | os.PathLike[str] | None = None, *, format: str | None = None
) -> Path:
    """
    Write one step of a saved TDPG model to a file.

    If statistics of observations lie beside the model (``vecnormalize.pkl`` or ``vec_normalize.pkl``), the file
    contains them.

    :param model: File written by ``model.save``. It is unpickled, which can run any code.
    :param out: The file to write. By default it has the folder and the name of the model.
    :param format: See :func:`export_policy`. By default, the suffix of ``out`` determines the format. Without a known
        suffix, the format is ONNX.
    :return: The file.
    :raises ValueError: if there is no such model.
    """
    model = Path(model)
    if not model.is_file():
        raise ValueError(f"{model} is not there: give the .zip file that model.save() wrote")
    path = model.with_suffix("") if out is None else Path(out)
    statistics = statistics_beside(model)
    return export_trained(
        TDPG.load(model, device="cpu"),
        path,
        format or ("onnx" if path.suffix not in FORMATS.values() else None),
        None if statistics is None else load_from_pkl(statistics),
    )


def export_trained(model: Any, path: str | os.PathLike[str], format: str | None, normalization: Any) -> Path:
    """
    Write one step of the policy of a TDPG model to a file; see :func:`export_policy`.

    :raises ValueError: if the training normalised the observations, but the statistics are missing.
    """
    check_statistics(model, normalization)
    return export_policy(model.policy, path, format=format, normalization=normalization)


def _write_onnx(step: ExportedStep, path: Path, metadata: str) -> None:
    try:
        from onnxscript import opset18 as op  # torch.onnx also needs onnxscript
    except ImportError as e:
        raise ImportError("ONNX needs more packages: pip install 'sb3_tdpg[export]'") from e

    def sigmoid(x: Any) -> Any:
        # Small values of ONNX Runtime's Sigmoid, as for TRVs with a small variance, are wrong by 10 % and more.
        return op.Reciprocal(op.Add(op.Exp(op.Neg(x)), op.Constant(value_float=1.0)))

    names = step.input_names
    # It would warn that torchvision is missing, which no policy needs.
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    program = th.onnx.export(
        step,
        step.example(),
        input_names=names,
        output_names=["action", "next_memory"],
        dynamic_shapes=(tuple({0: th.export.Dim.DYNAMIC} for _ in names),),
        custom_translation_table={th.ops.aten.sigmoid.default: sigmoid},
        opset_version=OPSET,
        dynamo=True,
        verbose=False,
    )
    assert program is not None
    program.model.metadata_props[METADATA] = metadata
    program.save(str(path))
