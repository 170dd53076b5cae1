"""The tests of rl-zoo3 2.9 for its own algorithms, repeated with TDPG where a third-party algorithm can take them."""

import os
import subprocess
import sys

import numpy as np
import pytest
from programs import run
from stable_baselines3.common.monitor import load_results

from sb3_tdpg import TDPG
from sb3_tdpg.cli import main
from tests.zoo.test_zoo import folder_of

pytest.importorskip("rl_zoo3")
import optuna
from rl_zoo3.utils import get_trained_models
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_tdpg.zoo.studies import open_storage

BLOCK = "policy: TRVPolicy, n_timesteps: 200, n_episodes: 2, n_envs: 1, mi_estimator: logdet, beta: 1.0"
NO_EVALUATION = ["--eval-freq", "-1", "--verbose", "0"]


def loaded(path, env, n=1):
    return TDPG.load(folder_of(path, n, env=env) / f"{env}.zip", device="cpu")


@pytest.mark.slow
def test_train_does_not_load_what_only_other_programs_need():
    show = "import sys; print(*(name for name in sys.modules if '.' not in name))"
    ours, theirs = (
        set(subprocess.check_output([sys.executable, "-c", f"import {module}; {show}"], text=True).split())
        for module in ("sb3_tdpg.zoo.programs, sb3_tdpg.common.provenance", "rl_zoo3.train")
    )
    assert not {"pandas", "requests"} & (ours - theirs)


def test_environments_get_the_keywords_of_the_command_line(here, monkeypatch):
    from sb3_tdpg.zoo.manager import TDPGExperimentManager

    gravities = {}
    create_envs = TDPGExperimentManager.create_envs

    def spy(self, n_envs, eval_env=False, no_log=False):
        env = create_envs(self, n_envs, eval_env, no_log)
        gravities["evaluation" if eval_env else "training"] = env.get_attr("unwrapped")[0].g
        return env

    monkeypatch.setattr(TDPGExperimentManager, "create_envs", spy)
    command = ["train", "--env", "Pendulum-v1", "-n", "100", "-params", "n_episodes:2", "batch_size:100"]
    assert main([*command, "--env-kwargs", "g:8.0", "--eval-env-kwargs", "g:5.0"]) == 0
    assert gravities == dict(training=8.0, evaluation=5.0)


def test_the_monitor_writes_the_keywords_of_the_block(here):
    keywords = "monitor_kwargs:dict(info_keywords=('TimeLimit.truncated',))"
    command = ["train", "--env", "Pendulum-v1", "-n", "400", "-params", "n_episodes:2", "batch_size:100", keywords]
    assert main([*command, *NO_EVALUATION]) == 0
    assert load_results(str(folder_of(here, env="Pendulum-v1")))["TimeLimit.truncated"].all()


def test_an_environment_and_a_block_from_a_package_of_ones_own(here):
    (here / "my_package").mkdir()
    (here / "my_package" / "__init__.py").write_text(
        "from gymnasium.envs.classic_control import PendulumEnv\nfrom gymnasium import register\n"
        'register("Mine-v0", entry_point=PendulumEnv, max_episode_steps=20)\n'
    )
    blocks = {"Mine-v0": dict(policy="TRVPolicy", n_timesteps=80, n_episodes=2, mi_estimator="logdet", beta=1.0)}
    (here / "my_package" / "config.py").write_text(f"hyperparams = {blocks}\n")
    command = ["train", "--env", "Mine-v0", "--gym-packages", "my_package", "--conf-file", "my_package.config"]
    path = os.pathsep.join(p for p in (str(here), *sys.path) if p)
    run(["-m", "sb3_tdpg", *command, *NO_EVALUATION], here, PYTHONPATH=path)
    assert loaded(here, "Mine-v0").num_timesteps == 80


@pytest.mark.parametrize("wrappers", [
    "env_wrapper: rl_zoo3.wrappers.TimeFeatureWrapper",
    "env_wrapper: [{rl_zoo3.wrappers.HistoryWrapper: {horizon: 3}}, rl_zoo3.wrappers.TimeFeatureWrapper]",
    "env_wrapper: [{rl_zoo3.wrappers.DelayedRewardWrapper: {delay: 10}}, rl_zoo3.wrappers.ActionNoiseWrapper]",
    "vec_env_wrapper: {stable_baselines3.common.vec_env.VecFrameStack: {n_stack: 2}}",
    "vec_env_wrapper: [{stable_baselines3.common.vec_env.VecFrameStack: {n_stack: 3}}, "
    "stable_baselines3.common.vec_env.VecMonitor]",
    "frame_stack: 2, normalize: {norm_obs: true, norm_reward: false}",
], ids=["one", "history", "noise", "stack", "stack and monitor", "stack and normalize"])  # fmt: skip
@pytest.mark.parametrize("env", ["Pendulum-v1", "Lava-v0"])
def test_wrappers_of_the_zoo(env, wrappers, here):
    (here / "mine.yml").write_text(f"{env}: {{{BLOCK}, {wrappers}}}\n")
    assert main(["train", "--env", env, "--conf-file", "mine.yml", "-n", "200", "--verbose", "0"]) == 0
    model = loaded(here, env)
    features, horizon = {"Pendulum-v1": (3, 200), "Lava-v0": (2, 5)}[env]
    assert model.horizon == horizon  # and not that of the history
    assert (model.observation_space.shape == (features,)) == ("delay" in wrappers)
    assert main(["enjoy", "--env", env, "--no-render", "-n", "200"]) == 0


def test_the_raw_statistics_of_episodes_go_to_tensorboard(here):
    callback = "callback:'rl_zoo3.callbacks.RawStatisticsCallback'"
    command = ["train", "--env", "Pendulum-v1", "-n", "800", "-params", "n_episodes:2", "batch_size:100", callback]
    assert main([*command, "--tensorboard-log", "tensorboard", *NO_EVALUATION]) == 0
    (folder,) = {path.parent for path in here.glob("tensorboard/**/events.*")}
    events = EventAccumulator(str(folder)).Reload()
    returns = [event.value for event in events.Scalars("raw/rollouts/episodic_return")]
    monitored = load_results(str(folder_of(here, env="Pendulum-v1")))["r"]
    np.testing.assert_allclose(sorted(returns), sorted(monitored), rtol=1e-4)


def test_enjoy_takes_the_best_model_and_the_checkpoints(here, capsys):
    command = ["train", "--env", "CartPole-v1", "-params", "n_envs:1", "n_episodes:2", "batch_size:100", "-P"]
    assert main([*command, "-n", "1000", "-f", "elsewhere", "--eval-freq", "500", "--save-freq", "500"]) == 0
    enjoy = ["enjoy", "--env", "CartPole-v1", "-f", "elsewhere", "--no-render", "-n", "100"]
    for flags, name in (
        (["--load-best", "-P"], "best_model.zip"),
        (["--load-checkpoint", "500"], "rl_model_500_steps.zip"),
        (["--load-last-checkpoint"], "rl_model_1000_steps.zip"),
    ):
        capsys.readouterr()
        assert main([*enjoy, *flags]) == 0
        assert f"CartPole-v1_1/{name}" in capsys.readouterr().out


@pytest.mark.slow
def test_the_zoos_benchmark_evaluates_tdpg(here):
    """The benchmark runs enjoy.py of its working directory, here the script of a third-party algorithm."""
    assert main(["train", "--env", "Lava-v0", "--block", "Lava-v0-logdet", "-n", "100", "-params", "n_episodes:20",
                 *NO_EVALUATION]) == 0  # fmt: skip
    assert get_trained_models("logs") == {"tdpg-Lava-v0": ("tdpg", "Lava-v0")}
    (here / "enjoy.py").write_text(
        "from rl_zoo3.enjoy import enjoy\n\nfrom sb3_tdpg.zoo import register\n\nregister()\nenjoy()\n"
    )
    path = os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]])  # it calls `python`
    command = ["-m", "rl_zoo3.benchmark", "-n", "100", "--log-dir", "logs/", "--benchmark-dir", "benchmark"]
    run([*command, "--test-mode", "--no-hub"], here, PATH=path)
    assert "|tdpg|Lava-v0|" in (here / "benchmark" / "benchmark.md").read_text().replace(" ", "")


def test_workers_one_after_the_other_stop_at_the_total_of_trials(here):
    command = ["tune", "--env", "Pendulum-v1", "-n", "400", "-params", "n_envs:1", "n_episodes:2", "batch_size:100"]
    command += ["--n-evaluations", "1", "--seed", "12", "--eval-episodes", "40", "--max-total-trials", "3"]
    for n_trials in ("2", "2"):
        assert main([*command, "--n-trials", n_trials, "--storage", "study.log", "--study-name", "a"]) == 0
    study = optuna.load_study(study_name="a", storage=open_storage("study.log"))
    assert len(study.get_trials(states=(optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED))) == 3
