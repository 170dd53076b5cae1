"""
Simulate a grasp with PyBullet: move the arm down, close the gripper, and lift.

A *pose* is the pose of the hand at the grasp, ``(x, y, z, yaw)``. A *state* is the pose of the mug's frame, also
``(4,)``.
"""

from typing import NamedTuple

import numpy as np

from .panda_arm import FINGER_JOINTS, FINGER_OPEN, FINGERTIPS_BELOW_HAND, HOME, ArmSimulation, Phase, Pose, Watch
from .panda_scene import CENTRE_OF_MASS, FRICTION, MUG_HEIGHT, ROBOT_FILE, add_mug_body

FINGER_SPINNING_FRICTION = 0.1
HAND_ABOVE_GRASP = 0.1  # m: the height of a grasp is the height of a point between the fingers, near their tips
# Half a turn does not change the gripper. With this one of the two possible turns, the last joint is at -60 degrees at
# the nominal yaw, and its range is -170 to 170 degrees. So the arm reaches all yaws within 90 degrees of the nominal
# yaw.
HAND_TURN = np.pi / 4 - np.pi
LIFTED = 0.05  # m: a mug above this height counts as lifted
LIFTED_FOR_GOOD = 0.06  # m: the fast motion ends once the mug is above this height
ACCURACY = 1e-6  # of inverse kinematics


class Motion(NamedTuple):
    """The solver setting and the phases of a grasp."""

    solver_iterations: int
    approach: Phase
    close: Phase
    lift: Phase
    start_height: float  # m, height of the hand above the grasp at the start
    is_fast: bool  # start above the rim, lift by LIFT_BY instead of to LIFT_TO, and end each phase as early as possible


MOTIONS = {
    "fast": Motion(50, Phase(80, 1.0, 0.2), Phase(60, 1.0, 0.2), Phase(90, 0.6, 0.2), 0.01, is_fast=True),
    "reference": Motion(150, Phase(1000, 0.15, 0.2), Phase(100, 0.15, 0.05), Phase(500, 0.1, 0.05), 0.2, is_fast=False),
}
ABOVE_RIM = 0.0167  # m between rim and fingertips at the start of the fast motion
LIFT_BY, LIFT_TO = 0.08, 0.3  # m


# The result of a grasp: the mug's state, (4,), and the number of points in which the fingers touch it at the end.
Outcome = tuple[np.ndarray, int]


class GraspSimulation(ArmSimulation):
    """
    Simulate grasps with robot, table and mug in a separate Bullet world, without visual shapes.

    Every grasp starts from the same state of the world, so that the outcome depends only on state and pose.
    """

    def __init__(self, cup_origin: np.ndarray, motion: Motion) -> None:
        super().__init__(motion.solver_iterations)
        self.motion, client = motion, self.client
        self._centre_of_mass = cup_origin + CENTRE_OF_MASS  # in the mug's frame; Bullet uses it as base position
        self._ends_early = motion.is_fast
        self._robot = int(client.loadURDF(ROBOT_FILE, useFixedBase=True, flags=self._unseen))
        for finger in FINGER_JOINTS:
            client.changeDynamics(
                self._robot, finger, lateralFriction=FRICTION, spinningFriction=FINGER_SPINNING_FRICTION
            )
        self._body = add_mug_body(client, cup_origin)
        self._put_arm(HOME)
        self._start = client.saveState()

    def grasp(self, state: np.ndarray, pose: np.ndarray, watch: Watch | None = None) -> Outcome:
        """Carry out a grasp; ``watch`` is called 30 times per simulated second and does not change the outcome."""
        motion, client, self._watch = self.motion, self.client, watch
        self._restore(state)
        x, y, z, yaw = pose.tolist()
        z += HAND_ABOVE_GRASP
        start_height = z + motion.start_height
        if motion.is_fast:
            start_height = max(start_height, MUG_HEIGHT + ABOVE_RIM + FINGERTIPS_BELOW_HAND)
        orientation = client.multiplyTransforms(
            (0.0, 0.0, 0.0), client.getQuaternionFromEuler((np.pi, 0.0, 0.0)),
            (0.0, 0.0, 0.0), client.getQuaternionFromEuler((0.0, 0.0, yaw + HAND_TURN)),
        )[1]  # fmt: skip
        low = self._joints_for((x, y, z), orientation, ACCURACY)
        self._put_arm(low)
        start = self._joints_for((x, y, start_height), orientation, ACCURACY)
        high = self._joints_for((x, y, z + LIFT_BY if motion.is_fast else LIFT_TO), orientation, ACCURACY)
        self._put_arm(start)
        self._run(motion.approach, low, FINGER_OPEN, lambda: self._is_at(low))
        self._run(motion.close, low, 0.0, self._fingers_stand_still)
        self._run(motion.lift, high, 0.0, lambda: self._is_decided() or self._is_at(high))
        return self._mug_state(state[3]), self._contacts()

    def _restore(self, state: np.ndarray) -> None:
        """Restore the saved state of the world, and move the mug to its state."""
        self._clear_contacts()  # restoreState keeps contacts
        self.client.restoreState(self._start)
        x, y, z, yaw = state.tolist()
        cos, sin = np.cos(yaw), np.sin(yaw)
        to_right, ahead, upward = self._centre_of_mass.tolist()
        self._put_body((x + cos * to_right - sin * ahead, y + sin * to_right + cos * ahead, z + upward), yaw)

    def _is_decided(self) -> bool:
        """Return whether the fingers have lost contact with the mug, or the mug is high enough to count as lifted."""
        return not self._contacts() or self._mug_frame()[0][2] > LIFTED_FOR_GOOD

    def _contacts(self) -> int:
        """Count the points in which the fingers touch the mug."""
        points = self.client.getContactPoints
        return sum(len(points(self._robot, self._body, finger, -1)) for finger in FINGER_JOINTS)

    def _mug_frame(self) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
        """Return origin ``(3,)``, axes ``(3, 3)`` and orientation (a quaternion) of the mug's frame."""
        centre, orientation = self.client.getBasePositionAndOrientation(self._body)
        axes = np.array(self.client.getMatrixFromQuaternion(orientation)).reshape(3, 3)
        return np.array(centre) - axes @ self._centre_of_mass, axes, orientation

    def _mug_state(self, yaw_before: float) -> np.ndarray:
        """Return the state of the mug; its yaw differs from ``yaw_before`` by at most half a turn."""
        origin, axes, _ = self._mug_frame()
        turned = np.arctan2(axes[1, 0], axes[0, 0]) - yaw_before
        return np.append(origin, yaw_before + (turned + np.pi) % (2 * np.pi) - np.pi)

    def _pose(self) -> Pose:
        origin, _, orientation = self._mug_frame()
        return tuple(origin.tolist()), tuple(orientation)
