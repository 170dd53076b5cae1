"""Models on the Hugging Face Hub: the folder that is pushed, read back by all who would read it. Nothing goes online."""

import json
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import yaml
from small_problems import assert_same_parameters, parameters, tiny_tdpg, train_epochs

from sb3_tdpg import TDPG
from sb3_tdpg.envs.scenarios import LAVA
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.hub import load_from_hub, pull_from_hub, push_to_hub, write_model_card
from sb3_tdpg.model_card import model_name, results_with_intervals
from sb3_tdpg.publication import Publication, read_run
from sb3_tdpg.rerun import main as rerun_main
from sb3_tdpg.rerun import rerun
from sb3_tdpg.runs import Run, complete_run

huggingface_hub = pytest.importorskip("huggingface_hub")
pytest.importorskip("scipy")
pytest.importorskip("matplotlib")

REPOSITORY = Path(__file__).resolve().parents[1]
REPO_ID = "someone/tdpg-Lava-v0"
TINY = dict(n_timesteps=800, n_episodes=20, mi_kwargs=dict(gradient_steps=2, warmup_gradient_steps=2))


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    """Refuse to go online, and trust nothing unless a test says so."""

    def refuse(*_):
        pytest.fail("a test goes online")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.delenv("TRUST_REMOTE_CODE", raising=False)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Folder of a policy-gradient run, and of a TDPG run that started from it."""
    folder = tmp_path_factory.mktemp("runs")
    pg = Run("PG", "Lava-v0", "Lava-v0-pg", 0, {"n_timesteps": 800, "n_episodes": 20})
    complete_run(pg, folder / "pg-seed0", LAVA[:2], n_eval_episodes=30)
    loose = [{"sb3_tdpg.callbacks.SelectionCallback": {"cost_limit": 1e6}}]
    tdpg = Run("TDPG", "Lava-v0", "Lava-v0", 0, {**TINY, "callback": loose}, start=folder / "pg-seed0")
    complete_run(tdpg, folder / "tdpg-seed0", [LAVA[1], LAVA[0]], n_eval_episodes=30)
    return folder


@pytest.fixture(scope="module")
def card(runs, tmp_path_factory):
    return write_model_card(runs / "tdpg-seed0", tmp_path_factory.mktemp("card") / "hub", REPO_ID)


@pytest.fixture
def on_the_hub(card, monkeypatch):
    """A stand-in for the Hub, which has what was written."""
    asked = []

    def hf_hub_download(repo_id, filename, **kwargs):
        asked.append((repo_id, filename, kwargs))
        return str(card / filename)

    monkeypatch.setattr(huggingface_hub, "hf_hub_download", hf_hub_download)
    return asked


def text_of(folder):
    return (folder / "README.md").read_text()


def blocks(folder, language):
    return re.findall(rf"^```{language}\n(.*?)^```$", text_of(folder), re.MULTILINE | re.DOTALL)


def costs_of(folder, scenario="Training"):
    return pd.read_csv(folder / "episodes.csv").query("scenario == @scenario")["cost"]


def test_the_metadata_has_the_mean_of_the_records_and_the_training_environment_first(card):
    data = huggingface_hub.ModelCard.load(card / "README.md").data
    assert data.library_name == "stable-baselines3"
    assert {"Lava-v0", "reinforcement-learning", "deep-reinforcement-learning", "stable-baselines3"} <= set(data.tags)
    assert data.model_name == "TDPG"
    assert [result.dataset_config for result in data.eval_results] == ["Training", "Sensor noise 1e-3"]
    for result in data.eval_results:
        mean, std = map(float, result.metric_value.split(" +/- "))
        costs = costs_of(card, result.dataset_config)
        assert mean == pytest.approx(-costs.mean(), abs=0.005)
        assert std == pytest.approx(costs.std(), abs=0.005)


def test_the_metadata_is_what_the_hub_reads_of_other_stable_baselines3_models(card):
    data = huggingface_hub.repocard.metadata_load(card / "README.md")
    first = data["model-index"][0]["results"][0]
    expected = huggingface_hub.metadata_eval_result(
        model_pretty_name="TDPG",
        task_pretty_name="reinforcement-learning",
        task_id="reinforcement-learning",
        metrics_pretty_name="mean_reward",
        metrics_id="mean_reward",
        metrics_value=first["metrics"][0]["value"],
        dataset_pretty_name="Lava-v0",
        dataset_id="Lava-v0",
        dataset_config="Training",
    )["model-index"][0]["results"][0]
    expected["metrics"][0].pop("verified")  # by the Hub's own evaluation service
    assert first == expected


def test_the_table_has_the_95_percent_interval_of_every_scenario(card):
    rows = re.findall(r"^\| (.*?) \| .* \| 30 \| (\S+) \[(\S+), (\S+)\] \|", text_of(card), re.MULTILINE)
    assert [row[0] for row in rows] == ["Training", "Sensor noise 1e-3"]
    for name, *numbers in rows:
        costs = costs_of(card, name)
        half = 2.045230 * costs.std() / np.sqrt(30)  # Student's t with 29 degrees of freedom
        expected = [costs.mean(), costs.mean() - half, costs.mean() + half]
        np.testing.assert_allclose([float(x) for x in numbers], expected, atol=0.0051)
    assert "`sensor_noise_std=0.03162`" in text_of(card)


def test_everything_that_the_card_refers_to_lies_beside_it(card):
    links = re.findall(r"\]\((?!https:)([^)]*)\)", text_of(card))
    assert "training.png" in links
    assert "episodes.csv" in links
    assert all((card / link).is_file() for link in links)
    assert (card / "training.png").read_bytes().startswith(b"\x89PNG")


def test_the_card_tells_seed_commit_versions_settings_and_which_policy_it_is(card, runs):
    text, config = text_of(card), json.loads((runs / "tdpg-seed0" / "config.json").read_text())
    assert "training seed: 0\n" in text
    assert f"torch {config['provenance']['versions']['torch']}" in text
    if config["provenance"]["git"] is not None:
        assert config["provenance"]["git"]["commit"] in text
    (settings,) = blocks(card, "yaml")
    read = json.loads(json.dumps(yaml.safe_load(settings)))
    assert read == config["settings"] == json.loads(json.dumps(yaml.safe_load((card / "config.yml").read_text())))
    epoch = json.loads((runs / "tdpg-seed0" / "selected.json").read_text())["epoch"]
    assert f"The policy is that of epoch {epoch}," in text
    assert "from the policy of another run, pg-seed0" in text


def test_the_command_of_a_user_is_told_and_that_of_a_worker_process_is_not(runs, tmp_path):
    folder = runs / "pg-seed0"
    config = json.loads((folder / "config.json").read_text())
    for i, (command, told) in enumerate(
        (
            ("python -m sb3_tdpg demo --out 'my results'", "python -m sb3_tdpg demo --out 'my results'"),
            ("/home/me/venv/bin/python train.py", "python train.py"),
            ("python -c 'from multiprocessing.spawn import spawn_main; spawn_main()' --multiprocessing-fork", None),
        )
    ):
        copy = tmp_path / f"run{i}"
        copy.mkdir()
        for name in ("model.zip", "episodes.csv", "progress_00000000.csv"):
            (copy / name).write_bytes((folder / name).read_bytes())
        config["provenance"]["command"] = command
        (copy / "config.json").write_text(json.dumps(config))
        assert read_run(copy).command == told
        written = write_model_card(copy, tmp_path / f"card{i}", REPO_ID)
        assert (f"```bash\n{told}\n```" in text_of(written)) == (told is not None)
        assert "spawn_main" not in text_of(written)


def test_the_command_in_the_card_makes_the_run_again(card, runs, tmp_path):
    copy = shutil.copytree(card, tmp_path / "copy")  # with the policy to start from in it
    program, *arguments = shlex.split(blocks(copy, "bash")[-1])
    assert program == "python"
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, *arguments], cwd=copy, check=True, env=environment)
    assert (copy / "again" / "episodes.csv").read_bytes() == (runs / "tdpg-seed0" / "episodes.csv").read_bytes()
    first, second = (TDPG.load(f / "model.zip", device="cpu") for f in (runs / "tdpg-seed0", copy / "again"))
    assert_same_parameters(parameters(first.policy), parameters(second.policy))


def test_a_rerun_keeps_to_the_recorded_settings_whatever_became_of_the_block(runs, tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_tdpg.runs.load_hyperparams", lambda block: pytest.fail("it reads the block"))
    rerun(runs / "pg-seed0" / "config.json", tmp_path / "again", progress_bar=False)
    assert (tmp_path / "again" / "episodes.csv").read_bytes() == (runs / "pg-seed0" / "episodes.csv").read_bytes()
    assert TDPG.load(tmp_path / "again" / "model.zip", device="cpu").mi_coef == 0  # beta is inf, and not a text


def test_a_rerun_without_the_very_policy_it_started_from_is_refused(card, runs, tmp_path, capsys):
    shutil.copy(card / "config.json", tmp_path)
    with pytest.raises(ValueError, match="is not trained yet: put the run's own there"):
        rerun(tmp_path / "config.json", tmp_path / "again")
    (tmp_path / "pg-seed0").mkdir()
    shutil.copy(runs / "tdpg-seed0" / "model.zip", tmp_path / "pg-seed0")  # another one
    assert rerun_main([str(tmp_path / "config.json"), str(tmp_path / "again")]) == 2
    assert capsys.readouterr().err.startswith("error: the run started from the policy ")
    with pytest.raises(ValueError, match=r"nothing.json does not describe a run"):
        rerun(tmp_path / "nothing.json", tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_the_code_in_the_card_runs_the_policy(card, on_the_hub, capsys):
    (code,) = blocks(card, "python")
    exec(code, {})
    assert re.fullmatch(r"cost \d+\.\d\d\n", capsys.readouterr().out)
    ((repo_id, filename, _),) = on_the_hub
    assert (repo_id, filename) == (REPO_ID, "tdpg-Lava-v0.zip")


def test_a_model_from_the_hub_is_the_one_that_was_trained(card, runs, on_the_hub, monkeypatch):
    names = [str(path.relative_to(card)) for path in card.rglob("*") if path.is_file()]
    assert "pg-seed0/model.zip" in names
    # What a run started from may be called like a model.
    monkeypatch.setattr(
        huggingface_hub.HfApi, "list_repo_files", lambda api, repo_id, revision: [*names, "tdpg-seed7/model.zip"]
    )
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    model = load_from_hub(REPO_ID, env="Lava-v0", revision="main", token="secret", device="cpu", beta=1 / 50)
    trained = TDPG.load(runs / "tdpg-seed0" / "model.zip", device="cpu")
    assert_same_parameters(parameters(model.policy), parameters(trained.policy))
    assert model.env is not None
    assert model.mi_coef == pytest.approx(50)
    asked = dict(revision="main", token="secret", library_name="sb3_tdpg")
    assert on_the_hub == [(REPO_ID, "tdpg-Lava-v0.zip", asked)]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["README.md", "ppo-Lava-v0.zip"], r"has no tdpg-\*.zip: give filename"),
        (["tdpg-a.zip", "tdpg-b.zip"], r"has several models \(tdpg-a.zip, tdpg-b.zip\): give filename"),
    ],
)
def test_a_repository_without_one_model_is_refused(names, message, monkeypatch):
    monkeypatch.setattr(huggingface_hub.HfApi, "list_repo_files", lambda api, repo_id, revision: names)
    with pytest.raises(ValueError, match=message):
        load_from_hub(REPO_ID, trust_remote_code=True)


def test_nothing_is_unpickled_without_trust(monkeypatch):
    for trust, variable in ((None, None), (None, "False"), (False, "True")):
        if variable is not None:
            monkeypatch.setenv("TRUST_REMOTE_CODE", variable)
        with pytest.raises(ValueError, match="if you trust who made it, give trust_remote_code=True"):
            load_from_hub(REPO_ID, "tdpg-Lava-v0.zip", trust_remote_code=trust)  # offline(): nothing is fetched


def test_stable_baselines3s_own_package_loads_the_model(card, on_the_hub, monkeypatch):
    try:
        from huggingface_sb3 import load_from_hub as load_as_sb3_does
    except ImportError as e:
        pytest.skip(f"huggingface_sb3 does not work with this huggingface_hub: {e}")
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    model = TDPG.load(load_as_sb3_does(REPO_ID, f"{model_name('Lava-v0')}.zip"), device="cpu")
    assert model.predict(np.zeros(2, np.float32))[0].shape == (1,)


def test_the_zoo_finds_all_files_that_it_asks_for(card, tmp_path, monkeypatch):
    try:
        import rl_zoo3.load_from_hub as zoo
    except ImportError as e:
        pytest.skip(f"rl_zoo3 does not import: {e}")
    from rl_zoo3 import get_saved_hyperparams

    def download(repo_id, filename):
        assert repo_id == REPO_ID
        if not (card / filename).exists():
            assert filename == "vec_normalize.pkl", "it cannot do without any other"
            raise zoo.HTTPError
        return str(card / filename)

    monkeypatch.setattr(zoo, "load_from_hub", download)
    zoo.download_from_hub("tdpg", zoo.EnvironmentName("Lava-v0"), 0, str(tmp_path), "someone")
    folder = tmp_path / "tdpg" / "Lava-v0_1"
    TDPG.load(folder / "Lava-v0.zip", device="cpu")
    assert len(pd.read_csv(folder / "progress_00000000.csv")) == 8
    settings, _ = get_saved_hyperparams(str(folder / "Lava-v0"), test_mode=True)
    assert settings["beta"] == pytest.approx(1 / 75)
    assert settings["normalize"] is False
    assert yaml.safe_load((folder / "Lava-v0" / "args.yml").read_text())["env_kwargs"] == {}


def test_results_json_is_the_zoos(card):
    results = json.loads((card / "results.json").read_text())
    assert results.pop("eval_datetime")[:2] == "20"
    costs = costs_of(card)
    assert results == dict(
        mean_reward=pytest.approx(-costs.mean()),
        std_reward=pytest.approx(costs.std()),
        is_deterministic=False,
        n_eval_episodes=30,
    )
