"""Callbacks select policies, stop on an interrupt and detect divergence."""

import json
import math

import numpy as np
import pytest
import torch as th
from small_problems import (
    AtEveryEpoch,
    AtEveryStep,
    assert_same_parameters,
    lava_env,
    parameters,
    same_parameters,
    tiny_tdpg,
    toy_vec_env,
    train_epochs,
)
from stable_baselines3.common.callbacks import CallbackList
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg import (
    TDPG,
    BatchedVecEnv,
    MINECallback,
    SelectionCallback,
    TrainingCheckpointCallback,
    TrainingDivergedError,
)
from sb3_tdpg.callbacks import Candidate
from sb3_tdpg.envs.lava import LavaEnv


class Scripted(AtEveryEpoch):
    """Overwrite the measurements of each epoch; it must come before the selection in the list of callbacks."""

    def __init__(self, measured):
        self.policies = {}
        super().__init__(self.overwrite)
        self.measured = measured

    def overwrite(self, model):
        cost, information = self.measured[model.epoch]
        model.rollout_buffer.costs[:] = cost / model.horizon
        model.information = np.full(model.horizon, information / model.horizon)
        self.policies[model.epoch] = parameters(model.policy)


MEASURED = [(50.0, 0.1), (30.0, 3.0), (35.0, 0.4), (25.0, 0.9), (38.0, 0.2), (20.0, 2.0), (60.0, 0.0)]


@pytest.mark.parametrize(("limits", "chosen"), [
    (dict(cost_limit=40.0), 4),  # the paper's rule: the lowest information under a cost limit
    (dict(cost_limit=32.0), 3),
    (dict(mi_limit=1.0), 3),  # the lowest cost under a limit on the information
    (dict(mi_limit=0.3), 4),
    (dict(mi_limit=5.0), 5),
    (dict(cost_limit=45.0, mi_limit=0.5), 2),
    (dict(cost_limit=math.inf), 6),
], ids=str)  # fmt: skip
def test_the_epoch_that_the_rule_asks_for_is_kept_and_restored(limits, chosen, tmp_path):
    script, selection = Scripted(MEASURED), SelectionCallback(**limits, save_path=tmp_path / "beta_0.013")
    model = train_epochs(tiny_tdpg(), len(MEASURED), callback=[script, selection])
    record = json.loads((tmp_path / "beta_0.013.json").read_text())
    saved = TDPG.load(tmp_path / "beta_0.013.zip", device="cpu")
    best = selection.restore(model)
    assert best.epoch == record["epoch"] == chosen
    assert (best.cost, best.information) == pytest.approx(MEASURED[chosen], rel=1e-5)
    assert record["cost"] == pytest.approx(MEASURED[chosen][0])
    # The selected policy is the one that made these rollouts, before their update.
    assert_same_parameters(parameters(model.policy), script.policies[chosen])
    assert_same_parameters(parameters(saved.policy), script.policies[chosen])


def test_unknown_information_does_not_win(tmp_path):
    later = tiny_tdpg(beta=lambda progress: math.inf if progress > 0.5 else 1 / 75)
    selection = SelectionCallback(cost_limit=1e9, save_path=tmp_path / "best")
    train_epochs(later, 6, callback=selection)
    assert math.isfinite(selection.best.information)
    never = SelectionCallback(mi_limit=0.001)
    train_epochs(tiny_tdpg(beta=math.inf), 2, callback=never)
    assert never.best is None
    unknown = Candidate(3, 17.0, math.inf)
    assert Candidate.from_json(unknown.to_json()) == unknown
    assert str(unknown) == "epoch 3: cost 17, information unknown"


@pytest.mark.parametrize("wrap", [list, CallbackList])
def test_the_users_own_mine_callback_replaces_the_default_and_comes_first(wrap):
    model, fits = tiny_tdpg(beta=1.0), []
    fit = model.estimator.fit
    model.estimator.fit = lambda batch: fits.append(1) or fit(batch)
    selection = SelectionCallback(cost_limit=1e9)
    train_epochs(model, 3, callback=wrap([selection, MINECallback()]))
    assert len(fits) == 3
    assert math.isfinite(selection.best.information)


def test_the_first_epoch_with_a_penalty_has_critics_that_were_fitted_to_it():
    model, calls = tiny_tdpg(beta=lambda progress: math.inf if progress > 0.5 else 1 / 75), []
    fit, train = model.estimator.fit, model.train
    model.estimator.fit = lambda batch: calls.append("fit") or fit(batch)
    model.train = lambda: calls.append("penalised" if model.mi_coef > 0 else "plain") or train()
    train_epochs(model, 6)
    penalised = [i for i, call in enumerate(calls) if call == "penalised"]
    assert penalised and all(calls[i - 1] == "fit" for i in penalised)
    assert calls.count("fit") == len(penalised)


def test_a_negative_or_broken_estimate_does_not_win():
    measured = [(30.0, -50.0), (30.0, math.nan), (20.0, 0.0), (math.nan, 0.0)]
    script, selection = Scripted(measured), SelectionCallback(cost_limit=40.0)
    model = tiny_tdpg(baseline="mean", beta=math.inf)  # train() is replaced, so the scripted costs cause no update
    model.train = lambda: setattr(model, "epoch", model.epoch + 1)
    train_epochs(model, 4, callback=[script, selection])
    # An information of -50 counts as 0, so the lower cost decides.
    assert selection.best.epoch == 2


def test_without_an_eligible_epoch_the_error_names_the_limits_and_the_model_stays():
    selection = SelectionCallback(cost_limit=-1.0, mi_limit=0.0)
    model = train_epochs(tiny_tdpg(), 1, callback=selection)
    before = parameters(model.policy)
    with pytest.raises(ValueError, match=r"cost < -1.0, information < 0.0.*train longer or loosen"):
        selection.restore(model)
    assert_same_parameters(before, parameters(model.policy))


def test_observations_whose_normalisation_would_not_be_selected_are_refused():
    selection = SelectionCallback(cost_limit=1e9)
    with pytest.raises(ValueError, match=r"not the statistics of VecNormalize.*normalize_observations=True"):
        train_epochs(tiny_tdpg(VecNormalize(lava_env(), norm_reward=False)), 1, callback=selection)
    train_epochs(tiny_tdpg(VecNormalize(lava_env(), norm_obs=False, norm_reward=False)), 1, callback=selection)
    assert selection.best is not None
    frozen = VecNormalize(lava_env(), norm_reward=False, training=False)
    train_epochs(tiny_tdpg(frozen), 1, callback=SelectionCallback(cost_limit=1e9))


def test_a_selection_goes_on_with_a_resumed_training_and_starts_anew_with_a_new_one(tmp_path):
    model = tiny_tdpg()
    path = tmp_path / "best"
    train_epochs(model, 3, callback=[Scripted(MEASURED), SelectionCallback(cost_limit=40.0, save_path=path)])
    resumed = SelectionCallback(cost_limit=40.0, save_path=path)
    # Epochs 3 and 4 are worse than epoch 2 of the first training.
    worse = [None] * 3 + [(39.0, 5.0)] * 2
    train_epochs(model, 2, callback=[Scripted(worse), resumed], reset_num_timesteps=False)
    assert resumed.best.epoch == 2
    saved = TDPG.load(path, device="cpu")
    resumed.restore(model)
    assert_same_parameters(parameters(saved.policy), parameters(model.policy))
    fresh = SelectionCallback(cost_limit=40.0, save_path=path)
    train_epochs(model, 1, callback=[Scripted([(39.0, 5.0)]), fresh])
    assert fresh.best.epoch == 0


def test_a_selection_of_another_training_or_under_looser_limits_is_not_taken_over(tmp_path):
    path = tmp_path / "best"
    train_epochs(tiny_tdpg(), 3, callback=[Scripted(MEASURED), SelectionCallback(cost_limit=40.0, save_path=path)])
    assert path.with_suffix(".json").exists()
    tighter = SelectionCallback(cost_limit=1.0, save_path=path)
    model = train_epochs(tiny_tdpg(), 1)
    train_epochs(model, 1, callback=tighter, reset_num_timesteps=False)
    assert tighter.best is None
    train_epochs(tiny_tdpg(), 1, callback=SelectionCallback(cost_limit=1.0, save_path=path))  # selects no policy
    assert not path.with_suffix(".json").exists()


def test_going_on_from_a_saved_selection_does_not_repeat_the_random_numbers_of_the_start(tmp_path):
    model, path = tiny_tdpg(), tmp_path / "best"
    train_epochs(model, 2, callback=SelectionCallback(cost_limit=1e9, save_path=path))
    first = []
    for callback in (None, SelectionCallback(cost_limit=1e9, save_path=path)):
        th.manual_seed(123)
        callbacks = [AtEveryEpoch(lambda m: first.append(m.rollout_buffer.noise.copy()))]
        train_epochs(model, 1, callback=[*callbacks, *([callback] if callback else [])], reset_num_timesteps=False)
    np.testing.assert_array_equal(*first)


def test_the_user_s_callbacks_find_the_information_of_the_epoch_that_has_just_been_rolled_out():
    seen = []
    model = train_epochs(tiny_tdpg(), 3, callback=AtEveryEpoch(lambda m: seen.append(m.information.copy())))
    batch = model.rollout_buffer.episode_batch().information_batch()
    np.testing.assert_allclose(seen[-1], model.estimator(batch).detach(), rtol=1e-5)
    assert len({x.sum() for x in seen}) == 3


@pytest.mark.parametrize("at_step", [1, 13, 15], ids=["first_step", "mid_rollout", "end_of_rollout"])
def test_ctrl_c_in_mid_rollout_leaves_a_model_that_predicts_saves_and_learns_on(at_step, tmp_path):
    after_epoch, model = {}, tiny_tdpg(mi_estimator="mine")

    def interrupt(callback):
        if callback.n_calls % 5 == 1:
            after_epoch[model.epoch] = parameters(model.policy)
        if callback.n_calls == at_step:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_epochs(model, 10, callback=AtEveryStep(interrupt), progress_bar=True)
    assert model.epoch == (at_step - 1) // 5
    assert_same_parameters(parameters(model.policy), after_epoch[model.epoch])
    model.predict(np.zeros((3, 2), np.float32))
    model.save(tmp_path / "model")
    assert_same_parameters(parameters(TDPG.load(tmp_path / "model", device="cpu").policy), parameters(model.policy))
    epoch = model.epoch
    train_epochs(model, 2, reset_num_timesteps=False, progress_bar=True)
    assert model.epoch >= epoch + 2
    assert model.rollout_buffer.alive.all()
    assert (model.rollout_buffer.states[0, :, 1] == 0).all()


def test_ctrl_c_while_the_critics_are_fitted_leaves_a_usable_model(tmp_path, monkeypatch):
    model = train_epochs(tiny_tdpg(mi_estimator="mine"), 1)
    before, steps, original = parameters(model.policy), [], th.optim.Adam.step

    def interrupt_the_second_step(optimizer):
        steps.append(optimizer)
        if len(steps) == 2:
            raise KeyboardInterrupt
        original(optimizer)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(th.optim.Adam, "step", interrupt_the_second_step)
        train_epochs(model, 2, reset_num_timesteps=False)
    assert_same_parameters(parameters(model.policy), before)
    model.save(tmp_path / "model")
    train_epochs(TDPG.load(tmp_path / "model", env=BatchedVecEnv(LavaEnv(), 20), device="cpu"), 1)
    train_epochs(model, 2, reset_num_timesteps=False)
    assert np.isfinite(model.information).all()


@pytest.mark.parametrize("beta", [math.inf, 0.1])
def test_a_cost_that_is_nan_stops_the_training_and_leaves_the_last_good_parameters(beta, tmp_path):
    model, path, good = tiny_tdpg(toy_vec_env(n_envs=4), beta=beta), tmp_path / "checkpoint.zip", {}

    def poison(m):
        good.update(parameters(m.policy))
        if m.epoch == 2:
            m.rollout_buffer.costs[1, 2] = math.nan

    with pytest.raises(TrainingDivergedError, match=r"costs of epoch 2 is NaN or infinite.*Check the environment"):
        train_epochs(model, 10, callback=[TrainingCheckpointCallback(path, save_freq=1), AtEveryEpoch(poison)])
    assert model.epoch == 2
    assert_same_parameters(parameters(model.policy), good)
    loaded = TDPG.load(path, env=toy_vec_env(n_envs=4), device="cpu")
    assert loaded.epoch == 2
    assert_same_parameters(parameters(loaded.policy), good)
    train_epochs(model, 1, reset_num_timesteps=False)
    assert not same_parameters(parameters(model.policy), good)


@pytest.mark.parametrize("field", ["observations", "states"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_nan_in_an_observation_or_a_state_never_reaches_the_parameters(field, value):
    model, good = tiny_tdpg(beta=0.1, mi_estimator="mine"), {}
    add_step = model.rollout_buffer.add_step

    def poisoned(t, episodes, **stored):
        if model.epoch == 1:
            good.update(parameters(model.policy))
            stored[field] = np.where(np.arange(20)[:, None] == 3, value, stored[field])
        add_step(t, episodes, **stored)

    model.rollout_buffer.add_step = poisoned
    with pytest.raises(TrainingDivergedError):
        train_epochs(model, 4)
    assert_same_parameters(parameters(model.policy), good)


def test_an_infinite_gradient_stops_the_training_before_the_step():
    model = train_epochs(tiny_tdpg(beta=math.inf), 1)
    good = parameters(model.policy)
    next(model.policy.parameters()).register_hook(lambda gradient: gradient * math.inf)
    with pytest.raises(TrainingDivergedError, match=r"gradient of epoch 1.*max_grad_norm"):
        train_epochs(model, 1, reset_num_timesteps=False)
    assert_same_parameters(parameters(model.policy), good)


@pytest.mark.parametrize(("n_episodes", "mi_estimator", "beta", "warns"), [
    (39, "mine", 0.1, True),
    (40, "mine", 0.1, False),
    (39, "infonce", 0.1, True),
    (4, "logdet", 0.1, False),
    (4, "vib", 0.1, False),
    (4, "mine", np.inf, False),  # without a penalty any number of episodes is enough
])  # fmt: skip
def test_too_few_episodes_for_the_critics_are_told_with_the_number(n_episodes, mi_estimator, beta, warns, recwarn):
    # There are two TRVs and two components of the state.
    train_epochs(tiny_tdpg(n_episodes=n_episodes, mi_estimator=mi_estimator, beta=beta), 1)
    messages = [str(w.message) for w in recwarn if "are too few for" in str(w.message)]
    assert len(messages) == warns
    assert all(f"n_episodes={n_episodes} are too few" in m and "n_episodes=40 or more" in m for m in messages)
