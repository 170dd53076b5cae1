"""An exported step of a policy acts as ``predict`` does, without torch, Stable-Baselines3 or this package."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import assert_same_parameters, parameters, toy_vec_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg import TDPG
from sb3_tdpg.cli import main
from sb3_tdpg.deployment.export import METADATA, ExportedStep, export_policy
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import evaluate_scenarios

onnxruntime = pytest.importorskip("onnxruntime")
pytestmark = [
    pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning"),
    pytest.mark.filterwarnings("ignore:deterministic=True acts with means"),
    pytest.mark.filterwarnings("ignore:.*multi-dimensional MultiDiscrete"),
]

ROBOT_LOOP = Path(__file__).parents[2] / "docs" / "robot" / "robot_loop.py"
N_STEPS = 1000
DICT = spaces.Dict(
    image=spaces.Box(0, 255, (3, 36, 36), np.uint8), position=spaces.Box(-2.0, 2.0, (3,)), mode=spaces.Discrete(4)
)
BOX = spaces.Box(-0.5, 2.0, (2,))


def made(env="Lava-v0", **kwargs):
    return TDPG("TRVPolicy", env, seed=0, device="cpu", **kwargs)


def toy(observation_space=BOX, action_space=BOX):
    return made(toy_vec_env(observation_space=observation_space, action_space=action_space, horizon=5), n_episodes=4)


def act_strongly(model):
    """Actions of untrained policies hardly differ."""
    with th.no_grad():
        for parameter in model.policy.action_head.parameters():
            parameter.mul_(4.0)
    return model


def about(path):
    return json.loads(session_of(path).get_modelmeta().custom_metadata_map[METADATA])


def normalized():
    """A model that was trained on standardised observations, as by rl-zoo3's key ``normalize``."""
    env = VecNormalize(make_vec_env("Pendulum-v1", 2), norm_reward=False, clip_obs=1.5)
    return made(env, epoch_steps=400).learn(400)


MODELS = {
    "vector, weights for each time step": made,
    "vector, shared weights": lambda: made("Pendulum-v1", epoch_steps=400).learn(400),
    "standardised": normalized,
    "image": lambda: made("BallCatch-v0"),
    "depth": lambda: made("PandaGrasp-v0"),
    "dict": lambda: toy(DICT),
    "discrete": lambda: toy(action_space=spaces.Discrete(5)),
    "several discrete": lambda: toy(action_space=spaces.MultiDiscrete([[2, 3], [4, 2]])),
    "binary": lambda: toy(action_space=spaces.MultiBinary(3)),
}


@pytest.fixture(scope="module", params=list(MODELS))
def exported(request, tmp_path_factory):
    """A model and its two files."""
    model = act_strongly(MODELS[request.param]())
    folder = tmp_path_factory.mktemp("exported")
    return model, model.export(folder / "policy.onnx"), model.export(folder / "policy.pt")


def session_of(path):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def observations_of(model, n):
    """Sample observations, as a list; a Box without bounds is sampled like a normal variable."""
    space = model.observation_space
    space.seed(0)
    found = [space.sample() for _ in range(n)]
    norm = model.get_vec_normalize_env()
    return found, [x if norm is None else norm.normalize_obs(x) for x in found]


def inputs_of(model, observation, memory, t, noises):
    step = ExportedStep(model.policy)
    parts = list(observation.values()) if isinstance(observation, dict) else [observation]
    values = [*parts, memory, *[t] * model.policy.time_varying, *noises]
    examples = step.example(1)
    return {
        name: np.asarray(value, x.numpy().dtype).reshape(x.shape)
        for name, value, x in zip(step.input_names, values, examples, strict=True)
    }


def test_both_files_act_as_predict_does(exported):
    """Over 1,000 steps, every other episode without noise."""
    model, onnx, torchscript = exported
    session, traced = session_of(onnx), th.jit.load(str(torchscript))
    policy, is_box = model.policy, isinstance(model.action_space, spaces.Box)
    n_actions = ExportedStep(policy).n_action_noises
    length = policy.horizon if policy.time_varying else 50
    state, worst, n_kinds = None, 0.0, set()
    for k, (observation, seen) in enumerate(zip(*observations_of(model, N_STEPS), strict=True)):
        t, is_start = k % length, k % length == 0
        deterministic = not is_box or (k // length) % 2 == 0
        memory = np.zeros((1, policy.trv_dim), np.float32) if is_start else state[0]
        th.manual_seed(k)
        expected, state = policy.predict(
            seen, None if is_start else state, np.array([is_start]), deterministic=deterministic
        )
        th.manual_seed(k)
        noises = [th.zeros(1, policy.trv_dim), th.zeros(1, n_actions)]
        if not deterministic:
            noises = [th.randn(1, policy.trv_dim), th.normal(th.zeros(1, n_actions), th.ones(1, n_actions))]
        feed = inputs_of(model, observation, memory, t, [x.numpy() for x in noises])
        with th.no_grad():
            by_torch = [x.numpy() for x in traced(*map(th.as_tensor, feed.values()))]
        for action, next_memory in (session.run(None, feed), by_torch):
            assert action.shape == (1, *model.action_space.shape)
            assert model.action_space.contains(action[0].astype(model.action_space.dtype)) or is_box
            for one, other in ((action[0], expected), (next_memory, state[0])):
                worst = max(worst, (np.abs(one - other) / np.maximum(1.0, np.abs(other))).max())
        n_kinds.add(deterministic)
    assert worst < 1e-5
    assert len(n_kinds) == 1 + is_box


@pytest.mark.parametrize(
    "space", [spaces.Discrete(3), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(2)], ids=lambda s: type(s).__name__
)
def test_with_noise_discrete_actions_have_the_probabilities_of_the_policy(space, tmp_path):
    model, n, rng = act_strongly(toy(action_space=space)), 40_000, np.random.default_rng(0)
    path = model.export(tmp_path / "policy.onnx")
    step = ExportedStep(model.policy)
    draw = dict(gumbel=rng.gumbel, logistic=rng.logistic)[about(path)["action_noise"]]
    values = [x.expand(n, *x.shape[1:]).numpy().copy() for x in step.example(1)]
    values[-1] = draw(size=values[-1].shape).astype(np.float32)
    actions, trvs = session_of(path).run(None, dict(zip(step.input_names, values, strict=True)))
    with th.no_grad():
        density = model.policy.action_density(th.as_tensor(trvs[:1]), np.zeros(1, np.int64))
        for action in np.unique(actions.reshape(n, -1), axis=0):
            one = th.as_tensor(action if action.size > 1 else action[0])[None].float()
            probability = density.log_prob(one).exp().item()
            assert (actions.reshape(n, -1) == action).all(1).mean() == pytest.approx(probability, abs=0.012)


@pytest.mark.parametrize("kind", ["vector, weights for each time step", "discrete", "image", "depth", "dict"])
def test_the_robot_loop_needs_numpy_and_onnxruntime_only(kind, tmp_path):
    """In a process that cannot import torch, Stable-Baselines3, gymnasium or this package."""
    model = MODELS[kind]()
    n = model.horizon
    observations, _ = observations_of(model, n)
    parts = observations if isinstance(observations[0], dict) else [{"": x} for x in observations]
    np.savez(tmp_path / "seen.npz", **{key: np.array([x[key] for x in parts]) for key in parts[0]})
    model.export(tmp_path / "policy.onnx")
    program = """
import sys
for name in ("torch", "stable_baselines3", "sb3_contrib", "gymnasium", "sb3_tdpg", "onnx", "onnxscript"):
    sys.modules[name] = None
import numpy as np, robot_loop
class Robot:
    def __init__(self):
        self.seen, self.t, self.sent = dict(np.load("seen.npz")), 0, []
    def read(self):
        now = {key: x[self.t] for key, x in self.seen.items()}
        return now[""] if list(now) == [""] else now
    def send(self, action):
        self.sent.append(action); self.t += 1
robots = []
for policy in (robot_loop.Policy("policy.onnx", deterministic=True), robot_loop.Policy("policy.onnx", seed=0)):
    for _ in range(2):
        robots.append(Robot())
        robot_loop.run(policy, robots[-1])
np.savez("sent.npz", *[np.array(robot.sent) for robot in robots])
"""
    environment = {**os.environ, "PYTHONPATH": str(ROBOT_LOOP.parent)}
    subprocess.run([sys.executable, "-c", program], cwd=tmp_path, env=environment, check=True)
    first, again, noisy, noisy_again = np.load(tmp_path / "sent.npz").values()
    np.testing.assert_array_equal(first, again)  # reset() forgets the episode before
    assert n == 1 or not np.array_equal(noisy, noisy_again)
    state = None
    for t, observation in enumerate(observations):
        action, state = model.predict(observation, state, np.array([t == 0]), deterministic=True)
        np.testing.assert_allclose(first[t], action, atol=1e-5)


def test_the_file_says_what_it_is(tmp_path):
    model = made()
    told = about(model.export(tmp_path / "p.onnx"))
    extra = {METADATA: ""}
    th.jit.load(str(model.export(tmp_path / "p.pt")), _extra_files=extra)
    assert json.loads(extra[METADATA]) == told
    assert told["inputs"]["observation"] == dict(shape=[2], dtype="float32", low=[None] * 2, high=[None] * 2)
    assert told["inputs"]["time_step"] == dict(shape=[], dtype="int64")
    assert (told["horizon"], told["action_noise"]) == (5, "normal")
    assert set(told["versions"]) == {"sb3_tdpg", "stable_baselines3", "torch"}


def test_an_export_leaves_the_model_as_it_was(tmp_path):
    model = made()
    model.policy.set_training_mode(True)
    before, state = parameters(model.policy), th.get_rng_state()
    model.export(tmp_path / "policy.onnx")
    assert model.policy.training
    assert_same_parameters(parameters(model.policy), before)
    assert th.equal(th.get_rng_state(), state)


def test_bad_requests_are_told_in_one_line(tmp_path, monkeypatch, capsys):
    model = made()
    with pytest.raises(ValueError, match=r"format=None is none of \['onnx', 'torchscript'\]: give one"):
        model.export(tmp_path / "policy")
    with pytest.raises(ValueError, match="format='tflite' is none of"):
        export_policy(model.policy, tmp_path / "policy.onnx", format="tflite")
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    (tmp_path / "policy.onnx").write_text("old")
    with pytest.raises(ImportError, match=r"pip install 'sb3_tdpg\[export\]'"):
        model.export(tmp_path / "policy.onnx")
    assert (tmp_path / "policy.onnx").read_text() == "old"
    assert main(["export", str(tmp_path / "nothing.zip")]) == 2
    assert "nothing.zip is not there" in capsys.readouterr().err.strip().splitlines()[-1]


def test_without_the_statistics_of_the_training_nothing_is_exported(tmp_path):
    normalized().save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"trained on normalised observations.*VecNormalize\.load"):
        TDPG.load(tmp_path / "model", device="cpu").export(tmp_path / "p.pt")
    plain = TDPG.load(tmp_path / "model", env=make_vec_env("Pendulum-v1"), device="cpu")
    with pytest.raises(ValueError, match="trained on normalised observations"):
        evaluate_scenarios(plain, [Scenario("Training", "Pendulum-v1")], 1)


@pytest.mark.parametrize(
    ("flags", "made"), [([], "model.onnx"), (["--format", "torchscript"], "model.pt"), (["--out", "b/p.pt"], "b/p.pt")]
)
def test_the_command_writes_beside_the_model_and_uses_the_statistics_there(tmp_path, monkeypatch, capsys, flags, made):
    monkeypatch.chdir(tmp_path)
    model = normalized()
    model.save("model")
    model.get_vec_normalize_env().save("vecnormalize.pkl")
    assert main(["export", "model.zip", *flags]) == 0
    assert capsys.readouterr().out.endswith(f"the policy's step is {made}\n")
    by_model = model.export("by_model" + Path(made).suffix)
    nothing = np.zeros(model.policy.trv_dim)
    feed = inputs_of(model, np.array([2.0, -1.0, 7.0]), nothing, 0, [nothing, 0.0])
    if made.endswith(".pt"):
        inputs = [th.as_tensor(value) for value in feed.values()]
        one, other = (th.jit.load(str(path))(*inputs)[1].detach().numpy() for path in (made, by_model))
    else:
        one, other = (session_of(path).run(None, feed)[1] for path in (made, by_model))
    np.testing.assert_array_equal(one, other)
