"""Bad input raises an error before any training, and the error says what to do."""

import io
import math
import re
import zipfile
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import ToyEnv, error_line, tiny_tdpg, toy_vec_env
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_tdpg import TDPG, BatchedVecEnv, InformationCallback, SelectionCallback, TrainingCheckpointCallback, TRVPolicy
from sb3_tdpg.envs.lava import LavaEnv

IMAGE = spaces.Box(0, 255, (3, 20, 16), np.uint8)


def lava(n=20, **kwargs):
    return BatchedVecEnv(LavaEnv(**kwargs), n)


def actions(space):
    return dict(env=toy_vec_env(action_space=space))


class WithoutHorizon(ToyEnv):
    def __init__(self):
        super().__init__(declares_horizon=False)


class NamedTwice(LavaEnv):
    state_names = ("d", "d")


# For each case: the arguments, and the regular expressions that the message must match, in any order.
ARGUMENTS = {
    **{f"policy {name}": (dict(policy=name), f"policy='{name}'", r"\['TRVPolicy'\]", "takes vectors, images and dicts")
       for name in ("MlpPolicy", "CnnPolicy", "MultiInputPolicy", "MlpLstmPolicy")},
    "beta zero": (dict(beta=0.0), "beta=0.0", "positive number", "inf"),
    "beta NaN": (dict(beta=math.nan), "beta=nan", "positive number"),
    "beta a string": (dict(beta="0.1"), "beta='0.1'", "a number", "'lin_1e-3'", "auto"),
    "beta a text that ends at zero": (dict(beta="lin_0.5"), "beta=0.0", "positive number"),
    "nuisance unknown": (dict(nuisance="fog"), "'fog' is unknown", "vector_noise"),
    "nuisance of another kind": (dict(nuisance="contrast"), "'contrast' does not apply", "images"),
    "nuisance a number": (dict(nuisance=3), "nuisance=3: 3 is no perturbation", "a function of the observations"),
    "cost_limit zero": (dict(cost_limit=0.0), "cost_limit=0.0", "other than 0"),
    "cost_limit NaN": (dict(cost_limit=math.nan), "cost_limit=nan", "finite"),
    "cost_limit a text": (dict(cost_limit="0.95"), "cost_limit='0.95'", "'95%'"),
    "cost_limit no number": (dict(cost_limit="x%"), "cost_limit='x%'", "'95%'"),
    "cost_limit and a number": (dict(beta=0.5, cost_limit=3.0), "cost_limit=3.0", "beta=0.5", "SelectionCallback"),
    "n_epochs zero": (dict(n_epochs=0), "n_epochs=0", "integer of at least 1"),
    "batch_size above an epoch": (dict(batch_size=101), "batch_size=101", "between 10 and 100, the steps of an epoch"),
    "batch_size of one episode": (dict(batch_size=5), "batch_size=5", "between 10 and 100", "two episodes at least"),
    "bptt_steps none": (dict(bptt_steps=0), "bptt_steps=0", "integer of at least 1"),
    "actions without bounds but in name": (actions(spaces.Box(-1e30, 1e30, (1,))), "infinite bounds, or above 1e.18"),
    "actions that begin with 1": (actions(spaces.MultiDiscrete([2, 3], start=[1, 1])), "must begin with 0"),
    "no threads": (dict(n_threads=0), "n_threads=0", "integer of at least 1"),
    "bptt_steps of a time-varying policy": (dict(bptt_steps=2), "bptt_steps=2", "horizon of 5", "time_varying=False"),
    "clip_range zero": (dict(clip_range=0.0), "clip_range=0.0", "positive", "inf"),
    "clip_range NaN": (dict(clip_range=math.nan), "clip_range=nan", "positive"),
    "clip_range a schedule that ends below zero": (dict(clip_range=lambda progress: progress - 0.5), "clip_range=-0.5"),
    "passes without clipping": (dict(n_epochs=3), "n_epochs=3", "clip_range=0.2"),
    "minibatches without clipping": (dict(batch_size=50), "batch_size=50", "2 updates", "clip_range=0.2"),
    "beta a schedule that ends at zero": (dict(beta=lambda progress: progress), "beta=0.0", "positive number"),
    "beta a schedule that returns a string": (dict(beta=lambda progress: "1"), "beta='1'", "positive number"),
    "unknown estimator": (dict(mi_estimator="mime"), "mi_estimator='mime'", r"\['directed', .* 'smile', 'vib'\]"),
    "estimator of a wrong class": (dict(mi_estimator=th.nn.Linear), "mi_estimator", "InformationEstimator"),
    "mi_kwargs misspelt": (dict(mi_estimator="mine", mi_kwargs=dict(hiden_sizes=3)), "mi_kwargs", "mean 'hidden_size"),
    "mi_kwargs of another": (dict(mi_estimator="logdet", mi_kwargs=dict(batch_size=5)), "batch_size", "LogDet"),
    "mi_kwargs out of range": (dict(mi_estimator="mine", mi_kwargs=dict(batch_size=0)), "batch_size=0", "positive"),
    "mi_kwargs of a wrong type": (dict(mi_kwargs="batch_size=5"), "mi_kwargs", "dict"),
    "n_episodes no multiple of n_envs": (dict(env=lava(6), n_episodes=20), "n_episodes=20", r"\(6\)", "use 18"),
    "n_episodes below n_envs": (dict(env=lava(6), n_episodes=4), "n_episodes=4", r"use 6"),
    "n_episodes no multiple of n_envs of an id": (dict(n_envs=6, n_episodes=20), "use 18"),
    "n_episodes one": (dict(n_episodes=1), "n_episodes=1", "at least 2"),
    "n_episodes a float": (dict(n_episodes=20.0), "n_episodes=20.0", "integer"),
    "n_envs zero": (dict(n_envs=0), "n_envs=0", "integer of at least 1"),
    "n_envs for an environment": (dict(env=lava(20), n_envs=10), "n_envs=10", "leave n_envs out"),
    "unknown baseline": (dict(baseline="median"), r"baseline='median' is unknown.*\['mean', 'regression', 'value'\]"),
    "unknown encoder gradient": (dict(encoder_gradient="sore"), "encoder_gradient='sore'", r"\['score', 'pathwise'\]"),
    "gamma a text": (dict(gamma="1"), "gamma='1' must be a number"),
    "gae_lambda a text": (dict(gae_lambda="1"), "gae_lambda='1' must be a number"),
    "epoch of one episode": (dict(n_episodes=None, epoch_steps=9), "epoch_steps=9", "two episodes", "n_episodes=2"),
    "three severities": (dict(nuisance={"vector_noise": [1, 2, 3]}), r"\[1, 2, 3\]", "the lowest and the highest"),
    "gamma zero": (dict(gamma=0.0), "gamma=0.0", r"\(0, 1\]"),
    "gamma NaN": (dict(gamma=math.nan), "gamma=nan", r"\(0, 1\]"),
    "max_grad_norm negative": (dict(max_grad_norm=-1.0), "max_grad_norm=-1.0", "positive", "inf"),
    "max_grad_norm NaN": (dict(max_grad_norm=math.nan), "max_grad_norm=nan", "positive", "inf"),
    "target_kl zero": (dict(target_kl=0.0), "target_kl=0.0", "positive", "inf"),
    "learning_rate negative": (dict(learning_rate=-1e-3), "learning_rate=-0.001", "non-negative"),
    "learning_rate a string": (dict(learning_rate="1e-3"), "learning_rate='1e-3'", "number"),
    "learning_rate a schedule that goes below zero": (
        dict(learning_rate=lambda progress: progress - 0.5), "learning_rate=-0.5", "non-negative"
    ),
    "unknown environment": (dict(env="Larva-v0"), "Larva"),
    "no horizon": (dict(env=DummyVecEnv([WithoutHorizon])), "finite horizon", "`horizon`", "max_episode_steps"),
    "horizon zero": (dict(env=toy_vec_env(horizon=0)), "finite horizon", "horizon=0"),
    "image without a state": (
        dict(env=toy_vec_env(observation_space=IMAGE, gives_state=False)),
        r"an image \(Box\(0, 255, \(3, 20, 16\), uint8\)\) cannot stand in for it",
        r'info\["state"\]', "state_space", "reset",
    ),
    "more names": (dict(env=toy_vec_env(state_names=("d (m)", "v (m/s)"))), r"\('d \(m\)', 'v", "1 different", "x0"),
    "names of the state as one text": (dict(env=toy_vec_env(state_names="d")), "state_names='d'", "1 different"),
    "a name of the state twice": (dict(env=BatchedVecEnv(NamedTwice(), 20)), "state_names=.'d', 'd'.", "2 different"),
    "infinite bounds": (actions(spaces.Box(-np.inf, np.inf, (1,), np.float32)), "action", "bound", "finite"),
    "actions that do not begin with 0": (actions(spaces.Discrete(3, start=5)), "action space", "begin with 0"),
    "actions in a dict": (actions(spaces.Dict(a=spaces.Discrete(2))), "action space", "Box", "Discrete"),
    "observations in a tuple": (
        dict(env=toy_vec_env(observation_space=spaces.Tuple([spaces.Box(-1, 1, (2,))]))), "FlattenObservation"
    ),
    "both lengths": (dict(n_episodes=10, epoch_steps=100), "n_episodes=10 and epoch_steps=100", "give one of them"),
    "rewards normalised": (dict(env=VecNormalize(lava())), "norm_reward=False", "beta"),
    "trv_dim misspelt": (dict(policy_kwargs=dict(trv_dims=2)), "policy_kwargs", "'trv_dims': did you mean 'trv_di"),
    "policy_kwargs a text": (dict(policy_kwargs="trv_dim=2"), "policy_kwargs='trv_dim=2' must be a dict of keywords"),
    "net_arch of PPO": (dict(policy_kwargs=dict(net_arch=dict(pi=[64]))), "net_arch", r"\['action_head', 'encoder'\]"),
    "action_mean_init too long": (
        dict(policy_kwargs=dict(action_mean_init=[0.1, 0.2])), r"action_mean_init=\[0.1, 0.2\]", "1 numbers", "Box"
    ),
    "trv_dim zero": (dict(policy_kwargs=dict(trv_dim=0)), "trv_dim=0", "at least 1"),
    "trv_dim a float": (dict(policy_kwargs=dict(trv_dim=2.5)), "trv_dim=2.5", "integer"),
    "floor negative": (dict(policy_kwargs=dict(encoder_var_floor=-1.0)), "encoder_var_floor=-1.0", "not be negative"),
    "variance floor NaN": (dict(policy_kwargs=dict(action_var_floor=math.nan)), "action_var_floor=nan"),
}  # fmt: skip


@pytest.mark.parametrize("case", ARGUMENTS)
def test_a_bad_argument_is_refused_with_the_mend(case):
    kwargs, *fragments = ARGUMENTS[case]
    with pytest.raises((ValueError, gym.error.Error)) as error:
        TDPG(**{"policy": "TRVPolicy", "env": "Lava-v0", "n_episodes": 20, "device": "cpu", **kwargs})
    for fragment in fragments:
        assert re.search(fragment, str(error.value)), f"{fragment!r} is not in {error.value!s}"


@pytest.mark.parametrize(("name", "mend"), [
    ("n_episods", ": did you mean 'n_episodes'"),
    ("xyz", "$"),
    ("n_step", ": use epoch_steps"),
    ("n_steps", ": use epoch_steps"),  # from here on, the arguments are PPO's
    ("ent_coef", ".*action_log_var_init"),
    ("use_sde", ".*encoder_log_var_init"),
])  # fmt: skip
def test_an_unknown_argument_is_told_with_the_nearest_name_or_its_equivalent(name, mend):
    with pytest.raises(TypeError, match=f"no argument '{name}'{mend}"):
        TDPG("TRVPolicy", **{name: 3})


def half(path):
    tiny_tdpg().save(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])


def rewritten(change):
    """Return a function that saves a model with parts replaced by ``change(name, content)``; ``None`` drops a part."""

    def write(path):
        tiny_tdpg().save(path)
        with zipfile.ZipFile(path) as archive:
            parts = {name: change(name, archive.read(name)) for name in archive.namelist()}
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in parts.items():
                if content is not None:
                    archive.writestr(name, content)

    return write


def part(wanted, content):
    return rewritten(lambda name, old: content if name == wanted else old)


DAMAGED = {
    "half": half,
    "text": lambda path: path.write_text("no zip file"),
    "empty": lambda path: path.write_bytes(b""),
    "nothing in an archive": rewritten(lambda name, old: None),
    "no weights": part("policy.pth", None),
    "half of the weights": rewritten(lambda name, old: old[: len(old) // 2] if name == "policy.pth" else old),
    "no settings": part("data", None),
    "settings that are no JSON": part("data", b"{]"),
    "settings that are none": part("data", b"{}"),
    "a list of settings": part("data", b"[]"),
    "settings of another encoding": part("data", b"\xff"),
    "damaged pickles": rewritten(
        lambda name, old: re.sub(rb'(":serialized:": "[^"]{20})[^"]*', rb"\1", old) if name == "data" else old
    ),
}


@pytest.mark.parametrize("write", DAMAGED.values(), ids=DAMAGED)
def test_a_damaged_model_is_told_in_a_line_that_names_it(write, tmp_path, capsys):
    path, out = tmp_path / "model.zip", tmp_path / "out"
    write(path)
    with pytest.raises(ValueError, match=r"model\.zip is not a model of TDPG: the file is damaged"):
        TDPG.load(path, device="cpu")
    for program, *to in (["enjoy"], ["certify", "--nuisance", "vector_bias", "--out", out], ["report", "--out", out]):
        assert "model.zip " in error_line(capsys, program, path, *to, "--env", "Lava-v0")
        assert not out.exists()


@pytest.mark.parametrize(("kwargs", "error", "message"), [
    (dict(env=lava(horizon=7)), ValueError, r"horizon=7.*made for horizon=5.*same shape"),
    (dict(env=lava(6)), ValueError, "use 18"),
    (dict(env=lava(), beta=-1.0), ValueError, "beta=-1.0 must be a positive number"),
    (dict(mi_estimator="mine"), ValueError, "has no networks for mi_estimator='mine'"),
    (dict(baseline="value"), ValueError, "has no networks for baseline"),
    (dict(n_episode=100), TypeError, r"n_episode.*n_episodes"),
], ids=lambda value: " ".join(value) if isinstance(value, dict) else "")  # fmt: skip
def test_a_model_is_not_loaded_with_what_does_not_fit_and_not_taken_for_damaged(kwargs, error, message, tmp_path):
    tiny_tdpg(beta=math.inf).save(tmp_path / "model")
    with pytest.raises(error, match=message) as refused:
        TDPG.load(tmp_path / "model", **kwargs, device="cpu")
    assert "damaged" not in str(refused.value)


def test_what_is_no_model_of_tdpg_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="no_such_model"):
        TDPG.load(tmp_path / "no_such_model", device="cpu")
    PPO("MlpPolicy", "CartPole-v1", device="cpu").save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"TRVPolicy.*class that saved it"):
        TDPG.load(tmp_path / "model", device="cpu")


@pytest.mark.parametrize(("env", "message"), [
    (lambda: lava(horizon=7), "horizon=7.*made for horizon=5"),
    (lambda: VecNormalize(lava()), "norm_reward=False"),
], ids=["horizon", "norm_reward"])  # fmt: skip
def test_an_environment_that_does_not_fit_cannot_be_set_and_leaves_the_old_one(env, message):
    model = tiny_tdpg()
    old = model.env
    with pytest.raises(ValueError, match=message):
        model.set_env(env())
    assert model.env is old
    model.learn(100)


POLICY = dict(observation_space=spaces.Discrete(2), action_space=spaces.Discrete(2), lr_schedule=lambda _: 1e-3)


@pytest.mark.parametrize(("make", "kwargs", "message"), [
    (InformationCallback, dict(eval_freq=0), "eval_freq=0 must be at least 1"),
    (SelectionCallback, dict(), "give cost_limit .* mi_limit .* or both"),
    (SelectionCallback, dict(cost_limit=math.nan), "cost_limit=nan must not be NaN"),
    (SelectionCallback, dict(mi_limit=-0.1), "mi_limit=-0.1 must be at least 0"),
    (TrainingCheckpointCallback, dict(save_path="checkpoint", save_freq=0), "save_freq=0 must be at least 1"),
    (TRVPolicy, dict(POLICY, horizon=0), "horizon.*at least 1"),
    (TRVPolicy, dict(POLICY, horizon=2.5), "horizon.*at least 1"),
])  # fmt: skip
def test_a_callback_or_a_policy_of_its_own_refuses_a_bad_argument(make, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


class Payload:
    """An object that runs code when it is unpickled."""

    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def test_a_payload_among_the_weights_is_refused_in_one_line(tmp_path):
    marker, changed = tmp_path / "marker", io.BytesIO()
    th.save({"weight": Payload(marker)}, changed)
    part("policy.pth", changed.getvalue())(tmp_path / "bad.zip")
    with pytest.raises(ValueError, match="is not a model of TDPG") as refused:
        TDPG.load(tmp_path / "bad.zip")
    assert len(str(refused.value).splitlines()) == 1
    assert not marker.exists()


@pytest.mark.skipif(th.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_is_not_there_is_reported():
    with pytest.warns(UserWarning, match="device='cuda', but torch finds no GPU: the model is on the CPU"):
        assert tiny_tdpg(device="cuda").device.type == "cpu"
    with pytest.raises(ValueError, match="device='foo' is unknown"):
        tiny_tdpg(device="foo")
