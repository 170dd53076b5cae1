"""A ROS 2 node that acts at a fixed rate: ``python ros_node.py policy.onnx 0.05`` beside ``robot_loop.py``."""

import sys

import numpy as np
import rclpy
from rclpy.node import Node
from robot_loop import Policy
from std_msgs.msg import Empty, Float32MultiArray


class PolicyNode(Node):
    """Subscribes ``observation`` and ``reset``, publishes ``action`` every ``period`` seconds until the horizon."""

    def __init__(self, path, period):
        super().__init__("tdpg_policy")
        self.policy = Policy(path)
        self.about = self.policy.about["inputs"]["observation"]
        self.begin(None)
        self.publisher = self.create_publisher(Float32MultiArray, "action", 1)
        self.create_subscription(Float32MultiArray, "observation", self.receive, 1)
        self.create_subscription(Empty, "reset", self.begin, 1)
        self.create_timer(period, self.act)

    def begin(self, _):
        """Begin an episode; until the first observation arrives, the policy sees zeros."""
        self.policy.reset()
        self.observation, self.is_new, self.n_missed = np.zeros(self.about["shape"], np.float32), False, 0

    def receive(self, message):
        """Take an observation, clipped to the bounds of the training; a broken one counts as missing."""
        observation = np.array(message.data, np.float32)
        if observation.size != self.observation.size or not np.isfinite(observation).all():
            self.get_logger().warning(f"an observation of {observation.size} numbers, or not finite, is left out")
            return
        if "low" in self.about:
            low, high = (np.array([np.nan if x is None else x for x in self.about[key]]) for key in ("low", "high"))
            observation = np.fmin(np.fmax(observation, low), high)  # a bound of NaN is none
        self.observation, self.is_new = observation.reshape(self.observation.shape), True

    def act(self):
        """Act at every tick: on the last observation, if no new one has arrived."""
        if "time_step" in self.policy.about["inputs"] and self.policy.t >= self.policy.about["horizon"]:
            return  # there are no weights for later steps: wait for a reset
        self.n_missed += not self.is_new
        self.is_new = False
        action = self.policy(self.observation)
        self.publisher.publish(Float32MultiArray(data=np.ravel(action).astype(float).tolist()))


if __name__ == "__main__":
    rclpy.init()
    rclpy.spin(PolicyNode(sys.argv[1], float(sys.argv[2])))
