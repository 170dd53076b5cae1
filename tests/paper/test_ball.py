"""The reproduction of ball catching with tiny settings, from nothing to tables, figures and records."""

import pickle

import numpy as np
import pandas as pd
import pytest
from small_problems import complete_runs_here, give_settings

from sb3_tdpg.cli import main
from sb3_tdpg.envs.ball_catch import RENDERERS
from sb3_tdpg.envs.scenarios import BALL_CATCH, BALL_CATCH_DIAGNOSIS
from sb3_tdpg.features import TRVCnn
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.paper import ball


@pytest.fixture
def tiny(monkeypatch):
    """Small epochs and the fast renderer, in this process."""
    small = dict(n_episodes=4, mi_kwargs={}, mi_estimator="logdet")
    give_settings(monkeypatch, lambda run: small if run.algo == "tdpg" else {})
    monkeypatch.setitem(RENDERERS, "pybullet", RENDERERS["fast"])
    monkeypatch.setattr(ball, "WALL_ROWS", ball.WALL_ROWS[:10])
    monkeypatch.setattr(ball, "SHIFTS", (*ball.SHIFTS[:10], *ball.SHIFTS[100:]))
    asked = []

    def complete_runs(tasks, *, n_eval_episodes, jobs):
        pickle.dumps(tasks)  # as the processes that train need it
        asked.append([run.method for run, *_ in tasks])
        complete_runs_here(tasks, n_eval_episodes=n_eval_episodes)

    monkeypatch.setattr(ball, "complete_runs", complete_runs)
    return asked


@pytest.mark.slow
@pytest.mark.parametrize(("n_seeds", "n_controls"), [(1, 5), (2, 1)])
def test_from_nothing_to_tables_figures_and_records(n_seeds, n_controls, tmp_path, tiny, monkeypatch):
    monkeypatch.setattr(ball, "N_CONTROLS", n_controls)
    out, published = tmp_path / "out", tmp_path / "docs"
    summary = ball.reproduce_ball(out, n_seeds=n_seeds, n_eval_episodes=2, n_timesteps=100, publish=published)

    assert (out / "summary.md").read_text() == summary
    files = {path.name for path in out.iterdir()} - {"runs"}
    assert {path.name for path in published.iterdir()} == files
    pictures = {"robustness.png", "diagnosis.png"}
    assert {"episodes.csv.xz", "shifts.csv.xz", "seeds.csv", "config.json", *pictures} <= files
    assert "MISSED" in summary, "an epoch reaches no goal, and the summary must say so"
    for method in ball.methods("fixed"):
        assert f"| {method.label} |" in summary
    for title in ("Table II", "Goals", "Unseen walls", "TDPG compared with", "Information in the TRVs"):
        assert title in summary
    records, shifts = (pd.read_csv(out / name) for name in ("episodes.csv.xz", "shifts.csv.xz"))
    n_policies = n_seeds * 3 + min(n_seeds, n_controls) * (len(ball.methods("fixed")) - 3)
    assert len(records) == n_policies * (len(BALL_CATCH) + len(BALL_CATCH_DIAGNOSIS)) * 2
    assert len(shifts) == n_policies * len(ball.SHIFTS) * 2
    # A terminal cost of 100 for each metre, and a little for driving.
    assert (records["cost"] >= 100 * records["distance"] - 0.1).all()
    assert (records["cost"] <= 100 * records["distance"] + 25 * 0.2 + 0.1).all()


@pytest.mark.slow
def test_the_ablations_may_be_added_later(tmp_path, tiny):
    arguments = dict(n_seeds=1, n_eval_episodes=2, n_timesteps=100)
    summary = ball.reproduce_ball(tmp_path, controls=False, **arguments)
    assert "earlier encoder" not in summary
    assert sorted(tiny[0]) == ["PG", "RecurrentPPO", "TDPG"]
    before = (tmp_path / "runs" / "tdpg-seed310" / "model.zip").read_bytes()
    assert "earlier encoder" in ball.reproduce_ball(tmp_path, **arguments)
    assert (tmp_path / "runs" / "tdpg-seed310" / "model.zip").read_bytes() == before


@pytest.mark.slow
def test_the_varying_launch_has_a_reproduction_of_its_own(tmp_path, tiny, capsys):
    arguments = ["--n-seeds", "1", "--n-eval-episodes", "2", "--n-timesteps", "100"]
    assert main(["reproduce", "ball-varying", "--out", str(tmp_path), *arguments]) == 0
    assert "a launch that varies" in capsys.readouterr().out
    records = pd.read_csv(tmp_path / "runs" / "pg-seed310" / "episodes.csv")
    landing = records.loc[records["scenario"] == "Training", "final_state_1"]
    assert landing.nunique() > 1


def test_the_command_leaves_the_number_of_episodes_to_the_experiment(monkeypatch, tmp_path):
    asked = {}
    monkeypatch.setattr(ball, "reproduce_ball", lambda out, **options: asked.update(options) or "done")
    assert main(["reproduce", "ball", "--out", str(tmp_path)]) == 0
    assert asked == {}
    assert main(["reproduce", "ball", "--out", str(tmp_path), "--n-eval-episodes", "7"]) == 0
    assert asked == {"n_eval_episodes": 7}


def test_a_group_is_the_mean_of_its_rows():
    rows = [(m, s, r.name, float(10 * i + s)) for m in ("PG",) for s in (0, 1) for i, r in enumerate(BALL_CATCH)]
    records = pd.DataFrame(rows, columns=["model", "train_seed", "scenario", "cost"])
    grouped = ball.with_groups(records).groupby(["train_seed", "scenario"])["cost"].mean()
    assert grouped[0, "Sensor noise, mean of 4"] == 25
    assert grouped[1, "Test backgrounds, mean of 7"] == 81
    noise, backgrounds = ball.group_rows(BALL_CATCH)
    assert backgrounds.paper["PG"].mean == pytest.approx(132.88, abs=0.01)
    assert backgrounds.paper["TDPG"].mean == pytest.approx(67.94, abs=0.01)
    assert noise.paper["TDPG"].distance == pytest.approx(0.22)


def test_every_goal_is_of_a_row_and_a_method_of_the_table():
    names = {row.name for row in (*BALL_CATCH, *ball.group_rows(BALL_CATCH))}
    names |= {ball.ALL_WALLS, ball.WORST_WALLS, ball.HELD}
    for method, goals in ball.GOALS.items():
        assert method in {m.label for m in ball.methods("fixed") if m.renderer == "pybullet"}
        assert set(goals) <= names


def test_the_worst_walls_are_those_of_each_policy():
    rows = [
        ("TDPG", seed, name, float(number if seed else -number))
        for seed in (0, 1)
        for number, name in enumerate(ball.WALL_ROWS)
    ]
    records = pd.DataFrame(rows, columns=["model", "train_seed", "scenario", "cost"])
    grouped = ball.with_groups(records).groupby(["train_seed", "scenario"])["cost"].mean()
    assert grouped[1, ball.ALL_WALLS] == 49.5
    assert grouped[1, ball.WORST_WALLS] == 94.5
    assert grouped[0, ball.WORST_WALLS] == -4.5


def test_each_row_changes_the_image_as_it_says():
    images = np.arange(256, dtype=np.uint8)
    changed = ball.gamma(images)
    assert (changed[[0, 255]] == [0, 255]).all()
    assert (changed[1:255] < images[1:255]).all()
    # Squares of the brightness, which no change of contrast gives.
    assert changed[128] == 64
    assert len({row.name for row in ball.SHIFTS}) == 103
    assert [row.sensor is None for row in ball.SHIFTS] == [True] * 100 + [False] * 3


def settings_of(method):
    return {**load_hyperparams(method.block, method.algo), **method.overrides}


@pytest.mark.parametrize("launch", ["fixed", "varying"])
def test_a_method_differs_from_the_one_line_in_what_its_name_says(launch):
    tdpg, *others = ball.methods(launch)
    one_line = settings_of(tdpg)
    assert one_line == {**load_hyperparams("BallCatch-v0"), "env_kwargs": ball.LAUNCHES[launch]}
    changed = {
        method.label: {key for key in settings_of(method) if settings_of(method)[key] != one_line.get(key)}
        for method in others
        if method.algo == "tdpg"
    }
    assert changed == {"PG": {"beta"}, "no nuisance": {"nuisance"}, "earlier encoder": {"policy_kwargs"}}
    for method in others:
        assert settings_of(method)["n_timesteps"] == one_line["n_timesteps"]
        assert settings_of(method)["env_kwargs"] == one_line["env_kwargs"]
        assert ("PerturbedVecEnv" in str(settings_of(method))) == (method.algo != "tdpg")
    ours = settings_of(others[-1])["policy_kwargs"]
    assert (ours["features_extractor_class"], ours["lstm_hidden_size"]) == (TRVCnn, 64)
