"""The tests of rl-zoo3 2.9 for its own algorithms, repeated with TDPG where a third-party algorithm can take them."""

import os
import sys

import pytest
from programs import run
from stable_baselines3.common.monitor import load_results

from sb3_tdpg import TDPG
from sb3_tdpg.cli import main
from tests.zoo.test_zoo import folder_of

pytest.importorskip("rl_zoo3")
import optuna

from sb3_tdpg.zoo.studies import open_storage

BLOCK = "policy: TRVPolicy, n_timesteps: 200, n_episodes: 2, n_envs: 1, mi_estimator: logdet, beta: 1.0"
NO_EVALUATION = ["--eval-freq", "-1", "--verbose", "0"]


def loaded(path, env, n=1):
    return TDPG.load(folder_of(path, n, env=env) / f"{env}.zip", device="cpu")


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
    block = "policy='sb3_tdpg.policies.TRVPolicy', n_timesteps=80, n_episodes=2, mi_estimator='logdet', beta=1.0"
    (here / "my_package" / "config.py").write_text(f"hyperparams = {{'Mine-v0': dict({block})}}\n")
    path = os.pathsep.join(p for p in (str(here), *sys.path) if p)
    for n, config in enumerate(("my_package.config", "my_package/config.py"), start=1):
        command = ["train", "--env", "Mine-v0", "--gym-packages", "my_package", "--conf-file", config]
        run(["-m", "sb3_tdpg", *command, *NO_EVALUATION], here, PYTHONPATH=path)
        assert loaded(here, "Mine-v0", n).num_timesteps == 80


@pytest.mark.parametrize("wrappers", [
    "env_wrapper: rl_zoo3.wrappers.TimeFeatureWrapper",
    "env_wrapper: [{rl_zoo3.wrappers.DelayedRewardWrapper: {delay: 10}}, rl_zoo3.wrappers.ActionNoiseWrapper]",
    "vec_env_wrapper: {stable_baselines3.common.vec_env.VecFrameStack: {n_stack: 2}}",
    "vec_env_wrapper: [{stable_baselines3.common.vec_env.VecFrameStack: {n_stack: 3}}, "
    "stable_baselines3.common.vec_env.VecMonitor]",
    "frame_stack: 2, normalize: {norm_obs: true, norm_reward: false}",
], ids=["one", "noise", "stack", "stack and monitor", "stack and normalize"])  # fmt: skip
@pytest.mark.parametrize("env", ["Pendulum-v1", "Lava-v0"])
def test_wrappers_of_the_zoo(env, wrappers, here):
    (here / "mine.yml").write_text(f"{env}: {{{BLOCK}, {wrappers}}}\n")
    assert main(["train", "--env", env, "--conf-file", "mine.yml", "-n", "200", "--verbose", "0"]) == 0
    model = loaded(here, env)
    features, horizon = {"Pendulum-v1": (3, 200), "Lava-v0": (2, 5)}[env]
    assert model.horizon == horizon
    assert (model.observation_space.shape == (features,)) == ("delay" in wrappers)
    assert main(["enjoy", "--env", env, "--no-render", "-n", "200"]) == 0


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


def test_workers_one_after_the_other_stop_at_the_total_of_trials(here):
    command = ["tune", "--env", "Pendulum-v1", "-n", "400", "-params", "n_envs:1", "n_episodes:2", "batch_size:100"]
    command += ["--n-evaluations", "1", "--seed", "12", "--eval-episodes", "40", "--max-total-trials", "3"]
    for _ in range(2):
        assert main([*command, "--n-trials", "2", "--storage", "study.log", "--study-name", "a"]) == 0
    study = optuna.load_study(study_name="a", storage=open_storage("study.log"))
    assert len(study.get_trials(states=(optuna.trial.TrialState.COMPLETE, optuna.trial.TrialState.PRUNED))) == 3
