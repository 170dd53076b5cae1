"""The phase that removes what the actions know of a nuisance."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import assert_same_parameters, parameters, rollouts, tiny_tdpg, toy_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_tdpg import TDPG, make_episodes_env
from sb3_tdpg.robustness import Perturbation
from sb3_tdpg.robustness.phase import NuisancePhase, actions, divergence


def shifted(*offsets):
    """A sensor that adds one of some offsets, which the episode keeps."""

    def draw(rng, n, value, sensor):
        return dict(offset=rng.choice(offsets, (n, 1)))

    return Perturbation("shifted", "vector", "", (1,) * 5, lambda y, value, episode, rng: y + episode["offset"], draw)


def phase_of(model, nuisance, n_steps=24):
    phase = NuisancePhase([(nuisance, 1)] if isinstance(nuisance, Perturbation) else nuisance, n_steps)
    phase.init_callback(model)
    return phase


def react_more(module):
    """Make a policy that reacts to its observations."""
    with th.no_grad():
        for parameter in module.parameters():
            parameter.mul_(3.0)


def known(model, batch, seen):
    """How far the actions are from those on plain observations, in nats a step."""
    with th.no_grad():
        now, plain = (actions(model.policy, batch._replace(observations=each)) for each in (seen, batch.observations))
        return divergence(now, plain, batch).item()


@pytest.mark.parametrize(("env", "settings"), [
    ("Lava-v0", {}),
    ("Lava-v0", dict(beta=math.inf, encoder_gradient="pathwise")),
    ("Lava-v0", dict(policy_kwargs=dict(time_varying=False), bptt_steps=2)),
    ("Discrete", {}),
    ("MultiDiscrete", {}),
])  # fmt: skip
def test_the_phase_lowers_what_the_actions_know_of_the_nuisance(env, settings):
    space = dict(Discrete=spaces.Discrete(3), MultiDiscrete=spaces.MultiDiscrete([2, 3])).get(env)
    env = "Lava-v0" if space is None else toy_vec_env(2, action_space=space)
    model = tiny_tdpg(env, **settings)
    batch = rollouts(model)
    phase = phase_of(model, shifted(-1.0, 1.0), 40)
    phase.optimizer.param_groups[0]["lr"] = 1e-2
    react_more(model.policy.encoder)
    th.manual_seed(1)
    perturbed = phase.perturbed(batch)
    before = known(model, batch, perturbed)
    left = phase.remove(batch)
    assert known(model, batch, perturbed) < 0.5 * before
    assert left < 0.7 * before


def test_a_member_lasts_for_an_episode_also_where_the_policy_learns_from_segments():
    env = toy_vec_env(2, horizon=60, observation_space=spaces.Box(-1, 1, (2,), np.float32))
    model = TDPG(env=env, seed=0, device="cpu", nuisance=None, epoch_steps=240)
    assert model.bptt_steps == 5
    phase = phase_of(model, {"group_failure": 3}, 1)
    shares, perturbed = [], phase.perturbed

    def observed(batch):
        seen = perturbed(batch)
        shares.append((seen != batch.observations).any(-1).float().mean().item())
        return seen

    phase.perturbed = observed
    model.learn(240)
    phase.remove(model.rollout_buffer.episode_batch(whole_horizon=False))
    assert np.mean(shares) > 0.3  # a failure begins at any step and lasts to the end


def test_normalised_observations_are_refused():
    space = spaces.Box(-1000, 1000, (2,), np.float32)
    model = tiny_tdpg(VecNormalize(toy_vec_env(2, observation_space=space), norm_reward=False), nuisance=None)
    with pytest.raises(ValueError, match="which VecNormalize has normalised"):
        phase_of(model, {"vector_noise": 1})


def test_on_plain_observations_the_policy_stays_as_it_was():
    model = tiny_tdpg("Lava-v0")
    batch, phase = rollouts(model), phase_of(model, shifted(2.0), 40)
    react_more(model.policy.encoder)
    with th.no_grad():
        before, shift = actions(model.policy, batch), known(model, batch, batch.observations + 2.0)
    phase.optimizer.param_groups[0]["lr"] = 1e-2
    phase.remove(batch)
    with th.no_grad():
        moved = divergence(actions(model.policy, batch), before, batch)
    assert moved < 0.2 * shift


def test_a_huge_divergence_moves_the_policy_by_a_bounded_step():
    model = tiny_tdpg("Lava-v0")
    batch = rollouts(model)
    react_more(model.policy)
    phase = phase_of(model, shifted(1000.0), 1)
    assert known(model, batch, phase.perturbed(batch)) > 100
    # Plain gradient descent, as Adam's own steps have about one length.
    phase.optimizer = th.optim.SGD(model.policy.parameters(), lr=1.0)
    before = parameters(model.policy)
    phase.remove(batch)
    after = parameters(model.policy)
    moved = th.cat([(after[name] - before[name]).flatten() for name in before]).norm()
    assert moved.item() == pytest.approx(1.0, rel=1e-3)


def test_the_divergence_is_that_of_the_two_densities():
    model = tiny_tdpg("Lava-v0")
    batch = rollouts(model)
    policy, expected = model.policy, []
    trv = plain_trv = th.zeros(20, policy.trv_dim)
    for t in range(model.horizon):
        at, y, eps = np.full(20, t), batch.observations[t], batch.noise[t]
        with th.no_grad():
            (mean, std), (plain_mean, plain_std) = (
                policy.encoder_density(*seen, at) for seen in ((y + 1.0, trv), (y, plain_trv))
            )
            trv, plain_trv = mean + std * eps, plain_mean + plain_std * eps
            p, q = (policy.action_density(x, at).distribution for x in (trv, plain_trv))
            expected.append(th.distributions.kl_divergence(p, q).sum(1).mean())
    alive = batch.alive * (th.arange(model.horizon) < 3)[:, None]
    assert known(model, batch._replace(alive=alive), batch.observations + 1.0) == pytest.approx(
        th.stack(expected[:3]).mean().item(), rel=1e-4
    )


def test_the_perturbed_observations_are_those_of_a_family_held_for_the_episode():
    model = tiny_tdpg(make_episodes_env("Lava-v0", 20, env_kwargs=dict(sensor_noise_std=0.0)))
    batch = rollouts(model)
    phase = phase_of(model, {"env_kwargs": [dict(sensor_bias=[1.0, 0.0]), dict(sensor_bias=[2.0, 0.0])]})
    offset = (phase.perturbed(batch) - batch.observations)[..., 0].round(decimals=4)
    assert set(offset.unique().tolist()) == {1.0, 2.0}
    assert (offset == offset[0]).all()


def test_it_follows_every_update_and_logs_what_is_left():
    steps, model = [], tiny_tdpg("Lava-v0", learning_rate="lin_1e-2_1e-3")
    phase, train = NuisancePhase("vector_bias", 2), model.train
    model.train = lambda: (steps.append("train"), train())
    remove = phase.remove

    def removing(batch):
        steps.append(phase.optimizer.param_groups[0]["lr"] == model.policy.optimizer.param_groups[0]["lr"])
        assert th.equal(batch.trvs, model.rollout_buffer.episode_batch().trvs)
        return remove(batch)

    phase.remove = removing
    for _ in range(2):  # a second call of learn begins with rollouts
        model.learn(2 * model.epoch_size, callback=phase, reset_num_timesteps=False)
    assert steps == ["train", True] * 4
    assert model.logger.name_to_value["nuisance/action_kl"] > 0


def test_a_function_that_returns_nan_stops_with_the_parameters_of_before():
    model = tiny_tdpg("Lava-v0")
    batch = rollouts(model)
    before = parameters(model.policy)
    with pytest.raises(ValueError, match="observations that are NaN or infinite"):
        phase_of(model, lambda y, rng: y * float("nan")).remove(batch)
    assert_same_parameters(parameters(model.policy), before)


def ball_env():
    return make_episodes_env("BallCatch-v0", 20, env_kwargs=dict(renderer="fast"), seed=0)


def test_on_images_it_makes_the_actions_less_sensitive():
    def known_after(n_steps):
        model = tiny_tdpg(ball_env(), nuisance=None, policy_kwargs={}, seed=1)
        model.learn(3 * model.epoch_size, callback=[NuisancePhase("auto", n_steps)] if n_steps else None)
        batch, judge = rollouts(model), phase_of(model, "auto")
        th.manual_seed(3)
        return known(model, batch, judge.perturbed(batch))

    assert known_after(30) < 0.5 * known_after(0)


@pytest.mark.parametrize(("make", "phase", "fragment"), [
    (lambda: "Lava-v0", lambda: NuisancePhase("vector_bias", 0), "n_steps=0 must be an integer of at least 1"),
    (lambda: "Lava-v0", NuisancePhase, "nuisance='auto' is none for"),
    (lambda: "Lava-v0", lambda: NuisancePhase("actuator_gain"), "changes the actions"),
    (ball_env, NuisancePhase, "needs plain rollouts: give TDPG nuisance=None"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(make, phase, fragment):
    model = TDPG("TRVPolicy", make(), n_episodes=20, device="cpu")
    with pytest.raises(ValueError, match=fragment):
        model.learn(1, callback=phase())
    assert model.num_timesteps == 0
