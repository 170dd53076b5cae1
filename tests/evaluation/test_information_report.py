"""What a policy's TRVs know: of each component, in the report with its figures, in the log, and in an episode."""

import math

import numpy as np
import pandas as pd
import pytest
import torch as th
from information_problems import channel, gaussian_batch, generator
from small_problems import CountdownEnv, lava_env, tiny_tdpg, train_epochs
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdpg import InformationCallback, SelectionCallback, make_episodes_env
from sb3_tdpg.envs.lava import LavaEnv
from sb3_tdpg.envs.scenarios import LAVA
from sb3_tdpg.evaluation import (
    InformationReport,
    information_interval,
    information_report,
    information_timeline,
    knowledge_map,
    save_figure,
    state_knowledge,
)
from sb3_tdpg.evaluation import information as information_module
from sb3_tdpg.evaluation.information import encode_episodes, information_bounds, rollout_information
from sb3_tdpg.evaluation.interval import component_estimates
from sb3_tdpg.information import InformationBatch
from sb3_tdpg.information.loo import own_sample_bound

PROBLEM = "Lava-v0"


def looking_at_the_first_then_the_second():
    """Two time steps: the TRVs tell the first component of three, then the second; the third is constant."""
    rng = np.random.default_rng(0)
    states = rng.standard_normal((2, 300, 3)) * np.array([1.0, 5.0, 0.0])
    return channel(states, 3 * np.stack([states[0, :, :1], states[1, :, 1:2] / 5]), 1.0, rng)


def test_the_knowledge_is_of_the_component_that_the_trvs_tell():
    frame = state_knowledge(looking_at_the_first_then_the_second(), names=("a", "b", "c"))
    assert list(frame.columns) == ["t", "component", "nats", "nats_lower", "r2"]
    assert list(frame["component"].unique()) == ["a", "b"]
    nats, r2 = (frame.pivot(index="t", columns="component", values=name) for name in ("nats", "r2"))
    truth = 0.5 * math.log(10)
    np.testing.assert_allclose(nats, [[truth, 0], [0, truth]], atol=0.15)
    np.testing.assert_allclose(r2, [[0.9, 0], [0, 0.9]], atol=0.05)
    assert (frame["nats_lower"] <= frame["nats"]).all()
    assert (frame["nats_lower"] > 0).tolist() == [True, False, False, True]
    with pytest.raises(ValueError, match="a name for each of the 3"):
        state_knowledge(looking_at_the_first_then_the_second(), names=("a", "b"))


def test_what_many_trvs_know_of_two_components_is_found_in_each_of_them():
    # Given one component, the density of the TRVs is a band along the other one.
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (1, 500, 2))
    batch = channel(states, np.tanh(2 * states @ rng.standard_normal((2, 16))), 0.2, rng)
    frame = state_knowledge(batch)
    assert (frame["r2"] > 0.9).all()
    assert (frame["nats_lower"] > 0.8).all()
    # No more than a sensor that shows nothing but this component, with as much noise as the regression leaves.
    assert (frame["nats"] < -0.5 * np.log(1 - frame["r2"]) + 0.3).all()


def test_a_component_that_is_constant_at_one_step_only_has_no_number_there():
    batch = looking_at_the_first_then_the_second()
    batch.states[0, :, 1] = 2.0
    estimates, limits = component_estimates(batch)
    np.testing.assert_array_equal(np.isnan(estimates), [[False, True, True], [False, False, True]])
    np.testing.assert_array_equal(np.isnan(limits), np.isnan(estimates))
    frame = state_knowledge(batch)
    assert frame["r2"].isna().tolist() == [False, True, False, False]


def test_the_report_on_a_policy_has_frames_and_figures(tmp_path):
    model = tiny_tdpg(PROBLEM)
    env = make_episodes_env(PROBLEM, n_episodes=40)
    report = information_report(model, env, n_episodes=50, seed=3)
    assert len(set(report.costs.tolist())) == 50, "the episodes of the two rounds differ"
    assert report.frame["t"].tolist() == list(range(model.horizon))
    assert (report.frame["n_episodes"] == 50).all()
    assert (report.frame["lower"] <= report.frame["upper"]).all()
    assert "summed over time" in str(report)
    assert report.knowledge.loc[report.knowledge["component"] == "v (m/step)", "nats"].isna().tolist()[0], "v_0 = 0"
    for name, figure in report.figures().items():
        save_figure(figure, tmp_path / f"{name}.png")
    assert {path.stem for path in tmp_path.iterdir()} >= {"timeline", "knowledge"}
    again = information_report(model, env, n_episodes=50, seed=3)
    pd.testing.assert_frame_equal(report.frame, again.frame)
    env.close()


def test_a_component_is_never_known_better_than_the_whole_state(monkeypatch):
    def too_much(batch, names, *, seed):
        frame = state_knowledge(batch, names, seed=seed)
        return frame.assign(nats=350.0, nats_lower=300.0)

    monkeypatch.setattr(information_module, "state_knowledge", too_much)
    report = information_report(tiny_tdpg(PROBLEM), make_episodes_env(PROBLEM, n_episodes=50), n_episodes=50, seed=3)
    for name in ("nats", "nats_lower"):
        np.testing.assert_allclose(report.knowledge[name], report.interval.upper[report.knowledge["t"]])


@pytest.mark.parametrize(("names", "shown"), [
    (LavaEnv.state_names, {"d (m)", "v (m/step)"}), (("place", "speed"), {"place", "speed"}), (None, {"x0", "x1"}),
], ids=["the environment's", "others", "numbers"])  # fmt: skip
def test_the_report_calls_the_components_as_the_environment_does(names, shown, monkeypatch):
    monkeypatch.setattr(LavaEnv, "state_names", names)
    report = information_report(tiny_tdpg(PROBLEM), lava_env(50), n_episodes=50, seed=0)
    assert set(report.knowledge["component"]) == shown
    labels = report.figures()["knowledge"].axes[0].get_yticklabels()
    assert {label.get_text() for label in labels} == shown


def test_a_report_tells_of_the_steps_that_its_sum_leaves_out():
    env = DummyVecEnv([lambda: CountdownEnv(0, (4,))] + 59 * [lambda: CountdownEnv(1, (2,))])
    report = information_report(tiny_tdpg(env, n_episodes=60), env, n_episodes=60, seed=0)
    assert report.frame["upper"].isna().tolist() == [False, False, True, True]
    assert "60 episodes, 2 steps with too few of them left out" in str(report)


def test_the_trvs_of_fresh_episodes_have_the_density_of_the_encoder():
    batch, _ = encode_episodes(tiny_tdpg(PROBLEM), lava_env(500))
    noise = (batch.trvs - batch.means) / batch.stds
    assert noise.square().mean().item() == pytest.approx(1, abs=5 * math.sqrt(2 / noise.numel()))


def test_a_report_of_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="no time step has an interval: at most 10 episodes are alive"):
        information_report(tiny_tdpg(), lava_env(10), n_episodes=10)
    with pytest.raises(ValueError, match=r"is of PPO.*TDPG"):
        information_report(PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8), lava_env(4), n_episodes=40)
    with pytest.raises(ValueError, match=r"observation_space is Box\(-inf.*environment's is Box\(\["):
        information_report(tiny_tdpg(), make_vec_env("Pendulum-v1", 4), n_episodes=40)


@pytest.mark.parametrize("callback", [InformationCallback(), SelectionCallback(cost_limit=1.0)])
def test_a_callback_of_tdpg_refuses_other_algorithms(callback):
    model = PPO("MlpPolicy", "Pendulum-v1", n_steps=8, batch_size=8)
    with pytest.raises(ValueError, match=f"{type(callback).__name__} is for TDPG.*PPO"):
        model.learn(8, callback=callback)


def test_the_map_shows_every_value_and_marks_what_is_not_known():
    frame = state_knowledge(looking_at_the_first_then_the_second(), names=("a", "b", "c"))
    axes = knowledge_map(frame).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == ["a", "b"]
    texts = [text.get_text() for text in axes.texts]
    assert len(texts) == 4
    assert [text.startswith("(") for text in texts] == [False, True, True, False]
    np.testing.assert_allclose(
        axes.images[0].get_array(), frame.pivot(index="component", columns="t", values="nats").to_numpy()
    )
    with pytest.raises(ValueError, match="no component"):
        knowledge_map(frame.iloc[:0])


def test_the_timeline_names_the_bounds():
    interval = information_interval(gaussian_batch(100, [[0.0, 0.0], [100.0, 100.0]], generator=generator()))
    axes = information_timeline(InformationReport(interval, pd.DataFrame(), np.zeros(0)).frame).axes[0]
    labels = axes.get_legend_handles_labels()[1]
    assert {"lower: frozen critic", "lower: never negative"} < set(labels)
    assert any("ln N" in label for label in labels)


def test_the_callback_logs_the_interval_at_its_epochs_and_changes_nothing_in_the_training(tmp_path, monkeypatch):
    # The console cuts these to the same name.
    wheels = [f"angular velocity of the wheel on the {side}" for side in ("left", "right")]
    monkeypatch.setattr(LavaEnv, "state_names", tuple(f"{name} (rad/s)" for name in wheels))
    losses = []
    for callback in (None, InformationCallback(2)):
        model = tiny_tdpg(PROBLEM, n_episodes=30, beta=float("inf"))
        folder = tmp_path / str(callback is None)
        model.set_logger(configure(str(folder), ["csv", "log"]))
        train_epochs(model, 4, callback=callback)
        losses.append(pd.read_csv(folder / "progress.csv"))
    plain, watched = losses
    pd.testing.assert_series_equal(plain["rollout/ep_cost_mean"], watched["rollout/ep_cost_mean"])
    assert not [name for name in plain if name.startswith("mi/")]
    assert {"mi/lower", "mi/upper", *(f"mi/knows_{name}" for name in wheels)} <= set(watched)
    # The CSV logger fills what is missing in a row with nothing.
    assert watched["mi/upper"].notna().tolist() == [True, False, True, False]
    assert (watched["mi/lower"].dropna() <= watched["mi/upper"].dropna()).all()


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
