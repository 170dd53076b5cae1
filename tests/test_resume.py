"""A training that is killed and resumed ends with exactly the numbers of an uninterrupted training."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import torch as th
from small_problems import TINY_CRITIC, AtEveryStep, assert_same_parameters, lava_env, parameters, tiny_tdpg
from stable_baselines3.common.env_util import make_vec_env

from sb3_tdpg import TDPG, SelectionCallback, TrainingCheckpointCallback

SLOW = pytest.mark.slow
REPOSITORY = Path(__file__).resolve().parents[1]
SAVE_FREQ = 2
# Environment steps of about seven epochs. An epoch has 20 episodes on Lava, and 8 episodes of varying length on
# CartPole.
TOTAL = {"lava": 700, "lava_in_dummy_vec_env": 700, "cartpole": 3000}

ENVIRONMENTS = {
    "lava": lava_env,
    "lava_in_dummy_vec_env": lambda: make_vec_env("Lava-v0", n_envs=4),
    "cartpole": lambda: make_vec_env("CartPole-v1", n_envs=4),
}
KEEPS_ALL = "mine that keeps its moments and an average"
SETTINGS = {
    "mine": dict(mi_estimator="mine"),
    KEEPS_ALL: dict(mi_estimator="mine", mi_kwargs=dict(TINY_CRITIC, reset_moments=False, ema_decay=0.9)),
    "logdet and schedules": dict(
        beta=lambda progress: 0.1 + progress, learning_rate=lambda progress: 1e-2 * progress, max_grad_norm=1.0
    ),
    "passes under a cost limit": dict(
        beta="auto", cost_limit=1e4, n_epochs=2, batch_size=20, clip_range=0.2, encoder_gradient="pathwise"
    ),
    "policy gradient without a seed": dict(beta=float("inf"), seed=None),
    "a nuisance": dict(nuisance={"vector_noise": (1, 3), "vector_bias": 5}),
}


def make_model(env, settings):
    given = dict(n_episodes=20, **SETTINGS[settings])
    if env == "cartpole":
        given["n_episodes"] = 8
        if "batch_size" in given:
            given["batch_size"] = 200
    return tiny_tdpg(ENVIRONMENTS[env](), **given)


def train(model, total_timesteps, path, callbacks=(), **kwargs):
    return model.learn(total_timesteps, callback=[TrainingCheckpointCallback(path, SAVE_FREQ), *callbacks], **kwargs)


def resume(env, path, callbacks=()):
    model = TDPG.load(path, env=ENVIRONMENTS[env](), device="cpu")
    # Random numbers that the process has drawn in the meantime must have no effect.
    th.manual_seed(99)
    np.random.seed(99)  # noqa: NPY002
    return train(model, model.remaining_timesteps, path, callbacks, reset_num_timesteps=False)


def moments(optimizer):
    return {
        f"{group}.{name}": value
        for group, state in optimizer.state_dict()["state"].items()
        for name, value in state.items()
        if isinstance(value, th.Tensor)
    }


def assert_same_training(first, second):
    assert (first.epoch, first.num_timesteps) == (second.epoch, second.num_timesteps)
    assert_same_parameters(parameters(first.policy), parameters(second.policy))
    assert_same_parameters(parameters(first.estimator), parameters(second.estimator))
    assert_same_parameters(moments(first.policy.optimizer), moments(second.policy.optimizer))
    np.testing.assert_array_equal(first.rollout_buffer.observations, second.rollout_buffer.observations)
    assert first.policy.optimizer.param_groups[0]["lr"] == second.policy.optimizer.param_groups[0]["lr"]


class Stop(Exception):
    """Ends a training immediately, like a kill."""


def stop_in_epoch(epoch):
    def stop(callback):
        if callback.model.epoch == epoch and callback.n_calls % 2 == 0:
            raise Stop

    return AtEveryStep(stop)


@pytest.mark.parametrize(("env", "settings"), [
    pytest.param(env, settings, marks=SLOW if (env, settings) == ("cartpole", "passes under a cost limit") else ())
    for env in ENVIRONMENTS
    for settings in SETTINGS
])  # fmt: skip
def test_a_training_that_stopped_anywhere_goes_on_bit_for_bit(env, settings, tmp_path):
    total, stop = TOTAL[env], stop_in_epoch(3)
    if SETTINGS[settings].get("seed", 0) is None:  # two new models would differ, so both continue from the same file
        start = tmp_path / "start.zip"
        with pytest.raises(Stop):
            train(make_model(env, settings), total, start, [stop_in_epoch(1)])
        (tmp_path / "b.zip").write_bytes(start.read_bytes())
        uninterrupted = resume(env, start)
        with pytest.raises(Stop):
            resume(env, tmp_path / "b.zip", [stop])
    else:
        uninterrupted = train(make_model(env, settings), total, tmp_path / "a.zip")
        with pytest.raises(Stop):
            train(make_model(env, settings), total, tmp_path / "b.zip", [stop])
    assert TDPG.load(tmp_path / "b.zip", device="cpu").epoch == 2
    assert_same_training(uninterrupted, resume(env, tmp_path / "b.zip"))


def test_a_selection_goes_on_as_if_nothing_had_happened_twice(tmp_path):
    def selection(name):
        return SelectionCallback(mi_limit=1e3, save_path=tmp_path / name)

    paths = [tmp_path / f"{name}_checkpoint.zip" for name in "ab"]
    expected, chosen = selection("a"), selection("b")
    uninterrupted = train(make_model("lava", "mine"), 700, paths[0], [expected])
    with pytest.raises(Stop):
        train(make_model("lava", "mine"), 700, paths[1], [selection("b"), stop_in_epoch(3)])
    with pytest.raises(Stop):
        resume("lava", paths[1], [selection("b"), stop_in_epoch(5)])
    resumed = resume("lava", paths[1], [chosen])
    assert_same_training(uninterrupted, resumed)
    assert chosen.best == expected.best
    expected.restore(uninterrupted)
    chosen.restore(resumed)
    assert_same_parameters(parameters(uninterrupted.policy), parameters(resumed.policy))


def test_a_checkpoint_of_other_environments_is_refused_with_the_mend(tmp_path):
    model = train(make_model("lava_in_dummy_vec_env", "mine"), 100, tmp_path / "c.zip")
    other = TDPG.load(tmp_path / "c.zip", env=make_vec_env("Lava-v0", n_envs=2), device="cpu")
    with pytest.raises(ValueError, match=r"made with 4 environments, .* has 2: resume with the same number"):
        other.learn(100, reset_num_timesteps=False)
    model.save(tmp_path / "model.zip")  # an ordinary file has no random state in it
    TDPG.load(tmp_path / "model.zip", env=other.env, device="cpu").learn(100, reset_num_timesteps=False)


SCRIPT = """
    import os, signal, sys, zipfile
    sys.path.insert(0, {tests!r})
    import torch as th
    th.set_num_threads(1)
    import stable_baselines3.common.save_util
    from small_problems import AtEveryStep
    from test_resume import TOTAL, make_model, train

    def kill_in_mid_rollout(callback):
        if callback.model.epoch == 5 and callback.n_calls % 2 == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    original, models = zipfile.ZipFile.open, []

    def kill_in_mid_save(archive, name, mode="r", **kwargs):
        if mode == "w" and name == "policy.pth":
            models.append(name)
            if len(models) == 4:  # at epoch 6
                archive.fp.flush()
                os.kill(os.getpid(), signal.SIGKILL)
        return original(archive, name, mode, **kwargs)

    callbacks = []
    if {where!r} == "mid_save":
        zipfile.ZipFile.open = kill_in_mid_save
    else:
        callbacks = [AtEveryStep(kill_in_mid_rollout)]
    train(make_model({env!r}, {settings!r}), TOTAL[{env!r}], {path!r}, callbacks)
"""


@pytest.mark.skipif(os.name == "nt", reason="there is no SIGKILL")
@pytest.mark.parametrize(
    ("env", "where"),
    [("lava", "mid_rollout"), ("lava", "mid_save"), pytest.param("cartpole", "mid_rollout", marks=SLOW)],
)
def test_a_process_killed_with_sigkill_leaves_a_whole_checkpoint_to_go_on_from(env, where, tmp_path):
    path = tmp_path / "killed.zip"
    script = textwrap.dedent(SCRIPT).format(
        tests=str(REPOSITORY / "tests"), env=env, where=where, settings=KEEPS_ALL, path=str(path)
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL, done.stderr
    if where == "mid_save":
        assert list(tmp_path.glob("*.partial")), "the kill came too late"
    assert TDPG.load(path, device="cpu").epoch == 4
    uninterrupted = train(make_model(env, KEEPS_ALL), TOTAL[env], tmp_path / "whole.zip")
    assert uninterrupted.epoch >= 7
    assert_same_training(uninterrupted, resume(env, path))


@pytest.mark.parametrize("failing", ["os.replace", "stable_baselines3.common.base_class.save_to_zip_file"])
def test_a_save_that_fails_half_way_leaves_the_old_file(failing, tmp_path, monkeypatch):
    model = tiny_tdpg()
    model.save(tmp_path / "model.zip")
    before = (tmp_path / "model.zip").read_bytes()

    def fail(*args, **kwargs):
        raise OSError("no space left on device")

    monkeypatch.setattr(failing, fail)
    with pytest.raises(OSError, match="no space"):
        model.save(tmp_path / "model.zip")
    assert (tmp_path / "model.zip").read_bytes() == before
