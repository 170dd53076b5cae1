"""
The simulation of a grasp: PyBullet moves the arm down, closes the gripper, and lifts.

A *pose* is that of the hand at the grasp, ``(x, y, z, yaw)``; a *state* is that of the mug's frame, also ``(4,)``.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .bullet import UNTURNED, BulletWorld
from .panda_scene import ROBOT_FILE, TABLE_FILE, TABLE_POSITION, PandaScene, add_mug_body

TIME_STEP = 1 / 240  # s
HAND = 8  # link
ARM_JOINTS = tuple(range(7))
FINGER_JOINTS = (9, 10)  # and links
HOME = (0.0, -0.215, 0.0, -2.57, 0.0, 2.356, -0.785)  # rad, from where inverse kinematics starts
FINGER_OPEN = 0.04  # m, of each of the two
ARM_FORCE, FINGER_FORCE = 70.0, 20.0
FINGER_SPINNING_FRICTION = 0.1
HAND_ABOVE_GRASP = 0.1  # m: the height of a grasp is that of a point between the fingers, near their tips
FINGERTIPS_BELOW_HAND = 0.1123  # m
# Half a turn does not change the gripper. This turn is in the middle of the last joint's range, so that the arm reaches
# all yaws of a half circle to either side of the nominal one.
HAND_TURN = np.pi / 4 - np.pi
LIFTED = 0.05  # m: higher than this a mug counts as lifted
LOOK_EVERY = 8  # steps, after which the fast motion checks whether a phase can end early
NEAR_TARGET = 0.01  # rad: the arm has arrived
FINGERS_STAND_STILL = 0.01  # m/s
LIFTED_FOR_GOOD = 0.06  # m
FAR_AWAY = (5.0, 5.0, 5.0)  # m


class Phase(NamedTuple):
    """A part of a grasp."""

    max_steps: int
    arm_speed: float  # rad/s, of each joint
    finger_speed: float  # m/s, of each finger


class Motion(NamedTuple):
    """How a grasp is carried out."""

    solver_iterations: int
    approach: Phase
    close: Phase
    lift: Phase
    start_height: float  # m, of the hand above the grasp
    is_fast: bool  # start above the rim, lift by LIFT_BY instead of to LIFT_TO, and end each phase as early as possible


MOTIONS = {
    "fast": Motion(50, Phase(80, 1.0, 0.2), Phase(60, 1.0, 0.2), Phase(90, 0.6, 0.2), 0.01, is_fast=True),
    "reference": Motion(150, Phase(1000, 0.15, 0.2), Phase(100, 0.15, 0.05), Phase(500, 0.1, 0.05), 0.2, is_fast=False),
}
ABOVE_RIM = 0.0167  # m between rim and fingertips at the start of the fast motion
LIFT_BY, LIFT_TO = 0.08, 0.3  # m


# The result of a grasp: the mug's state, (4,), and the number of points in which the fingers touch it at the end.
Outcome = tuple[np.ndarray, int]


class Configuration(NamedTuple):
    """Positions of everything that moves, at one instant."""

    joints: tuple[float, ...]  # seven of the arm, two of the fingers
    mug_position: tuple[float, ...]  # of its frame
    mug_orientation: tuple[float, ...]  # quaternion (x, y, z, w)


class GraspSimulation(BulletWorld):
    """
    Robot, table and mug in a Bullet world of their own, without visual shapes.

    Every grasp starts from the same state of the world, so that its outcome is a function of state and pose alone. A
    number of ``solver_iterations`` of Bullet's contact solver in a time step replaces that of the motion.
    """

    def __init__(self, scene: PandaScene, motion: Motion, solver_iterations: int | None = None) -> None:
        super().__init__()
        self.scene, self.motion, client = scene, motion, self.client
        client.setGravity(0.0, 0.0, -9.81)
        client.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=solver_iterations or motion.solver_iterations,
            # By default the order in which contacts are solved depends on earlier simulations, and changes the mug's
            # final pose in one trial of fifteen.
            deterministicOverlappingPairs=1,
        )
        unseen = client.URDF_IGNORE_VISUAL_SHAPES
        client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True, flags=unseen)
        self._robot = int(client.loadURDF(ROBOT_FILE, useFixedBase=True, flags=unseen))
        for finger in FINGER_JOINTS:
            client.changeDynamics(
                self._robot, finger, lateralFriction=scene.friction, spinningFriction=FINGER_SPINNING_FRICTION
            )
        self._mug = add_mug_body(client, scene)
        self._watch: Callable[[Configuration], object] | None = None
        self._put_arm(HOME)
        self._start = client.saveState()

    def grasp(
        self, state: np.ndarray, pose: np.ndarray, watch: Callable[[Configuration], object] | None = None
    ) -> Outcome:
        """Carry out a grasp; ``watch`` is called 30 times a second and does not change the outcome."""
        motion, client, self._watch = self.motion, self.client, watch
        self._restore(state)
        x, y, z, yaw = pose.tolist()
        z += HAND_ABOVE_GRASP
        start_height = z + motion.start_height
        if motion.is_fast:
            start_height = max(start_height, self.scene.mug_height + ABOVE_RIM + FINGERTIPS_BELOW_HAND)
        orientation = client.multiplyTransforms(
            (0.0, 0.0, 0.0), client.getQuaternionFromEuler((np.pi, 0.0, 0.0)),
            (0.0, 0.0, 0.0), client.getQuaternionFromEuler((0.0, 0.0, yaw + HAND_TURN)),
        )[1]  # fmt: skip
        low = self._joints_for((x, y, z), orientation)
        self._put_arm(low)
        start = self._joints_for((x, y, start_height), orientation)
        high = self._joints_for((x, y, z + LIFT_BY if motion.is_fast else LIFT_TO), orientation)
        self._put_arm(start)
        self._run(motion.approach, low, FINGER_OPEN, lambda: self._is_at(low))
        self._run(motion.close, low, 0.0, self._fingers_stand_still)
        self._run(motion.lift, high, 0.0, lambda: self._is_decided() or self._is_at(high))
        return self._mug_state(state[3]), self._contacts()

    def _run(self, phase: Phase, joints: tuple[float, ...], fingers: float, is_over: Callable[[], bool]) -> None:
        """Move arm and fingers towards a goal until a phase is over."""
        control = functools.partial(self.client.setJointMotorControl2, self._robot)
        position = self.client.POSITION_CONTROL
        for joint, goal in zip(ARM_JOINTS, joints, strict=True):
            control(joint, position, goal, force=ARM_FORCE, maxVelocity=phase.arm_speed)
        for joint in FINGER_JOINTS:
            control(joint, position, fingers, force=FINGER_FORCE, maxVelocity=phase.finger_speed)
        step = self.client.stepSimulation
        for i in range(phase.max_steps):
            if i % LOOK_EVERY == 0:
                self._show()
                if self.motion.is_fast and i > 0 and is_over():
                    return
            step()
        self._show()

    def _show(self) -> None:
        if self._watch is not None:
            self._watch(self._configuration())

    def _restore(self, state: np.ndarray) -> None:
        """Restore the saved state of the world, and move the mug to its state."""
        client = self.client
        # restoreState keeps the contacts of the last trial; a step in which nothing touches removes them.
        client.resetBasePositionAndOrientation(self._mug, FAR_AWAY, UNTURNED)
        client.stepSimulation()
        client.restoreState(self._start)
        x, y, z, yaw = state.tolist()
        cos, sin = np.cos(yaw), np.sin(yaw)
        to_right, ahead, upward = self.scene.centre_of_mass.tolist()
        position = (x + cos * to_right - sin * ahead, y + sin * to_right + cos * ahead, z + upward)
        client.resetBasePositionAndOrientation(self._mug, position, client.getQuaternionFromEuler((0.0, 0.0, yaw)))
        client.resetBaseVelocity(self._mug, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    def _put_arm(self, joints: tuple[float, ...]) -> None:
        """Set the joints of the arm, and open the gripper."""
        for joint, angle in zip((*ARM_JOINTS, *FINGER_JOINTS), (*joints, FINGER_OPEN, FINGER_OPEN), strict=True):
            self.client.resetJointState(self._robot, joint, angle, 0.0)

    def _joints_for(self, position: tuple[float, ...], orientation: tuple[float, ...]) -> tuple[float, ...]:
        """Solve for the arm's joints by inverse kinematics, starting from the present ones."""
        joints = self.client.calculateInverseKinematics(
            self._robot, HAND, position, orientation,
            jointDamping=[1e-5] * 9, maxNumIterations=200, residualThreshold=1e-6,
        )  # fmt: skip
        return tuple(joints[:7])

    def _is_at(self, joints: tuple[float, ...]) -> bool:
        states = self.client.getJointStates(self._robot, ARM_JOINTS)
        return all(abs(state[0] - goal) < NEAR_TARGET for state, goal in zip(states, joints, strict=True))

    def _fingers_stand_still(self) -> bool:
        states = self.client.getJointStates(self._robot, FINGER_JOINTS)
        return all(abs(state[1]) < FINGERS_STAND_STILL for state in states)

    def _is_decided(self) -> bool:
        """Return whether the mug is lost, or high enough to count as lifted."""
        return not self._contacts() or self._mug_frame()[0][2] > LIFTED_FOR_GOOD

    def _contacts(self) -> int:
        """Count the points in which the fingers touch the mug."""
        points = self.client.getContactPoints
        return sum(len(points(self._robot, self._mug, finger, -1)) for finger in FINGER_JOINTS)

    def _mug_frame(self) -> tuple[np.ndarray, np.ndarray, tuple[float, ...]]:
        """Origin ``(3,)`` and axes ``(3, 3)`` of the mug's frame, and its orientation as a quaternion."""
        centre, orientation = self.client.getBasePositionAndOrientation(self._mug)
        axes = np.array(self.client.getMatrixFromQuaternion(orientation)).reshape(3, 3)
        return np.array(centre) - axes @ self.scene.centre_of_mass, axes, orientation

    def _mug_state(self, yaw_before: float) -> np.ndarray:
        """State of the mug; its yaw continues from the one before, without a jump by a whole turn."""
        origin, axes, _ = self._mug_frame()
        turned = np.arctan2(axes[1, 0], axes[0, 0]) - yaw_before
        return np.append(origin, yaw_before + (turned + np.pi) % (2 * np.pi) - np.pi)

    def _configuration(self) -> Configuration:
        origin, _, orientation = self._mug_frame()
        states = self.client.getJointStates(self._robot, (*ARM_JOINTS, *FINGER_JOINTS))
        return Configuration(tuple(state[0] for state in states), tuple(origin.tolist()), tuple(orientation))
