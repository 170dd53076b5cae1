"""The programs of the page "On a robot"."""

import os
import shutil
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from sb3_tdpg import TDPG

pytest.importorskip("onnxruntime")

PROGRAMS = Path(__file__).parents[2] / "docs" / "robot"
ONNXRUNTIME_ROOT = os.environ.get("ONNXRUNTIME_ROOT")


@pytest.fixture
def ros(monkeypatch):
    """A stand-in for ROS 2 that keeps what a node makes and publishes; the module of the node."""

    class Node:
        def __init__(self, name):
            self.name, self.published, self.subscriptions_, self.timers_, self.warned = name, [], {}, [], []

        def create_publisher(self, kind, topic, depth):
            return types.SimpleNamespace(publish=lambda message: self.published.append((topic, message.data)))

        def create_subscription(self, kind, topic, function, depth):
            self.subscriptions_[topic] = function

        def create_timer(self, period, function):
            self.timers_.append((period, function))

        def get_logger(self):
            return types.SimpleNamespace(warning=self.warned.append)

    def module(name, **members):
        made = types.ModuleType(name)
        vars(made).update(members)
        monkeypatch.setitem(sys.modules, name, made)

    module("rclpy")
    module("rclpy.node", Node=Node)
    module("std_msgs")
    message = type("Float32MultiArray", (), {"__init__": lambda self, data: setattr(self, "data", data)})
    module("std_msgs.msg", Float32MultiArray=message, Empty=object)
    monkeypatch.syspath_prepend(str(PROGRAMS))
    monkeypatch.delitem(sys.modules, "ros_node", raising=False)
    import ros_node

    return types.SimpleNamespace(node=ros_node.PolicyNode, message=message)


def test_the_ros_node_acts_at_every_tick_and_waits_at_the_horizon(ros, tmp_path):
    model = TDPG("TRVPolicy", "Lava-v0", seed=0, device="cpu")
    node = ros.node(str(model.export(tmp_path / "policy.onnx")), 0.1)
    ((period, tick),) = node.timers_
    assert period == 0.1
    receive = node.subscriptions_["observation"]
    receive(ros.message([0.5, -1.0]))
    tick()
    receive(ros.message([np.nan, 0.0]))
    receive(ros.message([1.0]))
    tick()
    assert (node.n_missed, len(node.warned)) == (1, 2)
    np.testing.assert_array_equal(node.observation, np.array([0.5, -1.0], np.float32))  # the last good one
    for _ in range(5):
        tick()
    assert len(node.published) == model.horizon == 5
    assert all(topic == "action" and len(data) == 1 for topic, data in node.published)
    node.subscriptions_["reset"](None)
    tick()
    assert len(node.published) == 6


def test_the_ros_node_clips_observations_to_their_bounds(ros, tmp_path):
    model = TDPG("TRVPolicy", "Pendulum-v1", seed=0, device="cpu")
    node = ros.node(str(model.export(tmp_path / "policy.onnx")), 0.1)
    node.subscriptions_["observation"](ros.message([3.0, -0.5, -20.0]))
    np.testing.assert_array_equal(node.observation, np.array([1.0, -0.5, -8.0], np.float32))


@pytest.mark.skipif(not (ONNXRUNTIME_ROOT and shutil.which("g++")), reason="needs g++ and ONNX Runtime's C++ package")
def test_the_cpp_program_acts(tmp_path):
    TDPG("TRVPolicy", "Lava-v0", seed=0, device="cpu").export(tmp_path / "policy.onnx")
    root = Path(str(ONNXRUNTIME_ROOT))
    flags = [f"-I{root / 'include'}", f"-L{root / 'lib'}", f"-Wl,-rpath,{root / 'lib'}", "-lonnxruntime"]
    source = str(PROGRAMS / "robot_loop.cpp")
    subprocess.run(["g++", "-std=c++17", "-Wall", "-Werror", source, *flags, "-o", "loop"], cwd=tmp_path, check=True)
    done = subprocess.run(
        ["./loop", "policy.onnx", "5"], input="0.5 1.0\n" * 7, cwd=tmp_path, check=True, capture_output=True, text=True
    )
    assert len([float(line) for line in done.stdout.split()]) == 7
