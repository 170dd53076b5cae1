"""The card of a published model: its content, the files beside it, and the input that is refused."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import huggingface_hub
import numpy as np
import pandas as pd
import pytest
import yaml
from published_cards import REPO_ID, blocks, costs_of, text_of
from small_problems import error_line

from sb3_tdpg.common.provenance import with_numbers
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.experiments.rerun import rerun
from sb3_tdpg.experiments.runs import Run, complete_run
from sb3_tdpg.hub import pull_from_hub, push_to_hub, write_model_card
from sb3_tdpg.hub.model_card import model_card, results_with_intervals
from sb3_tdpg.hub.publication import read_run


def test_the_metadata_has_the_mean_of_the_records_and_the_training_environment_first(card):
    data = huggingface_hub.ModelCard.load(card / "README.md").data
    assert data.library_name == "stable-baselines3"
    assert {"Lava-v0", "reinforcement-learning", "deep-reinforcement-learning", "stable-baselines3"} <= set(data.tags)
    assert data.model_name == "TDPG"
    assert [result.dataset_config for result in data.eval_results] == ["Training", "Sensor noise 1e-3"]
    for result in data.eval_results:
        named = (result.task_type, result.metric_type, result.metric_name, result.dataset_type, result.dataset_name)
        assert named == ("reinforcement-learning", "mean_reward", "mean_reward", "Lava-v0", "Lava-v0")
        mean, std = map(float, result.metric_value.split(" +/- "))
        costs = costs_of(card, result.dataset_config)
        assert mean == pytest.approx(-costs.mean(), abs=0.005)
        assert std == pytest.approx(costs.std(), abs=0.005)


def test_the_table_has_the_95_percent_interval_of_every_scenario(card):
    rows = re.findall(r"^\| (.*?) \| .* \| 30 \| (\S+) \[(\S+), (\S+)\] \|", text_of(card), re.MULTILINE)
    assert [row[0] for row in rows] == ["Training", "Sensor noise 1e-3"]
    for name, *numbers in rows:
        costs = costs_of(card, name)
        half = 2.045230 * costs.std() / np.sqrt(30)  # Student's t with 29 degrees of freedom
        expected = [costs.mean(), costs.mean() - half, costs.mean() + half]
        np.testing.assert_allclose([float(x) for x in numbers], expected, atol=0.0051)
    assert "`sensor_noise_std=0.03162`" in text_of(card)


def test_all_files_that_the_card_links_to_are_in_its_folder(card):
    links = re.findall(r"\]\((?!https:)([^)]*)\)", text_of(card))
    assert "training.png" in links
    assert "episodes.csv" in links
    assert all((card / link).is_file() for link in links)
    assert (card / "training.png").read_bytes().startswith(b"\x89PNG")


def test_the_card_names_seed_commit_versions_settings_and_the_selected_epoch(card, runs):
    text, config = text_of(card), json.loads((runs / "tdpg-seed0" / "config.json").read_text())
    assert "training seed: 0\n" in text
    assert f"torch {config['provenance']['versions']['torch']}" in text
    if config["provenance"]["git"] is not None:
        assert config["provenance"]["git"]["commit"] in text
    (settings,) = blocks(card, "yaml")
    read = json.loads(json.dumps(yaml.safe_load(settings)))
    assert read == config["settings"] == json.loads(json.dumps(yaml.safe_load((card / "config.yml").read_text())))
    epoch = json.loads((runs / "tdpg-seed0" / "selected.json").read_text())["epoch"]
    assert f"The selection chose the policy of epoch {epoch}:" in text
    assert "from the policy of another run, pg-seed0" in text


def test_the_command_of_a_user_is_shown_and_that_of_a_worker_process_is_not(runs, tmp_path):
    folder = runs / "pg-seed0"
    config = json.loads((folder / "config.json").read_text())
    for i, (command, told) in enumerate(
        (
            ("python -m sb3_tdpg demo --out 'my results'", "python -m sb3_tdpg demo --out 'my results'"),
            ("/home/me/venv/bin/python train.py", "python train.py"),
            ("/home/me/venv/bin/python3 /home/me/venv/bin/sb3-tdpg train --env a", "sb3-tdpg train --env a"),
            ("python -c 'from multiprocessing.spawn import spawn_main; spawn_main()' --multiprocessing-fork", None),
        )
    ):
        copy = shutil.copytree(folder, tmp_path / f"run{i}")
        config["provenance"]["command"] = command
        (copy / "config.json").write_text(json.dumps(config))
        assert read_run(copy).command == told
        written = write_model_card(copy, tmp_path / f"card{i}", REPO_ID)
        assert (f"```bash\n{told}\n```" in text_of(written)) == (told is not None)
        assert "spawn_main" not in text_of(written)


def test_the_card_of_stacked_observations_says_how_to_stack(runs):
    run = read_run(runs / "pg-seed0")
    stacked = replace(run, settings={**run.settings, "frame_stack": 3})
    assert "`VecFrameStack(env, 3)`" in model_card(stacked, results_with_intervals(run.records), REPO_ID).text


def test_a_card_that_is_written_is_not_given_other_settings_or_another_name(card, capsys):
    line = error_line(capsys, "push", card, "--repo-id", REPO_ID, "--dry-run", "--card", "other")
    assert "has a card already" in line
    line = error_line(capsys, "push", card, "--repo-id", "other/name", "--dry-run")
    assert f"is for {REPO_ID}, not for other/name" in line


@pytest.mark.parametrize(("n", "low", "high"), [(0, 0, 0.27753), (1, 0.01788, 0.40415)])
def test_shares_of_failures_have_wilsons_interval(n, low, high, runs):
    failed = [True] * n + [False] * (10 - n)
    records = pd.DataFrame(dict(model="PG", scenario="Training", cost=0.0, failure=failed, seed=0, deterministic=False))
    results = results_with_intervals(records)
    assert results.loc[0, ["failure_low", "failure_high"]].tolist() == pytest.approx([low, high], abs=1e-5)
    text = model_card(read_run(runs / "pg-seed0"), results, REPO_ID).text
    assert f"0.00 [0.00, 0.00] | 0.00 | {10 * n:.1f}% [{100 * low:.1f}%, {100 * high:.1f}%] |" in text


@pytest.mark.parametrize(("name", "damage", "message"), [
    ("config.json", Path.unlink, "holds no training"),
    ("model.zip", Path.unlink, "no finished run, since model.zip is missing"),
    ("episodes.csv", Path.unlink, "no finished run, since episodes.csv is missing"),
    *(("config.json", lambda file, text=text: file.write_text(text),
       r"config\.json does not describe a run \(.*\): give a run's folder")
      for text in ("{}", "[]", "3", "{", '{"settings": 3}')),
])  # fmt: skip
def test_a_run_that_is_not_whole_is_refused_in_a_line_and_writes_nothing(name, damage, message, runs, tmp_path, capsys):
    copy = shutil.copytree(runs / "pg-seed0", tmp_path / "run")
    damage(copy / name)
    line = error_line(capsys, "push", copy, "--repo-id", REPO_ID, "--dry-run", "--card", tmp_path / "card")
    assert re.search(message, line)
    assert not (tmp_path / "card").exists()


def test_rows_may_have_their_own_number_of_episodes(runs, tmp_path):
    rows = [Scenario("Training", "Lava-v0"), Scenario("few", "Lava-v0", n_episodes=2)]
    config = json.loads((runs / "pg-seed0" / "config.json").read_text())
    run = Run("PG", "Lava-v0", None, 0, with_numbers(config["settings"]))
    folder = complete_run(run, tmp_path / "run", rows, n_eval_episodes=4)
    assert len(read_run(folder).records) == 6
    assert read_run(folder).again is not None
    config = json.loads((folder / "config.json").read_text())
    config["settings"]["policy_kwargs"] = dict(activation_fn="<class 'torch.nn.modules.activation.ELU'>")
    (folder / "config.json").write_text(json.dumps(config))
    assert read_run(folder).again is None, "a class cannot be read from the file"


def test_an_interval_needs_two_episodes(runs):
    records = read_run(runs / "pg-seed0").records
    for too_few in (records[:31], records[:0]):
        with pytest.raises(ValueError, match="at least 2 episodes of each scenario"):
            results_with_intervals(too_few)


def test_an_interrupted_card_leaves_nothing_and_is_written_again_without_unpickling(runs, tmp_path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("sb3_tdpg.hub.transfer.model_card", Mock(side_effect=KeyboardInterrupt))
        write_model_card(runs / "pg-seed0", tmp_path / "card", REPO_ID)
    assert not (tmp_path / "card").exists()
    monkeypatch.setattr("sb3_tdpg.TDPG.load", lambda *args, **kwargs: pytest.fail("it unpickles the model"))
    write_model_card(runs / "pg-seed0", tmp_path / "card", REPO_ID)
    assert [path.name for path in tmp_path.iterdir()] == ["card"]


def test_a_folder_that_is_not_empty_is_left_alone(card, runs, tmp_path):
    before = {path: path.read_bytes() for path in card.rglob("*") if path.is_file()}
    for refused in (lambda: write_model_card(runs / "pg-seed0", card, REPO_ID), lambda: pull_from_hub(REPO_ID, card)):
        with pytest.raises(ValueError, match="exists already: choose another folder, or remove it"):
            refused()
    assert {path: path.read_bytes() for path in card.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("start", ["../../evil", "/tmp", "..", 3])
def test_a_start_that_leads_out_of_the_folder_is_refused(start, runs, tmp_path):
    copy = shutil.copytree(runs / "tdpg-seed0", tmp_path / "runs" / "run")
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**config, "start": start}))
    for refused in (
        lambda: write_model_card(copy, tmp_path / "cards" / "card", REPO_ID),
        lambda: rerun(copy / "config.json", tmp_path / "cards" / "again"),
    ):
        with pytest.raises(ValueError, match=r"start of .*config\.json is .*, without a path"):
            refused()
    assert not (tmp_path / "cards").exists()


def test_a_symbolic_link_is_never_published(runs, card, tmp_path, capsys):
    copy, ready = shutil.copytree(runs / "pg-seed0", tmp_path / "run"), shutil.copytree(card, tmp_path / "ready")
    (copy / "progress_9.csv").symlink_to("/etc/hostname")
    (ready / "secret").symlink_to("/etc/hostname")
    for folder, more in ((copy, ["--card", tmp_path / "card"]), (ready, [])):
        assert "is a symbolic link" in error_line(capsys, "push", folder, "--repo-id", REPO_ID, "--dry-run", *more)
    with pytest.raises(ValueError, match="ready/secret is a symbolic link"):
        push_to_hub(ready, REPO_ID)
    assert not (tmp_path / "card").exists()
