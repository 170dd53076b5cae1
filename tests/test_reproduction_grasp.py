"""The reproduction of grasping with tiny settings, from nothing to tables, figures and records."""

from functools import partial

import numpy as np
import pandas as pd
import pytest

from sb3_tdpg.cli import main
from sb3_tdpg.envs.panda_grasp import PandaGraspEnv
from sb3_tdpg.envs.scenarios import PANDA_GRASP
from sb3_tdpg.evaluation import failures_by_yaw, knowledge
from sb3_tdpg.hyperparams import load_hyperparams
from sb3_tdpg.reproduction import common, grasp
from sb3_tdpg.runs import Run, complete_run


@pytest.fixture
def tiny(monkeypatch):
    """Small epochs, in this process."""
    block = Run.settings.fget
    monkeypatch.setattr(Run, "settings", property(lambda run: {**block(run), "n_episodes": 8, "batch_size": 8}))
    for module, name in ((grasp, "aggregate_seeds"), (common, "probability_of_improvement")):
        monkeypatch.setattr(module, name, partial(getattr(module, name), n_bootstrap=10))
    monkeypatch.setattr(grasp, "grasp_knowledge", partial(grasp.grasp_knowledge, n_episodes=400))

    def complete_runs(tasks, *, n_eval_episodes, jobs):
        for task in tasks:
            complete_run(*task, n_eval_episodes=n_eval_episodes)

    monkeypatch.setattr(common, "complete_runs", complete_runs)


def test_from_nothing_to_tables_figures_and_records(tmp_path, tiny, capsys):
    out, published = tmp_path / "out", tmp_path / "docs"
    arguments = ["--n-seeds", "2", "--n-eval-episodes", "3", "--n-timesteps", "8"]
    assert main(["reproduce", "grasp", "--out", str(out), "--publish", str(published), *arguments]) == 0
    summary = (out / "summary.md").read_text()
    assert summary in capsys.readouterr().out
    for heading in ("Goals", "What the penalty is worth", "What the TRVs know"):
        assert f"## {heading}" in summary
    assert "0.107" in summary, "the paper's"
    files = {"summary.md", "seeds.csv", "episodes.csv.xz", "knowledge.csv", "config.json", "yaw.png", "training.png"}
    assert {path.name for path in published.iterdir()} == files
    records = pd.read_csv(out / "episodes.csv.xz")
    assert len(records) == 3 * 2 * 3 * 3
    assert set(records["cost"]) <= {0.0, 1.0}


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


def test_the_control_differs_from_tdpg_in_nothing_but_the_penalty():
    methods = {method.label: method for method in grasp.METHODS}
    tdpg, control = ({**load_hyperparams(m.block), **m.overrides} for m in (methods["TDPG"], methods["its control"]))
    assert methods["TDPG"].start == methods["its control"].start == "PG"
    assert {key for key in tdpg if tdpg[key] != control.get(key)} == {"beta", "cost_limit"}
    assert set(tdpg) == set(control)


def test_every_goal_is_of_a_row_and_a_method():
    assert set(grasp.GOALS) <= {method.label for method in grasp.METHODS}
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


class Tells:
    """A model whose TRVs are the mug's x and the cosine of its yaw, read off the depth image's own state."""

    device = "cpu"

    def __init__(self, monkeypatch):
        env = PandaGraspEnv()
        self.observation_space, self.action_space, self.horizon = env.observation_space, env.action_space, 1
        self.states = None
        original = PandaGraspEnv._sensor

        def sensor(env, state):
            self.states = state
            return np.zeros((len(state), 1, 128, 128), np.float32) + np.float32(0.3)

        assert original is not sensor
        monkeypatch.setattr(PandaGraspEnv, "_sensor", sensor)

    def get_vec_normalize_env(self):
        return None

    def predict(self, observation, state=None, episode_start=None, deterministic=False):
        known = np.stack([self.states[:, 0], np.cos(self.states[:, 3])], axis=1)
        return np.zeros((len(observation), 4), np.float32), ((known - known.mean(0)) / known.std(0),)


def test_the_regression_finds_the_pose_that_the_trvs_tell_and_no_other(monkeypatch):
    known = knowledge.grasp_knowledge(Tells(monkeypatch), dict(yaw_range=(0.0, 2 * np.pi)), n_episodes=400)
    assert known["x"] > 0.99
    assert known["y"] < 0.1
    assert known["yaw"] == pytest.approx(0.5, abs=0.1), "the cosine, not the sine"
