"""The reproduction of grasping with tiny settings, from nothing to tables, figures and records."""

import math
from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch as th
from small_problems import complete_runs_here

from sb3_tdpg import TDPG, BatchedVecEnv
from sb3_tdpg.cli import main
from sb3_tdpg.envs.panda_grasp import PandaGraspEnv
from sb3_tdpg.envs.scenarios import PANDA_DRINK, PANDA_GRASP
from sb3_tdpg.evaluation import (
    draw_mugs,
    encode_mugs,
    failures_by_level,
    failures_by_yaw,
    grasp_knowledge,
    knowledge,
)
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.reproduction import common, grasp
from sb3_tdpg.runs import Run, complete_run


@pytest.fixture
def tiny(monkeypatch):
    """Small epochs, in this process."""
    block = Run.settings.fget
    monkeypatch.setattr(Run, "settings", property(lambda run: {**block(run), "n_episodes": 8, "batch_size": 8}))
    for module, name in ((grasp, "aggregate_seeds"), (common, "probability_of_improvement")):
        monkeypatch.setattr(module, name, partial(getattr(module, name), n_bootstrap=10))
    monkeypatch.setattr(grasp, "N_MUGS", 100)

    monkeypatch.setattr(grasp, "FITTED_MUGS", 60)
    monkeypatch.setattr(
        grasp, "CRITICS", {k: dict(v, warmup_gradient_steps=5, gradient_steps=2) for k, v in grasp.CRITICS.items()}
    )
    monkeypatch.setattr(common, "complete_runs", complete_runs_here)


def test_from_nothing_to_tables_figures_and_records(tmp_path, tiny, capsys):
    out, published = tmp_path / "out", tmp_path / "docs"
    arguments = ["--n-seeds", "2", "--n-eval-episodes", "3", "--n-timesteps", "8"]
    assert main(["reproduce", "grasp", "--out", str(out), "--publish", str(published), *arguments]) == 0
    summary = (out / "summary.md").read_text()
    assert summary in capsys.readouterr().out
    for heading in ("Goals", "What the penalty is worth", "What the TRVs know", "How much information is it?"):
        assert f"## {heading}" in summary
    assert "0.107" in summary, "the paper's"
    assert "| estimate | PG, 60 mugs | PG, fresh mugs | TDPG, 60 mugs | TDPG, fresh mugs |" in summary
    files = {"summary.md", "seeds.csv", "episodes.csv.xz", "knowledge.csv", "config.json", "yaw.png", "training.png"}
    assert {path.name for path in published.iterdir()} == files
    records = pd.read_csv(out / "episodes.csv.xz")
    assert len(records) == 3 * 2 * 3 * 3
    assert set(records["cost"]) <= {0.0, 1.0}


def test_mugs_with_a_drink_from_nothing_to_tables_figures_and_records(tmp_path, tiny, capsys):
    arguments = ["--n-seeds", "2", "--n-eval-episodes", "3", "--n-timesteps", "8"]
    assert main(["reproduce", "grasp-drink", "--out", str(tmp_path), *arguments]) == 0
    summary = (tmp_path / "summary.md").read_text()
    for text in ("Opposite level", "Empty mug", "make reproduce-grasp-drink"):
        assert text in summary
    assert "Goals" not in summary
    assert (tmp_path / "level.png").exists()
    assert not (tmp_path / "yaw.png").exists()
    records = pd.read_csv(tmp_path / "episodes.csv.xz")
    assert len(records) == 3 * 2 * 4 * 3
    low, high = PANDA_DRINK["level_range"]
    assert records["level"].dropna().between(low, high).all()
    assert set(records["scenario"][records["level"].isna()]) == {"Empty mug"}
    knowledge = pd.read_csv(tmp_path / "knowledge.csv")
    assert set(knowledge["mugs"]) == {"training", "any level"}
    assert knowledge["level"].between(0, 1).all()


def test_a_record_is_enough_to_carry_out_its_grasp_once_more(tmp_path, tiny):
    run = Run("PG", "PandaGrasp-v0", "PandaGrasp-v0-pg", 0, {"n_timesteps": 8})
    complete_run(run, tmp_path, PANDA_GRASP[:1], n_eval_episodes=6)
    records = pd.read_csv(tmp_path / "episodes.csv")
    mugs = records[[f"final_mug_{i}" for i in range(4)]].to_numpy()
    grasps = records[[f"final_grasp_{i}" for i in range(4)]].to_numpy()
    env = PandaGraspEnv()
    outcomes = env._terminal_cost(env._dynamics(mugs, (grasps - [0.5, 0.0, 0.06, np.pi / 6]) / 0.1))
    env.close()
    np.testing.assert_array_equal(outcomes, records["cost"])


@pytest.mark.parametrize("mug", grasp.EXPERIMENTS)
def test_the_control_differs_from_tdpg_in_nothing_but_the_penalty(mug):
    methods = {method.label: method for method in grasp.EXPERIMENTS[mug].methods}
    tdpg, control = ({**load_hyperparams(m.block), **m.overrides} for m in (methods["TDPG"], methods["its control"]))
    assert methods["TDPG"].start == methods["its control"].start == "PG"
    assert {key for key in tdpg if tdpg[key] != control.get(key)} == {"beta", "cost_limit"}
    assert set(tdpg) == set(control)


def test_the_training_row_of_a_drink_is_what_the_blocks_train_on():
    for method in grasp.EXPERIMENTS["drink"].methods:
        kwargs = load_hyperparams(method.block)["env_kwargs"]
        assert {name: kwargs[name] for name in PANDA_DRINK} == {k: pytest.approx(v) for k, v in PANDA_DRINK.items()}


def test_every_goal_is_of_a_row_and_a_method():
    assert set(grasp.GOALS) <= {method.label for method in grasp.EXPERIMENTS["empty"].methods}
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


def test_the_failures_are_drawn_over_what_the_level_gets_wrong():
    error = np.repeat([-0.05, -0.01, 0.01, 0.05], 5)
    cost = np.repeat([1.0, 0.0, 0.0, 0.4], 5)
    figure = failures_by_level(pd.DataFrame(dict(model="PG", error=error, cost=cost)), n_bins=4)
    (line,) = figure.axes[0].lines
    middles, shares = line.get_data()
    np.testing.assert_allclose(middles, [-3.75, -1.25, 1.25, 3.75])
    np.testing.assert_allclose(shares, [1.0, 0.0, 0.0, 0.4])


@pytest.mark.parametrize("mug", ["as the level tells", "elsewhere"])
def test_the_level_s_error_is_nothing_where_it_tells_x(monkeypatch, mug):
    seen = []
    monkeypatch.setattr(grasp, "failures_by_level", seen.append)
    shift = 0.0 if mug == "as the level tells" else 0.02
    (low, high), x = PANDA_DRINK["level_range"], np.linspace(0.45, 0.55, 5)
    level = low + (high - low) * (x - 0.45) / 0.1
    grasp._draw_level(pd.DataFrame(dict(scenario="Any level", x=x - shift, level=level)))
    np.testing.assert_allclose(seen[0]["error"], shift, atol=1e-12)


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
    assert "level" not in known
    with_level = th.cat([poses, noise[..., 2:3]], dim=-1)
    assert grasp_knowledge(InformationBatch(with_level, told, told, th.ones_like(told)))["level"] > 0.99
    share = (sine.var() / (sine.var() + th.cos(poses[..., 3]).var())).item()
    assert known["yaw"] == pytest.approx(0.25 * share, abs=0.08)
    assert known["yaw"] > 0.05


def test_the_mugs_that_a_policy_is_shown_are_those_of_the_environment(monkeypatch):
    monkeypatch.setattr(knowledge, "MUGS_AT_A_TIME", 8)
    model = TDPG("TRVPolicy", BatchedVecEnv(PandaGraspEnv(), 4), beta=math.inf, n_episodes=4, device="cpu")
    mugs = draw_mugs(dict(yaw_range=(2.0, 2.5)), n_mugs=20)
    assert ((mugs.poses[:, 3] >= 2.0) & (mugs.poses[:, 3] <= 2.5)).all()
    batch = encode_mugs(model, mugs)
    np.testing.assert_allclose(batch.states[0].numpy(), mugs.poses, rtol=1e-6)
    assert batch.trvs.shape == batch.means.shape == batch.stds.shape == (1, 20, 16)
    assert (batch.trvs != batch.means).all()
    again = encode_mugs(model, draw_mugs(dict(yaw_range=(2.0, 2.5)), n_mugs=20))
    assert all(th.equal(a, b) for a, b in zip(batch[:4], again[:4], strict=True))
