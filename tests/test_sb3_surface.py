"""TDPG behaves as users of Stable-Baselines3 expect from an algorithm."""

import io
import math
import re

import numpy as np
import pytest
import torch as th
from small_problems import (
    TINY_CRITIC,
    AtEveryEpoch,
    AtEveryStep,
    CountdownEnv,
    assert_same_parameters,
    lava_env,
    parameters,
    same_parameters,
    tiny_tdpg,
    toy_vec_env,
    train_epochs,
)
from stable_baselines3.common.callbacks import CallbackList, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_tdpg import TDPG, BatchedVecEnv, make_episodes_env
from sb3_tdpg.callbacks import TDPGProgressBar
from sb3_tdpg.envs.lava import LavaEnv


def stochastic_predictions(model, observation):
    """Return the actions of one whole episode; a seed determines the noise."""
    th.manual_seed(1)
    actions, state = [], None
    for _ in range(model.horizon):
        action, state = model.predict(observation, state)
        actions.append(action)
    return np.stack(actions)


def test_the_learning_rate_follows_its_schedule_and_leaves_the_critics_alone():
    model = tiny_tdpg(learning_rate=LinearSchedule(1e-2, 1e-4, 1.0), mi_estimator="mine")
    rates = []
    train_epochs(model, 4, callback=AtEveryEpoch(lambda m: rates.append(m.policy.optimizer.param_groups[0]["lr"])))
    assert rates[0] == pytest.approx(1e-2)
    assert np.diff(rates[1:]).max() < 0
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(1e-4)
    assert model.estimator.learning_rate == 1e-3


def test_keywords_reach_the_policy_and_the_estimator():
    of_policy = dict(trv_dim=3, time_varying=False, optimizer_class=th.optim.SGD)
    model = tiny_tdpg(policy_kwargs=of_policy, mi_estimator="mine", mi_kwargs={**TINY_CRITIC, "ema_decay": 0.5})
    assert (model.policy.trv_dim, model.policy.time_varying, model.estimator.trv_dim) == (3, False, 3)
    assert isinstance(model.policy.optimizer, th.optim.SGD)
    assert model.estimator.ema_decay == 0.5


def test_the_same_seed_gives_the_same_training_from_an_id_or_an_environment_and_another_seed_another():
    def train(seed, env="Lava-v0"):
        return parameters(train_epochs(tiny_tdpg(env, seed=seed, mi_estimator="mine"), 2).policy)

    assert_same_parameters(train(3), train(3, make_episodes_env("Lava-v0", n_episodes=20)))
    assert not same_parameters(train(3), train(4))


def test_learning_twice_starts_anew_or_goes_on_as_asked():
    model = train_epochs(tiny_tdpg(), 2)
    train_epochs(model, 2)
    assert (model.epoch, model.num_timesteps) == (2, 200)
    train_epochs(model, 3, reset_num_timesteps=False)
    assert (model.epoch, model.num_timesteps) == (5, 500)


def test_a_saved_model_predicts_the_same_with_and_without_an_environment(tmp_path):
    model = train_epochs(tiny_tdpg(mi_estimator="mine"), 2)
    model.save(tmp_path / "model")
    observation = np.random.default_rng(0).normal(size=(3, 2)).astype(np.float32)
    expected = stochastic_predictions(model, observation)
    for env in (None, lava_env()):
        loaded = TDPG.load(tmp_path / "model", env=env, device="cpu")
        np.testing.assert_array_equal(stochastic_predictions(loaded, observation), expected)
        assert_same_parameters(parameters(model.estimator), parameters(loaded.estimator))
        assert (loaded.horizon, loaded.epoch, loaded.num_timesteps) == (5, 2, 200)
        assert loaded.mi_coef == model.mi_coef
    train_epochs(loaded, 1, reset_num_timesteps=False)
    assert loaded.epoch == 3


def test_a_model_is_saved_to_a_file_object_and_under_any_name(tmp_path):
    model, file = tiny_tdpg(), io.BytesIO()
    for given in (file, tmp_path / "new" / "beta_0.5.zip", str(tmp_path / "name"), tmp_path / "beta_0.0133"):
        model.save(given)
        file.seek(0)
        assert_same_parameters(parameters(TDPG.load(given, device="cpu").policy), parameters(model.policy))
    assert (tmp_path / "new" / "beta_0.5.zip").exists()
    assert (tmp_path / "name.zip").exists()
    assert not list(tmp_path.rglob("*.partial"))


def test_a_loaded_model_asks_for_an_environment_and_can_be_given_one_later(tmp_path):
    tiny_tdpg().save(tmp_path / "model")
    model = TDPG.load(tmp_path / "model", device="cpu")
    with pytest.raises(Exception, match="set_env"):
        model.learn(100)
    model.set_env(BatchedVecEnv(LavaEnv(sensor_noise_std=30.0), 20))
    train_epochs(model, 1)
    assert np.std(model.rollout_buffer.observations - model.rollout_buffer.states) > 20


def test_evaluate_policy_clears_the_memory_between_episodes():
    model = tiny_tdpg()
    # Each environment runs more than one episode: without episode_start, the policy would go beyond the horizon.
    rewards, lengths = evaluate_policy(
        model, lava_env(4), n_eval_episodes=12, deterministic=False, return_episode_rewards=True, warn=False
    )
    assert lengths == [5] * 12
    assert np.mean(rewards) < 0


def test_evaluation_in_mid_rollout_does_not_disturb_the_training(tmp_path):
    # Policy and environment are deterministic, so that the evaluation draws no random numbers.
    evaluation = EvalCallback(lava_env(4), n_eval_episodes=8, eval_freq=3, verbose=0, best_model_save_path=tmp_path)
    plain, evaluated = (train_epochs(tiny_tdpg(), 3, callback=callback) for callback in (None, evaluation))
    assert_same_parameters(parameters(plain.policy), parameters(evaluated.policy))
    TDPG.load(tmp_path / "best_model", device="cpu")


@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.parametrize("is_terminal", [True, False])
def test_progress_has_lines_where_there_is_no_terminal(monkeypatch, capsys, is_terminal):
    rich = pytest.importorskip("rich")
    monkeypatch.setattr(type(rich.get_console()), "is_terminal", is_terminal)
    monkeypatch.setattr(TDPGProgressBar, "SECONDS", 0.0)
    train_epochs(tiny_tdpg(), 2, progress_bar=True)
    lines = [line for line in capsys.readouterr().out.splitlines() if " of 200 steps, cost " in line]
    assert [re.sub(r"^\d+ s: ", "", line).split(" of")[0] for line in lines] == ([] if is_terminal else ["100", "200"])


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_the_progress_bar_shows_the_share_of_failures_where_an_episode_can_succeed(monkeypatch):
    pytest.importorskip("rich")
    shown = []
    draw = TDPGProgressBar._on_rollout_end
    monkeypatch.setattr(TDPGProgressBar, "_on_rollout_end", lambda bar: (draw(bar), shown.append(bar.pbar.desc)))
    model = train_epochs(tiny_tdpg(), 1, progress_bar=True)
    model.ep_success_buffer.extend([True, True, True, False])
    train_epochs(model, 1, progress_bar=True, reset_num_timesteps=False)
    assert "failures" not in shown[0]
    assert ", 25% failures" in shown[1]


def test_the_log_has_what_the_paper_plots_and_the_single_steps_go_to_tensorboard_only(tmp_path):
    event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    model = tiny_tdpg(mi_estimator="mine")
    model.set_logger(configure(str(tmp_path), ["csv", "tensorboard"]))
    costs, information = [], []

    def remember(m):
        costs.append(m.rollout_buffer.episode_costs.mean())
        information.append(m.information)

    train_epochs(model, 3, callback=AtEveryEpoch(remember))
    model.logger.close()
    events = event_accumulator.EventAccumulator(str(tmp_path))
    events.Reload()
    scalars = {key: [event.value for event in events.Scalars(key)] for key in events.Tags()["scalars"]}
    per_step = {f"mi/t{t:02d}" for t in range(5)}
    expected = {"rollout/ep_cost_mean", "train/objective", "train/learning_rate", "mi/total", "mi/critic_refits"}
    assert per_step | expected <= set(scalars)
    np.testing.assert_allclose(scalars["rollout/ep_cost_mean"], costs, rtol=1e-5)
    np.testing.assert_allclose(scalars["mi/total"], np.sum(information, axis=1), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(scalars["mi/t03"], np.array(information)[:, 3], rtol=1e-4, atol=1e-6)
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    assert expected <= set(header)
    assert not per_step & set(header)


@pytest.mark.parametrize("callback", [
    [AtEveryStep(lambda c: None), StopTrainingOnMaxEpisodes(1)],
    CallbackList([StopTrainingOnMaxEpisodes(1)]),
    lambda local_variables, global_variables: local_variables["self"].num_timesteps < 100,
], ids=["list", "CallbackList", "function"])  # fmt: skip
def test_callbacks_are_given_as_one_or_a_list_or_a_function_and_see_the_episodes(callback):
    assert train_epochs(tiny_tdpg(), 5, callback=callback).num_timesteps == 100


def test_what_the_critics_make_of_held_out_episodes_is_in_the_log():
    model = tiny_tdpg(mi_estimator="mine", mi_kwargs={**TINY_CRITIC, "held_out": 0.2})
    logged = []
    train_epochs(model, 2, callback=AtEveryEpoch(lambda m: logged.append(dict(m.logger.name_to_value))))
    for values in logged:
        assert np.isfinite([values["mi/held_out"], values["mi/trained_on"]]).all()


@pytest.mark.parametrize("mi_estimator", ["mine", "nwj", "smile", "infonce", "logdet", "loo", "vib"])
def test_every_estimator_trains_from_its_name_and_its_parameters_fit_another_model(mi_estimator):
    first, second = (tiny_tdpg(seed=seed, mi_estimator=mi_estimator) for seed in (0, 1))
    train_epochs(first, 2)
    assert np.isfinite(first.information).all()
    found = first.get_parameters()
    assert set(found) == {"policy", "policy.optimizer", "estimator"}
    assert all(isinstance(x, th.Tensor) for x in (*found["policy"].values(), *found["estimator"].values()))
    assert not same_parameters(parameters(first.policy), parameters(second.policy))
    second.set_parameters(found)
    assert_same_parameters(parameters(first.policy), parameters(second.policy))
    assert_same_parameters(parameters(first.estimator), parameters(second.estimator))


def test_an_estimator_of_ones_own_is_given_as_a_class_and_saved(tmp_path):
    from sb3_tdpg.information.logdet import LogDet

    model = train_epochs(tiny_tdpg(mi_estimator=LogDet, mi_kwargs={}), 1)
    model.save(tmp_path / "model")
    assert isinstance(TDPG.load(tmp_path / "model", device="cpu").estimator, LogDet)


def test_the_discount_reaches_the_advantages():
    gradients = []
    for gamma in (1.0, 0.5):
        model = train_epochs(tiny_tdpg(beta=math.inf, gamma=gamma, policy_kwargs=dict(optimizer_class=th.optim.SGD)), 1)
        gradients.append(next(iter(model.policy.parameters())).grad.clone())
    assert not th.allclose(*gradients)


def test_vectors_stay_on_the_cpu_unless_asked(tmp_path, monkeypatch):
    tiny_tdpg().save(tmp_path / "model")
    monkeypatch.setattr("stable_baselines3.common.base_class.get_device", lambda device: th.device("cuda"))
    assert tiny_tdpg(device="auto").device.type == "cpu"
    assert TDPG.load(tmp_path / "model", device="auto").device.type == "cpu"
    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    assert tiny_tdpg(device="cuda:0", _init_setup_model=False).device.type == "cuda"


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("mi_estimator", ["mine", "logdet"])
def test_everything_runs_on_the_gpu(mi_estimator, tmp_path):
    model = train_epochs(tiny_tdpg(mi_estimator=mi_estimator, device="cuda"), 2)
    assert {p.device.type for p in [*model.policy.parameters(), *model.estimator.parameters()]} <= {"cuda"}
    model.save(tmp_path / "model")
    TDPG.load(tmp_path / "model", device="cpu").predict(np.zeros(2, np.float32))
    train_epochs(TDPG.load(tmp_path / "model", env=lava_env(), device="cuda"), 1)


def test_an_episode_that_runs_beyond_the_declared_horizon_is_refused():
    class Liar(CountdownEnv):
        horizon = 2

    model = tiny_tdpg(DummyVecEnv([lambda: Liar(0, [3])]), n_episodes=2)
    with pytest.raises(ValueError, match=r"did not end after horizon=2 steps.*declare its true horizon"):
        model.learn(10)


def test_an_environment_that_leaves_out_its_state_is_refused_with_the_mend():
    env = toy_vec_env()
    for e in env.envs:
        e._info = dict
    with pytest.raises(ValueError, match=r'no info\["state"\]'):
        train_epochs(tiny_tdpg(env), 1)


def test_the_first_deterministic_evaluation_warns_that_it_is_another_policy():
    model = tiny_tdpg()
    with pytest.warns(UserWarning, match=r"deterministic=True .* not the policy that was trained") as warned:
        for _ in range(2):
            evaluate_policy(model, make_episodes_env("Lava-v0", 2), n_eval_episodes=2)
    assert len([w for w in warned if "deterministic=True" in str(w.message)]) == 1


def test_a_dict_and_the_tuple_that_a_gymnasium_reset_returns_are_refused():
    with pytest.raises(ValueError, match="mixing Gym API with SB3 VecEnv API"):
        tiny_tdpg().predict(LavaEnv().reset())
    with pytest.raises(AssertionError, match="The observation provided is a dict"):
        tiny_tdpg().predict({"a": np.zeros(2, np.float32)})
