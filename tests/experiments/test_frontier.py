"""The frontier, from the command to results, with tiny trainings; its verdict and its knee on tables made by hand."""

import json
import math
import re
import shlex
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from small_problems import error_line

pytest.importorskip("matplotlib")
pytest.importorskip("rliable")

from sb3_tdpg import TDPG
from sb3_tdpg.cli import main
from sb3_tdpg.experiments import frontier as module
from sb3_tdpg.experiments.blind import BlindVecEnv
from sb3_tdpg.experiments.frontier import NO_PENALTY, OPEN_LOOP, frontier, frontier_table, knee, verdict
from sb3_tdpg.experiments.training import take_env
from sb3_tdpg.vec_env import make_episodes_env

COMMAND = ["frontier", "--env", "Lava-v0", "--shares", "90", "--seeds", "2", "--jobs", "1"]
COMMAND += ["--block", "Lava-v0-logdet-table"]
TINY = ["--n-timesteps", "1100", "--n-eval-episodes", "20", "--set", "n_episodes=20"]
LABELS = [NO_PENALTY, "90 %", OPEN_LOOP]


def test_the_command_writes_everything_that_it_promises_and_a_second_call_trains_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*COMMAND, *TINY]) == 0
    text = capsys.readouterr().out
    assert "results are in results/frontier-Lava-v0-logdet-table" in text
    out = tmp_path / "results" / "frontier-Lava-v0-logdet-table"
    assert (out / "frontier.md").read_text() in text
    assert (out / "frontier.png").read_bytes().startswith(b"\x89PNG")
    table = pd.read_csv(out / "frontier.csv")
    assert table["label"].tolist() == LABELS
    assert (table["seeds"] == 2).all()
    assert np.isfinite(table.drop(columns="label")).all(axis=None)
    assert (table["cost_low"] <= table["cost"]).all() and (table["cost"] <= table["cost_high"]).all()

    (report,) = re.findall(r"^sb3-tdpg (report .*)$", text, re.MULTILINE)
    assert "--env-kwargs" in report and "action_cost=1.0" in report  # of the block
    brief = ["--perturbations", "vector_noise", "--severities", "5", "--episodes", "5", "--jobs", "1"]
    assert main([*shlex.split(report), *brief]) == 0
    measured = (tmp_path / "results" / "frontier-Lava-v0-logdet-table-report" / "report.md").read_text()
    assert "| 90 %" in measured and f"| {NO_PENALTY}" in measured

    runs = pd.read_csv(out / "runs.csv")
    episodes = pd.concat(pd.read_csv(out / "runs" / folder / "episodes.csv") for folder in runs["folder"])
    costs = episodes.groupby(["model", "train_seed"], sort=False)["cost"]
    np.testing.assert_allclose(runs[["cost", "std"]], costs.agg(["mean", "std"]))
    assert (runs["information_lower"] <= runs["information"]).all()
    settings = {
        label: json.loads((out / "runs" / folder / "config.json").read_text())["settings"]
        for label, folder in zip(runs["label"], runs["folder"], strict=True)
    }
    assert [settings[label]["beta"] for label in LABELS] == ["inf", "auto", "inf"]
    assert [settings[label]["cost_limit"] for label in LABELS] == [None, "90%", None]
    assert all(each["mi_estimator"] == "logdet" and each["callback"] == [] for each in settings.values())
    blind = TDPG.load(out / "runs" / "open-loop-seed0" / "model.zip")
    assert blind.observation_space.shape == (8,)
    assert json.loads((out / "config.json").read_text())["runs"] == runs["folder"].tolist()

    before = {path: path.stat().st_mtime_ns for path in (out / "runs").rglob("*")}
    assert main([*COMMAND, *TINY]) == 0
    assert {path: path.stat().st_mtime_ns for path in (out / "runs").rglob("*")} == before
    pd.testing.assert_frame_equal(pd.read_csv(out / "frontier.csv"), table)


def test_the_command_that_measures_it_finds_the_models_whatever_the_name_of_the_folder():
    runs = pd.DataFrame(dict(label=[NO_PENALTY, OPEN_LOOP], folder=["no-penalty-seed0", "open-loop-seed0"]))
    command = module.report_command(Path("of [1]"), runs, "Lava-v0", {})
    assert shlex.split(command)[2:3] == ["no penalty=of [[]1]/runs/no-penalty-seed*/model.zip"]


def test_an_interrupted_frontier_goes_on_and_more_shares_add_to_it(tmp_path, monkeypatch):
    done = []

    def interrupted(tasks, **_):
        from sb3_tdpg.experiments.runs import complete_run

        for task in tasks:
            if len(done) == 2:
                raise KeyboardInterrupt
            if not (task[1] / "episodes.csv").exists():
                done.append(complete_run(*task, n_eval_episodes=20))

    monkeypatch.setattr("sb3_tdpg.experiments.frontier.complete_runs", interrupted)
    how = dict(n_seeds=1, out=tmp_path, n_timesteps=1100, n_eval_episodes=20, settings=dict(n_episodes=20))
    with pytest.raises(KeyboardInterrupt):
        frontier("Lava-v0", shares=[90], **how)
    assert not (tmp_path / "frontier.csv").exists()
    done[:] = [None] * 3
    frontier("Lava-v0", shares=[90], **how)
    assert len(done) == 4  # the open loop alone was left
    frontier("Lava-v0", shares=[50, 90], **how)
    assert done[4].name == "50-per-cent-seed0"
    assert len(done) == 5
    assert pd.read_csv(tmp_path / "frontier.csv")["label"].tolist() == [NO_PENALTY, "90 %", "50 %", OPEN_LOOP]
    with pytest.raises(ValueError, match=r"n_episodes: 20 there, 10 here: choose another folder or remove it"):
        frontier("Lava-v0", shares=[90], **{**how, "settings": dict(n_episodes=10)})


def test_an_environment_without_a_block_is_trained_with_the_defaults(tmp_path, monkeypatch):
    complete_runs = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr("sb3_tdpg.experiments.frontier.complete_runs", complete_runs)
    spec = replace(gym.spec("SqueezeInsert-v0"), id="WithoutABlock-v0")
    monkeypatch.setitem(gym.registry, "WithoutABlock-v0", spec)
    with pytest.raises(KeyboardInterrupt):
        frontier("WithoutABlock-v0", shares=[95], n_seeds=1, out=tmp_path)
    (tasks,) = complete_runs.call_args.args
    assert [task[0].block for task in tasks] == [None] * 3
    horizon = make_episodes_env("SqueezeInsert-v0", 1).get_attr("horizon")[0]
    assert tasks[0][0].settings["n_timesteps"] == 400 * 500 * horizon  # as learn() without a number


BAD = {
    "share": (["--shares", "95", "120"], "must be at least one number between 0 and 100"),
    "length": (["--n-timesteps", "1000"], "1000 steps are 10 epochs of 100"),
    "environment": (["--env", "Lave-v0"], "env='Lave-v0' with block"),
    "block": (["--block", "Lava-v1"], "no block 'Lava-v1'"),
    "setting": (["--set", "learning_rat=1"], "no argument 'learning_rat'"),
    "beta": (["--set", "beta=1"], "beta is set by the frontier"),
    "keyword": (["--env-kwargs", "horizons=3"], "horizons"),
}


@pytest.mark.parametrize("case", list(BAD))
def test_bad_input_is_one_line_and_exit_code_2_before_anything_is_trained(case, tmp_path, capsys):
    arguments, message = BAD[case]
    out = tmp_path / "out"
    assert message in error_line(capsys, *COMMAND, *TINY, *arguments, "--out", out)
    assert not list(out.glob("runs/*"))


@pytest.mark.parametrize("env_id", ["Lava-v0", "CartPole-v1"])
def test_a_blind_environment_shows_the_time_and_nothing_else(env_id):
    env = BlindVecEnv(make_episodes_env(env_id, 3, seed=0, use_processes=False))
    horizon = env.horizon
    time = np.zeros(3, int)
    observations = env.reset()
    for _ in range(60):
        expected = np.cos(np.pi * np.outer(time, np.arange(1, 9)) / horizon)
        np.testing.assert_allclose(observations, expected, atol=1e-6)
        observations, _, dones, infos = env.step(np.array([env.action_space.sample() for _ in range(3)]))
        time += 1
        for i in np.flatnonzero(dones):
            at_end = np.cos(np.pi * time[i] * np.arange(1, 9) / horizon)
            np.testing.assert_allclose(infos[i]["terminal_observation"], at_end, atol=1e-6)
        time[dones] = 0


def runs_of(**seeds):
    """Runs by label: a list of (cost, nats), one for each seed; ``s95`` stands for a limit of 95 %."""
    names = dict(no_penalty=NO_PENALTY, open_loop=OPEN_LOOP)
    return pd.DataFrame(
        dict(label=names.get(name, f"{name[1:]} %"), seed=seed, cost=cost, information=nats)
        for name, values in seeds.items()
        for seed, (cost, nats) in enumerate(values)
    )


def table_of(first_cost=110.0, **seeds):
    return frontier_table(runs_of(**seeds), first_cost)


FREE, BLIND = [(10.0, 4.0), (10.0, 8.0)], [(14.0, 0.5), (12.0, 0.1)]


def test_without_a_penalty_all_of_the_improvement_is_kept_however_the_seeds_scatter():
    free = [(cost, 4.0) for cost in (1.0, 1.0, 1.0, 1.0, 9.0)]
    table = table_of(10.0, no_penalty=free, s95=[(2.5, 2.0)] * 5, open_loop=free).set_index("label")
    assert table["improvement"].tolist()[:2] == pytest.approx([1.0, 7.5 / 9.0])


def test_the_open_loop_sees_an_unchanged_clock(tmp_path):
    noisy = {"sb3_tdpg.robustness.PerturbedVecEnv": dict(perturbation="vector_noise", scale=[1.0, 1.0])}
    shared = dict(policy="TRVPolicy", vec_env_wrapper=[noisy], n_episodes=4)
    run, *_ = module._task("Lava-v0", None, shared, OPEN_LOOP, 0, tmp_path)
    settings = dict(run.settings)
    np.testing.assert_array_equal(take_env("Lava-v0", settings).reset(), np.ones((4, 8)))


def test_the_table_pairs_the_seeds_and_a_blind_policy_has_no_information():
    table = table_of(no_penalty=FREE, s95=[(15.0, 2.0), (15.0, 2.0)], open_loop=BLIND).set_index("label")
    row = table.loc["95 %"]
    assert row[["cost", "nats", "kept"]].tolist() == pytest.approx([15.0, 2.0, (1 / 2 + 1 / 4) / 2])
    assert row[["kept_low", "kept_high"]].tolist() == pytest.approx([1 / 4, 1 / 2])
    assert row["improvement"] == pytest.approx(0.95)
    assert table.loc[OPEN_LOOP, ["nats", "kept", "best", "cost"]].tolist() == pytest.approx([0, 0, 12, 13])


FEW_NATS = [(12.0, 0.3), (12.0, 0.5)]


@pytest.mark.parametrize(("limit", "blind", "word", "why"), [
    (FEW_NATS, BLIND, "Probably", "keeps 98 % of the improvement (cost 12) with 7 % of the information"),
    (FEW_NATS, [(15.5, 0), (16.0, 0)], "Perhaps", "costs 15.5, which is expensive: the bound is 15,"),
    (FEW_NATS, [(14.5, 0), (18.0, 0)], "Probably", "costs 14.5, which is cheap: the bound is 15,"),  # the best seed
    ([(12.0, 0.2), (12.0, 1.6)], BLIND, "Perhaps", "12 % of the information (5 % to 20 %)"),  # one keeps more
    ([(25.0, 0.0), (25.0, 0.0)], BLIND, "Perhaps", "keeps 85 % of the improvement"),
    ([(12.0, 4.0), (12.0, 8.0)], [(99.0, 0)] * 2, "Probably not", "costs 99, which is expensive: the bound is 15,"),
])  # fmt: skip
def test_the_verdict_asks_for_information_to_spare_and_a_cheap_open_loop(limit, blind, word, why):
    text = verdict(table_of(no_penalty=FREE, s95=limit, open_loop=blind))
    assert text.startswith(f"**{word}**: ")
    assert why in text
    assert "\n" not in text


def test_of_limits_with_information_to_spare_the_cheapest_is_shown():
    limits = dict(s99=[(13.0, 0.1)], s95=[(11.0, 0.2)], s90=[(12.0, 0.1)])
    assert "a limit of 95 % keeps" in verdict(table_of(no_penalty=[(10.0, 4.0)], **limits, open_loop=[(12.0, 0.0)]))


def test_returns_are_judged_as_costs_are():
    # CartPole: the open loop falls over, although a limit keeps little of the information.
    cartpole = dict(no_penalty=[(-500.0, 90.0)], s95=[(-480.0, 5.0)], open_loop=[(-40.0, 0.0)])
    text = verdict(table_of(first_cost=-20.0, **cartpole))
    assert text.startswith("**Perhaps**") and "expensive: the bound is -250" in text and "one seed, no interval" in text


def test_a_policy_that_carries_no_information_has_nothing_to_leave_out():
    table = table_of(no_penalty=[(10.0, 0.001)], s95=[(10.0, 0.0)], open_loop=[(10.0, 0.0)])
    assert verdict(table).startswith("**Probably not**: without a penalty the policy carries 0.001 nats")
    assert knee(table) is None


def test_the_knee_is_the_limit_farthest_below_the_line_of_mixtures():
    ends = dict(no_penalty=[(10.0, 8.0)], open_loop=[(20.0, 0.0)])
    assert knee(table_of(s99=[(10.5, 6.0)], s95=[(12.0, 2.0)], s90=[(16.0, 1.0)], **ends)) == "95 %"
    assert knee(table_of(s99=[(10.2, 1.0)], s95=[(12.0, 0.9)], **ends)) == "99 %"
    assert knee(table_of(s99=[(12.0, 5.8)], s95=[(16.0, 4.0)], **ends)) is None  # hardly below it, and above
    ends["open_loop"] = [(9.0, 0.0)]
    assert knee(table_of(s95=[(10.0, 2.0)], **ends)) is None


def test_without_an_improvement_no_share_of_it_is_kept():
    table = table_of(first_cost=9.0, no_penalty=FREE, s95=FREE, open_loop=BLIND)
    assert all(math.isnan(share) for share in table["improvement"])
    assert verdict(table).startswith("**Perhaps**")
