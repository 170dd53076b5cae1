"""From the command line to results in a folder, with tiny settings: train, evaluate, interrupt, go on."""

import contextlib
import io
import json
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from programs import start, wait_for
from small_problems import assert_same_parameters, complete_runs_here, give_settings, parameters, stopped_in_epoch

from sb3_tdpg import TDPG
from sb3_tdpg.callbacks import TDPGProgressBar
from sb3_tdpg.cli import main
from sb3_tdpg.envs.scenarios import LAVA
from sb3_tdpg.experiments.runs import Run, complete_run, complete_runs, read_progress
from sb3_tdpg.experiments.training import make_training
from sb3_tdpg.paper.lava_tables import GOALS, METHODS, READINGS, methods, reproduce_lava

REPOSITORY = Path(__file__).resolve().parents[2]
TINY = ["--n-timesteps", "400", "--n-eval-episodes", "8"]
CHEAP = dict(n_timesteps=800, n_episodes=20, mi_kwargs=dict(gradient_steps=2, warmup_gradient_steps=2))


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Small epochs, so that a run of a few hundred steps has several."""
    with pytest.MonkeyPatch.context() as patch:
        give_settings(patch, dict(n_episodes=20))
        yield


def tiny_run(seed=0, **overrides):
    return Run("TDPG", "Lava-v0", "Lava-v0-table", seed, {**CHEAP, **overrides})


def policy_of(folder):
    return parameters(TDPG.load(folder / "model.zip", device="cpu").policy)


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """Return the folder of a tiny demo, and what it printed."""
    pytest.importorskip("matplotlib")
    folder, printed = tmp_path_factory.mktemp("demo"), io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main(["demo", "--out", str(folder), *TINY]) == 0
    return folder, printed.getvalue()


def test_demo_writes_everything_that_it_promises(demo):
    tmp_path, printed = demo
    assert "PG (paper)" in printed
    assert "31.04 (7.19)" in printed
    assert (tmp_path / "table.md").read_text().strip() in printed
    records = pd.read_csv(tmp_path / "episodes.csv")
    assert len(records) == 2 * len(LAVA) * 8
    assert set(records["model"]) == {"PG", "TDPG"}
    assert np.isfinite(records["cost"]).all()
    for picture in ("histograms.png", "trajectories.png", "training.png"):
        assert (tmp_path / picture).read_bytes().startswith(b"\x89PNG")
    config = json.loads((tmp_path / "config.json").read_text())
    assert [run["seed"] for run in config["runs"]] == [0, 0]
    assert config["provenance"]["versions"]["torch"]
    model = TDPG.load(tmp_path / "tdpg.zip")
    assert model.predict(np.zeros(2, np.float32), deterministic=True)[0].shape == (1,)
    assert TDPG.load(tmp_path / "pg.zip").mi_coef == 0


def test_demo_called_again_trains_nothing_and_prints_the_same(demo, capsys, monkeypatch):
    tmp_path, first = demo
    monkeypatch.setattr(TDPG, "learn", lambda *args, **kwargs: pytest.fail("it trains again"))
    assert main(["demo", "--out", str(tmp_path), *TINY]) == 0
    assert capsys.readouterr().out.split("\n\n")[1] == first.split("\n\n")[1]


def test_a_folder_with_another_run_is_refused_before_any_run_begins_and_left_alone(tmp_path):
    old = tmp_path / "old"
    complete_run(tiny_run(), old, LAVA[:1], n_eval_episodes=4)
    before = {path: path.read_bytes() for path in old.iterdir()}
    tasks = [(tiny_run(), tmp_path / "new", LAVA[:1]), (tiny_run(seed=1), old, LAVA[:1])]
    for refused in (lambda: complete_run(*tasks[1], n_eval_episodes=4),
                    lambda: complete_runs(tasks, n_eval_episodes=4, jobs=1)):  # fmt: skip
        with pytest.raises(ValueError, match=r"with other settings, seed: 0 there, 1 here: choose another folder"):
            refused()
    assert {path: path.read_bytes() for path in old.iterdir()} == before
    assert not (tmp_path / "new").exists()


def test_an_interrupted_run_goes_on_to_the_same_result(tmp_path, monkeypatch):
    monkeypatch.setattr("sb3_tdpg.experiments.runs.MAX_CHECKPOINT_EPOCHS", 2)
    complete_run(tiny_run(), tmp_path / "whole", LAVA, n_eval_episodes=4)

    def interrupt(callback):
        if callback.model.epoch == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(TDPGProgressBar, "_on_rollout_end", interrupt)
    with pytest.raises(KeyboardInterrupt):
        complete_run(tiny_run(), tmp_path / "halved", LAVA, n_eval_episodes=4, progress_bar=True)
    assert (tmp_path / "halved" / "attempt0" / "checkpoint.zip").exists()
    assert not (tmp_path / "halved" / "episodes.csv").exists()
    complete_run(tiny_run(), tmp_path / "halved", LAVA, n_eval_episodes=4)

    whole, halved = policy_of(tmp_path / "whole"), policy_of(tmp_path / "halved")
    assert_same_parameters(whole, halved)
    records, again = ((tmp_path / name / "episodes.csv").read_bytes() for name in ("whole", "halved"))
    assert records == again
    logs = [read_progress(tmp_path / name) for name in ("whole", "halved")]
    assert logs[0]["time/iterations"].tolist() == list(range(1, len(logs[0]) + 1))
    for column in ("time/iterations", "time/total_timesteps", "rollout/ep_cost_mean"):
        pd.testing.assert_series_equal(logs[0][column], logs[1][column])


def test_a_run_keeps_the_selected_policy_and_says_whether_an_epoch_met_the_limits(tmp_path):
    complete_run(tiny_run(), tmp_path / "none", LAVA[:1], n_eval_episodes=4)
    assert not pd.read_csv(tmp_path / "none" / "episodes.csv")["selected"].any()
    loose = [{"sb3_tdpg.callbacks.SelectionCallback": {"cost_limit": 1e6}}]
    complete_run(tiny_run(callback=loose), tmp_path / "some", LAVA[:1], n_eval_episodes=4)
    assert pd.read_csv(tmp_path / "some" / "episodes.csv")["selected"].all()
    assert {"epoch", "cost", "information"} == set(json.loads((tmp_path / "some" / "selected.json").read_text()))


def test_a_run_with_other_rows_or_another_start_is_refused(tmp_path):
    complete_run(tiny_run(), tmp_path / "first", LAVA[:1], n_eval_episodes=4)
    with pytest.raises(ValueError, match=r"scenarios\.1\.name: not there, .* here"):
        complete_run(tiny_run(), tmp_path / "first", LAVA[:2], n_eval_episodes=4)
    second = replace(tiny_run(), start=tmp_path / "first")
    complete_run(second, tmp_path / "second", LAVA[:1], n_eval_episodes=4)
    complete_run(second, tmp_path / "second", LAVA[:1], n_eval_episodes=4)
    shutil.rmtree(tmp_path / "first")
    complete_run(tiny_run(seed=5), tmp_path / "first", LAVA[:1], n_eval_episodes=4)
    with pytest.raises(ValueError, match=r"settings, start_policy: \"\w+\" there, \"\w+\" here: choose"):
        complete_run(second, tmp_path / "second", LAVA[:1], n_eval_episodes=4)


def test_runs_that_would_be_mixed_up_are_refused(tmp_path):
    names = [replace(tiny_run(), method=method).folder_name for method in ("beta 1.25", "beta 1/25")]
    assert names == ["beta-1.25-seed0", "beta-1-25-seed0"]
    with pytest.raises(ValueError, match="does not keep the statistics"):
        complete_run(tiny_run(normalize={}), tmp_path / "two", LAVA[:1])
    assert not list(tmp_path.iterdir())


def test_a_run_has_the_epochs_that_its_settings_say():
    training = make_training("Lava-v0", dict(policy="TRVPolicy", n_timesteps=2000, epoch_steps=500), device="cpu")
    assert training.model.n_envs * training.model.horizon == 500


def test_the_time_until_a_checkpoint_counts(tmp_path):
    with pytest.raises(KeyboardInterrupt), stopped_in_epoch(6):
        complete_run(tiny_run(), tmp_path, LAVA[:1], n_eval_episodes=4)
    times = [json.loads((tmp_path / "attempt0" / "time.json").read_text())]
    complete_run(tiny_run(), tmp_path, LAVA[:1], n_eval_episodes=4)
    times.append(json.loads((tmp_path / "time.json").read_text()))
    assert 0 < times[0]["cpu_s"] < times[1]["cpu_s"]


def test_attempts_go_on_until_one_meets_the_limits(tmp_path):
    run, callback = replace(tiny_run(), max_attempts=3), "sb3_tdpg.callbacks.SelectionCallback"
    complete_run(run, tmp_path / "none", LAVA[:1], n_eval_episodes=4)
    records = pd.read_csv(tmp_path / "none" / "episodes.csv")
    assert set(records["attempts"]) == {3}
    assert not records["selected"].any()
    costs = [read_progress(tmp_path / "none" / name)["rollout/ep_cost_mean"] for name in ("attempt0", "attempt1", ".")]
    assert not costs[0].equals(costs[1])
    assert not costs[1].equals(costs[2])

    # A limit between the attempts' best epochs: those before the one that meets it were in vain.
    best = [cost.min() for cost in costs]
    first = int(np.argmin(best[:2]))
    limits = [{callback: {"cost_limit": float(np.mean(best[:2])), "mi_limit": 1e6}}]
    limited = replace(run, overrides={**run.overrides, "callback": limits})
    complete_run(limited, tmp_path / "some", LAVA[:1], n_eval_episodes=4)
    records = pd.read_csv(tmp_path / "some" / "episodes.csv")
    assert set(records["attempts"]) == {first + 1}
    assert records["selected"].all()
    assert json.loads((tmp_path / "some" / "selected.json").read_text())["cost"] == pytest.approx(best[first])


def test_a_run_killed_between_training_and_evaluation_does_not_train_again(tmp_path, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr("sb3_tdpg.experiments.runs.evaluate_scenarios", Mock(side_effect=KeyboardInterrupt))
        complete_run(tiny_run(), tmp_path, LAVA[:1], n_eval_episodes=4)
    monkeypatch.setattr(TDPG, "learn", lambda *args, **kwargs: pytest.fail("it trains again"))
    complete_run(tiny_run(), tmp_path, LAVA[:1], n_eval_episodes=4)
    assert (tmp_path / "model.zip").exists()
    assert not (tmp_path / "attempt0").exists()


@pytest.mark.slow
def test_the_reproduction_goes_from_nothing_to_tables_figures_and_records(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    # In this process: the workers would not see the small epochs of this module.
    monkeypatch.setattr("sb3_tdpg.paper.lava_tables.complete_runs", complete_runs_here)
    monkeypatch.setattr("sb3_tdpg.evaluation.statistics.N_BOOTSTRAP", 10)
    tmp_path, published = tmp_path / "out", tmp_path / "docs" / "lava"
    summary = reproduce_lava(
        tmp_path, n_seeds=2, n_paper_seeds=1, n_eval_episodes=4, n_timesteps=200, publish=published
    )

    assert (tmp_path / "summary.md").read_text() == summary
    assert {path.name for path in published.iterdir()} == {path.name for path in tmp_path.iterdir()} - {"runs"}
    for title in ("Cost definition: table", "Cost definition: text", "The paper's own settings"):
        assert f"## {title}" in summary
    assert "MISSED" in summary, "two epochs reach no goal, and the summary must say so"
    for reading in READINGS:
        records = pd.read_csv(tmp_path / f"episodes_{reading}.csv.gz")
        assert len(records) == len(METHODS) * 2 * len(LAVA) * 4
        assert (tmp_path / f"trajectories_{reading}.png").exists()
    seeds = pd.read_csv(tmp_path / "seeds.csv")
    assert len(seeds) == 2 * len(METHODS) * 2 + len(methods("paper"))
    of_a_seed = "model == 'PG' and train_seed == 301 and "
    records = pd.read_csv(tmp_path / "episodes_text.csv.gz").query(of_a_seed + "scenario == 'Training'")
    found = seeds.query(of_a_seed + "group == 'text'")["mean"].item()
    assert found == pytest.approx(records["cost"].mean(), abs=1e-4)


def test_ctrl_c_stops_the_workers_and_keeps_what_is_done(tmp_path):
    process = start(["reproduce", "lava", "--out", str(tmp_path), "--jobs", "2"], tmp_path)
    wait_for(tmp_path, "runs/*/*/attempt0/checkpoint.zip", process)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)  # a training takes longer
    assert process.returncode == 130
    assert "the same command continues" in output
    assert "Traceback" not in output
    assert list(tmp_path.glob("runs/*/*/attempt0/checkpoint.zip"))


@pytest.mark.slow
def test_the_workers_of_a_command_that_is_killed_end_with_it(tmp_path):
    process = start(["frontier", "--env", "Lava-v0", "--jobs", "2", "--out", str(tmp_path)], tmp_path)
    wait_for(tmp_path, "runs/*/attempt0/*", process)
    process.kill()
    process.communicate(timeout=20)  # until nobody is left who could write there; a training takes longer
    assert not list(tmp_path.glob("runs/*/episodes.csv"))


def test_a_run_waits_for_the_one_that_it_starts_from(tmp_path):
    overrides = {"n_timesteps": 200, "n_episodes": 20}
    first = Run("PG", "Lava-v0", "Lava-v0-pg", 0, overrides)
    # A rate of zero: what comes out is what it started from.
    second = Run("more", "Lava-v0", "Lava-v0-pg", 0, {**overrides, "learning_rate": 0.0}, start=tmp_path / "first")
    tasks = [(second, tmp_path / "second", LAVA[:1]), (first, tmp_path / "first", LAVA[:1])]
    complete_runs(tasks, n_eval_episodes=4, jobs=2)
    assert_same_parameters(policy_of(tmp_path / "first"), policy_of(tmp_path / "second"))


def test_a_run_without_a_policy_to_start_from_is_refused_and_leaves_nothing(tmp_path):
    with pytest.raises(ValueError, match="nowhere, and there is none: train it first"):
        complete_run(replace(tiny_run(), start=tmp_path / "nowhere"), tmp_path / "run", LAVA[:1], n_eval_episodes=4)
    assert not list(tmp_path.iterdir())


def test_every_method_of_the_reproduction_has_goals_on_both_readings():
    assert set(GOALS) == set(READINGS)
    assert all(set(goals) == set(METHODS) for goals in GOALS.values())
