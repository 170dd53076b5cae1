"""The grasping problem as Gymnasium, Stable-Baselines3 and a reader of pictures see it."""

import gc
import os
import signal
import subprocess
import sys
import time
import types
from concurrent.futures.process import BrokenProcessPool

import gymnasium as gym
import numpy as np
import pytest
from panda_oracle import oracle_actions, run_python

from sb3_tdpg import BatchedVecEnv, make_episodes_env, vec_env
from sb3_tdpg.envs.panda_bullet import MOTIONS
from sb3_tdpg.envs.panda_grasp import PandaGraspEnv
from sb3_tdpg.envs.scenarios import PANDA_GRASP


@pytest.fixture
def env():
    env = PandaGraspEnv()
    yield env
    env.close()


@pytest.mark.parametrize(("row", "half_width", "yaw"), [
    (0, 0.05, (-np.pi / 4, np.pi / 4)), (1, 0.05, (0, 2 * np.pi)), (2, 0.075, (-np.pi / 4, np.pi / 4))
], ids=[row.name for row in PANDA_GRASP])  # fmt: skip
def test_the_mug_starts_anywhere_in_the_ranges_of_table_three(row, half_width, yaw):
    made = gym.make(PANDA_GRASP[row].env_id, **PANDA_GRASP[row].env_kwargs).unwrapped
    states = made.initial_state(20_000)
    low, high = [0.5 - half_width, -half_width, 0, yaw[0]], [0.5 + half_width, half_width, 0, yaw[1]]
    np.testing.assert_allclose(states.min(axis=0), low, atol=2e-3)
    np.testing.assert_allclose(states.max(axis=0), high, atol=2e-3)
    np.testing.assert_allclose(states.mean(axis=0), (np.array(low) + high) / 2, atol=0.03)
    assert made.state_space.contains(states[0])


def test_table_three_has_the_numbers_of_the_paper():
    numbers = [(row.name, row.paper["PG"].mean, row.paper["TDPG"].mean) for row in PANDA_GRASP]
    assert numbers == [("Training", 0.107, 0.094), ("Rotation", 0.182, 0.132), ("Translation", 0.367, 0.358)]
    assert gym.spec("PandaGrasp-v0").reward_threshold == -0.03  # three failures in a hundred


@pytest.mark.parametrize(("motion", "iterations"), [("fast", 50), ("reference", 150)])
def test_the_motion_decides_on_the_solver_s_iterations(motion, iterations):
    made = PandaGraspEnv(motion=motion)
    assert made._world.simulation.client.getPhysicsEngineParameters()["numSolverIterations"] == iterations
    assert made._world.simulation.motion is MOTIONS[motion]
    made.close()


@pytest.mark.parametrize(("given", "expected"), [
    ({}, 5), (dict(use_processes=False), 1), (dict(env_kwargs=dict(n_processes=3)), 3)
], ids=str)  # fmt: skip
def test_an_id_gets_a_process_for_each_core_unless_runs_are_side_by_side_or_a_number_is_given(
    given, expected, monkeypatch
):
    monkeypatch.setattr(vec_env, "usable_cores", lambda: 5)
    made = make_episodes_env("PandaGrasp-v0", n_episodes=7, **given)
    assert (type(made), made.num_envs, made.get_attr("n_processes")[0]) == (BatchedVecEnv, 7, expected)


def processes_of(made):
    return list(made.env._pool._executor._processes.values())


def has_ended(process):
    # Not process.join(): the executor's thread joins it, too, and one of the two then waits in vain.
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline:
        try:
            os.kill(process.pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def test_the_processes_do_not_end_by_ctrl_c_but_with_their_environment():
    for is_closed in (True, False):
        made = BatchedVecEnv(PandaGraspEnv(n_processes=2), 4)
        made.reset()
        processes = processes_of(made)
        assert processes
        for process in processes:
            os.kill(process.pid, signal.SIGINT)  # as a terminal does to all processes of a command
        assert made.step(np.zeros((4, 4), np.float32))[2].all()
        if is_closed:
            made.close()
        del made
        gc.collect()
        assert all(has_ended(process) for process in processes)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_processes_end_when_their_program_is_killed(number):
    program = (
        "import time, numpy as np\n"
        "from sb3_tdpg import make_episodes_env\n"
        "env = make_episodes_env('BallCatch-v0', 4, env_kwargs=dict(renderer='pybullet', n_processes=2), seed=0)\n"
        "env.reset()\n"
        "print('pids', *env.env._pool._executor._processes, flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as running:
        line = next(line for line in running.stdout if line.startswith("pids"))
        running.send_signal(number)
        running.wait()
        assert all(has_ended(types.SimpleNamespace(pid=int(pid))) for pid in line.split()[1:])


def test_a_process_that_dies_is_reported():
    made = BatchedVecEnv(PandaGraspEnv(n_processes=2), 4)
    made.reset()
    for process in processes_of(made):
        os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(BrokenProcessPool):
        made.step(np.zeros((4, 4), np.float32))
    made.close()


def test_a_script_without_a_main_guard_may_use_processes(tmp_path):
    if not hasattr(os, "fork"):
        pytest.skip("other start methods import the script once more")
    script = tmp_path / "script.py"
    script.write_text(
        "import numpy as np\n"
        "from sb3_tdpg import make_episodes_env\n"
        "env = make_episodes_env('PandaGrasp-v0', 2, seed=0, env_kwargs=dict(n_processes=2))\n"
        "env.reset()\n"
        "print(len(env.env._pool._executor._processes), env.step(np.zeros((2, 4), np.float32))[2])\n"
    )
    assert run_python("-W", "error::DeprecationWarning", str(script)).splitlines()[-1] == "2 [ True  True]"


@pytest.fixture(scope="module")
def pictured():
    """An environment after a grasp that lifted the mug, with the pictures before and after it."""
    env = PandaGraspEnv(render_mode="rgb_array", depth_noise_std=0.01)
    _, info = env.reset(seed=1)
    before = env.render()
    env.step(oracle_actions(info["state"][None])[0])
    yield env, before, env.render()
    env.close()


def test_the_picture_shows_the_scene_beside_the_depth_image(pictured):
    _, before, after = pictured
    for picture in (before, after):
        assert picture.shape == (256, 644, 3)
        assert picture.dtype == np.uint8
    red = (before[:, :384, 0].astype(int) - before[:, :384, 1]) > 80  # the mug
    assert 200 < red.sum() < 5000
    assert (before[:, :384] != after[:, :384]).any(axis=2).mean() > 0.05  # the robot has moved
    grey = before[:, 388:]
    assert (grey[..., 0] == grey[..., 1]).all()
    assert np.ptp(grey) > 200


def test_the_film_shows_the_grasp_from_its_beginning_to_what_is_rendered_after_it(pictured):
    env, before, after = pictured
    pictures = list(env.film())
    assert len(pictures) > 15
    np.testing.assert_array_equal(pictures[-1][:, :384], after[:, :384])
    assert not np.array_equal(pictures[0][:, :384], pictures[-1][:, :384])
    assert all(np.array_equal(picture[:, 388:], before[:, 388:]) for picture in pictures)  # what the robot went by
    heights = [configuration.position[2] for configuration in env._film]
    assert heights[0] == pytest.approx(0.0, abs=1e-3)
    assert max(heights) == pytest.approx(heights[-1], abs=0.01) and heights[-1] > 0.06


def test_a_film_needs_the_render_mode_and_a_grasp(env):
    env.reset(seed=0)
    for mode, message in ((None, "render_mode=None must be 'rgb_array' for a video"),
                          ("rgb_array", "no grasp to show before step")):  # fmt: skip
        env.render_mode = mode
        with pytest.raises(ValueError, match=message):
            next(env.film())


def test_a_window_without_a_display_is_refused_with_the_mend(monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    window = PandaGraspEnv(render_mode="human")
    with pytest.raises(ValueError, match=r"DISPLAY is not set.*render_mode='rgb_array'"):
        window.reset(seed=0)  # which draws, as Gymnasium has it, and so does each step
    calls = []
    monkeypatch.setattr(window, "render", lambda: calls.append(window._time))
    window.reset(seed=0)
    window.step(np.zeros(4, np.float32))
    assert calls == [0, 1]
