"""The robustness report: its page, its numbers, what is kept, and what is refused."""

import re
import shutil
from functools import partial

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest
from gymnasium import spaces
from perturbed_problems import ClockEnv
from scipy.stats import mannwhitneyu, trim_mean
from small_problems import ToyEnv, error_line, tiny_tdpg
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize

from sb3_tdpg.cli import main
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.envs.scenarios import Scenario
from sb3_tdpg.evaluation import evaluate_scenarios
from sb3_tdpg.report import load_model, parse_models, robustness_report
from sb3_tdpg.report.models import fingerprint, label_of
from sb3_tdpg.report.page import to_html
from sb3_tdpg.report.rows import ALL, make_rows
from sb3_tdpg.robustness import PerturbedVecEnv
from sb3_tdpg.robustness.registry import SCENES
from tests.report.test_report_time import report_of

pytest.importorskip("matplotlib")
pytest.importorskip("rliable")
pytest.importorskip("markdown_it")

N_EPISODES = 12


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two methods of three models each, named as a reproduction names them."""
    folder = tmp_path_factory.mktemp("runs")
    for method, offset in (("pg", 0), ("tdpg", 10)):
        for seed in range(3):
            tiny_tdpg(seed=seed + offset).save(folder / f"{method}-seed{seed}" / "model.zip")
    return folder


@pytest.fixture(scope="module")
def report(folder, tmp_path_factory):
    """Arguments of the command, and the folder of a report of two perturbations."""
    out = tmp_path_factory.mktemp("report") / "lava"
    arguments = ["report", f"PG={folder}/pg-seed*/model.zip", f"{folder}/tdpg-seed*/model.zip", "--env", "Lava-v0"]
    arguments += ["--perturbations", "vector_noise", "vector_delay", "--severities", "2", "5"]
    arguments += ["--episodes", str(N_EPISODES), "--jobs", "1", "--out", str(out)]
    assert main(arguments) == 0
    return arguments, out


def test_the_page_and_its_files(report):
    _, out = report
    page = (out / "report.md").read_text()
    for words in (
        "3 models of **PG** and 3 models of **tdpg**",
        "## In short",
        "**tdpg compared with PG**: undecided. With 3 and 3 models no difference can be clear",
        "vector_delay",
        "Sensor noise 1e0",
        "pg-seed2/model.zip",
        "Made by `",
        "| vector_noise | Add noise to every component | standard deviation, scales | 0.1 | 0.8 |",
        "A scale is the standard deviation of a component of the observations: with finite bounds, that of",
    ):
        assert words in page
    for words in ("probability", "What the policies know", "Unfinished"):
        assert words not in page
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", page)
    assert {"figures/degradation.png", "figures/examples.png"} < set(pictures)
    assert all((out / picture).stat().st_size > 1000 for picture in pictures)
    assert not list(out.rglob("*.partial"))


def test_the_html_needs_no_other_file_and_shows_what_is_html_in_a_name(report, tmp_path):
    _, out = report
    html, page = (out / "report.html").read_text(), (out / "report.md").read_text()
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", page)
    sources = re.findall(r'src="(.{22})', html)
    assert len(sources) == len(pictures)
    assert set(sources) == {"data:image/png;base64,"}
    assert not re.search(r"https?://|<script|<link|@import|url\(|file:", re.sub(r'src="[^"]*"', "", html))
    assert html.count("<table>") == len(re.findall(r"^\|[-:| ]+\|$", page, re.MULTILINE))
    assert "<b>" not in to_html("# A <b>bold</b> claim", tmp_path, "<b>")


def test_the_numbers_are_those_of_the_records(report):
    _, out = report
    records = pd.read_csv(out / "episodes.csv.xz")
    assert len(records) == 6 * N_EPISODES * (1 + 4 + 2 * 2)
    means = records.groupby(["perturbation", "severity", "model", "train_seed"])["cost"].mean()
    levels = pd.read_csv(out / "levels.csv").set_index(["model", "perturbation", "severity"])
    assert len(levels) == 2 * 9
    for (model, perturbation, severity), row in levels.iterrows():
        of_seeds = means[perturbation, severity, model].to_numpy()
        assert row["iqm"] == pytest.approx(trim_mean(of_seeds, 0.25))
        assert of_seeds.min() - 1e-9 <= row["low"] <= row["iqm"] <= row["high"] <= of_seeds.max() + 1e-9
    row = levels.loc[("tdpg", "vector_delay", 5)]
    section = (out / "report.md").read_text().split("## Every severity")[1]
    assert f"{row['iqm']:.1f} [{row['low']:.1f},\N{NO-BREAK SPACE}{row['high']:.1f}] |" in section

    groups = pd.read_csv(out / "perturbations.csv").set_index(["model", "perturbation"])
    comparisons = pd.read_csv(out / "comparisons.csv").set_index("perturbation")
    plain, noisy = means["unperturbed", 0], means["vector_noise"].groupby(["model", "train_seed"]).mean()
    assert groups.loc[("tdpg", "vector_noise"), "iqm"] == pytest.approx(trim_mean(noisy["tdpg"], 0.25))
    added = noisy - plain
    assert groups.loc[("PG", "vector_noise"), "added"] == pytest.approx(trim_mean(added["PG"], 0.25))
    for column, values in (("p_cost", noisy), ("p_added", added)):
        expected = mannwhitneyu(values["PG"], values["tdpg"]).statistic / 9
        assert comparisons.loc["vector_noise", column] == pytest.approx(expected)
    every = means.drop(index=[name for name in means.index.levels[0] if not name.startswith("vector")], level=0)
    overall = every.groupby(["model", "train_seed"]).mean()
    assert groups.loc[("PG", ALL), "iqm"] == pytest.approx(trim_mean(overall["PG"], 0.25))


def test_an_unperturbed_row_is_what_evaluate_scenarios_gives(report, folder):
    _, out = report
    records = pd.read_csv(out / "episodes.csv.xz").query("model == 'tdpg' and train_seed == 1")
    model = load_model(folder / "tdpg-seed1" / "model.zip", "Lava-v0", {})
    expected = evaluate_scenarios(model, [Scenario("Unperturbed", "Lava-v0")], N_EPISODES)
    costs = records.loc[records["kind"] == "unperturbed", "cost"].to_numpy()
    np.testing.assert_allclose(costs, expected["cost"])
    for _, perturbed in records.query("perturbation == 'vector_noise'").groupby("severity"):
        assert not np.allclose(costs, perturbed["cost"])


def test_it_goes_on_where_it_stopped_and_gives_the_same(report, monkeypatch):
    arguments, out = report
    before = {name: (out / name).read_bytes() for name in ("episodes.csv.xz", "levels.csv", "comparisons.csv")}
    kept, lost = sorted((out / "rows").iterdir())[:2]
    lost.unlink()
    when = kept.stat().st_mtime_ns
    assert main(arguments) == 0
    assert lost.exists()
    assert kept.stat().st_mtime_ns == when
    assert {name: (out / name).read_bytes() for name in before} == before


@pytest.mark.slow
def test_other_perturbations_may_be_asked_for_later(report):
    arguments, out = report
    n_rows = len(list((out / "rows").iterdir()))
    index = arguments.index("--perturbations")
    assert main([*arguments[: index + 1], "vector_bias", *arguments[index + 3 :]]) == 0
    assert len(list((out / "rows").iterdir())) == n_rows + 2
    assert "vector_bias" in (out / "report.md").read_text()
    assert main(arguments) == 0  # for the other tests


@pytest.mark.slow
def test_processes_give_the_same_episodes(report, tmp_path):
    arguments, out = report
    arguments = [*arguments[: arguments.index("--jobs")], "--jobs", "2", "--out", str(tmp_path / "two")]
    assert main(arguments) == 0
    assert (tmp_path / "two" / "episodes.csv.xz").read_bytes() == (out / "episodes.csv.xz").read_bytes()


def test_all_methods_meet_the_same_episodes(tmp_path):
    model = tiny_tdpg()
    text = report_of(str(tmp_path), {"A": model, "B": [model]}, n_episodes=30, perturbations="vector_bias")
    assert (tmp_path / "report.md").read_text() == text
    records = pd.read_csv(tmp_path / "episodes.csv.xz").set_index(["model", "perturbation", "severity", "episode"])
    pd.testing.assert_series_equal(records.loc["A"]["cost"], records.loc["B"]["cost"])


def test_one_model_is_not_taken_for_a_method(tmp_path):
    models = {"A": tiny_tdpg(), "B": tiny_tdpg(seed=1)}
    text = report_of(tmp_path, models, severities=[3], n_episodes=30)
    assert "about this model" in text
    assert "With 1 and 1 model no difference can be clear" in text
    assert "Which is more robust" not in text
    levels = pd.read_csv(tmp_path / "levels.csv")
    costs = pd.read_csv(tmp_path / "episodes.csv.xz").query("model == 'A' and severity == 3")["cost"]
    row = levels.query("model == 'A' and severity == 3").iloc[0]
    assert row["iqm"] == pytest.approx(costs.mean())
    assert row["high"] - row["low"] == pytest.approx(2 * 1.96 * costs.sem(), rel=1e-3)


def test_models_are_grouped_by_label_or_folder(tmp_path):
    for name in ("runs/pg-seed0/model.zip", "runs/pg-seed1/model.zip", "runs/b=2_seed3/model.zip", "c/ppo_s.zip"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    methods = parse_models([f"{tmp_path}/runs/*-seed*/model.zip", f"my x={tmp_path}/runs/b=2_seed3", f"{tmp_path}/c/*"])
    assert {label: [str(p.relative_to(tmp_path)) for p in paths] for label, paths in methods.items()} == {
        "pg": ["runs/pg-seed0/model.zip", "runs/pg-seed1/model.zip"],
        "my x": ["runs/b=2_seed3/model.zip"],
        "ppo_s": ["c/ppo_s.zip"],
    }
    assert list(parse_models([f"{tmp_path}/runs/b=2_seed3/model.zip"])) == ["b=2"]
    folder = tmp_path / "logs" / "ppo" / "Lava-v0_1"
    assert label_of(folder / "Lava-v0.zip", "Lava-v0") == "ppo Lava-v0"
    folder.mkdir(parents=True)
    (folder / "run.json").write_text('{"block": "Lava-v0-wide"}')
    assert label_of(folder / "Lava-v0.zip", "sb3_tdpg:Lava-v0") == "ppo Lava-v0-wide"
    with pytest.raises(ValueError, match="given twice"):
        parse_models([f"A={tmp_path}/c/ppo_s.zip", f"B={tmp_path}/c/ppo_s.zip"])
    for name in ("rl_model_10_steps", "rl_model_20_steps", "sac_1", "sac_2", "Lava-v0_seed0", "Lava-v0_seed1"):
        (folder / f"{name}.zip").touch()
    assert len(parse_models([f"{folder}/Lava-v0_*.zip"], "Lava-v0")["ppo Lava-v0-wide"]) == 2
    assert len(parse_models([f"{folder}/sac_*.zip", f"A={folder}/rl_*.zip"])["sac"]) == 2
    with pytest.raises(ValueError, match="count as two trainings of 'ppo Lava-v0-wide': give each a label"):
        parse_models([f"{folder}/rl_*.zip"], "Lava-v0")


@pytest.mark.filterwarnings("ignore:You are trying to run PPO")
@pytest.mark.parametrize(("name", "statistics"), [
    ("Lava-v0", "Lava-v0/vecnormalize.pkl"),
    ("best_model", "Lava-v0/vecnormalize.pkl"),
    ("tdpg-Lava-v0", "vec_normalize.pkl"),  # on the Hub
])  # fmt: skip
def test_the_statistics_that_lie_beside_a_model_are_used(name, statistics, tmp_path):
    env = VecNormalize(make_vec_env("Lava-v0", 2, seed=0), norm_reward=False)
    model = PPO("MlpPolicy", env, n_steps=10, batch_size=10, n_epochs=1, seed=0, device="cpu").learn(100)
    folder = tmp_path / "Lava-v0_1"
    (folder / "Lava-v0").mkdir(parents=True)
    model.save(folder / name)
    env.save(folder / statistics)
    loaded = load_model(folder / f"{name}.zip", "Lava-v0", {}).get_vec_normalize_env()
    np.testing.assert_array_equal(loaded.obs_rms.mean, env.obs_rms.mean)


def test_images_get_a_gallery_and_a_scene(tmp_path, monkeypatch):
    model = tiny_tdpg("BallCatch-v0", n_episodes=4, cost_limit=20.0)
    wall = np.zeros((16, 16, 3), np.uint8)
    monkeypatch.setitem(SCENES["BallCatch-v0"], "white_wall", (dict(texture=wall + 255),) * 5)
    settings = dict(perturbations=["noise", "camera_pose", "white_wall"], severities=[5], env_kwargs=dict(texture=wall))
    text = report_of(tmp_path, {"A": model}, "BallCatch-v0", **settings)
    assert "figures/examples.png" in text
    assert "| camera_pose | the environment changes | `camera_pitch`, `camera_height` | 40.0, 2.5 |" in text
    assert "| white_wall | the environment changes | `texture` | array (16, 16, 3) |" in text
    records = pd.read_csv(tmp_path / "episodes.csv.xz")
    assert records["kind"].unique().tolist() == ["unperturbed", "sensor", "scene"]


PARTS = spaces.Dict(place=spaces.Box(-1, 1, (2,), np.float32), camera=spaces.Box(0, 255, (3, 36, 36), np.uint8))


def test_a_dict_and_a_plant_are_perturbed(tmp_path, registry):
    gym.register("Toy-v0", ToyEnv, kwargs=dict(observation_space=PARTS, horizon=6))
    model = PPO("MultiInputPolicy", gym.make("Toy-v0"), n_steps=6, batch_size=6, seed=0, device="cpu")
    names = ["noise", "vector_bias", "freeze", "group_failure", "actuator_gain", "actuator_delay"]
    text = report_of(tmp_path, {"A": model}, "Toy-v0", perturbations=names, severities=[5], n_episodes=4)
    levels = pd.read_csv(tmp_path / "levels.csv").set_index("perturbation")
    assert levels["kind"].tolist() == ["unperturbed", *["sensor"] * 4, *["plant"] * 2]
    assert (levels.loc[names, "iqm"] != levels.loc["unperturbed", "iqm"]).any()
    assert "| actuator_delay | Apply the action of some steps ago, and 0 until then | steps | 5 |" in text
    assert "figures/examples.png" in text


def test_models_of_stacked_observations_are_perturbed_before_the_stack(tmp_path):
    short = dict(max_episode_steps=5)
    env = VecFrameStack(make_vec_env("Pendulum-v1", 1, env_kwargs=short), 3)
    model = PPO("MlpPolicy", env, n_steps=10, batch_size=10, seed=0, device="cpu")
    settings = dict(perturbations=["vector_bias", "freeze"], severities=[5], env_kwargs=short, deterministic=True)
    report_of(tmp_path, {"A": model}, "Pendulum-v1", **settings)
    records = pd.read_csv(tmp_path / "episodes.csv.xz").set_index("perturbation")["cost"]
    sensor = partial(PerturbedVecEnv, perturbation="vector_bias", severity=5, seed=0)
    row = Scenario("biased", "Pendulum-v1", short, sensor=sensor)
    expected = evaluate_scenarios(model, [row], 3, deterministic=True)
    np.testing.assert_allclose(records["vector_bias"], expected["cost"])
    assert (records["vector_bias"].to_numpy() != records["unperturbed"].to_numpy()).all()


BAD = {
    "file": (["A=nothing.zip"], {}, "nothing.zip: there is no such file"),
    "folder": (["."], {}, "holds no model.zip"),
    "no model": (["notes.zip"], {}, "notes.zip cannot be read"),
    "label": (["A="], {}, "LABEL=FILE"),
    "environment": (["{pg}"], {"--env": "Larva-v0"}, "Larva-v0 cannot be made .*Larva"),
    "spaces": (["{pg}"], {"--env": "Pendulum-v1"}, "does not fit.*the model's observation_space"),
    "keyword": (["{pg}"], {"--env-kwargs": "lava=3"}, "cannot be made"),
    "horizon": (["{pg}"], {"--env-kwargs": "horizon=7"}, "horizon of 5 steps, the environment has 7"),
    "perturbation": (["{pg}"], {"--perturbations": "fog"}, "'fog' is unknown; this environment has .*vector_noise"),
    "another kind": (["{pg}"], {"--perturbations": "hue"}, "'hue' does not apply"),
    "severity": (["{pg}"], {"--severities": "6"}, "integers from 1 to 5"),
    "seed": (["{pg}"], {"--seed": "-1"}, "seed=-1 must be"),
    "same policy": (["A={pg}", "A=copy.zip"], {}, "models 0 and 1 of 'A' are the same policy"),
}


@pytest.mark.parametrize(("models", "env_id", "message"), [
    ([], "Lava-v0", r"models=\[\] must be a dictionary"),
    ({}, "Lava-v0", "models={} must be a dictionary"),
    ({"A": []}, "Lava-v0", r"models\['A'\] is empty"),
    ({"A": "nothing.zip"}, LavaEnv(), "must be the id of an environment: gymnasium.register"),
])  # fmt: skip
def test_what_is_no_model_or_no_id_is_refused(models, env_id, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        robustness_report(models, env_id, out=tmp_path)


@pytest.mark.parametrize("models, options, message", BAD.values(), ids=BAD)
def test_bad_input_is_told_in_a_line(models, options, message, folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.zip").write_text("no archive")
    pg = shutil.copy(folder / "pg-seed0" / "model.zip", tmp_path / "copy.zip").with_name("pg.zip")
    shutil.copy(tmp_path / "copy.zip", pg)
    models = [model.format(pg=pg) for model in models]
    options = {"--env": "Lava-v0", **options}
    line = error_line(capsys, "report", *models, *(word for option in options.items() for word in option))
    assert re.search(message, line)
    assert not (tmp_path / "results").exists()


@pytest.mark.parametrize("content", ["{}", "[1]", '{"half": '])
def test_a_folder_of_something_else_is_refused(content, folder, tmp_path, capsys):
    (tmp_path / "config.json").write_text(content)
    line = error_line(capsys, "report", folder / "pg-seed0" / "model.zip", "--env", "Lava-v0", "--out", tmp_path)
    assert line.endswith("config.json is there already and is not that of a report: choose another folder")
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]


def rows_of(*scenarios):
    space = spaces.Box(-np.inf, np.inf, (2,), np.float32)
    return make_rows("Lava-v0", {}, space, 5, perturbations=["vector_noise"], scenarios=scenarios)


@pytest.mark.parametrize("name", ["vector_noise", "unperturbed", ALL, "twice"])
def test_scenarios_must_not_be_called_as_another_row_of_a_table(name):
    with pytest.raises(ValueError, match=re.escape(f"['{name}'] name several rows")):
        rows_of(Scenario(name, "Lava-v0"), *[Scenario("twice", "Lava-v0")] * (name == "twice"))
    assert len(rows_of(Scenario("once", "Lava-v0"))) == 1 + 5 + 1


def test_records_of_another_environment_or_sensor_are_no_records_of_this_one():
    sensor = partial(PerturbedVecEnv, perturbation="vector_noise")
    here, there, changed = (
        rows_of(Scenario("x", env_id, sensor=wrapper))[-1]
        for env_id, wrapper in (("Lava-v0", None), ("Other-v0", None), ("Lava-v0", sensor))
    )
    assert len({here.file_name, there.file_name, changed.file_name}) == 3
    assert changed.scenario.sensor is sensor


def test_another_order_of_the_methods_compares_with_another_one(report, tmp_path):
    arguments, out = report
    labels = arguments[1 : arguments.index("--env")]
    again = shutil.copytree(out, tmp_path / "again")
    arguments = [arguments[0], *labels[::-1], *arguments[1 + len(labels) :], "--out", str(again)]
    assert main(arguments) == 0
    before, after = (pd.read_csv(folder / "comparisons.csv") for folder in (out, again))
    assert set(before["model"]) == {"tdpg"} and set(after["model"]) == {"PG"}


def test_a_model_of_a_dict_is_known_by_its_statistics():
    space = spaces.Dict(gyro=spaces.Box(-10, 1000, (2,), np.float32))
    env = VecNormalize(DummyVecEnv([lambda: ClockEnv(space)]))
    model = PPO("MultiInputPolicy", env, n_steps=4, batch_size=4, device="cpu")
    before = fingerprint(model)
    env.obs_rms["gyro"].mean += 1.0
    assert fingerprint(model) != before


@pytest.mark.parametrize(("change", "difference"), [
    (lambda arguments: [*arguments, "--seed", "1"], "seed: 0 there, 1 here"),
    (lambda arguments: [arguments[0], *arguments[2:]], r"models.PG: \[.*\] there, not here"),
], ids=["seed", "models"])  # fmt: skip
def test_a_folder_with_another_report_is_refused(report, change, difference, capsys):
    arguments, out = report
    before = (out / "config.json").read_bytes()
    line = error_line(capsys, *change(arguments))
    assert re.search(f"holds a report with other settings, {difference}: choose", line)
    assert (out / "config.json").read_bytes() == before
