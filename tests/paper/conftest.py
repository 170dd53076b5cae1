import pytest

from sb3_tdpg.evaluation import statistics


@pytest.fixture(autouse=True)
def short_bootstrap(monkeypatch):
    """Resample ten times instead of thousands."""
    bootstrap = statistics._bootstrap
    monkeypatch.setattr(statistics, "_bootstrap", lambda *args, **how: bootstrap(*args, **{**how, "n_bootstrap": 10}))
