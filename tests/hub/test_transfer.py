"""Push to the Hub, pull from it, and the errors of both."""

import importlib
import sys
from types import SimpleNamespace

import pytest
from huggingface_hub import errors
from published_cards import REPO_ID

from sb3_tdpg.hub import pull_from_hub, push_to_hub


@pytest.fixture
def api(monkeypatch):
    """A stand-in for the client, which records its calls and can be made to fail."""
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
    monkeypatch.setattr("huggingface_hub.HfApi", make)
    return api


def test_a_push_makes_the_repository_and_uploads_the_folder(card, api):
    url = push_to_hub(card, REPO_ID, private=True, commit_message="More epochs", token="secret")
    assert url == "https://huggingface.co/someone/tdpg-Lava-v0"
    (_, client), (create, repository), (upload, folder) = api.calls
    assert client["token"] == "secret"
    assert (create, repository) == ("create_repo", dict(repo_id=REPO_ID, private=True, exist_ok=True))
    assert upload == "upload_folder"
    # A video of an earlier model is deleted, and files of the user stay.
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


@pytest.mark.parametrize(("error", "message"), [
    (errors.LocalTokenNotFoundError("Token is required"), r"\(Token is required\): .*hf auth login"),
    (http_error(401, "401 Unauthorized\nInvalid user token"), r"\(401 Unauthorized\): .*hf auth login"),
    (http_error(503, "\n503 Service Unavailable"), r"\(503 Service Unavailable\): try again .* pushed again"),
    (ConnectionError("no route"), r"\(no route\): try again when the Hub can be reached; .* pushed again"),
    (errors.HTTPError("refused"), r"\(refused\): try again"),
])  # fmt: skip
def test_errors_of_the_hub_are_reported_in_one_line(error, message, card, api):
    api.error = error
    with pytest.raises(ValueError, match="someone/tdpg-Lava-v0 cannot be written " + message) as told:
        push_to_hub(card, REPO_ID)
    assert "\n" not in str(told.value)
    assert api.calls[-1][0] == "create_repo", "nothing is uploaded"


def test_a_pull_downloads_the_repository(tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(
        "huggingface_hub.snapshot_download", lambda repo_id, **kwargs: asked.update(repo_id=repo_id, **kwargs)
    )
    assert pull_from_hub(REPO_ID, tmp_path / "there", revision="v1", token="secret") == tmp_path / "there"
    assert asked.pop("library_name") == "sb3_tdpg"
    assert asked == dict(repo_id=REPO_ID, revision="v1", local_dir=tmp_path / "there", token="secret")


@pytest.mark.parametrize("module", ["huggingface_hub", "matplotlib"])
def test_without_its_extra_the_error_names_it(module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.delitem(sys.modules, "sb3_tdpg.hub")
    with pytest.raises(ImportError, match=rf"sb3_tdpg.hub needs {module}: pip install 'sb3_tdpg\[hub\]'"):
        importlib.import_module("sb3_tdpg.hub")
