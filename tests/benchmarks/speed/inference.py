"""One step of a policy on a robot: ``predict``, and the exported step in ONNX Runtime."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import onnxruntime
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO

from sb3_tdpg import TDPG
from sb3_tdpg.deployment.export import ExportedStep
from tests.benchmarks.speed.measure import SEED, Row, Sizes, compare, seconds

N_STEPS = 500


def predict(model: Any) -> Callable[[], float]:
    """Return a function that measures a step of ``predict``."""
    observation = model.observation_space.sample()

    def steps() -> None:
        state = None
        for _ in range(N_STEPS):
            # A policy with weights for each time step begins an episode at every step.
            given = None if isinstance(model, TDPG) and model.policy.time_varying else state
            _, state = model.predict(observation, given, deterministic=False)

    return lambda: seconds(steps, N_STEPS)


def exported(model: TDPG) -> Callable[[], float]:
    """Return a function that measures a step of the exported policy."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    with tempfile.TemporaryDirectory() as folder:
        path = model.export(Path(folder, "policy.onnx"))
        session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
    step = ExportedStep(model.policy)
    feed = {name: x.numpy() for name, x in zip(step.input_names, step.example(1), strict=True)}

    def steps() -> None:
        for _ in range(N_STEPS):
            session.run(None, feed)

    return lambda: seconds(steps, N_STEPS)


def bench_inference(sizes: Sizes) -> Iterable[Row]:
    """Compare ``predict`` with that of PPO and RecurrentPPO, and with the exported step."""
    for env_id in ("CartPole-v1", "Pendulum-v1"):
        ours = TDPG("TRVPolicy", env_id, seed=SEED, device="cpu")
        for algorithm, policy, goal in ((PPO, "MlpPolicy", 1 / 1.5), (RecurrentPPO, "MlpLstmPolicy", 1.0)):
            other = algorithm(policy, env_id, seed=SEED, device="cpu")
            name = f"predict, {env_id}: against {algorithm.__name__}"
            yield compare(name, predict(ours), predict(other), sizes.repetitions, goal=goal)
    for env_id in ("Lava-v0", "CartPole-v1", "Pendulum-v1", "BallCatch-v0", "PandaGrasp-v0"):
        model = TDPG("TRVPolicy", env_id, seed=SEED, device="cpu")
        yield compare(f"step, {env_id}: ONNX against predict", exported(model), predict(model), sizes.repetitions)
