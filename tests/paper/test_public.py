"""The benchmark on public tasks: what it trains, how it goes on, and what its tables say."""

import dataclasses

import gymnasium as gym
import numpy as np
import pandas as pd
import pytest

pytest.importorskip("popgym")
pytest.importorskip("mujoco")
pytest.importorskip("rl_zoo3")
pytest.importorskip("rliable")

from sb3_tdpg import TDPG
from sb3_tdpg.paper import public_trainings
from sb3_tdpg.paper.public import Records, make_trainings
from sb3_tdpg.paper.public_trainings import LIMIT, PRESET, TASKS, Training, complete_training, with_limit

CARTPOLE = TASKS[0]


@pytest.fixture(autouse=True)
def _few_episodes(monkeypatch):
    monkeypatch.setattr(public_trainings, "N_EVAL_ENVS", 3)


def trained(root, method=PRESET, seed=200):
    task = dataclasses.replace(CARTPOLE, n_timesteps=400)
    settings = None if method == "PPO" else dict(epoch_steps=200, batch_size=100, n_epochs=1)
    training = Training(task, method, seed, settings, n_eval_episodes=3)
    return training, complete_training(training, root)


def episodes_of(returns, *, deterministic):
    """Episodes on CartPole: for each method, what each of its seeds returns."""
    return pd.DataFrame(
        dict(env_id="CartPole-v1", method=method, train_seed=seed, deterministic=deterministic, **{"return": value})
        for method, values in returns.items()
        for seed, value in enumerate(values)
    )


@pytest.mark.parametrize("task", TASKS, ids=lambda task: task.env_id)
def test_every_task_declares_its_horizon_and_has_settings_of_the_zoo(task):
    env = gym.make(task.env_id)
    assert env.get_wrapper_attr("_max_episode_steps") >= 50
    assert task.zoo_block()["policy"] == ("MlpLstmPolicy" if task.hidden else "MlpPolicy")


def test_hopper_without_velocities_shows_the_positions_only():
    hidden, full = gym.make("HopperNoVel-v5"), gym.make("Hopper-v5")
    shown, everything = hidden.reset(seed=3)[0], full.reset(seed=3)[0]
    np.testing.assert_array_equal(shown, everything[:5])
    assert hidden.observation_space.contains(shown)
    assert full.unwrapped.model.nq - 1 == 5  # all but the position along the track


def test_a_task_of_popgym_which_keeps_its_state_to_itself_can_be_trained_on():
    model = TDPG("TRVPolicy", "RepeatPreviousEasy-v0", epoch_steps=200, batch_size=100, n_epochs=1, seed=0)
    assert "state_space" in vars(gym.make("RepeatPreviousEasy-v0").unwrapped)
    assert model.learn(200).state_dim == 1  # the observation


@pytest.mark.parametrize("method", [PRESET, "PPO"])
def test_a_finished_training_is_kept_and_has_all_records(method, tmp_path):
    training, folder = trained(tmp_path, method)
    records = Records([training], tmp_path)
    assert records.times[list(training.labels)].to_dict("records") == [training.labels]
    assert records.times["timesteps"][0] >= 400
    assert records.times["nats"].notna()[0] == (method == PRESET)
    assert records.episodes.groupby("deterministic").size().to_dict() == {True: 3, False: 3}
    assert records.curves["return"].between(1, 500).all()
    before = (folder / "time.json").read_text()
    assert trained(tmp_path, method)[1] == folder
    assert (folder / "time.json").read_text() == before
    with pytest.raises(ValueError, match="other settings"):
        complete_training(dataclasses.replace(training, settings=dict(epoch_steps=300)), tmp_path)


def test_the_page_has_a_table_for_each_question(tmp_path):
    records = Records([trained(tmp_path)[0], trained(tmp_path, "PPO")[0]], tmp_path)
    for name in ("episodes", "times", "curves"):
        table = getattr(records, name)
        hidden = table.replace({"method": {"PPO": "RecurrentPPO"}}).assign(env_id="CartPoleNoVel-v1")
        limited = table[table["method"] == PRESET].assign(method=LIMIT)
        setattr(records, name, pd.concat([table, hidden, limited], ignore_index=True))
    summary = records.write(tmp_path / "out")
    assert (tmp_path / "out" / "summary.md").read_text() == summary
    for part in ("## Final returns", "## Cost limit", "| kept |", "## CPU time", "`sb3-tdpg reproduce public` at"):
        assert part in summary
    assert (tmp_path / "out" / "curves.png").stat().st_size > 10_000


def test_a_return_is_judged_by_the_interval_of_the_rival(tmp_path):
    training, _ = trained(tmp_path)
    records = Records([training], tmp_path)
    verdicts = {}
    for ours in (10.0, 100.0, 300.0):
        returns = {"PPO": (80.0, 90.0, 100.0, 110.0, 120.0), PRESET: (ours,) * 5}
        records.episodes = episodes_of(returns, deterministic=True)
        table = records.returns_table(deterministic=True)
        verdicts[ours] = next(word for word in ("below", "within", "above") if word in table)
    assert verdicts == {10.0: "below", 100.0: "within", 300.0: "above"}


@pytest.mark.parametrize(("reached", "limit"), [(480.0, -456.0), (-200.0, 210.0)])
def test_the_limit_is_a_twentieth_below_what_the_seed_has_reached(reached, limit, tmp_path):
    training = Training(CARTPOLE, PRESET, 200, {})
    episodes = pd.DataFrame({"return": [reached - 1, reached + 1, 7.0], "deterministic": [False, False, True]})
    (tmp_path / training.folder_name).mkdir(parents=True)
    episodes.to_csv(tmp_path / training.folder_name / "episodes.csv")
    limited = with_limit(training, tmp_path)
    assert (limited.method, limited.seed, limited.settings) == (LIMIT, 200, dict(cost_limit=limit))


def test_a_seed_keeps_a_share_of_its_own_return(tmp_path):
    training, _ = trained(tmp_path)
    records = Records([training], tmp_path)
    records.episodes = episodes_of({PRESET: (-100.0, -200.0), LIMIT: (-110.0, -204.0)}, deterministic=False)
    records.times = pd.DataFrame([dict(env_id="CartPole-v1", method=method, nats=2.0) for method in (PRESET, LIMIT)])
    table = records.limit_table()
    assert "0.94 (0.90 to 0.98)" in table
    assert "missed" in table


def test_trainings_have_the_final_seeds_and_the_rivals_the_same():
    listed = make_trainings([200, 201])
    assert len({training.folder_name for training in listed}) == len(listed)
    for task in TASKS:
        methods = [t.method for t in listed if t.task == task and t.seed == 201]
        assert {PRESET, task.rival} <= set(methods)
