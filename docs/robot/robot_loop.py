"""Run an exported policy on a robot: numpy and onnxruntime are all it needs."""

import json

import numpy as np
import onnxruntime


class Policy:
    """The policy of a file that ``model.export("policy.onnx")`` wrote, with its memory."""

    def __init__(self, path, deterministic=False, seed=None):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # a step is too small to share
        self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        self.about = json.loads(self.session.get_modelmeta().custom_metadata_map["sb3_tdpg"])
        rng = np.random.default_rng(seed)
        self.draw = dict(trv_noise=rng.normal, action_noise=getattr(rng, self.about["action_noise"]))
        self.scale = 0.0 if deterministic else 1.0
        self.reset()

    def reset(self):
        """Forget the episode before."""
        self.memory, self.t = np.zeros((1, *self.about["inputs"]["memory"]["shape"]), np.float32), 0

    def __call__(self, observation):
        """Return the action for one observation, an array or a dict of arrays, and remember what matters of it."""
        parts = observation if isinstance(observation, dict) else {"": observation}
        given = {("observation." + key).rstrip("."): part for key, part in parts.items()}
        given |= {"memory": self.memory[0], "time_step": self.t}
        inputs = self.about["inputs"]
        given |= {name: self.scale * draw(size=inputs[name]["shape"]) for name, draw in self.draw.items()}
        feed = {name: np.asarray(given[name], x["dtype"])[None] for name, x in inputs.items()}
        action, self.memory = self.session.run(None, feed)
        self.t += 1
        return action[0]


def run(policy, robot, n_steps=None):
    """Drive a robot, an object with ``read()`` and ``send(action)``; by default to the horizon of the training."""
    policy.reset()
    for _ in range(n_steps or policy.about["horizon"]):
        robot.send(policy(robot.read()))
