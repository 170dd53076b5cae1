"""The reproduction of ball catching with tiny settings, from nothing to tables, figures and records."""

from functools import partial

import numpy as np
import pandas as pd
import pytest
from small_problems import complete_runs_here

from sb3_tdpg.cli import main
from sb3_tdpg.envs.ball_catch import RENDERERS
from sb3_tdpg.envs.scenarios import BALL_CATCH, BALL_CATCH_DIAGNOSIS
from sb3_tdpg.experiments.runs import Run, complete_run
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.paper import ball, common


@pytest.fixture
def tiny(monkeypatch):
    """Small epochs and the fast renderer, in this process."""
    block = Run.settings.fget
    monkeypatch.setattr(
        Run,
        "settings",
        property(
            lambda run: {**block(run), "n_episodes": 4, "batch_size": 4, "mi_kwargs": {}, "mi_estimator": "logdet"}
        ),
    )
    monkeypatch.setitem(RENDERERS, "pybullet", RENDERERS["fast"])
    for module, name in (
        (ball, "aggregate_seeds"),
        (common, "probability_of_improvement"),
        (common, "paired_difference"),
    ):
        monkeypatch.setattr(module, name, partial(getattr(module, name), n_bootstrap=10))
    monkeypatch.setattr(ball, "trv_knowledge", partial(ball.trv_knowledge, n_walls=4))
    asked = []

    def complete_runs(tasks, *, n_eval_episodes, jobs):
        asked.append([run.method for run, *_ in tasks])
        complete_runs_here(tasks, n_eval_episodes=n_eval_episodes)

    monkeypatch.setattr(ball, "complete_runs", complete_runs)
    return asked


@pytest.mark.slow
@pytest.mark.parametrize("n_seeds", [1, 2])
def test_from_nothing_to_tables_figures_and_records(n_seeds, tmp_path, tiny):
    out, published = tmp_path / "out", tmp_path / "docs"
    summary = ball.reproduce_ball(out, n_seeds=n_seeds, n_eval_episodes=2, n_timesteps=100, publish=published)

    assert (out / "summary.md").read_text() == summary
    assert {path.name for path in published.iterdir()} == {path.name for path in out.iterdir()} - {"runs"}
    assert {"episodes.csv.xz", "seeds.csv", "config.json", "robustness.png", "diagnosis.png", "training.png"} <= {
        path.name for path in out.iterdir()
    }
    assert "MISSED" in summary, "an epoch reaches no goal, and the summary must say so"
    for method in (*ball.METHODS, *ball.PAPER_METHODS):
        assert method.label in summary
    for title in (
        "images by PyBullet",
        "images by the ray caster",
        "own settings",
        "Goals",
        "Effect of the penalty",
        "TRVs know",
    ):
        assert title in summary
    records = pd.read_csv(out / "episodes.csv.xz")
    n_policies = n_seeds * len(ball.METHODS) + len(ball.PAPER_METHODS)
    assert len(records) == n_policies * (len(BALL_CATCH) + len(BALL_CATCH_DIAGNOSIS)) * 2
    # A terminal cost of 100 for each metre, and a little for driving.
    assert (records["cost"] >= 100 * records["distance"] - 0.1).all()
    assert (records["cost"] <= 100 * records["distance"] + 25 * 0.2 + 0.1).all()


@pytest.mark.slow
def test_the_ablations_may_be_added_later(tmp_path, tiny):
    arguments = dict(n_seeds=1, n_eval_episodes=2, n_timesteps=100)
    summary = ball.reproduce_ball(tmp_path, controls=False, **arguments)
    assert common.NO_PENALTY not in summary
    assert sorted(tiny[0]) == ["PG", "PG, perturbed images", "TDPG"]
    before = (tmp_path / "runs" / "tdpg-seed100" / "model.zip").read_bytes()
    assert common.NO_PENALTY in ball.reproduce_ball(tmp_path, **arguments)
    assert (tmp_path / "runs" / "tdpg-seed100" / "model.zip").read_bytes() == before


def test_a_second_stage_starts_from_the_policy_of_the_first(tmp_path, tiny):
    run = Run("PG", "BallCatch-v0", "BallCatch-v0-pg", 0, {"n_timesteps": 100})
    complete_run(run, tmp_path / "first", BALL_CATCH[:1], n_eval_episodes=2)
    # A rate of zero: what is found is what it started from.
    second = Run(
        "TDPG",
        "BallCatch-v0",
        "BallCatch-v0-two-stages",
        0,
        {"n_timesteps": 100, "learning_rate": 0.0},
        start=tmp_path / "first",
    )
    complete_run(second, tmp_path / "second", BALL_CATCH[:1], n_eval_episodes=2)
    costs = [pd.read_csv(tmp_path / name / "episodes.csv")["cost"].to_numpy() for name in ("first", "second")]
    np.testing.assert_allclose(*costs)


@pytest.mark.slow
def test_the_varying_launch_has_a_reproduction_of_its_own(tmp_path, tiny, capsys):
    arguments = ["--n-seeds", "1", "--n-eval-episodes", "2", "--n-timesteps", "100"]
    assert main(["reproduce", "ball-varying", "--out", str(tmp_path), *arguments]) == 0
    assert "a launch that varies" in capsys.readouterr().out
    records = pd.read_csv(tmp_path / "runs" / "pg-seed100" / "episodes.csv")
    landing = records.loc[records["scenario"] == "Training", "final_state_1"]
    assert landing.nunique() > 1


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
    for method, goals in ball.GOALS.items():
        assert method in {m.label for m in ball.METHODS if m.renderer == "pybullet"}
        assert set(goals) <= names


def test_every_method_but_the_first_stages_starts_from_one():
    first_stages = (["PG", "PG, perturbed images"], ["PG"])
    for methods, first in zip((ball.METHODS, ball.VARYING_METHODS), first_stages, strict=True):
        assert [m.label for m in methods if m.start is None] == first
        labels = [m.label for m in methods]
        for method in methods:
            assert method.start is None or labels.index(method.start) < labels.index(method.label)
        assert {label for pair in ball.COMPARISONS for label in pair} <= set(labels)


def test_an_ablation_differs_from_its_method_in_nothing_but_the_penalty():
    for methods in (ball.METHODS, ball.VARYING_METHODS):
        by_label = {method.label: method for method in methods}
        for model, ablation in ball.COMPARISONS[:2]:
            settings = [
                {**load_hyperparams(by_label[label].block), **by_label[label].overrides} for label in (model, ablation)
            ]
            assert by_label[model].start == by_label[ablation].start
            assert {key for key in settings[0] if settings[0][key] != settings[1].get(key)} == {"beta", "cost_limit"}
            assert set(settings[0]) == set(settings[1])
