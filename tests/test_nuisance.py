"""The nuisance: its declaration, its members, and the phase that removes it."""

import math

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_problems import assert_same_parameters, parameters, same_parameters, tiny_tdpg, toy_vec_env, train_epochs

from sb3_tdpg import TDPG, make_episodes_env
from sb3_tdpg.envs.ball_catch import BallCatchEnv
from sb3_tdpg.information.nuisance import action_divergence, behaviour
from sb3_tdpg.robustness.nuisance import Members, Nuisance, OneMember, make_nuisance

IMAGES = spaces.Box(0, 255, (3, 24, 24), np.uint8)
DEPTH = spaces.Box(0.2, 0.7, (1, 16, 16), np.float32)
VECTOR = spaces.Box(-1, 1, (2,), np.float32)
PARTS = spaces.Dict(camera=IMAGES, arm=VECTOR)


def ball_env(n=6, **kwargs):
    return make_episodes_env("BallCatch-v0", n, env_kwargs=dict(renderer="fast", **kwargs), seed=0)


def observed(space, n=4, length=3, seed=0):
    """Observations of n episodes, a list of steps."""
    rng = np.random.default_rng(seed)

    def one(part):
        if isinstance(part, spaces.Dict):
            return {key: one(x) for key, x in part.items()}
        high = 256 if part.dtype == np.uint8 else part.high.flat[0]
        return rng.uniform(part.low.flat[0], high, (n, *part.shape)).astype(part.dtype)

    return [one(space) for _ in range(length)]


def shown(members, steps, which=None, states=None):
    n = len(next(iter(steps[0].values())) if isinstance(steps[0], dict) else steps[0])
    which = np.arange(n) if which is None else which
    return [members(step, np.zeros((n, 1)) if states is None else states, which) for step in steps]


def rollouts(model):
    """Roll out an epoch without an update; the batch that the update would get."""
    model.train = lambda: None
    train_epochs(model, 1)
    return model.rollout_buffer.episode_batch()


# -- declarations -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("declared", "space"), [
    ("auto", IMAGES),
    ({"noise": 1, "dropped_pixels": (1, 4), "brightness": 2}, DEPTH),
    ("auto", PARTS),
    ("images", IMAGES),
    ({"images": dict(color=0.0, held=False)}, IMAGES),
    ("noise", IMAGES),
    ({"noise": (1, 3), "contrast": 4, "delay": 2}, IMAGES),
    ({"vector_bias": (4, 5), "noise": (4, 5)}, PARTS),
    ({"vector_noise": 5}, VECTOR),
    (lambda y, rng: y + np.asarray(rng.random(), y.dtype), VECTOR),
])  # fmt: skip
def test_a_declared_nuisance_changes_the_observations_and_keeps_shape_and_type(declared, space):
    nuisance = make_nuisance(declared, space, toy_vec_env(observation_space=space))
    steps = observed(space)
    before = [{k: v.copy() for k, v in s.items()} if isinstance(s, dict) else s.copy() for s in steps]
    for step, unchanged, after in zip(steps, before, shown(nuisance.members(4), steps), strict=True):
        parts = [(step, unchanged, after)]
        if isinstance(step, dict):
            parts = [(step[k], unchanged[k], after[k]) for k in step]
        for y, copy, changed in parts:
            np.testing.assert_array_equal(y, copy)
            assert changed.shape == y.shape and changed.dtype == y.dtype
        if declared != {"noise": (1, 3), "contrast": 4, "delay": 2}:
            assert any((y != changed).any() for y, _, changed in parts)


@pytest.mark.parametrize(("declared", "space", "fragment"), [
    ("fog", IMAGES, "perturbation='fog' is unknown"),
    ("noise", VECTOR, "'noise' does not apply"),
    ("images", DEPTH, "images of bytes"),
    ("vector_noise", spaces.Dict(camera=IMAGES), "applies to no part"),
    ({"noise": 6}, IMAGES, "severity=6"),
    ("vector_noise", spaces.Dict(arm=spaces.Box(-np.inf, np.inf, (2,))), "needs finite bounds of"),
    ({"noise": (3, 1)}, IMAGES, "the lowest and the highest"),
    ({"images": dict(colour=1)}, IMAGES, "keywords of MixtureNuisance"),
    ({"images": dict(pattern=2)}, IMAGES, "pattern=2 must be between 0 and 1"),
    ({}, IMAGES, "must be None, 'auto'"),
    (3, IMAGES, "must be None, 'auto'"),
    ({"env_kwargs": dict(texture="violet_dots")}, IMAGES, "needs an environment that can observe a given state"),
])  # fmt: skip
def test_a_wrong_declaration_is_explained(declared, space, fragment):
    with pytest.raises(ValueError, match=fragment):
        make_nuisance(declared, space, toy_vec_env(observation_space=space))


def test_a_function_that_changes_the_shape_is_refused():
    nuisance = make_nuisance(lambda y, rng: y[:, :1], VECTOR, toy_vec_env())
    with pytest.raises(ValueError, match=r"shape \(4, 1\).*expected those it was given: \(4, 2\)"):
        shown(nuisance.members(4), observed(VECTOR))


@pytest.mark.parametrize(("arguments", "fragment"), [
    (dict(nuisance="vector_noise", nuisance_steps=0), "nuisance_steps=0 must be an integer of at least 1"),
    (dict(nuisance="vector_noise", nuisance_level="both"), "nuisance_level='both' is unknown"),
    (dict(nuisance="noise"), "does not apply"),
])  # fmt: skip
def test_wrong_arguments_are_refused_before_training(arguments, fragment):
    with pytest.raises(ValueError, match=fragment):
        tiny_tdpg("Lava-v0", **arguments)


def test_the_default_is_a_nuisance_for_images_and_none_for_vectors():
    assert tiny_tdpg("Lava-v0").nuisance is None
    assert tiny_tdpg("Lava-v0").nuisance_phase is None
    assert tiny_tdpg(toy_vec_env(observation_space=DEPTH), beta=math.inf).nuisance is None
    assert tiny_tdpg(ball_env(20)).nuisance == {"images": {"held": False}}
    assert tiny_tdpg(ball_env(20), nuisance=None).nuisance_phase is None


# -- members ----------------------------------------------------------------------------------------------------


def test_what_is_held_changes_equal_images_of_an_episode_equally():
    space = spaces.Box(0, 255, (3, 24, 24), np.uint8)
    env = toy_vec_env(observation_space=space)
    steps = [observed(space, length=1)[0]] * 3
    for held in (True, False):
        members = make_nuisance({"images": dict(noise=0.0, held=held)}, space, env).members(4)
        first, second, third = shown(members, steps)
        assert (first == second).all() == held == (first == third).all()
    members = make_nuisance({"images": dict(noise=0.0)}, space, env).members(4)
    first = shown(members, steps[:1])[0]
    members.begin(np.array([1, 3]))
    second = shown(members, steps[:1])[0]
    assert [bool((first[i] == second[i]).all()) for i in range(4)] == [True, False, True, False]


def test_every_episode_has_one_family_of_several():
    space = spaces.Box(-100, 100, (2,), np.float32)
    declared = dict(vector_bias=5, vector_scale=5)
    members = make_nuisance(declared, space, toy_vec_env(observation_space=space)).members(400)
    zeros = [np.zeros((400, 2), np.float32)] * 2
    first, second = shown(members, zeros)
    is_biased = (first != 0).any(axis=1)  # a scale leaves zeros as they are
    np.testing.assert_array_equal(first, second)
    assert 0.4 < is_biased.mean() < 0.6
    # Other episodes in another order: the same members.
    which = np.array([7, 3, 390])
    np.testing.assert_array_equal(members(zeros[0][:3], np.zeros((3, 1)), which), first[which])


def test_another_scene_is_seen_in_the_same_state():
    env = ball_env()
    declared = dict(env_kwargs=[dict(texture="violet_dots"), dict(texture="grey_plaster")])
    nuisance = make_nuisance(declared, env.observation_space, env)
    images = env.reset()
    states = np.stack([info["state"] for info in env.reset_infos])
    members = nuisance.members(6)
    (seen,) = shown(members, [images], states=states)
    others = [BallCatchEnv(renderer="fast", **kwargs).sensor(states) for kwargs in declared["env_kwargs"]]
    for i in range(6):
        assert any((seen[i] == other[i]).all() for other in others)
        assert not (seen[i] == images[i]).all()


def test_a_scene_may_redraw_components_of_the_state():
    env = ball_env()
    declared = {"env_kwargs": dict(robot_range=(1.0, 1.0)), "redraw": ["d (m)"]}
    images = env.reset()
    states = np.stack([info["state"] for info in env.reset_infos])
    (seen,) = shown(make_nuisance(declared, env.observation_space, env).members(6), [images], states=states)
    states[:, 0] = 1.0
    np.testing.assert_array_equal(seen, BallCatchEnv(renderer="fast").sensor(states))
    with pytest.raises(ValueError, match=r"redraw=\['e'\] are no components of the state: use some of \['d \(m\)'"):
        make_nuisance({**declared, "redraw": ["e"]}, env.observation_space, env)


def test_the_members_follow_torch_and_leave_the_environment_alone():
    def train(nuisance):
        model = tiny_tdpg("Lava-v0", nuisance=nuisance, nuisance_steps=2)
        train_epochs(model, 2)
        return model

    declared = {"vector_noise": (1, 5), "vector_dropout": 3}
    assert_same_parameters(parameters(train(declared).policy), parameters(train(declared).policy))
    first_rollouts = [rollouts(tiny_tdpg("Lava-v0", nuisance=n)).observations for n in (None, declared)]
    th.testing.assert_close(*first_rollouts, rtol=0, atol=0)


def test_one_member_of_a_family_is_the_same_for_all_episodes_and_every_time():
    steps = observed(VECTOR, n=1) * 2
    steps = [np.repeat(step, 4, axis=0) for step in steps]
    family = make_nuisance("vector_bias", VECTOR, toy_vec_env(observation_space=VECTOR))
    before = th.get_rng_state()
    first, again, other = (shown(OneMember(family, seed).members(4), steps) for seed in (1, 1, 2))
    assert (th.get_rng_state() == before).all()
    np.testing.assert_array_equal(first, again)
    assert (first[0] == first[0][:1]).all()
    assert (np.array(first) != np.array(other)).any()


# -- the phase --------------------------------------------------------------------------------------------------


class Shifted(Nuisance):
    """A sensor that adds one of some offsets, which the episode keeps."""

    def __init__(self, *offsets):
        self.offsets = np.array(offsets, np.float32)

    def members(self, n):
        return ShiftedMembers(self.offsets, n)


class ShiftedMembers(Members):
    def __init__(self, offsets, n):
        self.offsets, self.offset = offsets, np.zeros(n, np.float32)
        self.begin(np.arange(n))

    def begin(self, which):
        self.offset[which] = self.offsets[th.randint(len(self.offsets), (len(which),)).numpy()]

    def __call__(self, observations, states, which):
        return observations + self.offset[which, None]


@pytest.mark.parametrize(("env", "settings"), [
    ("Lava-v0", {}),
    ("Lava-v0", dict(beta=math.inf, encoder_gradient="pathwise")),
    ("Lava-v0", dict(policy_kwargs=dict(time_varying=False), bptt_steps=2)),
    ("Discrete", {}),
    ("MultiDiscrete", {}),
])  # fmt: skip
def test_the_phase_lowers_what_the_actions_know_of_the_nuisance(env, settings):
    actions = dict(Discrete=spaces.Discrete(3), MultiDiscrete=spaces.MultiDiscrete([2, 3])).get(env)
    env = "Lava-v0" if actions is None else toy_vec_env(2, action_space=actions)
    settings = dict(nuisance=Shifted(-1.0, 1.0), nuisance_steps=40, learning_rate=1e-2) | settings
    model = tiny_tdpg(env, **settings)
    batch = rollouts(model)
    if not model.policy.time_varying:
        batch = batch.segments(2)
    phase = model.nuisance_phase
    for group in phase.optimizer.param_groups:
        group["lr"] = 1e-2
    with th.no_grad():  # a policy that reacts to its observations
        for parameter in model.policy.encoder.parameters():
            parameter.mul_(3.0)
    th.manual_seed(1)
    perturbed = phase.perturbed(batch, model.nuisance_family)
    before = phase.divergence(batch, perturbed).mean().item()
    left = phase.remove(batch, model.nuisance_family, model._check_finite)
    assert phase.divergence(batch, perturbed).mean().item() < 0.5 * before
    assert left < 0.7 * before


def test_on_plain_observations_the_policy_stays_as_it_was():
    model = tiny_tdpg("Lava-v0", nuisance=Shifted(-1.0, 1.0), nuisance_steps=40)
    batch = rollouts(model)
    with th.no_grad():
        before = behaviour(model.policy, batch, batch.observations)
        shift = action_divergence(behaviour(model.policy, batch, batch.observations + 1.0), before).mean()
    model.nuisance_phase.remove(batch, model.nuisance_family, model._check_finite)
    with th.no_grad():
        moved = action_divergence(behaviour(model.policy, batch, batch.observations), before).mean()
    assert moved < 0.3 * shift


def test_a_nuisance_that_changes_nothing_changes_no_parameter():
    model = tiny_tdpg("Lava-v0", nuisance=Shifted(0.0), nuisance_steps=5)
    batch = rollouts(model)
    before = parameters(model.policy)
    left = model.nuisance_phase.remove(batch, model.nuisance_family, model._check_finite)
    for name, value in parameters(model.policy).items():
        th.testing.assert_close(value, before[name], rtol=0, atol=1e-4)  # rounding, and Adam makes it a step
    assert left == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("nuisance", "level", "expected"), [
    ("auto", "auto", ("rollouts", {"images": {"held": False}})),
    ("auto", "action", ("action", {"images": {"held": True}})),
    ({"noise": 2}, "auto", ("action", {"noise": 2})),
    (None, "auto", ("auto", None)),
])  # fmt: skip
def test_images_have_the_nuisance_in_the_rollouts_unless_one_is_declared(tmp_path, nuisance, level, expected):
    model = tiny_tdpg(ball_env(4), n_episodes=4, nuisance=nuisance, nuisance_level=level, policy_kwargs={})
    assert (model.nuisance_level, model.nuisance) == expected
    assert (model.nuisance_phase is not None) == (expected == ("action", model.nuisance) and nuisance is not None)
    model.save(tmp_path / "model")
    loaded = TDPG.load(tmp_path / "model", env=model.env)
    assert (loaded.nuisance_level, loaded.nuisance) == expected


def test_the_divergence_is_that_of_the_two_densities():
    model = tiny_tdpg("Lava-v0", nuisance=Shifted(1.0))
    batch = rollouts(model)
    policy, actions = model.policy, model.nuisance_phase.divergence(batch, batch.observations + 1.0)
    trv = plain_trv = th.zeros(20, policy.trv_dim)
    for t in range(model.horizon):
        at, y, eps = np.full(20, t), batch.observations[t], batch.noise[t]
        with th.no_grad():
            (mean, std), (plain_mean, plain_std) = (
                policy.encoder_density(*seen, at) for seen in ((y + 1.0, trv), (y, plain_trv))
            )
            trv, plain_trv = mean + std * eps, plain_mean + plain_std * eps
            p, q = (policy.action_density(x, at).distribution for x in (trv, plain_trv))
            th.testing.assert_close(actions[t], th.distributions.kl_divergence(p, q).sum(1), rtol=1e-4, atol=1e-6)


def test_in_rollouts_the_policy_sees_the_nuisance():
    env = make_episodes_env("Lava-v0", 20, env_kwargs=dict(sensor_noise_std=0.0))
    model = tiny_tdpg(env, nuisance=Shifted(-5.0, 5.0), nuisance_level="rollouts")
    batch = rollouts(model)
    difference = batch.observations - batch.states
    assert (difference.abs() - 5.0).abs().max() < 1e-5
    assert ((difference > 0) == (difference[:1, :, :1] > 0)).all()  # one offset for an episode
    assert (difference[0, :, 0] > 0).float().mean().item() == pytest.approx(0.5, abs=0.4)
    with th.no_grad():
        now = behaviour(model.policy, batch, batch.observations)
    th.testing.assert_close(now.trvs, batch.trvs, rtol=1e-4, atol=1e-5)  # the policy acted on what it was shown


def test_a_function_that_returns_nan_stops_with_the_parameters_of_before():
    model = tiny_tdpg("Lava-v0", nuisance=lambda y, rng: y + np.float32(np.nan))
    batch = rollouts(model)
    before = parameters(model.policy)
    with pytest.raises(ValueError, match="the nuisance returned observations that are NaN or infinite"):
        model.nuisance_phase.remove(batch, model.nuisance_family, model._check_finite)
    assert_same_parameters(parameters(model.policy), before)


# -- the model --------------------------------------------------------------------------------------------------


def test_a_loaded_model_goes_on_and_the_nuisance_may_be_changed(tmp_path):
    plain = tiny_tdpg("Lava-v0")
    train_epochs(plain, 1)
    plain.save(tmp_path / "plain")
    env = make_episodes_env("Lava-v0", 20, seed=0)
    model = TDPG.load(tmp_path / "plain", env=env, nuisance={"vector_noise": 3}, nuisance_steps=2)
    train_epochs(model, 1)
    assert model.nuisance_phase.optimizer.state
    model.save(tmp_path / "model")
    assert TDPG.load(tmp_path / "model").nuisance == {"vector_noise": 3}  # without an environment
    again = TDPG.load(tmp_path / "model", env=env)
    first, second = (m.nuisance_phase.optimizer.state_dict()["state"][0]["exp_avg"] for m in (model, again))
    th.testing.assert_close(first, second)
    without = TDPG.load(tmp_path / "model", env=env, nuisance=None)
    assert without.nuisance_phase is None
    train_epochs(without, 1)


def test_with_the_default_for_images_the_policy_sees_changed_ones_each_with_its_own_change():
    model = tiny_tdpg(ball_env(20), policy_kwargs={})
    batch, clean = rollouts(model), rollouts(tiny_tdpg(ball_env(20), policy_kwargs={}, nuisance=None))
    change = batch.observations.float() - clean.observations.float()
    by_image = change.abs().mean(dim=(2, 3, 4))
    assert (by_image > 5).float().mean() > 0.8
    assert (by_image.std(dim=0) > 5).all()  # an image that is held would have nearly the same at all steps
    with th.no_grad():
        now = behaviour(model.policy, batch, batch.observations)
    th.testing.assert_close(now.trvs, batch.trvs, rtol=1e-3, atol=1e-4)


def test_the_phase_on_images_makes_the_actions_less_sensitive():
    def known(nuisance):
        settings = dict(nuisance=nuisance, nuisance_level="action", nuisance_steps=30)
        model = tiny_tdpg(ball_env(20), **settings, policy_kwargs={}, seed=1)
        train_epochs(model, 3)
        judge = TDPG("TRVPolicy", ball_env(20), nuisance_level="action", n_episodes=20, seed=2)
        judge.nuisance_phase.policy = model.policy
        batch = rollouts(model)
        th.manual_seed(3)
        changed = judge.nuisance_phase.perturbed(batch, judge.nuisance_family)
        return judge.nuisance_phase.divergence(batch, changed).mean().item()

    assert known("auto") < 0.5 * known(None)


def test_other_seeds_train_other_policies():
    models = [tiny_tdpg("Lava-v0", nuisance="vector_bias", nuisance_steps=2, seed=seed) for seed in (0, 1)]
    for model in models:
        train_epochs(model, 1)
    assert not same_parameters(*(parameters(model.policy) for model in models))
