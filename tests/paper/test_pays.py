"""Where the bottleneck pays, in miniature: faults, methods, tables."""

import numpy as np
import pandas as pd
import pytest
from small_problems import complete_runs_here

from sb3_tdpg import TDPG, make_episodes_env
from sb3_tdpg.cli import main
from sb3_tdpg.envs.scenarios import PANDA_SQUEEZE, Scenario
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.experiments.training import make_training
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.paper import pays
from sb3_tdpg.paper.pays import MEAN, PROBLEMS, TRAINING, WORST, with_summary


def observed(row: Scenario, action=0.0):
    """The observations of an episode of many environments under a fault, ``(T, N, D)``."""
    env = make_episodes_env(row.env_id, 500, env_kwargs=row.env_kwargs, seed=0)
    env = env if row.sensor is None else row.sensor(env)
    seen = [env.reset()]
    for _ in range(3):
        seen.append(env.step(np.full((500, *env.action_space.shape), action, np.float32))[0])
    return np.stack(seen)


def rows(name, label="TDPG"):
    problem = PROBLEMS[name]
    method = next(m for m in problem.methods() if m.label == label)
    return {row.name: row for row in problem.rows(method)}


def test_a_fault_is_as_strong_as_its_name_says():
    of_squeeze = rows("squeeze")
    clean = observed(of_squeeze[TRAINING])
    for name, std in (("noise 1", 1.0), ("noise 2", 2.0)):
        assert (observed(of_squeeze[name]) - clean).std() == pytest.approx(std, rel=0.05)
    assert np.abs(observed(of_squeeze["bias 1"]) - clean) == pytest.approx(1.0, abs=1e-4)
    ratio = observed(of_squeeze["scale 2"]) / clean
    assert set(np.round(ratio.ravel(), 2)) == {0.5, 2.0}
    assert (observed(of_squeeze["dropout .7"]) == 0).mean() == pytest.approx(0.7, abs=0.03)


def test_the_cue_never_fails():
    of_cue = rows("cue")
    clean = observed(of_cue[TRAINING])[..., 2]
    for name in pays._NO_BLACKOUT:
        if name != "group failure":  # after which the environment would name its groups
            np.testing.assert_array_equal(observed(of_cue[name])[..., 2], clean)


def test_the_cue_has_a_recipe_and_shows_the_defaults_beside_it():
    methods = {method.label: method for method in PROBLEMS["cue"].methods()}
    models = {
        label: make_training(
            "SqueezeInsert-v0", load_hyperparams(methods[label].block), **methods[label].overrides
        ).model
        for label in ("TDPG", pays.BY_DEFAULT, "TDPG, logdet", "PG, noise to 1")
    }
    by_default = TDPG("TRVPolicy", "SqueezeInsert-v0")
    for name in ("beta", "mi_estimator"):
        assert getattr(models[pays.BY_DEFAULT], name) == getattr(by_default, name)
        assert getattr(models["TDPG"], name) != getattr(by_default, name)
    assert models["TDPG, logdet"].beta == models["TDPG"].beta
    assert {model.policy.trv_dim for model in models.values()} == {8}
    assert pays.BY_DEFAULT not in {method.label for method in PROBLEMS["squeeze"].methods()}


@pytest.mark.slow
def test_the_recipe_keeps_the_cue_and_drops_the_yaw():
    training = make_training("SqueezeInsert-v0", load_hyperparams("SqueezeInsert-v0-cue"), seed=1)
    model = training.model.learn(training.n_timesteps)
    of_cue = rows("cue")
    records = evaluate_scenarios({"TDPG": model}, [of_cue[name] for name in (TRAINING, "noise 2", "scale 2")], 500)
    costs = records.groupby("scenario")["cost"].mean()
    assert costs.max() < 12  # 90 without the cue; the ablation costs 40 under its worst fault
    information = model.estimator(model.rollout_buffer.episode_batch().information_batch())
    assert 0.6 < information.sum() < 1.2  # a bit is 0.69 nats


def test_a_blind_policy_stays_blind_under_every_fault_and_meets_those_of_the_plant():
    of_lava = rows("lava", pays.BLIND)
    expected = observed(of_lava[TRAINING])
    for row in of_lava.values():
        np.testing.assert_array_equal(observed(row), expected)
    env = of_lava["actuator gain 1.2"].sensor(make_episodes_env("Lava-v0", 400, seed=0))
    env.reset()
    speeds = env.step(np.full((400, 1), 1.0, np.float32))[3]
    assert {round(abs(float(info["state"][1])), 3) for info in speeds} <= {1.2, 0.833, 0.0}


def test_those_that_were_told_train_on_the_faults_of_the_sensor_and_no_others():
    told = next(m for m in PROBLEMS["lava"].methods() if m.label == "PPO, told the faults")
    (wrapper,) = told.overrides["vec_env_wrapper"]
    (settings,) = wrapper.values()
    plain, *faults = settings["perturbation"]
    names = [name for name, *_ in faults]
    assert plain is None
    assert len(names) == len(pays.FAULTS)
    assert "actuator_gain" not in names


@pytest.mark.parametrize("name", PROBLEMS)
def test_every_method_builds_and_takes_as_many_steps(name):
    for method in PROBLEMS[name].methods():
        run = method.run(PROBLEMS[name].env_id, 0)
        assert run.settings["n_timesteps"] == load_hyperparams(PROBLEMS[name].block)["n_timesteps"]
        if method.algo == "tdpg":
            make_training(run.env_id, run.settings, n_episodes=10, seed=0)


def test_the_worst_fault_is_that_of_each_policy():
    costs = {
        ("A", 0): dict(Training=1, x=5, y=2),
        ("A", 1): dict(Training=1, x=3, y=9),
        ("B", 0): dict(Training=0, x=1, y=1.5),
    }
    records = pd.DataFrame(
        [
            dict(model=model, train_seed=seed, scenario=row, cost=cost + noise)
            for (model, seed), of_row in costs.items()
            for row, cost in of_row.items()
            for noise in (-0.5, 0.5)
        ]
    )
    means = with_summary(records).groupby(["model", "train_seed", "scenario"])["cost"].mean()
    assert [means["A", 0, WORST], means["A", 1, WORST], means["B", 0, WORST]] == [5, 9, 1.5]
    assert [means["A", 0, MEAN], means["A", 1, MEAN], means["B", 0, MEAN]] == [3.5, 6, 1.25]


def test_the_table_of_faults_shows_each_cost_where_it_belongs():
    by_seed = pd.DataFrame(
        [
            dict(model=model, train_seed=seed, scenario=row, cost=cost + seed)
            for model, costs in (("B", (1, 2, 3)), ("A", (10, 30, 20)))
            for row, cost in zip((TRAINING, "z", "a"), costs, strict=True)
            for seed in (-1, 1)
        ]
    )
    table = pays._faults_table(by_seed).set_index("method")
    assert table.to_dict("index") == {
        "B": {TRAINING: "1", "z": "2", "a": "3"},
        "A": {TRAINING: "10", "z": "30", "a": "20"},
    }


def test_from_nothing_to_tables_figure_and_records(tmp_path, monkeypatch):
    wanted = {"TDPG", pays.NO_PENALTY, pays.BLIND, "PG, noise to 1, 4 or 10", "PPO, told the faults"}
    methods = pays.Problem.methods
    monkeypatch.setattr(pays.Problem, "methods", lambda problem: [m for m in methods(problem) if m.label in wanted])
    monkeypatch.setattr(pays, "complete_runs", lambda tasks, **given: complete_runs_here(tasks, n_eval_episodes=4))
    arguments = ["--n-seeds", "2", "--n-timesteps", "2000", "--publish", str(tmp_path / "docs")]
    assert main(["reproduce", "pays", "--out", str(tmp_path / "out"), *arguments]) == 0
    summary = (tmp_path / "out" / "summary.md").read_text()
    for text in (*wanted, "## Lava", "`sb3-tdpg reproduce pays` at", "| TDPG | Training | <= 7.9 |"):
        assert text in summary
    assert main(["reproduce", "pays-cue", "--no-controls", "--out", str(tmp_path / "cue"), *arguments[:4]]) == 0
    summary = (tmp_path / "cue" / "summary.md").read_text()
    assert "sb3-tdpg reproduce pays-cue --no-controls" in summary
    assert "PPO" not in summary
    seeds = pd.read_csv(tmp_path / "docs" / "seeds.csv")
    seeds = seeds[(seeds["problem"] == "squeeze") & (seeds["model"] == "TDPG")]
    of_tdpg = seeds[seeds["train_seed"] == 500].set_index("scenario")["cost"]
    assert of_tdpg[WORST] == pytest.approx(of_tdpg.drop([TRAINING, MEAN, WORST]).max())
    assert (tmp_path / "docs" / "pays.png").stat().st_size > 5000


def test_policies_of_the_fitted_model_are_carried_over_to_pybullet():
    problem = PROBLEMS["panda"]
    assert {row.env_id for row in rows("panda").values()} == {"PandaSqueeze-v0"}
    assert all(not row.env_kwargs and row.n_episodes == 200 for row in rows("panda").values())
    for method in problem.methods():
        run = method.run(problem.env_id, 0)
        assert run.env_id == "SqueezeInsert-v0"
        assert run.settings["env_kwargs"] == dict(PANDA_SQUEEZE)


def test_the_largest_fall_is_that_of_the_worst_fault_of_each_seed():
    shares = {(0, TRAINING): 0.0, (0, "noise"): 0.5, (0, "bias"): 0.25, (1, TRAINING): 0.25, (1, "noise"): 0.0}
    shares[1, "bias"] = 0.5
    records = pd.DataFrame(
        dict(model="A", train_seed=seed, scenario=row, failure=i < 4 * share)
        for (seed, row), share in shares.items()
        for i in range(4)
    )
    table = pays._successes_table(records).iloc[0]
    assert table[["method", TRAINING, "noise", "bias"]].tolist() == ["A", "87.5", "75.0", "62.5"]
    assert table["largest fall"] == "37.5 (25.0 to 50.0)"
