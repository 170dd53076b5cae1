"""Runs of SB3's algorithms beside TDPG's, and the time that a training takes."""

import json
from pathlib import Path

import pytest
from sb3_contrib import RecurrentPPO
from small_problems import give_settings
from stable_baselines3 import PPO

from sb3_tdpg.checks import schedule_of
from sb3_tdpg.envs.scenarios import LAVA
from sb3_tdpg.experiments import runs
from sb3_tdpg.experiments.runs import Run, SB3Run, complete_run
from sb3_tdpg.experiments.training import take_env
from sb3_tdpg.paper.common import Method, training_times


@pytest.fixture
def tiny(monkeypatch):
    """Small batches."""
    give_settings(monkeypatch, dict(n_envs=4, batch_size=20, n_epochs=1), SB3Run)


@pytest.mark.parametrize(("algo", "cls"), [("ppo", PPO), ("ppo_lstm", RecurrentPPO)])
def test_a_run_of_sb3_is_the_model_that_its_block_makes(algo, cls, tmp_path, tiny):
    run = Method("baseline", "Lava-v0", algo=algo, overrides=dict(n_timesteps=200)).run("Lava-v0", 3)
    complete_run(run, tmp_path / "run", LAVA[:1], n_eval_episodes=4)

    settings = run.settings
    n_timesteps, policy = settings.pop("n_timesteps"), settings.pop("policy")
    env = take_env("Lava-v0", settings)
    settings["learning_rate"] = schedule_of("learning_rate", settings["learning_rate"])
    model = cls(policy, env, **settings, seed=3, device="cpu").learn(n_timesteps)
    saved = cls.load(tmp_path / "run" / "model.zip", device="cpu")
    for name, value in model.policy.state_dict().items():
        assert (saved.policy.state_dict()[name] == value).all(), name
    assert saved.num_timesteps == 200
    assert (tmp_path / "run" / "progress_00000000.csv").stat().st_size > 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (config["algo"], config["seed"], config["settings"]["gae_lambda"]) == (algo, 3, 0.7)


def test_a_model_that_was_half_written_when_a_run_was_killed_is_trained_anew(tmp_path, tiny, monkeypatch):
    run = Method("baseline", "Lava-v0", algo="ppo", overrides=dict(n_timesteps=20)).run("Lava-v0", 3)
    save = PPO.save

    def killed(self, path, *args, **kwargs):
        Path(path).write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(PPO, "save", killed)
    with pytest.raises(KeyboardInterrupt):
        complete_run(run, tmp_path / "run", LAVA[:1], n_eval_episodes=2)
    monkeypatch.setattr(PPO, "save", save)
    complete_run(run, tmp_path / "run", LAVA[:1], n_eval_episodes=2)
    assert PPO.load(tmp_path / "run" / "model.zip", device="cpu").num_timesteps == 20
    assert not list((tmp_path / "run").rglob("*.partial*"))


def test_the_time_of_a_training_is_that_of_all_attempts_and_of_all_its_parts(tmp_path, monkeypatch):
    class Clock:
        now = 0.0

        def __call__(self):
            return self.now

    wall, cpu = Clock(), Clock()
    monkeypatch.setattr(runs.time, "perf_counter", wall)
    monkeypatch.setattr(runs.time, "process_time", cpu)

    def train(run, attempt, folder, progress_bar, keep_times):
        folder.mkdir(parents=True, exist_ok=True)
        wall.now += 10.0
        cpu.now += 3.0
        if wall.now == 20.0:
            raise KeyboardInterrupt
        return PPO("MlpPolicy", "Lava-v0", device="cpu"), wall.now == 40.0

    monkeypatch.setattr(Run, "_train", train)
    run = Run("TDPG", "Lava-v0", "Lava-v0-logdet", 0, max_attempts=3)
    with pytest.raises(KeyboardInterrupt):
        complete_run(run, tmp_path, LAVA[:1], n_eval_episodes=2)
    complete_run(run, tmp_path, LAVA[:1], n_eval_episodes=2)
    # The first attempt was called twice (its model was not kept here), the interrupted one leaves no time.
    assert training_times([(run, tmp_path, LAVA[:1])]).to_dict("records") == [
        dict(model="TDPG", train_seed=0, wall_s=30.0, cpu_s=9.0)
    ]
