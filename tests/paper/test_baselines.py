"""The comparison with baselines in miniature: what is trained, evaluated, timed and written."""

import json
from pathlib import Path

import pandas as pd
import pytest
from sb3_contrib import RecurrentPPO
from small_problems import complete_runs_here
from stable_baselines3 import PPO

from sb3_tdpg.checks import schedule_of
from sb3_tdpg.cli import main
from sb3_tdpg.common.files import write_atomically
from sb3_tdpg.common.provenance import write_frame_atomically
from sb3_tdpg.envs.scenarios import LAVA
from sb3_tdpg.experiments import runs
from sb3_tdpg.experiments.runs import Run, SB3Run, complete_run
from sb3_tdpg.experiments.training import make_training, take_env
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.paper import baselines, grasp
from sb3_tdpg.paper.baselines import GRASP_BASELINES, LAVA_BASELINES, training_time, training_times
from sb3_tdpg.paper.common import Method

COMPARISONS = (LAVA_BASELINES, GRASP_BASELINES)
RESULTS = Path(__file__).parents[2] / "docs" / "results"


@pytest.fixture
def results(tmp_path):
    """Records of policies that are not trained again: each seed's costs are its number, and 50 for others' policies."""
    folder = tmp_path / "results"
    for each in COMPARISONS:
        rows = [
            (model, seed, row.name, episode, 50.0 if model == "another" else float(seed), 0, False)
            for model in ("another", *each.recorded)
            for seed in range(each.first_seed, each.first_seed + 10)
            for row in each.rows
            for episode in range(3)
        ]
        columns = ["model", "train_seed", "scenario", "episode", "cost", "seed", "deterministic"]
        write_frame_atomically(pd.DataFrame(rows, columns=columns), folder / each.records)
    return folder


@pytest.fixture
def tiny(monkeypatch):
    """Small batches, in this process."""
    run, sb3_run = Run.settings.fget, SB3Run.settings.fget
    small = dict(n_envs=4, batch_size=20, n_epochs=1)
    monkeypatch.setattr(Run, "settings", property(lambda self: {**run(self), "n_episodes": 20}))
    monkeypatch.setattr(SB3Run, "settings", property(lambda self: {**sb3_run(self), **small}))
    monkeypatch.setattr(baselines, "complete_runs", complete_runs_here)


@pytest.mark.slow
def test_from_nothing_to_the_table_and_the_records(tmp_path, tiny, results):
    out, published = tmp_path / "out", tmp_path / "docs"
    arguments = dict(n_seeds=2, n_eval_episodes=2, n_timesteps=100, records=results)
    summary = baselines.reproduce_baselines(out, publish=published, **arguments)

    assert (published / "summary.md").read_text() == summary
    assert {path.name for path in published.iterdir()} == {"summary.md", "seeds.csv", "episodes.csv.xz", "config.json"}
    for each in COMPARISONS:
        assert each.title in summary
        for label in (*each.recorded.values(), *(baseline.label for baseline in each.baselines if baseline.is_shown)):
            assert f"| {label} | " in summary
    assert "first stage" not in summary
    # Of a method with records the table has these, of its first five seeds, and not the training for its time.
    plain = summary.replace("**", "")
    assert "| TDPG (log-det) | 5 | 302.00 " in plain
    assert "| VIB | 2 | " in plain
    # One seed has no interval.
    assert "| PPO | 1 | " in plain
    assert "[" not in plain.split("## Grasping")[1].split("| PPO | 1 | ")[1].split("\n")[0]
    n_runs = [
        sum(min(n, baseline.max_seeds) for baseline in each.baselines)
        for each, n in zip(COMPARISONS, (2, 1), strict=True)
    ]
    records = pd.read_csv(out / "episodes.csv.xz")
    assert len(records) == 2 * sum(n * len(each.rows) for each, n in zip(COMPARISONS, n_runs, strict=True))
    assert not records.isna().any().any()
    assert records.groupby("env_id")["train_seed"].unique().map(list).to_dict() == {
        "Lava-v0": [300, 301],
        "PandaGrasp-v0": [100],
    }
    seeds = pd.read_csv(out / "seeds.csv")
    assert (seeds[["cpu_s", "wall_s"]] > 0).all().all()
    means = records.groupby(["env_id", "model", "train_seed", "scenario"])["cost"].mean()
    for row in seeds.itertuples():
        assert row.cost == pytest.approx(means[row.env_id, row.model, row.train_seed, row.scenario], abs=1e-3)

    models = {path.parent: path.stat().st_mtime_ns for path in out.rglob("model.zip")}
    assert baselines.reproduce_baselines(out, **arguments).split("Made by")[0] == summary.split("Made by")[0]
    assert models == {path.parent: path.stat().st_mtime_ns for path in out.rglob("model.zip")}, "trained again"


@pytest.mark.parametrize(("algo", "cls"), [("ppo", PPO), ("ppo_lstm", RecurrentPPO)])
def test_a_run_of_sb3_is_the_model_that_its_block_makes(algo, cls, tmp_path, tiny):
    run = Method("baseline", "Lava-v0", algo=algo, overrides=dict(n_timesteps=200)).run("Lava-v0", 3)
    complete_run(run, tmp_path / "run", LAVA[:1], n_eval_episodes=4)

    settings = run.settings
    n_timesteps, policy = settings.pop("n_timesteps"), settings.pop("policy")
    env = take_env("Lava-v0", settings)
    settings["learning_rate"] = schedule_of("learning_rate", settings["learning_rate"])
    model = cls(policy, env, **settings, seed=3, device="cpu").learn(n_timesteps)
    saved = cls.load(tmp_path / "run" / "model.zip", device="cpu")
    for name, value in model.policy.state_dict().items():
        assert (saved.policy.state_dict()[name] == value).all(), name
    assert saved.num_timesteps == 200
    assert (tmp_path / "run" / "progress_00000000.csv").stat().st_size > 0
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (config["algo"], config["seed"], config["settings"]["gae_lambda"]) == (algo, 3, 0.7)


def test_a_model_that_was_half_written_when_a_run_was_killed_is_trained_anew(tmp_path, tiny, monkeypatch):
    run = Method("baseline", "Lava-v0", algo="ppo", overrides=dict(n_timesteps=20)).run("Lava-v0", 3)
    save = PPO.save

    def killed(self, path, *args, **kwargs):
        Path(path).write_bytes(b"half")
        raise KeyboardInterrupt

    monkeypatch.setattr(PPO, "save", killed)
    with pytest.raises(KeyboardInterrupt):
        complete_run(run, tmp_path / "run", LAVA[:1], n_eval_episodes=2)
    monkeypatch.setattr(PPO, "save", save)
    complete_run(run, tmp_path / "run", LAVA[:1], n_eval_episodes=2)
    assert PPO.load(tmp_path / "run" / "model.zip", device="cpu").num_timesteps == 20
    assert not list((tmp_path / "run").rglob("*.partial*"))


def test_the_time_of_a_training_is_that_of_all_attempts_and_of_all_its_parts(tmp_path, tiny, monkeypatch):
    class Clock:
        now = 0.0

        def __call__(self):
            return self.now

    wall, cpu = Clock(), Clock()
    monkeypatch.setattr(runs.time, "perf_counter", wall)
    monkeypatch.setattr(runs.time, "process_time", cpu)

    def train(run, attempt, folder, progress_bar):
        folder.mkdir(parents=True, exist_ok=True)
        wall.now += 10.0
        cpu.now += 3.0
        if wall.now == 20.0:
            raise KeyboardInterrupt
        return PPO("MlpPolicy", "Lava-v0", device="cpu"), wall.now == 40.0

    monkeypatch.setattr(Run, "_train", train)
    run = Run("TDPG", "Lava-v0", "Lava-v0-logdet", 0, max_attempts=3)
    with pytest.raises(KeyboardInterrupt):
        complete_run(run, tmp_path, LAVA[:1], n_eval_episodes=2)
    complete_run(run, tmp_path, LAVA[:1], n_eval_episodes=2)
    # The first attempt was called twice (its model was not kept here), the interrupted one leaves no time.
    assert training_time(tmp_path) == dict(wall_s=30.0, cpu_s=9.0)


def test_the_time_of_a_second_stage_holds_that_of_the_first(tmp_path, monkeypatch):
    tasks = [task for task in GRASP_BASELINES.tasks(1, tmp_path) if task[0].method[:3] in ("fir", "VIB")]
    for (run, folder, _), seconds in zip(tasks, (100.0, 30.0), strict=True):
        write_atomically(path_of_time(folder), json.dumps(dict(wall_s=seconds, cpu_s=seconds / 2)))
        assert run.start == (None if run.method == "first stage" else tasks[0][1])
    table = training_times(tasks)
    assert list(table["wall_s"]) == [100.0, 130.0]
    assert list(table["cpu_s"]) == [50.0, 65.0]


def path_of_time(folder):
    folder.mkdir(parents=True)
    return folder / "time.json"


def test_weight_decay_reaches_the_optimiser_and_changes_nothing_else():
    model = baselines.with_weight_decay("Lava-v0-pg", 100).run("Lava-v0", 0)
    kwargs = load_hyperparams("Lava-v0-pg")["policy_kwargs"]
    changes = dict(n_timesteps=100, policy_kwargs={**kwargs, "optimizer_kwargs": {"weight_decay": 0.001}})
    assert model.overrides == changes
    optimizer = make_training("Lava-v0", model.settings).model.policy.optimizer
    assert [group["weight_decay"] for group in optimizer.param_groups] == [0.001] * len(optimizer.param_groups)


def settings_of(comparison):
    return {baseline.label: baseline.run(comparison.env_id, 0).settings for baseline in comparison.baselines}


def changed(one, other):
    return {key for key in one.keys() | other.keys() if one.get(key) != other.get(key)}


@pytest.mark.parametrize("comparison", COMPARISONS, ids=lambda comparison: comparison.env_id)
def test_the_baselines_of_one_table_have_as_many_steps_as_tdpg_in_all_stages(comparison):
    of_tdpg = {
        "Lava-v0": load_hyperparams("Lava-v0-logdet")["n_timesteps"],
        "PandaGrasp-v0": load_hyperparams("PandaGrasp-v0-pg")["n_timesteps"] + grasp.SECOND_STAGE["n_timesteps"],
    }
    settings = settings_of(comparison)
    for baseline in comparison.baselines:
        if baseline.is_shown:
            steps = sum(settings[label]["n_timesteps"] for label in (baseline.label, baseline.start) if label)
            assert steps == of_tdpg[comparison.env_id], baseline


def test_a_baseline_differs_in_what_its_name_says():
    lava, on_grasp = (settings_of(comparison) for comparison in COMPARISONS)
    assert changed(lava["TDPG (log-det)"], lava["VIB"]) == {"mi_estimator"}
    assert changed(lava["PG"], lava["PG, weight decay"]) == {"policy_kwargs"}
    attempts = {baseline.label: baseline.max_attempts for baseline in LAVA_BASELINES.baselines}
    assert attempts["TDPG (log-det)"] == attempts["VIB"]
    # And from the methods of the tables of which the records are.
    (tdpg,) = (method for method in grasp.METHODS["fixed"] if method.label == "TDPG")
    assert changed({**load_hyperparams(tdpg.block), **tdpg.overrides}, on_grasp["VIB"]) == {"mi_estimator"}


def test_without_the_records_it_says_how_to_make_them_and_trains_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["reproduce", "baselines"]) == 2
    assert "make reproduce-lava reproduce-grasp" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "arguments",
    [["grasp", "--n-grasp-seeds", "2"], ["baselines", "--n-paper-seeds", "2"], ["ball", "--n-paper-seeds", "2"]],
)
def test_an_option_of_another_experiment_is_refused(arguments, capsys):
    assert main(["reproduce", *arguments]) == 2
    assert arguments[1] in capsys.readouterr().err


@pytest.mark.skipif(
    not all((RESULTS / each.records).exists() for each in COMPARISONS), reason="the records of the release are not here"
)
def test_the_records_of_the_release_have_what_the_table_takes_from_them():
    for each in COMPARISONS:
        records = each.read_recorded(RESULTS, 1000)
        counts = records.groupby(["model", "train_seed", "scenario"]).size()
        assert len(counts) == len(each.recorded) * baselines.N_RECORDED_SEEDS * len(each.rows)
        assert (counts == 1000).all()
        assert set(records["seed"]) == {0}
        assert not records["deterministic"].any()
