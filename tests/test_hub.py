"""Models on the Hugging Face Hub: the folder that is pushed, read back by all who would read it, offline."""

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
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
import yaml
from small_problems import assert_same_parameters, lava_env, parameters, tiny_tdpg, train_epochs
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg import TDPG
from sb3_tdpg.envs.scenarios import LAVA, Scenario
from sb3_tdpg.evaluation import evaluate_scenarios, provenance
from sb3_tdpg.hub import load_from_hub, pull_from_hub, push_to_hub, write_model_card
from sb3_tdpg.model_card import model_name, results_with_intervals
from sb3_tdpg.publication import Publication, read_publication, read_run
from sb3_tdpg.rerun import main as rerun_main
from sb3_tdpg.rerun import rerun
from sb3_tdpg.runs import Run, complete_run

huggingface_hub = pytest.importorskip("huggingface_hub")
errors = pytest.importorskip("huggingface_hub.errors")
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
            ("/home/me/venv/bin/python3 /home/me/venv/bin/sb3-tdpg train --env a", "sb3-tdpg train --env a"),
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


def test_the_block_of_the_guide_loads_the_model(card, on_the_hub, monkeypatch):
    names = [str(path.relative_to(card)) for path in card.rglob("*") if path.is_file()]
    monkeypatch.setattr(huggingface_hub.HfApi, "list_repo_files", lambda api, repo_id, revision: names)
    guide = (REPOSITORY / "docs" / "guide" / "zoo.md").read_text()
    (code,) = re.findall(r"<!-- no-run -->\n```python\n(from sb3_tdpg\.hub.*?)^```", guide, re.MULTILINE | re.DOTALL)
    namespace = {}
    exec(code.replace("me/tdpg-Lava-v0", REPO_ID), namespace)
    assert isinstance(namespace["model"], TDPG)
    assert [repo_id for repo_id, *_ in on_the_hub] == [REPO_ID]


def test_a_model_from_the_hub_is_the_one_that_was_trained(card, runs, on_the_hub, monkeypatch):
    names = [str(path.relative_to(card)) for path in card.rglob("*") if path.is_file()]
    assert "pg-seed0/model.zip" in names
    # What a run started from may be called like a model.
    monkeypatch.setattr(
        huggingface_hub.HfApi, "list_repo_files", lambda api, repo_id, revision: [*names, "tdpg-seed7/model.zip"]
    )
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    model = load_from_hub(REPO_ID, env=lava_env(), revision="main", token="secret", device="cpu", beta=1 / 50)
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
    load_as_sb3_does = pytest.importorskip("huggingface_sb3", exc_type=ModuleNotFoundError).load_from_hub
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    model = TDPG.load(load_as_sb3_does(REPO_ID, f"{model_name('Lava-v0')}.zip"), device="cpu")
    assert model.predict(np.zeros(2, np.float32))[0].shape == (1,)


def test_the_zoo_finds_all_files_that_it_asks_for(card, tmp_path, monkeypatch):
    pytest.importorskip("rl_zoo3", exc_type=ModuleNotFoundError)
    import rl_zoo3.load_from_hub as zoo
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


@pytest.fixture(scope="module")
def zoo_folder(tmp_path_factory):
    """What the zoo's train leaves of a training on normalised observations, with the evaluations of a callback."""
    pytest.importorskip("rl_zoo3", exc_type=ModuleNotFoundError)
    import rl_zoo3.train
    from rl_zoo3.exp_manager import ExperimentManager

    folder = tmp_path_factory.mktemp("zoo")
    block = dict(
        policy="TRVPolicy",
        n_timesteps=500,
        n_envs=2,
        n_episodes=20,
        beta=float("inf"),
        normalize=dict(norm_obs=True, norm_reward=False),
        env_kwargs=dict(action_cost=1.0),
    )
    (folder / "conf.yml").write_text(yaml.safe_dump({"Lava-v0": block}))
    flags = f"train --algo tdpg --env Lava-v0 --seed 3 -f {folder}/logs --conf-file {folder}/conf.yml --eval-freq 100"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(rl_zoo3.ALGOS, "tdpg", TDPG)
        # Another test may have called register() in this process.
        patch.setattr(rl_zoo3.train, "ExperimentManager", ExperimentManager)
        patch.setattr(sys, "argv", flags.split())
        rl_zoo3.train.train()
    return folder / "logs" / "tdpg" / "Lava-v0_1"


def test_a_folder_of_the_zoo_is_evaluated_and_told_of(zoo_folder, tmp_path):
    card = write_model_card(zoo_folder, tmp_path / "card", REPO_ID, n_eval_episodes=10, seed=5, scenarios=LAVA[:2])
    records = pd.read_csv(card / "episodes.csv")
    assert records.groupby("scenario").size().to_dict() == {"Training": 10, "Sensor noise 1e-3": 10}

    statistics = zoo_folder / "Lava-v0" / "vecnormalize.pkl"
    assert (card / "vec_normalize.pkl").read_bytes() == statistics.read_bytes()
    env = VecNormalize.load(str(statistics), lava_env(1))
    model = TDPG.load(card / "tdpg-Lava-v0.zip", env=env, device="cpu")
    by_hand = evaluate_scenarios(model, LAVA[:2], 10, seed=5, env_kwargs=dict(action_cost=1.0))
    assert records["cost"].to_numpy() == pytest.approx(by_hand["cost"].to_numpy())
    assert "VecNormalize.load" in text_of(card)

    for name in ("args.yml", "config.yml", "command.txt"):
        assert (card / name).read_bytes() == (zoo_folder / "Lava-v0" / name).read_bytes()
    with zipfile.ZipFile(card / "train_eval_metrics.zip") as archive:
        assert set(archive.namelist()) == {"0.monitor.csv", "1.monitor.csv", "evaluations.npz"}
    text = text_of(card)
    assert "gym.make('Lava-v0', action_cost=1.0)" in text
    assert "training seed: 3\n" in text
    assert re.search(r"versions: Python \d.*PyTorch \d", text)
    # The zoo's own program leaves the last policy, whatever a selection has chosen.
    assert "the policy is the one of the end of the training." in text
    assert "The policy is that of" not in text
    assert (card / "training.png").exists()


def test_the_training_of_the_zoo_is_drawn_by_its_monitors(zoo_folder):
    progress = read_publication(zoo_folder, n_eval_episodes=2, scenarios=LAVA[:1]).progress
    rewards = load_results(str(zoo_folder))["r"].to_numpy()
    assert len(rewards) == 100
    assert progress["time/iterations"].tolist() == [1, 2, 3, 4, 5]
    assert progress["rollout/ep_cost_mean"].to_numpy() == pytest.approx(-rewards.reshape(5, 20).mean(axis=1))


def test_a_folder_of_the_zoo_without_its_last_policy_gives_the_best_one(zoo_folder, tmp_path):
    copy = shutil.copytree(zoo_folder, tmp_path / "Lava-v0_1")
    (copy / "Lava-v0.zip").unlink()
    publication = read_publication(copy, n_eval_episodes=2, scenarios=LAVA[:1])
    assert publication.model == copy / "best_model.zip"
    assert "did best" in publication.notes[0]
    (copy / "best_model.zip").unlink()
    with pytest.raises(ValueError, match=r"neither Lava-v0.zip nor best_model.zip: let the training end first"):
        read_publication(copy)


def test_the_card_of_a_folder_of_ours_says_which_policy_it_is(zoo_folder, tmp_path):
    copy = shutil.copytree(zoo_folder, tmp_path / "Lava-v0_1")
    (copy / "selected.json").write_text(json.dumps(dict(epoch=3, cost=17.0, information=0.5)))

    def notes():
        return " ".join(read_publication(copy, n_eval_episodes=2, scenarios=LAVA[:1]).notes)

    assert "the policy is the one of the end" in notes()  # the zoo's own program leaves the last one
    assert "epoch 3" not in notes()
    (copy / "run.json").write_text(json.dumps(dict(provenance=provenance())))
    assert "The policy is that of epoch 3, which the selection chose" in notes()
    assert "of the end" not in notes()
    (copy / "checkpoint.zip").touch()  # interrupted
    assert "the policy is the one of the end" in notes()
    assert "epoch 3" not in notes()


def test_a_model_in_memory_is_published_with_its_records(tmp_path):
    model = train_epochs(tiny_tdpg(), 2)
    rows = [Scenario("Wide", "Lava-v0", dict(sensor_noise_std=0.5)), LAVA[0]]
    records = evaluate_scenarios({"mine": model}, rows, 5, deterministic=True)
    settings = dict(beta=float("inf"), learning_rate=np.float64(0.5), env_kwargs=dict(sensor_noise_std=0.5))
    publication = Publication(
        model=model, env_id="sb3_tdpg:Lava-v0", records=records, scenarios=rows, method="mine", settings=settings
    )
    card = write_model_card(publication, tmp_path / "card", REPO_ID, film_episodes=0)
    loaded = TDPG.load(card / "tdpg-Lava-v0.zip", device="cpu")
    assert_same_parameters(parameters(loaded.policy), parameters(model.policy))
    assert yaml.safe_load((card / "config.yml").read_text()) == dict(
        beta=float("inf"), learning_rate=0.5, env_kwargs=dict(sensor_noise_std=0.5)
    )
    text = text_of(card)
    assert "Deterministic policy" in text
    assert "| Wide |  | 5 |" in text, "it is the training environment"
    assert "training.png" not in text
    assert huggingface_hub.ModelCard(text).data.eval_results[0].dataset_config == "Training"
    with pytest.raises(ValueError, match="does not describe a run"):
        rerun(card / "config.json", tmp_path / "again")


def test_shares_of_failures_have_wilsons_interval():
    records = pd.DataFrame(
        dict(model="PG", scenario="Training", cost=[0.0] * 10, failure=[False] * 10, seed=0, deterministic=False)
    )
    row = results_with_intervals(records).iloc[0]
    assert (row["failure_low"], row["failure_high"]) == (pytest.approx(0), pytest.approx(0.27753, abs=1e-5))
    records["failure"] = [True] + [False] * 9
    row = results_with_intervals(records).iloc[0]
    assert (row["failure_low"], row["failure_high"]) == (
        pytest.approx(0.01788, abs=1e-5),
        pytest.approx(0.40415, abs=1e-5),
    )


def test_the_film_of_some_episodes_lies_beside_the_card(runs, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    card = write_model_card(runs / "pg-seed0", tmp_path / "card", REPO_ID, film_episodes=1)
    assert b"ftyp" in (card / "replay.mp4").read_bytes()[:12]
    assert "[replay.mp4](replay.mp4)" in text_of(card)


@pytest.mark.parametrize("missing", ["config.json", "model.zip", "episodes.csv"])
def test_what_is_not_finished_is_refused_and_nothing_is_written(missing, runs, tmp_path):
    copy = shutil.copytree(runs / "pg-seed0", tmp_path / "run")
    (copy / missing).unlink()
    message = "holds no training" if missing == "config.json" else f"no finished run, since {missing} is missing"
    with pytest.raises(ValueError, match=message):
        write_model_card(copy, tmp_path / "card", REPO_ID)
    assert not (tmp_path / "card").exists()


def test_records_that_are_not_of_one_policy_are_refused(runs, tmp_path):
    run = read_run(runs / "pg-seed0")
    for records, message in (
        (pd.concat([run.records, run.records.assign(train_seed=7)]), r"the records are of train_seed \[0, 7\]"),
        (pd.concat([run.records, run.records.assign(model="TDPG")]), r"the records are of model \['PG', 'TDPG'\]"),
        (run.records[:31], "at least 2 episodes of each scenario"),
        (run.records[:0], "at least 2 episodes of each scenario"),
    ):
        with pytest.raises(ValueError, match=message):
            write_model_card(replace(run, records=records), tmp_path / "card", REPO_ID)
    assert not (tmp_path / "card").exists()


def test_a_damaged_model_is_refused_and_no_card_is_written(runs, tmp_path):
    damaged = tmp_path / "model.zip"
    damaged.write_bytes(b"no zip")
    with pytest.raises(ValueError, match="wasn't a zip-file"):
        write_model_card(replace(read_run(runs / "pg-seed0"), model=damaged), tmp_path / "card", REPO_ID)
    assert not (tmp_path / "card").exists()


def test_a_card_that_could_not_be_finished_does_not_stand_in_the_way(runs, tmp_path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("sb3_tdpg.hub.card_text", Mock(side_effect=KeyboardInterrupt))
        write_model_card(runs / "pg-seed0", tmp_path / "card", REPO_ID)
    assert not (tmp_path / "card").exists()
    write_model_card(runs / "pg-seed0", tmp_path / "card", REPO_ID)
    assert [path.name for path in tmp_path.iterdir()] == ["card"]


def test_a_folder_with_something_in_it_is_left_alone(card, runs, tmp_path):
    before = {path: path.read_bytes() for path in card.rglob("*") if path.is_file()}
    for refused in (lambda: write_model_card(runs / "pg-seed0", card, REPO_ID), lambda: pull_from_hub(REPO_ID, card)):
        with pytest.raises(ValueError, match="exists already: choose another folder, or remove it"):
            refused()
    assert {path: path.read_bytes() for path in card.rglob("*") if path.is_file()} == before


@pytest.fixture
def api(monkeypatch):
    """A stand-in for the client: it writes down what it is told, and fails if it is told to."""
    api = SimpleNamespace(calls=[], error=None)

    def make(**kwargs):
        api.calls.append(("HfApi", kwargs))
        return api

    def create_repo(repo_id, **kwargs):
        api.calls.append(("create_repo", {"repo_id": repo_id, **kwargs}))
        if api.error is not None:
            raise api.error
        return "https://huggingface.co/" + repo_id

    api.create_repo, api.upload_folder = create_repo, lambda **kwargs: api.calls.append(("upload_folder", kwargs))
    monkeypatch.setattr(huggingface_hub, "HfApi", make)
    return api


def test_a_push_makes_the_repository_and_uploads_the_folder(card, api):
    url = push_to_hub(card, REPO_ID, private=True, commit_message="More epochs", token="secret")
    assert url == "https://huggingface.co/someone/tdpg-Lava-v0"
    (_, client), (create, repository), (upload, folder) = api.calls
    assert client["token"] == "secret"
    assert (create, repository) == ("create_repo", dict(repo_id=REPO_ID, private=True, exist_ok=True))
    assert upload == "upload_folder"
    # A film of an earlier model goes, and what else someone has put there stays.
    gone = folder.pop("delete_patterns")
    assert {"replay.mp4", "vec_normalize.pkl"} <= set(gone)
    assert all("*" not in name for name in gone)
    assert folder == dict(repo_id=REPO_ID, folder_path=card, commit_message="More epochs")


def test_a_folder_without_a_card_is_not_pushed(runs, api):
    with pytest.raises(ValueError, match=r"has no README.md: let write_model_card write the folder first"):
        push_to_hub(runs / "pg-seed0", REPO_ID)
    assert not api.calls


def http_error(status, text):
    response = SimpleNamespace(status_code=status, headers={}, request=None)
    return errors.HfHubHTTPError(text, response=response)


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (
            errors.LocalTokenNotFoundError("Token is required"),
            r"\(Token is required\): .*hf auth login",
        ),
        (http_error(401, "401 Unauthorized\nInvalid user token"), r"\(401 Unauthorized\): .*hf auth login"),
        (http_error(503, "\n503 Service Unavailable"), r"\(503 Service Unavailable\): try again .* pushed again"),
        (ConnectionError("no route"), r"\(no route\): try again when the Hub can be reached; .* pushed again"),
        (errors.HTTPError("refused"), r"\(refused\): try again"),
    ],
)
def test_what_goes_wrong_on_the_way_is_told_in_one_line(error, message, card, api):
    api.error = error
    with pytest.raises(ValueError, match="someone/tdpg-Lava-v0 cannot be written " + message) as told:
        push_to_hub(card, REPO_ID)
    assert "\n" not in str(told.value)
    assert api.calls[-1][0] == "create_repo", "nothing is uploaded"


def test_a_pull_downloads_the_repository(tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(
        huggingface_hub, "snapshot_download", lambda repo_id, **kwargs: asked.update(repo_id=repo_id, **kwargs)
    )
    assert pull_from_hub(REPO_ID, tmp_path / "there", revision="v1", token="secret") == tmp_path / "there"
    assert asked.pop("library_name") == "sb3_tdpg"
    assert asked == dict(repo_id=REPO_ID, revision="v1", local_dir=tmp_path / "there", token="secret")


@pytest.mark.parametrize("module", ["huggingface_hub", "scipy", "matplotlib"])
def test_without_its_extra_the_error_names_it(module, card, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    for call in (
        lambda: write_model_card(card, tmp_path / "card", REPO_ID),
        lambda: push_to_hub(card, REPO_ID),
        lambda: load_from_hub(REPO_ID, trust_remote_code=True),
        lambda: pull_from_hub(REPO_ID, tmp_path / "there"),
    ):
        with pytest.raises(ImportError, match=rf"needs {module} here: pip install sb3_tdpg\[hub\]"):
            call()
