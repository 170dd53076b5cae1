"""The reproduction of grasping with tiny settings, from nothing to tables, figures and records."""

import math

import numpy as np
import pandas as pd
import pytest
import torch as th
from information_problems import gaussian_batch, gaussian_information
from small_problems import complete_runs_here, give_settings

from sb3_tdpg import TDPG, BatchedVecEnv
from sb3_tdpg.cli import main
from sb3_tdpg.envs.panda_grasp import PandaGraspEnv
from sb3_tdpg.envs.scenarios import PANDA_CAMERA, PANDA_GRASP
from sb3_tdpg.experiments.runs import Run, complete_run
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.paper import common, grasp, knowledge
from sb3_tdpg.paper.knowledge import draw_mugs, encode_mugs, grasp_knowledge
from sb3_tdpg.paper.plots import failures_by_yaw


@pytest.fixture
def tiny(monkeypatch):
    """Small epochs, in this process."""
    give_settings(monkeypatch, dict(n_episodes=8, batch_size=8))
    monkeypatch.setattr(knowledge, "N_MUGS", 100)
    monkeypatch.setattr(grasp, "complete_runs", complete_runs_here)


def test_from_nothing_to_tables_figures_and_records(tmp_path, tiny, capsys):
    out, published = tmp_path / "out", tmp_path / "docs"
    arguments = ["--n-seeds", "2", "--n-eval-episodes", "3", "--n-timesteps", "8"]
    assert main(["reproduce", "grasp", "--out", str(out), "--publish", str(published), *arguments]) == 0
    summary = (out / "summary.md").read_text()
    assert summary in capsys.readouterr().out
    for heading in ("Goals", "Effect of the penalty", "What the TRVs know"):
        assert f"## {heading}" in summary
    assert "0.107" in summary, "the paper's"
    files = {"summary.md", "seeds.csv", "episodes.csv.xz", "knowledge.csv", "config.json", "yaw.png", "training.png"}
    assert {path.name for path in published.iterdir()} == files
    records = pd.read_csv(out / "episodes.csv.xz")
    assert len(records) == 4 * 2 * 3 * 3
    assert set(records["cost"]) <= {0.0, 1.0}


@pytest.mark.slow
def test_a_varying_camera_from_nothing_to_tables_figures_and_records(tmp_path, tiny, capsys):
    arguments = ["--n-seeds", "2", "--n-eval-episodes", "3", "--n-timesteps", "8"]
    assert main(["reproduce", "grasp-camera", "--out", str(tmp_path), *arguments]) == 0
    summary = (tmp_path / "summary.md").read_text()
    for text in ("Twice the range", "Usual height", "make reproduce-grasp-camera"):
        assert text in summary
    assert "Goals" not in summary
    assert (tmp_path / "camera.png").exists()
    assert not (tmp_path / "yaw.png").exists()
    records = pd.read_csv(tmp_path / "episodes.csv.xz")
    assert len(records) == 3 * 2 * 3 * 3
    heights = records.groupby("scenario")["camera"]
    assert heights.max()["Training"] <= 0.03 and heights.min()["Training"] >= -0.03
    assert heights.nunique()["Usual height"] == 1
    known = pd.read_csv(tmp_path / "knowledge.csv")
    assert set(known["mugs"]) == {"training", "twice the range"}
    assert known["camera"].between(0, 1).all()


def test_a_record_is_enough_to_carry_out_its_grasp_once_more(tmp_path, tiny):
    run = Run("PG", "PandaGrasp-v0", "PandaGrasp-v0-pg", 0, {"n_timesteps": 8})
    complete_run(run, tmp_path, PANDA_GRASP[:1], n_eval_episodes=6)
    records = pd.read_csv(tmp_path / "episodes.csv")
    mugs = records[[f"final_mug_{i}" for i in range(4)]].to_numpy()
    grasps = records[[f"final_grasp_{i}" for i in range(4)]].to_numpy()
    env = PandaGraspEnv()
    outcomes = env.terminal_cost(env.dynamics(mugs, (grasps - [0.5, 0.0, 0.06, np.pi / 6]) / 0.1))
    env.close()
    np.testing.assert_array_equal(outcomes, records["cost"])


@pytest.mark.parametrize("camera", grasp.METHODS)
def test_the_ablation_differs_from_tdpg_in_nothing_but_the_penalty(camera):
    methods = {method.label: method for method in grasp.METHODS[camera]}
    pair = methods["TDPG"], methods[common.NO_PENALTY]
    tdpg, ablation = ({**load_hyperparams(m.block), **m.overrides} for m in pair)
    assert [method.start for method in pair] == ["PG", "PG"]
    assert {key for key in tdpg if tdpg[key] != ablation.get(key)} == {"beta", "cost_limit"}
    assert set(tdpg) == set(ablation)


def test_the_training_row_of_a_varying_camera_is_what_the_blocks_train_on():
    for method in grasp.METHODS["varying"]:
        assert tuple(load_hyperparams(method.block)["env_kwargs"]["camera_range"]) == PANDA_CAMERA["camera_range"]


def test_every_goal_is_of_a_row_and_a_method():
    assert set(grasp.GOALS) <= {method.label for method in grasp.METHODS["fixed"]}
    for goals in grasp.GOALS.values():
        assert set(goals) == {row.name for row in PANDA_GRASP}


def test_the_failures_are_drawn_in_the_sector_of_their_yaw():
    yaw = np.repeat(np.arange(24) * 2 * np.pi / 24 + 0.1, 10) - 2 * np.pi  # a whole turn makes no difference
    cost = np.repeat(np.arange(24) == 5, 10).astype(float)
    figure = failures_by_yaw(pd.DataFrame(dict(model="PG", yaw=yaw, cost=cost)))
    (line,) = figure.axes[0].lines
    angles, shares = line.get_data()
    assert shares.tolist() == [*(float(i == 5) for i in range(24)), 0.0]
    assert angles[5] == pytest.approx(5.5 * 2 * np.pi / 24)


def test_the_bounds_enclose_an_information_that_is_known():
    rng = th.Generator().manual_seed(0)
    batch = gaussian_batch(2000, [[2.0, 1.0]], generator=rng)
    (truth,) = gaussian_information([[2.0, 1.0]])
    found = knowledge.bounds(batch)
    # The standard deviation of a sample's bound is about 0.02.
    assert truth - 0.1 < found["lower bound"] <= found["upper bound"] < truth + 0.1


def test_the_penalty_is_told_from_where_it_began_and_where_there_was_none():
    log = pd.DataFrame({
        "train/mi_coef": [np.nan, 0.0, 0.01, 0.02, 0.03, 0.04],
        "mi/total": [5.0, 5.0, 5.0, 4.5, 4.0, 3.5],
        "rollout/ep_cost_mean": [0.9, 0.05, 0.01, 0.01, 0.02, 0.01],
    })  # fmt: skip
    with_penalty, without = knowledge.penalty_table({1: log, 2: log.assign(**{"train/mi_coef": 0.0})})
    assert list(with_penalty.values()) == [1, "2", "0.04", "5.00", "3.50", "0.020"]
    assert (without["first epoch with the penalty"], without["last weight"]) == ("none", "0")
    (of_one_epoch,) = knowledge.penalty_table({1: log.drop(columns="train/mi_coef")[:1]})
    assert of_one_epoch["first epoch with the penalty"] == "none"
    assert of_one_epoch["information in the last epoch"] == "5.00"


@pytest.mark.parametrize("half_width", [np.pi, np.pi / 4])
def test_the_regression_finds_the_pose_that_the_trvs_tell_and_no_other(half_width):
    poses = th.tensor(np.random.default_rng(0).uniform(-1, 1, (1, 20_000, 4)) * [0.1, 0.1, 0, half_width])
    noise = th.tensor(np.random.default_rng(1).standard_normal((1, 20_000, 16)))
    x, sine = poses[..., 0], th.sin(poses[..., 3])
    # Three parts of noise on one of the sine, in variance.
    weak = sine / sine.std() + 3**0.5 * noise[..., 1]
    told = th.cat([x[..., None], weak[..., None], noise[..., 2:]], dim=-1)
    known = grasp_knowledge(InformationBatch(poses, told, told, th.ones_like(told)))
    assert known["x"] > 0.99
    assert known["y"] < 0.02
    assert "camera" not in known
    with_camera = th.cat([poses, noise[..., 2:3]], dim=-1)
    assert grasp_knowledge(InformationBatch(with_camera, told, told, th.ones_like(told)))["camera"] > 0.99
    share = (sine.var() / (sine.var() + th.cos(poses[..., 3]).var())).item()
    assert known["yaw"] == pytest.approx(0.25 * share, abs=0.08)
    assert known["yaw"] > 0.05


def test_the_mugs_that_a_policy_is_shown_are_those_of_the_environment(monkeypatch):
    monkeypatch.setattr(knowledge, "MUGS_AT_A_TIME", 8)
    model = TDPG("TRVPolicy", BatchedVecEnv(PandaGraspEnv(), 4), beta=math.inf, n_episodes=4, device="cpu")
    mugs = draw_mugs(dict(yaw_range=(2.0, 2.5)), 20)
    assert ((mugs.states[:, 3] >= 2.0) & (mugs.states[:, 3] <= 2.5)).all()
    batch = encode_mugs(model, mugs)
    np.testing.assert_allclose(batch.states[0].numpy(), mugs.states, rtol=1e-6)
    assert batch.trvs.shape == batch.means.shape == batch.stds.shape == (1, 20, 16)
    assert (batch.trvs != batch.means).all()
    again = encode_mugs(model, draw_mugs(dict(yaw_range=(2.0, 2.5)), 20))
    assert all(th.equal(a, b) for a, b in zip(batch[:4], again[:4], strict=True))
