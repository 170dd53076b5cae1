"""Trained models and the card of one, offline, for all tests of this folder."""

import importlib.util
import socket

import pytest
from published_cards import REPO_ID, TINY

from sb3_tdpg.envs.scenarios import LAVA
from sb3_tdpg.experiments.runs import Run, complete_run

# Without the extra there is nothing to test.
if any(importlib.util.find_spec(module) is None for module in ("huggingface_hub", "matplotlib")):
    collect_ignore_glob = ["*"]


@pytest.fixture(autouse=True)
def offline(monkeypatch):
    """Refuse to go online, and trust nothing unless a test says so."""

    def refuse(*_):
        pytest.fail("a test goes online")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.delenv("TRUST_REMOTE_CODE", raising=False)


@pytest.fixture(scope="session")
def runs(tmp_path_factory):
    """Folder of a policy-gradient run, and of a TDPG run that started from it."""
    folder = tmp_path_factory.mktemp("runs")
    pg = Run("PG", "Lava-v0", "Lava-v0-pg", 0, {"n_timesteps": 800, "n_episodes": 20})
    complete_run(pg, folder / "pg-seed0", LAVA[:2], n_eval_episodes=30)
    loose = [{"sb3_tdpg.callbacks.SelectionCallback": {"cost_limit": 1e6}}]
    tdpg = Run("TDPG", "Lava-v0", "Lava-v0", 0, {**TINY, "callback": loose}, start=folder / "pg-seed0")
    complete_run(tdpg, folder / "tdpg-seed0", [LAVA[1], LAVA[0]], n_eval_episodes=30)
    return folder


@pytest.fixture(scope="session")
def card(runs, tmp_path_factory):
    from sb3_tdpg.hub import write_model_card

    return write_model_card(runs / "tdpg-seed0", tmp_path_factory.mktemp("card") / "hub", REPO_ID)


@pytest.fixture
def on_the_hub(card, monkeypatch):
    """A stand-in for the Hub, which has what was written."""
    asked = []

    def hf_hub_download(repo_id, filename, **kwargs):
        asked.append((repo_id, filename, kwargs))
        return str(card / filename)

    names = [str(path.relative_to(card)) for path in card.rglob("*") if path.is_file()]
    assert "pg-seed0/model.zip" in names
    names.append("tdpg-seed7/model.zip")  # what a run started from may be called like a model
    monkeypatch.setattr("huggingface_hub.hf_hub_download", hf_hub_download)
    monkeypatch.setattr("huggingface_hub.HfApi.list_repo_files", lambda api, repo_id, revision: names)
    return asked
