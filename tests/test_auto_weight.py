"""With ``beta="auto"`` the weight follows a cost limit, which is a number or a share of the improvement."""

import math

import numpy as np
import pytest
from small_problems import lava_env, parameters, same_parameters, tiny_tdpg, toy_vec_env, train_epochs

from sb3_tdpg import TDPG, SelectionCallback, TrainingDivergedError
from sb3_tdpg.auto_weight import LEVEL_EPOCHS, WINDOW, AutoWeight


def values_of(weight, costs, information=4.0):
    """Update a weight with the costs of epochs; return its value after each of them."""
    return [weight.update(cost, information) or weight.value for cost in costs]


@pytest.mark.parametrize(("limit", "above", "met", "below"), [(10.0, 12.0, 9.0, 5.0), (-400.0, -100.0, -450.0, -490.0)])
def test_the_weight_waits_for_the_limit_then_grows_below_it_and_shrinks_above(limit, above, met, below):
    """Costs are negative returns, so they are negative in environments with positive rewards."""
    *before, start, larger, smaller = values_of(AutoWeight(limit), [above] * 5 + [met, below, above])
    assert before == [0.0] * 5
    assert start * 4.0 == pytest.approx(abs(limit))
    assert larger > start
    assert 0 < smaller < larger


def test_a_limit_close_to_the_best_cost_moves_the_weight_as_fast_as_a_distant_one():
    for limit, best, above in ((-475.0, -500.0, -450.0), (-200.0, -500.0, 100.0)):
        target = (best + limit) / 2
        start, *values = values_of(AutoWeight(limit, by_slack=True), [best, best, target, above, 1e9])
        assert start * 4.0 == pytest.approx(limit - best)
        assert np.log(np.divide(values, start)) / 0.3 == pytest.approx([0.3, 0.3, 0.3 - 1.5, 0.3 - 1.5 - 3])


def test_a_constant_in_every_cost_does_not_change_the_weight_of_a_share():
    values = []
    for constant in (0.0, 5000.0, -5000.0):
        weight = AutoWeight("95%")
        for epoch in range(100):
            cost = 10 + 90 * math.exp(-epoch / 5)
            weight.update(cost + constant, information=4.0, progress_remaining=1 - epoch / 100)
        values.append(weight.value)
    assert values == pytest.approx([values[0]] * 3, rel=1e-6)
    assert values[0] > 4.5 / 4  # the weight has grown since its start


@pytest.mark.parametrize(("cost", "is_penalised"), [(5.0, True), (0.0, False)])
def test_costs_that_never_change_have_a_penalty_unless_they_are_zero(cost, is_penalised, recwarn):
    weight = AutoWeight("95%")
    for epoch in range(40):
        weight.update(cost, information=1.0, progress_remaining=1 - epoch / 40)
    weight.warn_if_never_met()
    assert (weight.value > 0.01) == is_penalised
    assert (not recwarn) == is_penalised


def test_a_slack_limit_does_not_let_the_weight_grow_without_end():
    assert values_of(AutoWeight(10.0), [0.0] * 500, information=0.0)[-1] == pytest.approx(10.0 * 1000.0)


def test_costs_that_are_not_finite_leave_the_weight_alone():
    model = tiny_tdpg(toy_vec_env(n_envs=4, nan_cost_in_episode=3), n_episodes=4, beta="auto", cost_limit=1e3)
    with pytest.raises(TrainingDivergedError, match="costs"):
        train_epochs(model, 10)
    assert math.isfinite(model.mi_coef)


def test_training_keeps_the_cost_at_the_limit_and_takes_information_out():
    passes = dict(n_epochs=4, clip_range=0.2, learning_rate=5e-3)
    arguments = dict(n_episodes=200, encoder_gradient="pathwise", gae_lambda=0.95, **passes)
    costs, information = [], []
    for beta in ("auto", 1e6):
        model = train_epochs(tiny_tdpg(beta=beta, cost_limit=40.0 if beta == "auto" else None, **arguments), 150)
        costs.append(model.rollout_buffer.episode_costs.mean())
        information.append(model.information.sum())
    assert costs[1] < 25 < costs[0] < 50
    assert information[0] < 0.7 * information[1]


@pytest.mark.parametrize(("limit", "n_epochs"), [(1e4, 3), ("80%", 16)])
def test_the_weight_is_saved_and_goes_on_where_it_was_unless_the_limit_changes(limit, n_epochs, tmp_path):
    model = train_epochs(tiny_tdpg(cost_limit=limit), n_epochs)
    model.save(tmp_path / "model")

    def load(**kwargs):
        return TDPG.load(tmp_path / "model", env=lava_env(), **kwargs, device="cpu")

    loaded = load()
    assert vars(loaded.auto_weight) == vars(model.auto_weight)
    assert loaded.mi_coef == model.mi_coef > 0
    # With another share the weight starts again, but the improvement is measured from the very first epoch.
    other = load(cost_limit="70%")
    assert (other.mi_coef, other.auto_weight.first_cost) == (0.0, model.first_cost)
    assert load(cost_limit=5.0).mi_coef == 0
    assert load(beta=0.5).mi_coef == 2


def test_a_policy_gradient_model_may_go_on_with_a_cost_limit(tmp_path):
    model = train_epochs(tiny_tdpg(beta=math.inf), 2)
    model.save(tmp_path / "pg")

    def load(**kwargs):
        return TDPG.load(tmp_path / "pg", env=lava_env(), **kwargs, device="cpu")

    assert train_epochs(load(beta="auto", cost_limit=1e4), 1).mi_coef > 0
    loaded = load(cost_limit=8.0)  # a limit implies beta="auto"
    assert (loaded.beta, loaded.cost_limit) == ("auto", 8.0)
    loaded = load(beta="auto")  # the improvement is measured from the very first epoch
    assert (loaded.cost_limit, loaded.auto_weight.first_cost) == ("95%", model.first_cost)
    with pytest.raises(ValueError, match=r"cost_limit=8.0.*beta=0.5"):
        load(beta=0.5, cost_limit=8.0)


def test_before_the_limit_is_met_the_information_is_measured_but_not_penalised():
    """The selection compares epochs by their information."""
    trained = []
    for arguments in (dict(beta="auto", cost_limit=1e-3), dict(beta=math.inf)):
        model = tiny_tdpg(**arguments)
        selection = SelectionCallback(cost_limit=1e6)
        train_epochs(model, 2, callback=selection)
        trained.append(parameters(model.policy))
        assert (model.information is None) == (arguments["beta"] == math.inf)
    assert same_parameters(*trained)


def test_the_weight_falls_at_most_by_twice_the_rate():
    """One bad epoch must not cancel the effect of many good epochs."""
    start, *values = values_of(AutoWeight(10.0), [10.0, 1e6, -1e6])
    assert np.log(np.divide(values, start)) == pytest.approx([-0.6, -0.6 + 0.3])


def costs_that_level_off(first, best, n_falling=20, n_level=20):
    """Return costs that fall linearly and then stay constant."""
    return [*np.linspace(first, best, n_falling), *[best] * n_level]


@pytest.mark.parametrize(("first", "best"), [(200.0, 10.0), (-20.0, -500.0), (50.0, -50.0)])
def test_a_share_is_of_the_improvement_of_costs_of_either_sign(first, best):
    weight = AutoWeight("90%")
    values_of(weight, costs_that_level_off(first, best))
    assert weight.limit == pytest.approx(first - 0.9 * (first - best))
    assert weight.first_cost == first


def test_with_a_share_the_weight_starts_once_the_cost_has_levelled_off():
    weight = AutoWeight("90%")
    values = values_of(weight, [*costs_that_level_off(100.0, 0.0), 1e3])
    started = int(np.flatnonzero(values)[0])
    # When the mean over five epochs is below the mean ten epochs earlier by less than the slack.
    assert 20 < started < 20 + WINDOW + LEVEL_EPOCHS
    assert weight.information_before == 4.0
    assert values[started] == pytest.approx(0.1 * 100.0 / 4.0)  # the penalty equals the slack
    assert values[started + 1] > values[started]
    assert values[-1] == pytest.approx(values[-2] * math.exp(-0.9))


def test_with_a_share_the_weight_starts_in_the_middle_of_a_training_that_still_improves():
    weight = AutoWeight("99%")
    for i, cost in enumerate(np.linspace(100.0, 0.0, 40)):
        weight.update(cost, information=4.0, progress_remaining=1 - i / 40)
        assert (weight.value > 0.0) == (i >= 20), i


def test_with_a_share_the_weight_grows_more_slowly_towards_the_end():
    growth = []
    for progress in (1.0, 0.5, 0.25, 0.0):
        weight = AutoWeight("90%")
        before = values_of(weight, [100.0] * 5 + [0.0] * 15)[-1]
        weight.update(0.0, 4.0, progress)
        growth.append(math.log(weight.value / before))
    assert growth == pytest.approx([0.09, 0.09, 0.045, 0.0])


def test_the_limit_is_known_once_the_first_window_of_costs_is_full():
    weight = AutoWeight("90%")
    for epoch in range(WINDOW):
        assert math.isnan(weight.limit), epoch
        weight.update(10.0 - epoch, 5.0)
    smoothed = 10.0 - (WINDOW - 1) / 2
    assert weight.limit == pytest.approx(10.0 - 0.9 * (10.0 - smoothed))


def test_one_lucky_epoch_does_not_set_the_limit():
    weight = AutoWeight("90%")
    values_of(weight, [100.0] + [10.0] * 8 + [-90.0] + [10.0] * 8)
    smoothed = (4 * 10.0 - 90.0) / WINDOW
    assert weight.limit == pytest.approx(100.0 - 0.9 * (100.0 - smoothed))


def test_too_short_a_training_is_told(recwarn):
    tiny_tdpg(beta="auto", seed=0).learn(20 * 5 * (WINDOW - 1))
    assert any("too short for cost_limit='95%'" in str(warning.message) for warning in recwarn)


def test_the_default_share_needs_no_number_and_is_logged():
    model = tiny_tdpg(beta="auto", n_episodes=100, encoder_gradient="pathwise", learning_rate=5e-3)
    assert (model.cost_limit, model.auto_weight.share) == ("95%", 0.95)
    train_epochs(model, 1)
    assert "train/cost_limit" not in model.logger.name_to_value, "one epoch says nothing of the improvement"
    train_epochs(model, 30)
    assert model.mi_coef > 0
    limit = model.logger.name_to_value["train/cost_limit"]
    assert limit == model.auto_weight.limit
    assert model.first_cost > limit > model.auto_weight._lowest


def test_what_was_kept_is_told_as_a_share_of_what_there_was():
    weight = AutoWeight(10.0)
    assert weight.kept() is None
    for cost, information in ((20.0, 5.0), (9.0, 8.4), (1.5, 3.1)):
        weight.update(cost, information)
    assert weight.kept() == "3.1 of 8.4 nats kept, at a cost of 1.5 (cost_limit 10)"
