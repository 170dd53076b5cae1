import pytest

from sb3_tdpg.evaluation import statistics


@pytest.fixture(autouse=True)
def short_bootstrap(monkeypatch):
    """Resample ten times instead of thousands."""
    monkeypatch.setattr(statistics, "N_BOOTSTRAP", 10)
