"""``sb3-tdpg tune``: what it searches, what it minimises, under which limit, and what it leaves."""

import csv
import math
import re
import sys
import tempfile
from pathlib import Path

import numpy as np
import optuna
import pytest
import yaml
from programs import start
from small_problems import error_line, tiny_tdpg
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg import TDPG, BatchedVecEnv
from sb3_tdpg.cli import main
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.evaluation.information import encode_episodes, information_bounds

pytest.importorskip("rl_zoo3")
from sb3_tdpg.zoo.search import put_in, read_space, relevant, sample
from sb3_tdpg.zoo.studies import open_storage
from sb3_tdpg.zoo.tuning import _Measuring, _rank, best_trial

SMALL = ["--env", "Lava-v0", "--block", "Lava-v0-logdet", "-params", "n_episodes:20", "--eval-episodes", "40"]
TINY = [*SMALL, "-n", "400", "--n-evaluations", "2"]


def test_sampled_values_lie_in_their_ranges_and_go_where_they_belong():
    space = read_space()
    block = dict(beta=0.1, learning_rate=1.0, policy_kwargs=dict(trv_dim=9, squash_trv_mean=False), n_episodes=7)
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
    for _ in range(20):
        values = sample(study.ask(), space)
        assert all(entry["low"] <= values[name] <= entry["high"] for name, entry in space.items())
        made = put_in(block, values, cost_scale=40.0)
        assert made["beta"] == pytest.approx(1 / (40 * values["mi_coef"]))
        assert float(made["learning_rate"].removeprefix("lin_")) == values["learning_rate"]
        assert made["policy_kwargs"]["trv_dim"] == values["policy_kwargs.trv_dim"]
        assert isinstance(made["policy_kwargs"]["trv_dim"], int)
        # The zoo's own samplers replace policy_kwargs as a whole.
        assert made["policy_kwargs"]["squash_trv_mean"] is False
        assert made["n_episodes"] == 7
    assert block["policy_kwargs"]["trv_dim"] == 9
    assert put_in({}, dict(learning_rate="lin_1e-3"), 1.0)["learning_rate"] == "lin_1e-3"  # one of the choices


def test_the_weight_is_not_sampled_where_there_is_none_to_choose():
    space = read_space()
    for beta in ("auto", math.inf):
        assert set(space) - set(relevant(space, dict(beta=beta))) == {"mi_coef"}
    assert relevant(space, dict(beta=0.1)) == space


@pytest.mark.parametrize(("text", "message"), [
    ("a: [", "cannot be read"),
    ("[]", "must map names of arguments to ranges"),
    ("foo: {low: 1, high: 2}", "foo of .* is no argument of TDPG"),
    ("gamma: 3", "gamma of .* must have numbers low and high .* It is 3 "),
    ("gamma: {low: 1}", "gamma of .* must have numbers low and high"),
    ("gamma: {low: 2, high: 1}", "gamma of .* must have .*low=2, high=1"),
    ("gamma: {low: 1e-3, high: 1}", r"gamma of .* \(1.0e-3, not 1e-3\).* It is {'low': '1e-3'"),
    ("gamma: {choices: 3}", "gamma of .* or choices"),
], ids=str)  # fmt: skip
def test_a_bad_space_is_refused_with_the_mend(text, message, tmp_path):
    path = tmp_path / "space.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        read_space(path)


def test_policies_under_the_limit_come_before_all_others_whatever_the_sign_of_the_cost():
    for limit in (40.0, -450.0):
        ranks = [_rank(cost, nats, limit) for cost, nats in ((limit - 1, 0.1), (limit - 9, 3.0), (limit, 1e6))]
        ranks += [_rank(limit + excess, 0.0, limit) for excess in (0.1, 20.0, 1e6)]
        assert ranks == sorted(ranks)
        assert len(set(ranks)) == len(ranks)
    assert _rank(12.0, 99.0, math.inf) == 12.0


def test_what_is_measured_is_on_fresh_episodes_and_leaves_the_training_alone():
    trained = tiny_tdpg(seed=3, beta=1.0).learn(600)
    env = BatchedVecEnv(LavaEnv(), 50)
    trial = optuna.create_study().ask()
    measuring = _Measuring(trial, env, 1e9, 100)
    watched = tiny_tdpg(seed=3, beta=1.0).learn(600, measuring)
    for a, b in zip(trained.policy.parameters(), watched.policy.parameters(), strict=True):
        assert (a == b).all()
    batch, costs = encode_episodes(watched, env, seed=trial.number)
    cost, information = measuring.measure()
    assert cost == costs.mean()
    assert information == pytest.approx(information_bounds(batch).upper)
    assert trial.user_attrs == dict(cost=cost, information=information)
    assert len(costs) == 50
    assert len(trial.study.get_trials()[trial.number].intermediate_values) == 5


def test_a_policy_is_measured_with_the_statistics_of_its_training():
    seen = VecNormalize(BatchedVecEnv(LavaEnv(), 20), norm_reward=False)
    model = tiny_tdpg(seen, seed=3, n_episodes=20, beta=1.0).learn(600)
    fresh = VecNormalize(BatchedVecEnv(LavaEnv(), 20), norm_reward=False, training=False)
    measuring = _Measuring(optuna.create_study().ask(), fresh, 1e9, 100)
    measuring.init_callback(model)
    measuring.measure()
    np.testing.assert_array_equal(fresh.obs_rms.mean, seen.obs_rms.mean)


def test_episodes_that_end_early_count_until_then():
    env = make_vec_env("CartPole-v1", n_envs=6, seed=0)
    model = tiny_tdpg("CartPole-v1", n_episodes=6, beta=1.0)
    batch, costs = encode_episodes(model, env)
    lengths = batch.alive.sum(dim=0).numpy()
    assert (lengths == -costs).all()  # a reward of 1 a step
    assert lengths.min() < 100
    env.close()


def test_the_best_trial_meets_the_limit():
    study = optuna.create_study()
    for value, excess in ((0.1, 5.0), (0.5, -1.0), (0.3, 0.0), (2.0, -9.0)):
        trial = study.ask()
        trial.set_constraint("cost", excess)
        study.tell(trial, value)
    assert best_trial(study).value == 0.3
    none = optuna.create_study()
    trial = none.ask()
    trial.set_constraint("cost", 1.0)
    none.tell(trial, 0.0)
    assert best_trial(none) is None


def test_tune_leaves_a_block_that_train_takes_and_the_same_command_goes_on(here, capsys):
    command = ["tune", *TINY, "--cost-limit", "1e6"]
    assert main([*command, "--n-trials", "3"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("trial ")]
    assert len(lines) == 3
    number = r"[\d.e+-]+"
    assert re.fullmatch(rf"trial 0: expected cost {number}, {number} nat \(1 of 3 finished\)", lines[0])
    folder = here / "logs" / "tdpg" / "study-Lava-v0-logdet-information"
    assert {p.name for p in folder.iterdir()} >= {"best.yml", "trials.csv", "study.json", "study.log"}
    assert main([*command, "--n-trials", "5"]) == 0
    trials = list(csv.DictReader((folder / "trials.csv").open()))
    complete = [trial for trial in trials if trial["state"] == "COMPLETE"]
    assert len(trials) == 5
    best = min(complete, key=lambda trial: float(trial["value"]))
    assert float(best["value"]) == float(best["user_attrs_information"])
    block = yaml.safe_load((folder / "best.yml").read_text())["Lava-v0-logdet"]
    assert block["policy_kwargs"]["trv_dim"] == int(best["params_policy_kwargs.trv_dim"])
    assert block["n_timesteps"] == 400

    assert main([*command, "--n-trials", "5", "-n", "500"]) == 2  # TINY's -n comes first
    assert "exists with other settings, block.n_timesteps: 400 there, 500 here" in capsys.readouterr().err

    train = ["train", "--env", "Lava-v0", "--block", "Lava-v0-logdet", "--eval-freq", "-1"]
    assert main([*train, "--conf-file", str(folder / "best.yml")]) == 0
    model = TDPG.load(here / "logs" / "tdpg" / "Lava-v0_1" / "Lava-v0.zip", device="cpu")
    assert (model.beta, model.num_timesteps) == (pytest.approx(block["beta"]), 400)


def test_keywords_of_the_environment_belong_to_the_study_and_its_best_block(here, capsys):
    command = ["tune", *TINY, "--cost-limit", "1e6", "--n-trials", "1", "-f", "my logs", "--env-kwargs"]
    assert main([*command, "action_cost:0.5"]) == 0
    assert f"--conf-file '{next(Path('my logs').rglob('best.yml'))}'" in capsys.readouterr().out
    (path,) = here.rglob("best.yml")
    assert yaml.safe_load(path.read_text())["Lava-v0-logdet"]["env_kwargs"] == dict(action_cost=0.5)
    line = error_line(capsys, *command, "action_cost:0.1")
    assert "exists with other settings, block.env_kwargs.action_cost: 0.5 there, 0.1 here" in line


def test_a_shifted_scenario_is_what_the_cost_is_of(here, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    shift = ["--eval-env-kwargs", "lava_terminal_cost:1e6"]
    assert main(["tune", *TINY, *shift, "--n-trials", "2"]) == 0
    assert not list(tmp_path.glob("SB3-*"))  # as SB3 makes in the system's folder for a training without a log
    folder = here / "logs" / "tdpg" / "study-Lava-v0-logdet-shift"
    trials = list(csv.DictReader((folder / "trials.csv").open()))
    assert all(float(trial["value"]) == float(trial["user_attrs_cost"]) > 1e3 for trial in trials)


def test_trials_that_fall_behind_are_pruned(here):
    command = ["tune", *SMALL, "-n", "2000", "--n-evaluations", "10", "--cost-limit", "1e6", "--n-startup-trials", "2"]
    assert main([*command, "--n-trials", "8", "--seed", "0"]) == 0
    (path,) = here.rglob("trials.csv")
    states = [trial["state"] for trial in csv.DictReader(path.open())]
    assert states.count("PRUNED") >= 1
    assert states.count("COMPLETE") >= 2
    assert len(states) == 8


def test_the_number_of_episodes_may_be_searched(here):
    (here / "space.yml").write_text("n_episodes: {choices: [20, 60]}")
    assert main(["tune", *TINY, "--n-trials", "2", "--seed", "0", "--space", "space.yml"]) == 0
    (path,) = here.rglob("trials.csv")
    assert {trial["state"] for trial in csv.DictReader(path.open())} == {"COMPLETE"}


@pytest.mark.slow
def test_two_workers_share_a_study(here):
    command = ["tune", *TINY, "--cost-limit", "1e6", "--n-trials", "6", "--storage", "study.log"]
    workers = [start(command, here) for _ in range(2)]
    outputs = [worker.communicate(timeout=300)[0] for worker in workers]
    assert [worker.returncode for worker in workers] == [0, 0], outputs
    study = optuna.load_study(study_name="Lava-v0-logdet-information", storage=open_storage("study.log"))
    finished = [trial for trial in study.trials if trial.state.name in ("COMPLETE", "PRUNED")]
    assert 6 <= len(finished) <= 6 + 2
    assert all("best of" in output for output in outputs)


@pytest.mark.parametrize(("sampler", "pruner"), [
    ("random", "median"),
    ("tpe", "halving"),
    *(pytest.param(*both, marks=pytest.mark.slow)
      for both in (("random", "none"), ("random", "halving"), ("tpe", "none"), ("tpe", "median"))),
])  # fmt: skip
def test_the_zoos_samplers_and_pruners_take_tdpg(sampler, pruner, here):
    arguments = ["--env", "CartPole-v1", "-n", "100", "-params", 'policy_kwargs:"dict(trv_dim=3)"', "n_envs:1"]
    arguments += ["n_episodes:2", "batch_size:100", "--seed", "14", "--log-folder", "elsewhere", "--n-trials", "2"]
    arguments += ["--n-jobs", "1", "--sampler", sampler, "--pruner", pruner, "--n-evaluations", "2"]
    arguments += ["--n-startup-trials", "1", "--optimization-log-path", "kept", "--eval-episodes", "40"]
    assert main(["tune", *arguments]) == 0
    assert len(list(here.glob("kept/trial_*/model.zip"))) == 2
    assert len(list(here.glob("elsewhere/tdpg/study-CartPole-v1-information/trials.csv"))) == 1


def test_a_limit_that_no_trial_meets_is_told(here, capsys):
    assert main(["tune", *TINY, "--cost-limit", "1e-6", "--n-trials", "2"]) == 0
    assert "no complete trial of Lava-v0-logdet-information keeps the cost below 1e-06" in capsys.readouterr().out
    assert not list(here.rglob("best.yml"))


@pytest.mark.parametrize("arguments, message", [
    (["--eval-env-kwargs", "foo:1"], "does not fit .TypeError: .*'foo'"),
    (["--storage", "postgresql://me:secret@127.0.0.1:1/db"], r"me:\*\*\*@127.0.0.1:1/db cannot be opened"),
    (["-params", "gamma:3"], "gamma=3 must"),
], ids=["keyword", "storage", "setting"])  # fmt: skip
def test_what_the_trials_would_fail_at_is_told_in_a_line(arguments, message, here, capsys):
    line = error_line(capsys, "tune", *TINY, *arguments)
    assert re.search(message, line)
    assert "secret" not in line
    assert not list(here.rglob("study.log"))


def test_other_algorithms_are_tuned_as_the_zoo_does_it(here, capsys):
    command = ["tune", "--algo", "a2c", "--env", "CartPole-v1", "-n", "200", "--n-trials", "1", "--eval-episodes", "1"]
    assert main([*command, "--n-evaluations", "1", "--no-optim-plots", "--seed", "0"]) == 0
    assert "Best trial" in capsys.readouterr().out
    assert list(here.glob("logs/a2c/report_*.csv"))
    assert sys.argv[0] != "sb3-tdpg tune"
