"""The sweep over beta, from the command to results, with tiny trainings; interrupted, and killed."""

import json
import math
import multiprocessing as mp
import re
import time

import numpy as np
import pandas as pd
import pytest
import torch as th
from small_problems import tiny_tdpg

optuna = pytest.importorskip("optuna")
pytest.importorskip("matplotlib")

from postgres import postgres  # noqa: E402, F401

from sb3_tdpg import TDPG  # noqa: E402
from sb3_tdpg.envs.scenarios import LAVA  # noqa: E402
from sb3_tdpg.evaluation.information import information_bounds, rollout_information  # noqa: E402
from sb3_tdpg.experiments.studies import enqueue_once, open_storage  # noqa: E402
from sb3_tdpg.experiments.sweep import beta_label, parse_inverse_beta, select, sweep  # noqa: E402
from sb3_tdpg.information import InformationBatch  # noqa: E402
from sb3_tdpg.information.loo import own_sample_bound  # noqa: E402

SETTINGS = dict(mi_estimator="logdet", n_episodes=20, policy_kwargs=dict(net_arch=dict(encoder=[8], action_head=[8])))


def quick_sweep(out, env_id="Lava-v0", **kwargs):
    defaults = dict(betas=["1/25", "inf"], n_seeds=2, cost_limit=1e6, n_timesteps=400, n_eval_episodes=8)
    return sweep(env_id, out=out, **{**defaults, "settings": SETTINGS, **kwargs})


def assert_complete(out, n_runs):
    runs = pd.read_csv(out / "runs.csv")
    assert len(runs) == n_runs
    assert not runs.duplicated(["label", "seed"]).any()
    assert np.isfinite(runs[["cost", "information", "information_lower", "cost: Sensor noise 1e0"]]).all(axis=None)
    assert (out / "sweep.png").read_bytes().startswith(b"\x89PNG")
    assert "## Robustness" in (out / "summary.md").read_text()
    return runs


def test_a_sweep_writes_everything_that_it_promises_and_a_second_call_trains_nothing(tmp_path, monkeypatch):
    text = quick_sweep(tmp_path, jobs=1, n_seeds=1)
    runs = assert_complete(tmp_path, 2)
    assert runs["label"].tolist() == ["inf", "1/25"]
    for folder in runs["folder"]:
        episodes = pd.read_csv(tmp_path / "runs" / folder / "episodes.csv")
        assert len(episodes) == 8 * len(LAVA)
        row = runs[runs["folder"] == folder].iloc[0]
        of_training = episodes[episodes["scenario"] == "Training"]
        assert of_training["cost"].mean() == pytest.approx(row["cost"])
    config = json.loads((tmp_path / "runs" / "beta-1-25-seed0" / "config.json").read_text())
    assert config["settings"]["beta"] == 1 / 25
    assert config["settings"]["mi_estimator"] == "logdet"
    assert TDPG.load(tmp_path / "runs" / "beta-inf-seed0" / "model.zip").mi_coef == 0

    selected = json.loads((tmp_path / "selected.json").read_text())
    assert f"**Selected: beta = {selected['beta']}, seed {selected['seed']}**" in text
    model = tmp_path / "runs" / selected["folder"] / "model.zip"
    assert (tmp_path / "selected.zip").read_bytes() == model.read_bytes()

    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("*")}
    monkeypatch.setattr(TDPG, "learn", lambda *args, **kwargs: pytest.fail("it trains again"))
    assert quick_sweep(tmp_path, n_seeds=1, jobs=1).split("\n\n")[:-1] == text.split("\n\n")[:-1]
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "runs").rglob("*")} == before


def test_a_run_that_diverges_is_told_and_the_others_are_kept(tmp_path):
    text = quick_sweep(tmp_path, "sb3_tdpg:Lava-v0", betas=["1e-37", "inf"], jobs=1, n_seeds=1)
    assert_complete(tmp_path, 1)
    assert re.search(r"## Failed.*seed0`: .*NaN or infinite", text, re.DOTALL)
    assert (tmp_path / "selected.zip").exists()


def test_if_no_run_is_below_the_limit_none_is_selected_and_an_earlier_one_is_removed(tmp_path):
    storage = str(tmp_path / "study.log")
    quick_sweep(tmp_path, storage=storage, n_seeds=1)
    assert (tmp_path / "selected.zip").exists()
    text = quick_sweep(tmp_path, storage=storage, n_seeds=1, cost_limit=0.5)
    assert "**No run costs less than 0.5, so none is selected**" in text
    assert not (tmp_path / "selected.zip").exists()
    assert not (tmp_path / "selected.json").exists()


def run_sweep(out, storage):
    th.set_num_threads(1)
    quick_sweep(out, storage=storage, grace_period=2, n_timesteps=5000, n_seeds=1)


def test_a_worker_that_is_killed_costs_no_run(tmp_path, postgres):  # noqa: F811
    storage = postgres.create_database("sweep_killed")
    worker = mp.get_context("forkserver").Process(target=run_sweep, args=(tmp_path, storage))
    worker.start()
    try:
        deadline = time.monotonic() + 120
        while not list(tmp_path.glob("runs/*/attempt0/*")):  # in the middle of a training
            assert time.monotonic() < deadline
            assert worker.is_alive()
            time.sleep(0.02)
    finally:
        worker.kill()
        worker.join()
    assert not list(tmp_path.glob("runs/*/episodes.csv"))
    run_sweep(tmp_path, storage)
    assert_complete(tmp_path, 2)
    study = optuna.load_study(study_name="sweep-Lava-v0", storage=open_storage(storage))
    assert sorted(trial.state.name for trial in study.trials) == ["COMPLETE"] * 2 + ["FAIL"]


def test_an_interrupted_sweep_goes_on(tmp_path, monkeypatch):
    storage = str(tmp_path / "study.log")
    learn, calls = TDPG.learn, []

    def interrupted_learn(model, *args, **kwargs):
        calls.append(model.seed)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return learn(model, *args, **kwargs)

    monkeypatch.setattr(TDPG, "learn", interrupted_learn)
    with pytest.raises(KeyboardInterrupt):
        quick_sweep(tmp_path, storage=storage)
    quick_sweep(tmp_path, storage=storage)
    assert_complete(tmp_path, 4)
    assert len(calls) == 5  # the interrupted one twice, the others once


def test_a_worker_with_a_folder_of_its_own_writes_all_results_and_says_where_the_model_is(tmp_path):
    storage = str(tmp_path / "study.log")
    quick_sweep(tmp_path / "one", storage=storage, n_seeds=1)
    text = quick_sweep(tmp_path / "other", storage=storage, n_seeds=1)
    assert_complete(tmp_path / "other", 2)
    first, other = (pd.read_csv(tmp_path / name / "runs.csv") for name in ("one", "other"))
    pd.testing.assert_frame_equal(first, other)
    assert "not in this folder" in text
    assert not (tmp_path / "other" / "selected.zip").exists()


def test_more_seeds_and_betas_add_to_a_study_and_other_settings_are_refused(tmp_path):
    storage = str(tmp_path / "study.log")
    quick_sweep(tmp_path, storage=storage, n_seeds=1, betas=["1/25"])
    quick_sweep(tmp_path, storage=storage, n_seeds=2, betas=["0.04", "1/50"])
    runs = assert_complete(tmp_path, 4)
    assert set(runs["label"]) == {"1/25", "1/50"}
    with pytest.raises(ValueError, match=r"settings.n_timesteps: 400 there, 800 here"):
        quick_sweep(tmp_path, storage=storage, n_timesteps=800)


def test_a_training_that_fails_is_named_in_the_summary(tmp_path, monkeypatch):
    learn = TDPG.learn

    def failing_learn(model, *args, **kwargs):
        if model.seed == 1:
            raise ValueError("the policy has diverged")
        return learn(model, *args, **kwargs)

    monkeypatch.setattr(TDPG, "learn", failing_learn)
    text = quick_sweep(tmp_path, storage=str(tmp_path / "study.log"), betas=["inf"])
    assert_complete(tmp_path, 1)
    assert '- `{"inverse_beta": 0.0, "seed": 1}`: the policy has diverged' in text


@pytest.mark.parametrize("storage", [None, "study.log"])
def test_a_folder_with_another_run_is_refused_before_any_training_and_does_not_spoil_the_study(storage, tmp_path):
    storage = storage and str(tmp_path / storage)
    quick_sweep(tmp_path / "out", betas=["1/50"], n_seeds=1, n_timesteps=800)
    before = sorted(tmp_path.rglob("out/*"))
    with pytest.raises(ValueError, match=r"beta-1-50-seed0 holds .* settings.n_timesteps: 800 there, 400 here: choose"):
        quick_sweep(tmp_path / "out", storage=storage, betas=["inf", "1/50"], n_seeds=1)
    assert sorted(tmp_path.rglob("out/*")) == before
    if storage:
        quick_sweep(tmp_path / "elsewhere", storage=storage, betas=["inf", "1/50"], n_seeds=1)
        assert_complete(tmp_path / "elsewhere", 2)


def test_a_job_of_another_worker_for_which_there_is_no_place_here_is_left_to_others(tmp_path):
    storage = str(tmp_path / "study.log")
    quick_sweep(tmp_path / "out", betas=["1/50"], n_seeds=1, n_timesteps=800)
    quick_sweep(tmp_path / "mine", storage=storage, betas=["inf"], n_seeds=1)
    study = optuna.load_study(study_name="sweep-Lava-v0", storage=open_storage(storage))
    enqueue_once(study, [dict(inverse_beta=50.0, seed=0)])
    with pytest.raises(FileExistsError, match="holds a run with other settings"):
        quick_sweep(tmp_path / "out", storage=storage, betas=["inf"], n_seeds=1)
    quick_sweep(tmp_path / "mine", storage=storage, betas=["inf"], n_seeds=1)
    assert_complete(tmp_path / "mine", 2)


def test_several_workers_of_one_machine_run_each_job_once(tmp_path):
    quick_sweep(tmp_path, storage=str(tmp_path / "study.log"), jobs=2)
    assert_complete(tmp_path, 4)


def runs_of(*rows):
    return pd.DataFrame(rows, columns=["cost", "information"])


def test_the_selected_run_has_the_least_information_of_those_below_the_limit():
    runs = runs_of((10.0, 3.0), (39.0, 0.5), (40.0, 0.1), (20.0, 0.7))
    assert select(runs, 40.0)["cost"] == 39.0
    assert select(runs, 30.0)["cost"] == 20.0
    assert select(runs, 10.0) is None
    # Of runs that know about nothing the cheapest is selected.
    assert select(runs_of((30.0, 0.001), (17.0, 0.004), (16.0, 0.02)), 40.0)["cost"] == 17.0


@pytest.mark.parametrize(
    ("text", "inverse", "label"),
    [("1/25", 25, "1/25"), ("0.04", 25, "1/25"), (1 / 75, 75, "1/75"), ("3/10", 10 / 3, "0.3"), ("2", 0.5, "2"),
     ("1", 1, "1"), ("inf", 0, "inf"), (math.inf, 0, "inf")],
)  # fmt: skip
def test_a_beta_is_a_number_a_fraction_or_inf(text, inverse, label):
    assert parse_inverse_beta(text) == pytest.approx(inverse)
    assert beta_label(parse_inverse_beta(text)) == label


@pytest.mark.parametrize("text", ["0", "-1/25", "1/0", "0/1", "nan", "1/25/3", "often", "", "1/inf", "inf/inf"])
def test_a_bad_beta_is_named(text):
    with pytest.raises(ValueError, match=r"beta=.* must be a positive number") as caught:
        parse_inverse_beta(text)
    assert repr(text) in str(caught.value)


@pytest.mark.parametrize(("kwargs", "message"), [
    (dict(betas=[]), "at least one beta"),
    (dict(block="Lava-v1"), "has no block 'Lava-v1'"),
    (dict(storage="nowhere"), "storage='nowhere' must be"),
    (dict(storage="study.log", grace_period=-1.0), "grace_period=-1.0 must be"),
    (dict(study_name="s"), "needs a storage"),
    (dict(cost_limit=math.nan), "NaN"),
    (dict(settings={"beta": 0.1}), "beta is varied by the sweep"),
    (dict(settings={"learning_rat": 1.0}), "learning_rat"),
    (dict(settings={"n_episodes": 1}), r"n_episodes=1 .*at least 2"),
    (dict(env_id="Lave-v0"), "env='Lave-v0' is not registered"),
], ids=str)  # fmt: skip
def test_bad_input_is_named_before_anything_is_trained(tmp_path, kwargs, message):
    with pytest.raises(ValueError, match=message):
        quick_sweep(tmp_path, **kwargs)
    assert not list(tmp_path.iterdir())


def of_gaussian_noise(means):
    return InformationBatch(means, means + th.randn_like(means), means, th.ones_like(means))


# The TRVs are a sample, which alone would give the lower bound of the faint ones an error of ten times the truth.
@pytest.mark.parametrize(("spread", "n_steps", "n_episodes", "tolerances"), [
    (2.0, 3, 2000, (dict(abs=0.1), dict(abs=0.2))),
    (0.02, 5, 1000, (dict(rel=0.25), dict(rel=0.25))),
])  # fmt: skip
def test_bounds_enclose_the_information_of_a_gaussian_channel(spread, n_steps, n_episodes, tolerances):
    exact = n_steps * 2 * 0.5 * math.log(1 + spread**2)  # in each of two components, at each step
    for _ in range(5):
        bounds = information_bounds(of_gaussian_noise(spread * th.randn(n_steps, n_episodes, 2)))
        assert bounds.upper == pytest.approx(exact, **tolerances[0])
        assert bounds.lower == pytest.approx(exact, **tolerances[1])


@pytest.mark.parametrize("n_episodes", [5, 40, 1000])
@pytest.mark.parametrize("spread", [0.0, 0.02, 1.0])
def test_the_bound_from_below_is_never_above_the_one_from_above(spread, n_episodes):
    for _ in range(20):
        bounds = information_bounds(of_gaussian_noise(spread * th.randn(5, n_episodes, 2)))
        assert bounds.lower <= bounds.upper


def test_the_bound_from_below_is_that_of_the_own_sample_with_less_noise():
    modes = 3.0 * th.randint(0, 2, (40, 1, 400, 2)).float()
    skew = th.randn(40, 1, 400, 2).exp()
    for means in (modes, skew):
        batches = [of_gaussian_noise(each) for each in means]
        plain = np.array([own_sample_bound(batch).item() for batch in batches])
        lower = np.array([information_bounds(batch).lower for batch in batches])
        assert (lower - plain).mean() == pytest.approx(0.0, abs=4 * (lower - plain).std() / math.sqrt(len(plain)))
        assert lower.std() < 1.1 * plain.std()


@pytest.mark.parametrize(("n_alive", "counts"), [(0, 1), (4, 2)])
def test_a_step_with_few_living_episodes_knows_as_much_as_the_last_with_enough_and_one_with_none_nothing(
    n_alive, counts
):
    x = th.randn(2, 500, 3)
    alive = th.ones(2, 500, dtype=th.bool)
    alive[1, n_alive:] = False  # 3 TRVs take 5 episodes
    batch = InformationBatch(x, x, x, th.ones_like(x), alive)
    first = information_bounds(InformationBatch(*(v[:1] for v in batch[:4])))
    assert information_bounds(batch) == (counts * first.upper, counts * first.lower)
    with pytest.raises(ValueError, match="3 TRVs cannot be estimated from 4 episodes: it takes at least 5"):
        information_bounds(InformationBatch(*(v[:, :4] for v in batch[:4])))


def test_rollouts_for_the_information_are_those_of_the_policy():
    model = tiny_tdpg(n_episodes=400)
    model.learn(model.n_episodes * model.horizon)
    with th.no_grad():
        in_training = model.estimator(model.rollout_buffer.episode_batch().information_batch()).sum().item()
    fresh = rollout_information(model, LAVA[0], 2000)
    assert fresh.trvs.shape == (model.horizon, 2000, model.policy.trv_dim)
    assert fresh.states.shape == (model.horizon, 2000, 2)
    # The start positions are drawn, and so is the noise of the TRVs.
    noise = (fresh.trvs - fresh.means) / fresh.stds
    assert noise.std().item() == pytest.approx(1.0, abs=0.05)
    assert information_bounds(fresh).upper == pytest.approx(in_training, rel=0.35, abs=0.02)
    again = rollout_information(model, LAVA[0], 2000)
    assert (again.trvs == fresh.trvs).all()
