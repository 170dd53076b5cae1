"""Repeat a published run with the command in its card."""

import json
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import pandas as pd
import pytest
from published_cards import blocks
from small_problems import assert_same_parameters, parameters

from sb3_tdpg import TDPG
from sb3_tdpg.cli import main
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.experiments.rerun import rerun
from sb3_tdpg.experiments.runs import SB3Run, complete_run
from sb3_tdpg.robustness import PerturbedVecEnv

REPOSITORY = Path(__file__).resolve().parents[2]


def test_the_command_in_the_card_repeats_the_run(card, runs, tmp_path):
    copy = shutil.copytree(card, tmp_path / "copy")  # with the policy to start from in it
    program, *arguments = shlex.split(blocks(copy, "bash")[-1])
    assert program == "sb3-tdpg"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-m", "sb3_tdpg", *arguments], cwd=copy, check=True, env=environment)
    assert (copy / "again" / "episodes.csv").read_bytes() == (runs / "tdpg-seed0" / "episodes.csv").read_bytes()
    first, second = (TDPG.load(f / "model.zip", device="cpu") for f in (runs / "tdpg-seed0", copy / "again"))
    assert_same_parameters(parameters(first.policy), parameters(second.policy))


def test_a_rerun_uses_the_recorded_settings_and_not_the_block(runs, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_tdpg.experiments.runs.load_hyperparams", lambda *_: pytest.fail("it reads the block"))
    rerun(runs / "pg-seed0" / "config.json", tmp_path / "again", progress_bar=False)
    assert (tmp_path / "again" / "episodes.csv").read_bytes() == (runs / "pg-seed0" / "episodes.csv").read_bytes()
    assert TDPG.load(tmp_path / "again" / "model.zip", device="cpu").mi_coef == 0  # beta is inf, and not a text


def test_a_run_of_ppo_is_repeated_without_the_rows_that_a_function_changes(tmp_path, capsys):
    settings = dict(n_timesteps=100, n_steps=10, batch_size=10, n_envs=1)
    run = SB3Run("PPO", "Lava-v0", "Lava-v0", 0, overrides=settings, algo="ppo")
    rows = [Scenario("Training", "Lava-v0", n_episodes=3), Scenario("Noisy", "Lava-v0", sensor=noisy)]
    complete_run(run, tmp_path / "run", rows, n_eval_episodes=4, progress_bar=False)
    rerun(tmp_path / "run" / "config.json", tmp_path / "again", progress_bar=False)
    first, second = (pd.read_csv(tmp_path / folder / "episodes.csv") for folder in ("run", "again"))
    assert first["scenario"].value_counts().to_dict() == {"Noisy": 4, "Training": 3}
    pd.testing.assert_frame_equal(second, first[first["scenario"] == "Training"])
    assert "left out, for a function changes their sensor: Noisy\n" in capsys.readouterr().out


def test_a_run_of_an_open_loop_is_refused_before_it_is_trained(tmp_path):
    run = SB3Run("PPO", "Lava-v0", "Lava-v0", 0, overrides=dict(n_timesteps=10, n_steps=10, batch_size=10), algo="ppo")
    complete_run(run, tmp_path / "run", [Scenario("Noisy", "Lava-v0", sensor=noisy)], n_eval_episodes=2)
    with pytest.raises(ValueError, match="evaluated behind a function alone"):
        rerun(tmp_path / "run" / "config.json", tmp_path / "again", progress_bar=False)
    assert not (tmp_path / "again").exists()


def noisy(env):
    return PerturbedVecEnv(env, "vector_noise", 5)


def test_a_rerun_that_cannot_write_or_is_interrupted_is_told_in_a_line(runs, capsys, monkeypatch):
    config = str(runs / "pg-seed0" / "config.json")
    assert main(["rerun", config, "/proc/nowhere"]) == 2
    assert capsys.readouterr().err == "error: [Errno 2] No such file or directory: '/proc/nowhere'\n"
    monkeypatch.setattr("sb3_tdpg.experiments.rerun.complete_run", Mock(side_effect=KeyboardInterrupt))
    assert main(["rerun", config, "again"]) == 130


def test_a_rerun_without_the_policy_that_the_run_started_from_is_refused(card, runs, tmp_path, capsys):
    shutil.copy(card / "config.json", tmp_path)
    with pytest.raises(ValueError, match="is not trained yet: put the run's own there"):
        rerun(tmp_path / "config.json", tmp_path / "again")
    (tmp_path / "pg-seed0").mkdir()
    shutil.copy(runs / "tdpg-seed0" / "model.zip", tmp_path / "pg-seed0")  # another one
    assert main(["rerun", str(tmp_path / "config.json"), str(tmp_path / "again")]) == 2
    assert capsys.readouterr().err.startswith("error: the run started from the policy ")
    with pytest.raises(ValueError, match=r"nothing.json does not describe a run"):
        rerun(tmp_path / "nothing.json", tmp_path / "again")
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize("key", ["callback", "vec_env_wrapper"])
def test_a_record_that_names_a_function_instead_of_a_class_runs_nothing(key, runs, tmp_path):
    config, marker = json.loads((runs / "pg-seed0" / "config.json").read_text()), tmp_path / "marker"
    config["settings"][key] = [{"os.system": {"command": f"touch {marker}"}}]
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match=r"os\.system is not a subclass of"):
        rerun(tmp_path / "config.json", tmp_path / "again", progress_bar=False)
    assert not marker.exists()
