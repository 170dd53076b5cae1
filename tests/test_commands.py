"""``sweep``, ``push`` and ``pull`` work from the command line; other tests cover the functions that they call."""

import json
import re

import pandas as pd
import pytest
from small_problems import error_line

from sb3_tdpg.cli import main

pytest.importorskip("huggingface_hub")
pytest.importorskip("matplotlib")

SWEEP = ["sweep", "--env", "Lava-v0", "--betas", "1/25", "inf", "--seeds", "1", "--cost-limit", "1e6", "--jobs", "1"]
TINY = ["--n-timesteps", "200", "--n-eval-episodes", "20", "--set", "mi_estimator=logdet", "n_episodes=20"]


def test_a_sweep_and_the_card_of_one_of_its_runs(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*SWEEP, *TINY, "--env", "sb3_tdpg:Lava-v0"]) == 0
    assert "results are in results/sweep-Lava-v0" in capsys.readouterr().out
    out = tmp_path / "results" / "sweep-Lava-v0"
    runs = pd.read_csv(out / "runs.csv")
    assert runs["label"].tolist() == ["inf", "1/25"]
    config = json.loads((out / "runs" / runs["folder"][1] / "config.json").read_text())
    assert config["settings"]["mi_estimator"] == "logdet"
    assert config["settings"]["n_episodes"] == 20
    assert config["settings"]["n_timesteps"] == 200

    folder = out / "runs" / runs["folder"][1]
    assert main(["push", str(folder), "--repo-id", "me/tdpg-Lava-v0", "--dry-run"]) == 0
    text = capsys.readouterr().out
    card = folder.with_name(folder.name + "-hub")
    for path in card.rglob("*.*"):
        assert path.name in text
    assert "Mean cost [95 %]" in (card / "README.md").read_text()


def test_push_and_pull_hand_on_what_they_are_given(tmp_path, capsys, monkeypatch):
    called = []
    monkeypatch.setattr("sb3_tdpg.hub.push_to_hub", lambda *a, **k: called.append((a, k)) or "https://there")
    monkeypatch.setattr("sb3_tdpg.hub.pull_from_hub", lambda *a, **k: called.append((a, k)) or a[1])
    (tmp_path / "README.md").write_text("a card")
    assert main(["push", str(tmp_path), "--repo-id", "me/model"]) == 0
    assert main(["pull", "me/model", "--to", str(tmp_path / "here")]) == 0
    assert called == [((tmp_path, "me/model"), {}), (("me/model", tmp_path / "here"), {})]
    assert "https://there" in capsys.readouterr().out


def test_the_card_of_the_folder_where_one_stands_lies_beside_it(tmp_path, monkeypatch):
    called = []
    monkeypatch.setattr("sb3_tdpg.hub.write_model_card", lambda folder, card, *a, **k: called.append(card) or card)
    (tmp_path / "run").mkdir()
    monkeypatch.chdir(tmp_path / "run")
    assert main(["push", ".", "--repo-id", "me/model", "--dry-run"]) == 0
    assert called == [tmp_path / "run-hub"]


BAD = {
    "beta": ([*SWEEP, "--betas", "1/x"], "beta='1/x' must be a positive number"),
    "environment": ([*SWEEP, "--env", "Foo-v0"], "'Foo-v0' is not registered"),
    "block": ([*SWEEP, "--block", "Lava-v0-foo"], "no block 'Lava-v0-foo'.*choose one with --block"),
    "setting": ([*SWEEP, "--set", "policy_kwargs.trv_dim=3"], "_dim=3' is not a keyword or setting with a plain name"),
    "storage": ([*SWEEP, *TINY, "--storage", "postgresql://a:b@127.0.0.1:1/c"], "cannot be opened"),
    "out": ([*SWEEP, *TINY, "--out", "/proc/nowhere"], "No such file or directory: '/proc/nowhere'"),
    "grace period": ([*SWEEP, "--storage", "s.log", "--grace-period", "inf"], "grace_period=inf must be at least 2 s"),
    "seed": (["demo", "--seed", "-1", "--out", "out"], "seed=-1 must be at least 0"),
    "option": (["reproduce", "grasp", "--n-paper-seeds", "2"], "--n-paper-seeds is for lava, not for grasp"),
    "flag": (["reproduce", "grasp", "--no-controls"], "--no-controls is for ball and ball-varying and pays"),
    "folder": (["push", "nothing", "--repo-id", "a/b"], "nothing holds no training"),
}


@pytest.mark.parametrize("arguments, message", BAD.values(), ids=BAD)
def test_bad_input_is_told_in_a_line(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert re.search(message, error_line(capsys, *arguments))
    assert not list(tmp_path.iterdir())


def test_a_flag_that_is_no_number_is_told_with_what_is_expected(capsys):
    for value in ("abc", "0", "1.5"):
        with pytest.raises(SystemExit, match="2"):
            main(["demo", "--n-timesteps", value])
        assert f"argument --n-timesteps: {value} must be an integer of at least 1" in capsys.readouterr().err
