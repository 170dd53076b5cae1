"""Load a published model with this plugin, with Stable-Baselines3's package and with rl-zoo3; push and pull."""

import importlib
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import huggingface_hub
import numpy as np
import pandas as pd
import pytest
import yaml
from huggingface_hub import errors
from published_cards import REPO_ID, blocks, costs_of
from small_problems import assert_same_parameters, lava_env, parameters

from sb3_tdpg import TDPG
from sb3_tdpg.hub import load_from_hub, pull_from_hub, push_to_hub
from sb3_tdpg.hub.model_card import model_name

REPOSITORY = Path(__file__).resolve().parents[2]


def test_the_code_in_the_card_runs_the_policy(card, on_the_hub, capsys):
    (code,) = blocks(card, "python")
    exec(code, {})
    assert re.fullmatch(r"cost \d+\.\d\d\n", capsys.readouterr().out)
    ((repo_id, filename, _),) = on_the_hub
    assert (repo_id, filename) == (REPO_ID, "tdpg-Lava-v0.zip")


def test_the_block_of_the_guide_loads_the_model(on_the_hub):
    guide = (REPOSITORY / "docs" / "guide" / "zoo.md").read_text()
    (code,) = re.findall(r"<!-- no-run -->\n```python\n(from sb3_tdpg\.hub.*?)^```", guide, re.MULTILINE | re.DOTALL)
    namespace = {}
    exec(code.replace("me/tdpg-Lava-v0", REPO_ID), namespace)
    assert isinstance(namespace["model"], TDPG)
    assert [repo_id for repo_id, *_ in on_the_hub] == [REPO_ID]


def test_a_model_from_the_hub_is_the_one_that_was_trained(runs, on_the_hub, monkeypatch):
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    model = load_from_hub(REPO_ID, env=lava_env(), revision="main", token="secret", device="cpu", beta=1 / 50)
    trained = TDPG.load(runs / "tdpg-seed0" / "model.zip", device="cpu")
    assert_same_parameters(parameters(model.policy), parameters(trained.policy))
    assert model.env is not None
    assert model.mi_coef == pytest.approx(50)
    asked = dict(revision="main", token="secret", library_name="sb3_tdpg")
    assert on_the_hub == [(REPO_ID, "tdpg-Lava-v0.zip", asked)]


@pytest.mark.parametrize(("names", "message"), [
    (["README.md", "ppo-Lava-v0.zip"], r"has no tdpg-\*.zip: give filename"),
    (["tdpg-a.zip", "tdpg-b.zip"], r"has several models \(tdpg-a.zip, tdpg-b.zip\): give filename"),
])  # fmt: skip
def test_a_repository_without_one_model_is_refused(names, message, monkeypatch):
    monkeypatch.setattr(huggingface_hub.HfApi, "list_repo_files", lambda api, repo_id, revision: names)
    with pytest.raises(ValueError, match=message):
        load_from_hub(REPO_ID, trust_remote_code=True)


def test_nothing_is_unpickled_without_trust(monkeypatch):
    for trust, variable in ((None, None), (None, "False"), (False, "True")):
        if variable is not None:
            monkeypatch.setenv("TRUST_REMOTE_CODE", variable)
        with pytest.raises(ValueError, match="if you trust its author, give trust_remote_code=True"):
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


def test_results_json_has_the_format_of_the_zoo(card):
    results = json.loads((card / "results.json").read_text())
    assert results.pop("eval_datetime")[:2] == "20"
    costs = costs_of(card)
    assert results == dict(
        mean_reward=pytest.approx(-costs.mean()),
        std_reward=pytest.approx(costs.std()),
        is_deterministic=False,
        n_eval_episodes=30,
    )


@pytest.fixture
def api(monkeypatch):
    """A stand-in for the client, which records its calls and can be made to fail."""
    api = Mock()
    api.create_repo.side_effect = lambda repo_id, **_: "https://huggingface.co/" + repo_id
    api.made = Mock(return_value=api)
    monkeypatch.setattr("huggingface_hub.HfApi", api.made)
    return api


def test_a_push_makes_the_repository_and_uploads_the_folder(card, api):
    url = push_to_hub(card, REPO_ID, private=True, commit_message="More epochs", token="secret")
    assert url == "https://huggingface.co/someone/tdpg-Lava-v0"
    assert api.made.call_args.kwargs["token"] == "secret"
    api.create_repo.assert_called_once_with(REPO_ID, private=True, exist_ok=True)
    folder = api.upload_folder.call_args.kwargs
    # Files that only an earlier model had are deleted, and files of the user stay.
    gone = folder.pop("delete_patterns")
    assert {"config.json", "replay.mp4", "vec_normalize.pkl"} <= set(gone)
    assert all("*" not in name for name in gone)
    assert folder == dict(repo_id=REPO_ID, folder_path=card, commit_message="More epochs")


def test_a_folder_without_a_card_is_not_pushed(runs, api):
    with pytest.raises(ValueError, match=r"has no README.md: let write_model_card write the folder first"):
        push_to_hub(runs / "pg-seed0", REPO_ID)
    assert not api.create_repo.called


def http_error(status, text):
    response = SimpleNamespace(status_code=status, headers={}, request=None)
    return errors.HfHubHTTPError(text, response=response)


@pytest.mark.parametrize(("error", "message"), [
    (errors.LocalTokenNotFoundError("Token is required"), r"\(Token is required\): .*hf auth login"),
    (http_error(401, "401 Unauthorized\nInvalid user token"), r"\(401 Unauthorized\): .*hf auth login"),
    (http_error(503, "\n503 Service Unavailable"), r"\(503 Service Unavailable\): try again .* pushed again"),
    (ConnectionError("no route"), r"\(no route\): try again when the Hub can be reached; .* pushed again"),
    (errors.HTTPError("refused"), r"\(refused\): try again"),
])  # fmt: skip
def test_errors_of_the_hub_are_reported_in_one_line(error, message, card, api):
    api.create_repo.side_effect = error
    with pytest.raises(ValueError, match="someone/tdpg-Lava-v0 cannot be written " + message) as told:
        push_to_hub(card, REPO_ID)
    assert "\n" not in str(told.value)
    assert not api.upload_folder.called


def test_a_pull_downloads_the_repository_and_leaves_nothing_of_a_broken_download(tmp_path, monkeypatch):
    asked, out = [], tmp_path / "there"

    def download(repo_id, local_dir, **kwargs):
        asked.append((repo_id, kwargs))
        Path(local_dir, "figures").mkdir(parents=True)
        Path(local_dir, "README.md").touch()
        if len(asked) == 1:
            raise ConnectionError("no route")

    monkeypatch.setattr("huggingface_hub.snapshot_download", download)
    with pytest.raises(ValueError, match=r"cannot be read \(no route\): try again"):
        pull_from_hub(REPO_ID, out)
    assert not list(tmp_path.iterdir())
    assert pull_from_hub(REPO_ID, out, revision="v1", token="secret") == out
    assert sorted(path.name for path in out.iterdir()) == ["README.md", "figures"]
    assert asked[1] == (REPO_ID, dict(revision="v1", token="secret", library_name="sb3_tdpg"))


@pytest.mark.parametrize("module", ["huggingface_hub", "matplotlib"])
def test_without_its_extra_the_error_names_it(module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "sb3_tdpg.hub")
    with pytest.raises(ImportError, match=rf"sb3_tdpg.hub needs {module}: pip install 'sb3_tdpg\[hub\]'"):
        importlib.import_module("sb3_tdpg.hub")
