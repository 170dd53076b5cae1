import pytest


@pytest.fixture
def here(tmp_path, monkeypatch):
    """Run in an empty folder, since the zoo writes to logs/ in the working directory."""
    monkeypatch.chdir(tmp_path)
    # Its plots would open a window.
    monkeypatch.setenv("MPLBACKEND", "agg")
    return tmp_path
