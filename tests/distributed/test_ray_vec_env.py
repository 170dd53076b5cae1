"""Environments in Ray actors give the results of SB3's VecEnvs, and a dead actor is restarted or reported."""

import multiprocessing
import os
import re
import signal
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from small_problems import AtEveryStep, assert_same_parameters, parameters, tiny_tdpg, train_epochs
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import CSVOutputFormat, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_tdpg import TDPG, TrainingCheckpointCallback

ray = pytest.importorskip("ray")

from sb3_tdpg.distributed import DeadActorError, RayVecEnv  # noqa: E402

REPOSITORY = Path(__file__).resolve().parents[2]
N = 3  # not a multiple of the number of actors: environment 0 is in actor 0, the others are in actor 1


@pytest.fixture(scope="module", autouse=True)
def local_ray():
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("RAY_USAGE_STATS_ENABLED", "0")
        environment.delenv("RAY_ADDRESS", raising=False)
        # As SubprocVecEnv's processes do, the actors must find what the tests import.
        environment.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)))
        # SubprocVecEnv's processes are forked from one that has imported PyTorch once.
        multiprocessing.set_forkserver_preload(["sb3_tdpg"])
        ray.init("local", num_cpus=2, include_dashboard=False, log_to_driver=False)
        yield
        ray.shutdown()


class WanderEnv(gym.Env):
    """A noisy walk in any kind of space; it ends at a random time, or is cut off, and shows what it was told."""

    metadata = {"render_modes": ["rgb_array"]}
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    horizon = 4

    def __init__(self, kind="box", name=0, render_mode=None):
        self.name, self.render_mode, self.gain = name, render_mode, 1.0
        box = spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.observation_space = dict(
            box=box,
            dict=spaces.Dict(walk=box, time=spaces.Box(0, 99, (), np.int64)),
            tuple=spaces.Tuple((box, spaces.Box(0, 99, (1,), np.int64))),
            discrete=spaces.Discrete(99),
        )[kind]
        self.kind = kind

    def _observe(self):
        walk = self.x.copy()
        tuples = (walk, np.array([self.t]))
        return dict(box=walk, dict=dict(walk=walk, time=self.t), tuple=tuples, discrete=self.t)[self.kind]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        self.x = self.np_random.standard_normal(3) + (options or {}).get("shift", 0.0)
        return self._observe(), {"begins_at": self.x.copy()}

    def step(self, action):
        action *= self.gain  # in place, which is an environment's right
        self.t += 1
        self.x[:2] += action
        self.x += 0.1 * self.np_random.standard_normal(3)
        truncated = self.t == self.horizon
        terminated = bool(self.np_random.random() < 0.1) or (truncated and self.name == 0)
        info = {"x": self.x, "ends": (terminated, truncated)}
        return self._observe(), float(self.x.sum()), terminated, truncated, info

    def render(self):
        return np.full((4, 4, 3), self.name, np.uint8)

    def double(self, value, *, plus=0):
        return 2 * value + plus + self.name

    def pid(self):
        return os.getpid()

    def fail(self):
        raise KeyError("lost key")


class FailingEnv(WanderEnv):
    """If told to, it takes its process along, or falls asleep in its first life."""

    def __init__(self, marker=None):
        super().__init__()
        self.marker = marker

    def step(self, action):
        if action[0] > 0.99 and self.marker is None:
            os.kill(os.getpid(), signal.SIGKILL)
        if action[0] > 0.99 and not self.marker.exists():
            self.marker.touch()
            time.sleep(600)
        return super().step(action)


def wanderers(kind="box", **kwargs):
    return [lambda name=name: WanderEnv(kind, name, **kwargs) for name in range(N)]


@pytest.fixture
def make():
    """Make a RayVecEnv of two actors that is closed whatever happens."""
    made = []

    def make_one(env_fns, n_actors=2, **kwargs):
        made.append(RayVecEnv(env_fns, n_actors, **kwargs))
        return made[-1]

    yield make_one
    for env in made:
        env.close()


def actions(t, n=N):
    return np.random.default_rng(t).uniform(-0.9, 0.9, (n, 2)).astype(np.float32)


def assert_same(first, second):
    """Compare what two environments returned: values, types, and whether arrays may be written to."""
    if isinstance(first, dict):
        assert list(first) == list(second)
        for key in first:
            if key != "t":  # Monitor's clock
                assert_same(first[key], second[key])
    elif isinstance(first, (tuple, list)):
        for one, other in zip(first, second, strict=True):
            assert_same(one, other)
    elif isinstance(first, np.ndarray):
        assert first.dtype == second.dtype
        assert first.flags.writeable == second.flags.writeable
        np.testing.assert_array_equal(first, second)
    else:
        assert type(first) is type(second)
        assert first == second


def kill(env, index):
    """Kill -9 the process of the actor that an environment is in."""
    (pid,) = env.env_method("pid", indices=index)
    assert pid != os.getpid()
    os.kill(pid, signal.SIGKILL)


def trace(env, n_steps=15, *, seed=3, before_step=None):
    """Everything that an environment returns."""
    env.seed(seed)
    seen = [(env.reset(), list(env.reset_infos))]
    for t in range(n_steps):
        if before_step is not None:
            before_step(t)
        observations, rewards, dones, infos = env.step(actions(t))
        seen.append((observations, rewards, dones, list(infos), list(env.reset_infos)))
    return seen


@pytest.mark.parametrize(
    "kind", ["box", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("dict", "tuple", "discrete"))]
)
def test_it_gives_what_dummy_vec_env_gives(kind, make):
    ours, theirs = make(wanderers(kind)), DummyVecEnv(wanderers(kind))
    seen = trace(ours)
    assert_same(seen, trace(theirs))
    ends = {info["ends"] for step in seen[1:] for info in step[3]}
    assert ends == {(False, False), (True, False), (False, True), (True, True)}
    assert_same(ours.reset(), theirs.reset())  # a seed is used once
    for env in (ours, theirs):
        env.seed(4)
        env.set_options([{"shift": 10.0 * i} for i in range(N)])
    assert_same(ours.reset(), theirs.reset())
    assert_same(list(ours.reset_infos), list(theirs.reset_infos))
    assert_same(ours.reset(), theirs.reset())  # so are options
    theirs.close()


def test_attributes_methods_and_pictures_of_the_environments_can_be_reached(make):
    env = make([lambda f=f: Monitor(f()) for f in wanderers(render_mode="rgb_array")])
    assert env.get_attr("name") == [0, 1, 2]
    assert env.get_attr("name", indices=[2, 0, -2]) == [2, 0, 1]
    assert env.get_attr("name", indices=2) == [2]
    env.set_attr("colour", np.arange(2), indices=[2])
    with pytest.raises(AttributeError, match="colour"):
        env.get_attr("colour")
    env.set_attr("colour", np.zeros(2), indices=[0, 1])
    np.testing.assert_array_equal(np.array(env.get_attr("colour"))[:, 1], [0, 0, 1])
    assert env.get_attr("colour")[0].flags.writeable
    assert env.has_attr("kind")
    assert not env.has_attr("no_such_attribute")
    assert env.env_method("double", 10, plus=0.5, indices=[2, 1]) == [22.5, 21.5]
    assert env.env_is_wrapped(Monitor) == [True] * N
    assert env.env_is_wrapped(gym.wrappers.TimeLimit, indices=[0]) == [False]
    assert [image[0, 0, 0] for image in env.get_images()] == [0, 1, 2]
    assert env.render().shape == (8, 8, 3)  # tiled
    assert len(set(env.env_method("pid"))) == 2  # one process for each actor
    with pytest.raises(ValueError, match="2 actions were given: 3 environments"):
        env.step(actions(0, 2))
    # An error of an environment is raised as it is, and does no harm to the others.
    with pytest.raises(KeyError, match="lost key"):
        env.env_method("fail", indices=[1])
    assert env.get_attr("name") == [0, 1, 2]


def csv_log(vec_env, path, **kwargs):
    """Train for two epochs; return what was logged, but for times, and the policy."""
    model = tiny_tdpg(vec_env, n_episodes=4, **kwargs)
    model.set_logger(Logger(None, [CSVOutputFormat(str(path))]))
    model.learn(2 * model.epoch_size)
    vec_env.close()
    rows = [line.split(",") for line in path.read_text().splitlines()]
    columns = [i for i, key in enumerate(rows[0]) if not key.startswith("time/") or key == "time/total_timesteps"]
    assert len(rows) == 3
    assert "rollout/ep_rew_mean" in rows[0]
    return [[row[i] for i in columns] for row in rows], parameters(model.policy)


GRASPING = dict(beta=float("inf"), n_epochs=1, batch_size=None, policy_kwargs={})


@pytest.mark.parametrize(
    ("env_id", "kwargs"), [("Lava-v0", {}), pytest.param("PandaGrasp-v0", GRASPING, marks=pytest.mark.slow)]
)
def test_a_training_gives_the_log_that_it_gives_with_subproc_vec_env(env_id, kwargs, tmp_path):
    # With the module: the server that SubprocVecEnv's processes are forked from may be that of an earlier test.
    logs, policies = zip(*[
        csv_log(make_vec_env(f"sb3_tdpg:{env_id}", n_envs=2, seed=1, vec_env_cls=vec_env), tmp_path / "log", **kwargs)
        for vec_env in (RayVecEnv, SubprocVecEnv)
    ], strict=True)  # fmt: skip
    assert logs[0] == logs[1]
    assert_same_parameters(*policies)


@pytest.mark.slow
def test_the_block_of_the_guide_trains():
    guide = (REPOSITORY / "docs" / "guide" / "zoo.md").read_text()
    (code,) = re.findall(r"<!-- no-run -->\n```python\n(from stable.*?)^```", guide, re.MULTILINE | re.DOTALL)
    small = {"n_envs=40": "n_envs=4", "n_actors=8": "n_actors=2", "seed=0": "seed=0, n_episodes=40", "40_000": "80"}
    for full, brief in small.items():
        assert code.count(full) == 1
        code = code.replace(full, brief)
    namespace = {}
    exec(code, namespace)
    try:
        assert isinstance(namespace["env"], RayVecEnv)
        assert namespace["model"].num_timesteps == 80
    finally:
        namespace["env"].close()


def test_a_dead_actor_is_reported_by_name_at_every_call_and_the_rest_can_be_closed(make):
    env = make(wanderers())
    env.reset()
    kill(env, 2)
    for call in (lambda: env.step(actions(0)), env.reset, lambda: env.get_attr("name")):
        with pytest.raises(DeadActorError, match=r"actor 1 of 2 \(environments 1 to 2\) has died.*last checkpoint"):
            call()
    assert env.get_attr("name", indices=[0]) == [0]
    env.close()
    env.close()


@pytest.mark.parametrize("kind", ["box", pytest.param("dict", marks=pytest.mark.slow)])
def test_a_restarted_actor_ends_its_lost_episodes_like_a_time_limit_and_starts_new_ones(kind, make):
    undisturbed = DummyVecEnv(wanderers(kind))
    expected = trace(undisturbed)
    env = make(wanderers(kind), max_restarts=2)
    env.seed(3)
    last_observations = env.reset()
    kill(env, 2)
    with pytest.warns(UserWarning, match=r"restarted actor 1 of 2 \(environments 1 to 2\).*episodes.*lost"):
        observations, rewards, dones, infos = env.step(actions(0))
    assert list(dones) == [False, True, True]
    np.testing.assert_array_equal(rewards[1:], 0.0)
    for i in (1, 2):
        assert infos[i]["TimeLimit.truncated"]
        assert infos[i]["episode_lost"]
        terminal = infos[i]["terminal_observation"]
        one = {key: last_observations[key][i] for key in terminal} if kind == "dict" else last_observations[i]
        assert_same(terminal, one)
        begins_at = env.reset_infos[i]["begins_at"]
        np.testing.assert_array_equal((observations["walk"] if kind == "dict" else observations)[i], begins_at)
    # Nothing happens to the other actor, and the new episodes go on.
    assert_same(infos[0], expected[1][3][0])
    assert env.get_attr("t") == [1, 0, 0]
    _, _, dones, infos = env.step(actions(1))
    assert env.get_attr("t", indices=[1, 2]) == [0 if done else 1 for done in dones[1:]]
    assert not any("episode_lost" in info for info in infos)
    # With the same seed, environments that were made anew give the same episodes.
    assert_same(trace(env)[1:], expected[1:])


class Lava(gym.Wrapper):
    """Tells in which process it is."""

    def __init__(self):
        super().__init__(gym.make("Lava-v0"))
        self.pid = os.getpid()


def lava_model(env):
    return tiny_tdpg(env, n_episodes=4)


def killing_at(step):
    """Kill an actor in mid-training; Lava takes ten steps an epoch here."""

    def strike(callback):
        if callback.n_calls == step:
            os.kill(callback.training_env.get_attr("pid")[1], signal.SIGKILL)

    return AtEveryStep(strike)


@pytest.mark.slow
def test_a_training_goes_on_with_a_restarted_actor_or_from_its_checkpoint_after_a_report(make, tmp_path):
    restarting = lava_model(make([Lava] * 2, max_restarts=1))
    with pytest.warns(UserWarning, match="Ray has restarted actor 1 of 2"):
        train_epochs(restarting, 4, callback=killing_at(7))
    assert restarting.epoch == 4
    restarting.env.close()
    path = tmp_path / "checkpoint.zip"
    undisturbed = lava_model(make([Lava] * 2))
    train_epochs(undisturbed, 4, callback=TrainingCheckpointCallback(tmp_path / "other.zip", 1))
    undisturbed.env.close()
    broken = lava_model(make([Lava] * 2))
    with pytest.raises(DeadActorError, match="actor 1 of 2"):
        train_epochs(broken, 4, callback=[TrainingCheckpointCallback(path, 1), killing_at(23)])
    broken.env.close()
    resumed = TDPG.load(path, env=make([Lava] * 2), device="cpu")
    assert resumed.epoch == 2
    resumed.learn(resumed.remaining_timesteps, callback=TrainingCheckpointCallback(path, 1), reset_num_timesteps=False)
    assert_same_parameters(parameters(resumed.policy), parameters(undisturbed.policy))


@pytest.mark.slow
def test_an_action_that_kills_every_restarted_actor_is_reported_in_the_end(make):
    env = make([FailingEnv] * 2, max_restarts=1)
    env.reset()
    action = np.array([[0, 0], [1, 0]], np.float32)
    with pytest.warns(UserWarning, match="restarted"):
        env.step(action)
    with pytest.raises(DeadActorError, match=r"actor 1 of 2.*max_restarts=1"):
        env.step(action)


@pytest.mark.parametrize("max_restarts", [pytest.param(0, marks=pytest.mark.slow), 1])
def test_an_actor_that_does_not_answer_counts_as_dead(max_restarts, make, tmp_path):
    env = make([lambda: FailingEnv(tmp_path / "marker")], 1, max_restarts=max_restarts, step_timeout=2.0)
    env.reset()
    action = np.array([[1, 0]], np.float32)
    if max_restarts == 0:
        with pytest.raises(DeadActorError, match=r"actor 0 of 1 .*did not answer within step_timeout=2\.0"):
            env.step(action)
    else:
        with pytest.warns(UserWarning, match="has restarted actor 0"):
            _, _, dones, infos = env.step(action)
        assert dones[0]
        assert infos[0]["episode_lost"]
        assert "episode_lost" not in env.step(action)[3][0]  # the episode may end of itself, at random


def test_files_of_monitor_are_not_overwritten_by_a_restarted_actor(make, tmp_path):
    env_fns = [lambda: Monitor(WanderEnv(), str(tmp_path / "log"))]
    with pytest.raises(ValueError, match=r"VecMonitor\(env, filename\)"):
        make(env_fns, 1, max_restarts=1)


def test_more_actors_than_the_cluster_has_cpus_are_refused_after_a_while(make, monkeypatch):
    with monkeypatch.context() as patch, pytest.raises(TimeoutError, match=r"\d of 3 actors did not start .*n_actors"):
        patch.setattr("sb3_tdpg.distributed.ray_vec_env.START_TIMEOUT", 2.0)
        make(wanderers(), 3)
    assert make(wanderers(), 1).num_envs == N  # what was asked for is not still waited for


def test_an_error_while_the_environments_are_made_is_raised_as_it_is(make):
    with pytest.raises(gym.error.NameNotFound, match="NoSuchEnv"):
        make([lambda: WanderEnv(), lambda: gym.make("NoSuchEnv-v0")])


@pytest.mark.parametrize("kwargs, message", [
    (dict(env_fns=[]), "env_fns is empty"),
    (dict(n_actors=0), "n_actors=0 must be an integer of at least 1"),
    (dict(n_actors=N + 1), "n_actors=4 must be at most the number of environments: 3"),
    (dict(max_restarts=-1), "max_restarts=-1"),
    (dict(step_timeout=-1.0), r"step_timeout=-1\.0"),
])  # fmt: skip
def test_bad_arguments_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        RayVecEnv(**{"env_fns": wanderers(), **kwargs})


def test_without_ray_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"pip install sb3_tdpg\[ray\]"):
        RayVecEnv(wanderers())
