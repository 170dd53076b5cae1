"""Table II by the paper's own algorithm, in miniature; its rule of selection; and the callback that stops at a cost."""

import numpy as np
import pandas as pd
import pytest
from small_problems import complete_runs_here, give_settings, tiny_tdpg, train_epochs

from sb3_tdpg.cli import main
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.paper import ball_paper


@pytest.fixture
def tiny(monkeypatch):
    """Epochs of four episodes, two prices, two levels."""
    give_settings(monkeypatch, dict(n_episodes=4, batch_size=4 * 25, mi_kwargs={}, mi_estimator="logdet"))
    monkeypatch.setattr(ball_paper, "LEVELS", (1e6, 8.7))
    monkeypatch.setattr(ball_paper, "PRICES", (16, 40))
    monkeypatch.setattr(ball_paper, "complete_runs", lambda tasks, **_: complete_runs_here(tasks, n_eval_episodes=2))


@pytest.mark.slow
def test_from_nothing_to_tables_figures_and_records(tmp_path, tiny, monkeypatch):
    # Without a limit every epoch may be selected.
    no_limit = dict(callback=[{"sb3_tdpg.callbacks.SelectionCallback": dict(cost_limit=1e6)}])
    give_settings(monkeypatch, lambda run: no_limit if run.method.startswith("TDPG") else {})
    arguments = ["--n-seeds", "2", "--n-timesteps", "800", "--publish", str(tmp_path / "docs")]
    assert main(["reproduce", "ball-paper", "--out", str(tmp_path / "out"), *arguments]) == 0
    summary = (tmp_path / "out" / "summary.md").read_text()
    for text in ("TDPG from 8.7", "PG to 8.7", "PG to 1e+06", "make reproduce-ball-paper"):
        assert text in summary
    runs = pd.read_csv(tmp_path / "docs" / "runs.csv").set_index(["model", "train_seed"])
    assert len(runs) == 2 * 2 * 3
    # The first level is met as soon as there are five epochs to average; the second one never, in eight epochs.
    assert runs.loc[("PG to 1e+06", 400), "epochs"] == 5
    assert runs.loc[("PG to 8.7", 400), "epochs"] == 8
    assert runs["information"].notna().sum() == 2 * 2 * 2


def test_the_policy_of_the_lowest_information_is_selected_for_each_level_and_seed():
    runs = pd.DataFrame(
        [("TDPG 16 from 8.7", 0, 2.0), ("TDPG 40 from 8.7", 0, 1.0), ("TDPG 16 from 8.7", 1, 0.5),
         ("TDPG 40 from 8.7", 1, np.nan), ("TDPG 16 from 5", 0, np.nan)],
        columns=["model", "train_seed", "information"],
    )  # fmt: skip
    records = pd.concat([runs, pd.DataFrame(dict(model=["PG to 8.7"], train_seed=[0]))], ignore_index=True)
    chosen = ball_paper.select(runs, records.assign(cost=range(len(records))))
    found = chosen.set_index(["model", "train_seed"])
    assert found.loc[("TDPG from 8.7", 0), ["cost", "price"]].tolist() == [1, "40"]
    assert found.loc[("TDPG from 8.7", 1), ["cost", "price"]].tolist() == [2, "16"]
    assert set(chosen["model"]) == {"PG to 8.7", "TDPG from 8.7"}, "no epoch of the other level met the limit"
    chosen = ball_paper.select(runs.assign(information=np.nan), records)
    assert set(chosen["model"]) == {"PG to 8.7"}
    assert "price" in chosen, "also if no run met its limit"


def test_a_training_stops_once_five_epochs_cost_little_enough():
    model, callback = tiny_tdpg(beta=np.inf), ball_paper.StopAtCost(1e6)
    model.learn(100 * 20 * 5, callback)
    assert model.epoch == 5
    model = tiny_tdpg(beta=np.inf)
    model.learn(7 * 20 * 5, ball_paper.StopAtCost(-1.0))
    assert model.epoch == 7


def test_a_resumed_training_remembers_the_costs_of_its_last_epochs():
    model = tiny_tdpg(beta=np.inf)
    train_epochs(model, 4, callback=ball_paper.StopAtCost(1e9))
    again = ball_paper.StopAtCost(1e9)
    train_epochs(model, 4, callback=again, reset_num_timesteps=False)
    assert model.epoch == 5


def test_the_methods_have_the_papers_settings():
    labels = [method.label for method in ball_paper.methods()]
    assert labels[:2] == ["PG to 24", "TDPG 16 from 24"]
    assert [m.start for m in ball_paper.methods() if m.label.startswith("PG")] == [None, "PG to 24", "PG to 8.7"]
    tdpg = load_hyperparams("BallCatch-v0-paper")
    assert tdpg["n_timesteps"] == 100 * 200 * 25
    assert tdpg["mi_kwargs"]["warmup_gradient_steps"] == 100_000
    assert (tdpg["learning_rate"], tdpg["mi_kwargs"]["learning_rate"], tdpg["baseline"]) == (1e-3, 5e-5, "mean")
