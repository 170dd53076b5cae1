"""Every perturbation reaches the policy, in every episode, and never touches the state."""

import functools

import gymnasium as gym
import numpy as np
import pytest
from perturbed_problems import APPLYING, PROBLEMS, PictureEnv, countdown, differs, dummy, episodes, perturbed, run
from small_problems import lava_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_tdpg import make_episodes_env
from sb3_tdpg.robustness import PERTURBATIONS, Perturbation, PerturbedVecEnv, applicable, register


@pytest.fixture(scope="module")
def clean():
    """Unperturbed runs by problem."""
    return functools.cache(lambda problem: run(PROBLEMS[problem](3)))


@pytest.mark.parametrize(("problem", "name"), APPLYING)
def test_it_reaches_the_policy_in_every_episode_and_never_touches_the_state(problem, name, clean):
    expected = clean(problem)
    for severity in (1, 5):
        env = perturbed(PROBLEMS[problem](3), name, severity)
        seen = run(env)

        changed = differs(seen.observations, expected.observations)
        assert expected.starts[1:].any(axis=0).all()  # every environment has been reset by itself
        if PERTURBATIONS[name].later_only:
            assert not changed[expected.starts].any()
            met = [changed[steps, i].any() for i, steps in episodes(expected.starts)]
            assert any(met) if name == "hold" else all(met)  # which may hold nothing in a short episode
        elif name == "vector_dropout":  # at even distances, whether or not it is the first
            assert all(changed[steps, i].any() for i, steps in episodes(expected.starts))
        else:
            assert changed.all()

        for ours, theirs in zip(seen.states, expected.states, strict=True):
            np.testing.assert_array_equal(ours, theirs)
        np.testing.assert_array_equal(seen.rewards, expected.rewards)
        np.testing.assert_array_equal(seen.dones, expected.dones)
        space = env.observation_space
        assert seen.observations.dtype == space.dtype
        assert all(space.contains(observation) for step in seen.observations for observation in step)
        assert all(space.contains(observation) for _, observation in seen.terminal)
        env.close()


@pytest.mark.parametrize(("problem", "name"), APPLYING)
def test_the_same_seeds_give_the_same_and_other_seeds_something_else(problem, name):
    def observations(seed, env_seed):
        return run(perturbed(PROBLEMS[problem](2), name, seed=seed), seed=env_seed).observations

    first = observations(5, 0)
    np.testing.assert_array_equal(observations(5, 0), first)
    # Nothing is drawn, or there may be one possible draw in a short episode.
    if name not in ("contrast", "blur", "delay", "vector_delay"):
        assert (observations(6, 0) != first).any()
        assert (observations(None, 0) != first).any()


@pytest.mark.parametrize("name", ["noise", "occlusion"])
def test_a_seed_of_the_environment_is_enough_also_before_it_is_wrapped(name):
    def shown(seed):
        env = PROBLEMS["colour"](2)
        env.seed(seed)
        return PerturbedVecEnv(env, name).reset()

    np.testing.assert_array_equal(shown(0), shown(0))
    assert (shown(0) != shown(1)).any()


# Smooth enough that what is later is further away; several episodes of many environments.
SMOOTH = {
    "colour": lambda: make_episodes_env("BallCatch-v0", 6, env_kwargs=dict(renderer="fast", horizon=14)),
    "depth": lambda: make_episodes_env("PandaGrasp-v0", 12, use_processes=False),
    "bounded vector": lambda: dummy(lambda i: gym.make("Pendulum-v1", max_episode_steps=14), 12),
}


@pytest.fixture(scope="module")
def smooth():
    """Each problem with what it shows in a run, by name."""

    @functools.cache
    def recorded(problem):
        env = SMOOTH[problem]()
        # Of a grasp, the policy sees what there was before it.
        return env, run(env, n_steps=0 if problem == "depth" else 29).observations

    return recorded


@pytest.mark.parametrize(("problem", "name"), [
    pytest.param(*p.values, id=p.id) for p in APPLYING if p.values[0] in SMOOTH
])  # fmt: skip
def test_a_higher_severity_changes_more(problem, name, smooth):
    env, expected = smooth(problem)
    distances = [
        np.abs(run(perturbed(env, name, severity), len(expected) - 1).observations - expected.astype(float)).mean()
        for severity in range(1, 6)
    ]
    assert distances[0] > 0
    assert (np.diff(distances) > 0).all(), distances


def test_environments_in_processes_show_the_same_as_in_this_one():
    runs = []
    for env in (dummy(PictureEnv, 2), SubprocVecEnv([PictureEnv, functools.partial(PictureEnv, 1)], "fork")):
        runs.append(run(perturbed(env, "occlusion")))
        env.close()
    np.testing.assert_array_equal(runs[0].observations, runs[1].observations)
    np.testing.assert_array_equal(*([observation for _, observation in each.terminal] for each in runs))


@pytest.mark.parametrize("severity", [1, 3])
def test_a_delay_shows_what_was_some_steps_ago_and_nothing_of_an_earlier_episode(severity):
    plain, late = countdown(), PerturbedVecEnv(countdown(), "vector_delay", severity, scale=1.0)
    seen, shown = run(plain, 15), run(late, 15)
    name, episode, t = np.moveaxis(seen.observations, 2, 0)
    expected = np.stack([name, episode, np.maximum(t - severity, 0)], axis=2)
    np.testing.assert_array_equal(shown.observations, expected)
    for (_, last), (_, delayed) in zip(seen.terminal, shown.terminal, strict=True):
        np.testing.assert_array_equal(delayed, [*last[:2], max(last[2] - severity, 0)])
    np.testing.assert_array_equal(late.reset(), plain.reset())  # also of an episode that is left


def test_a_lost_frame_leaves_the_last_one_that_arrived():
    expected = run(PROBLEMS["channels last"](3), 40)
    shown = run(perturbed(PROBLEMS["channels last"](3), "dropped_frames", 3), 40)
    n_lost, n_frames = 0, 0
    for i, steps in episodes(expected.starts):
        frames, seen = expected.observations[steps, i], shown.observations[steps, i]
        for t in range(1, len(frames)):
            is_lost = (seen[t] != frames[t]).any()
            np.testing.assert_array_equal(seen[t], seen[t - 1] if is_lost else frames[t])
            n_lost += is_lost
            n_frames += 1
    assert n_lost / n_frames == pytest.approx(0.5, abs=0.05)


def test_an_occluder_stays_for_an_episode_and_is_another_one_in_the_next_and_beside_it():
    expected, shown = (run(make(PROBLEMS["colour"](3))) for make in (lambda e: e, lambda e: perturbed(e, "occlusion")))
    squares = []
    for i, steps in episodes(expected.starts):
        seen = shown.observations[steps, i]  # (T, C, H, W)
        inside = (seen != expected.observations[steps, i]).any(axis=(0, 1))
        square = seen[:, :, inside]
        assert inside.any() and (square == square[:1, :, :1]).all()
        squares.append((*np.argwhere(inside)[0], *square[0, :, 0]))
    assert len(set(squares)) == len(squares) == 6


def test_reset_infos_can_be_read_from_the_wrapper():
    env = perturbed(PROBLEMS["unbounded vector"](3), "vector_noise")
    env.reset()
    for _ in range(8):
        _, _, dones, _ = env.step(np.zeros((3, 1), np.float32))
        assert env.reset_infos == env.unwrapped.reset_infos
    assert dones.all()


@pytest.mark.parametrize(("problem", "arguments", "fragment"), [
    ("colour", dict(perturbation="fog"), r"'fog' is unknown: use one of \['noise'"),
    ("colour", dict(perturbation="blur", severity=0), "severity=0 of 'blur' must be an integer from 1 to 5"),
    ("colour", dict(perturbation="blur", severity=2.0), "severity=2.0"),
    ("colour", dict(perturbation="blur", severity=True), "severity=True"),
    ("colour", dict(perturbation="blur", seed=-1), "seed=-1 must be None or an integer of at least 0"),
    ("colour", dict(perturbation="vector_noise"), "it is for vectors"),
    ("colour", dict(perturbation="noise", scale=1.0), "scale=1.0 is for vectors"),
    ("bounded vector", dict(perturbation="noise"), "it is for images"),
    ("bounded vector", dict(perturbation="vector_noise", scale=[1.0, 2.0]), r"must be a number, or an array of shape"),
    ("bounded vector", dict(perturbation="vector_noise", scale=-1.0), "not negative"),
    ("bounded vector", dict(perturbation="vector_noise", scale=0.0), "no component"),
    ("grey", dict(perturbation="hue"), "needs images of 3 channels, and these have 1"),
    ("depth", dict(perturbation="texture_overlay"), "in a depth image"),
    ("depth", dict(perturbation="delay"), "with a horizon of 1 there is no other"),
])  # fmt: skip
def test_what_does_not_fit_is_refused(problem, arguments, fragment):
    with pytest.raises(ValueError, match=fragment):
        PerturbedVecEnv(PROBLEMS[problem](2), **arguments)


def one(env_id):
    return DummyVecEnv([lambda: gym.make(env_id)])


@pytest.mark.parametrize(("make", "fragment"), [
    (lambda: one("FrozenLake-v1"), "is not a Box"),
    (lambda: one("CartPole-v1"), "changes the actions of a Box, and the action space is Di"),
    (lambda: gym.make("Pendulum-v1"), "is not a VecEnv of Stable-Baselines3.*DummyVecEnv"),
    (lambda: gym.make_vec("Pendulum-v1", 2), "is not a VecEnv of Stable-Baselines3"),
    (lambda: VecNormalize(lava_env()), r"VecNormalize\(PerturbedVecEnv"),
])  # fmt: skip
def test_an_environment_that_cannot_be_wrapped_is_refused(make, fragment):
    with pytest.raises(ValueError, match=fragment):
        PerturbedVecEnv(make(), "actuator_gain" if "actions" in fragment else "vector_noise")


def test_actuators_are_perturbed_only_where_actions_are_a_box():
    for env_id, expected in (("Pendulum-v1", {"actuator_gain", "actuator_delay"}), ("CartPole-v1", set())):
        env = gym.make(env_id)
        names = applicable(env.observation_space, None, env.action_space)
        assert {name for name in names if PERTURBATIONS[name].kind == "action"} == expected


def test_a_row_of_the_table_must_be_complete_and_new():
    blur = PERTURBATIONS["blur"]
    with pytest.raises(ValueError, match="expected 5"):
        Perturbation("fog", "image", "opacity", (0.1, 0.2), blur.apply)
    with pytest.raises(ValueError, match="must be one of"):
        Perturbation("fog", "sound", "opacity", (0.1, 0.2, 0.3, 0.4, 0.5), blur.apply)
    with pytest.raises(ValueError, match="already"):
        register(blur)
