"""``push`` and ``pull`` work from the command line; other tests cover the functions that they call."""

import re

import pytest
from small_problems import error_line

from sb3_tdpg.cli import main
from sb3_tdpg.envs.scenarios import LAVA
from sb3_tdpg.experiments.runs import Run, complete_run

pytest.importorskip("huggingface_hub")
pytest.importorskip("matplotlib")


def test_push_writes_the_card_of_a_run_beside_it_and_lists_its_files(tmp_path, capsys):
    run = Run("TDPG", "Lava-v0", "Lava-v0-logdet", 0, dict(n_episodes=20, n_timesteps=200))
    folder = complete_run(run, tmp_path / "run", LAVA[:1], n_eval_episodes=20)
    assert main(["push", str(folder), "--repo-id", "me/tdpg-Lava-v0", "--dry-run"]) == 0
    text = capsys.readouterr().out
    card = tmp_path / "run-hub"
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
    "setting": (["frontier", "--env", "Lava-v0", "--set", "a.b=3"], "'a.b=3' is not a keyword or setting with a plain"),
    "out": (["demo", "--out", "/proc/nowhere"], "No such file or directory: '/proc/nowhere'"),
    "option": (["reproduce", "grasp", "--n-paper-seeds", "2"], "grasp has no --n-paper-seeds"),
    "flag": (["reproduce", "grasp", "--no-controls"], "grasp has no --no-controls"),
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
