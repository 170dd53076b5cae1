"""Certificates for a declared nuisance: no random member costs more than its bound."""

import json

import pandas as pd
import pytest
from small_problems import error_line, tiny_tdpg, train_epochs
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_tdpg.certificates.declared import FAMILY, certify_nuisance, nuisance_table
from sb3_tdpg.cli import main
from sb3_tdpg.envs.lava import LavaEnv


def test_certified_bounds_hold_for_random_members(tmp_path):
    model = tiny_tdpg("Lava-v0", n_episodes=100, nuisance="vector_bias")
    train_epochs(model, 3)
    model.save(tmp_path / "model.zip")
    declared = "{vector_noise: [1, 5], vector_bias: 2}"
    command = ["certify", str(tmp_path / "model.zip"), "--env", "Lava-v0", "--nuisance", declared, "--members", "20"]
    main([*command, "--n-episodes", "2000", "--n-test-episodes", "200", "--out", str(tmp_path / "out")])
    records = pd.read_csv(tmp_path / "out" / "nuisance.csv")
    assert len(records) == 21
    assert (records["clipped_cost"] <= records["bound"]).all()
    assert records["kl"].nunique() > 15  # another member, another divergence
    assert (records["measured_kl"] <= records["kl"] + 1e-6).mean() > 0.9
    summary = (tmp_path / "out" / "summary.md").read_text()
    assert "random members" in summary and "The trivial bound is 315" in summary and "Made by" in summary
    config = json.loads((tmp_path / "out" / "config.json").read_text())
    assert config["cost_bound"] == 315  # standing at the wall
    assert config["n_budget_episodes"] == 2000


NUISANCE = ["--nuisance", "vector_bias"]


@pytest.mark.parametrize(("arguments", "message"), [
    (["nothing.zip", *NUISANCE], "nothing.zip cannot be read"),
    (["model.zip", *NUISANCE, "--seed", "-1"], "seed=-1 must be at least 0"),
    (["model.zip", *NUISANCE, "--n-test-episodes", "1"], "n_test_episodes=1 must be at least 2"),
    (["model.zip", *NUISANCE, "--confidence", "1.5"], "confidence=1.5 must lie between 0 and 1"),
    (["model.zip", *NUISANCE, "--cost-bound", "nan"], "cost_bound=nan must be finite"),
    (["model.zip", *NUISANCE, "--out", "model.zip"], "File exists"),
    (["model.zip", "--nuisance", "{"], "is not YAML"),
    (["model.zip", "--nuisance", "fog"], "perturbation='fog' is unknown"),
    (["model.zip", "--nuisance", "auto"], "is none for"),
    (["model.zip", "--nuisance", "actuator_gain"], "changes the actions"),
])  # fmt: skip
def test_bad_input_to_the_command_is_told_in_a_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sb3_tdpg.certificates.shifts.record_episodes", None)  # by then, nothing has been run
    tiny_tdpg("Lava-v0", n_episodes=2).save("model.zip")
    assert message in error_line(capsys, "certify", "--env", "Lava-v0", *arguments)


def test_another_environment_needs_a_bound_on_the_cost(tmp_path):
    tiny_tdpg("SqueezeInsert-v0", n_episodes=2).save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="cost_bound is needed for SqueezeInsert-v0"):
        certify_nuisance([tmp_path / "model.zip"], "SqueezeInsert-v0", "vector_bias", tmp_path)


def test_a_model_of_normalised_observations_is_refused(tmp_path):
    env = VecNormalize(DummyVecEnv([LavaEnv]), norm_reward=False)
    tiny_tdpg(env, n_episodes=2).save(tmp_path / "model.zip")
    env.save(tmp_path / "vecnormalize.pkl")
    with pytest.raises(ValueError, match="without VecNormalize"):
        certify_nuisance([tmp_path / "model.zip"], "Lava-v0", "vector_bias", tmp_path)


def test_a_cost_above_its_bound_counts_from_three_standard_errors_on():
    errors_above = [-5.0, 0.0, 2.0, 2.9, 3.1, 10.0]
    numbers = dict(model="policy", training_cost=1.0, bound=10.0, standard_error=0.5)
    rows = [dict(shift=FAMILY, clipped_cost=5.0, **numbers)]
    rows += [dict(shift=f"member {x}", clipped_cost=10.0 + 0.5 * x, **numbers) for x in errors_above]
    heads, _, cells = (
        [x.strip() for x in line.split("|")] for line in nuisance_table(pd.DataFrame(rows), 50.0).split("\n")
    )
    table = dict(zip(heads, cells, strict=True))
    assert (table["random members"], table["cost above the bound"]) == ("6", "4")
    assert table["by more than 3 standard errors"] == "2"
