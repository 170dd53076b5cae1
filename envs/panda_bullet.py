"""
The grasp itself: PyBullet moves the arm down, closes the gripper, and lifts.

A *pose* is where the hand grasps, ``(x, y, z, yaw)``; a *state* that of the mug's frame, likewise ``(4,)``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .bullet import BulletClient
from .panda_scene import ROBOT_FILE, TABLE_FILE, TABLE_POSITION, UNTURNED, PandaScene, add_mug_body

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
# A gripper that is turned by half a turn is the same gripper: of the two ways to hold it, this one is in the middle of
# the last joint's range, so that all yaws of a half circle to either side of the nominal one can be reached.
HAND_TURN = np.pi / 4 - np.pi

LIFTED = 0.05  # m: higher than this a mug counts as lifted

# When the fast motion goes on before a phase's time is over; it looks whenever LOOK_EVERY steps are done.
LOOK_EVERY = 8
NEAR_TARGET = 0.01  # rad: the arm has arrived, since it comes nearer while the next phase begins
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
    start_height: float  # m, of the hand above where it grasps
    clears_rim: bool  # it starts higher if it must for the fingertips to be above the rim
    lift_by: float | None  # m; None: the hand goes to lift_to
    lift_to: float
    ends_early: bool  # a phase is over when nothing more is to come of it


MOTIONS = {
    "fast": Motion(
        solver_iterations=50,
        approach=Phase(80, 1.0, 0.2),
        close=Phase(60, 1.0, 0.2),
        lift=Phase(90, 0.6, 0.2),
        start_height=0.01,
        clears_rim=True,
        lift_by=0.08,
        lift_to=0.3,
        ends_early=True,
    ),
    "reference": Motion(
        solver_iterations=150,
        approach=Phase(1000, 0.15, 0.2),
        close=Phase(100, 0.15, 0.05),
        lift=Phase(500, 0.1, 0.05),
        start_height=0.2,
        clears_rim=False,
        lift_by=None,
        lift_to=0.3,
        ends_early=False,
    ),
}
ABOVE_RIM = 0.0167  # m between rim and fingertips where the fast motion starts


class Outcome(NamedTuple):
    """What became of the mug."""

    state: np.ndarray  # (4,)
    contacts: int  # points in which the fingers touch the mug in the end


class Configuration(NamedTuple):
    """Where everything that moves is at one instant."""

    joints: tuple[float, ...]  # seven of the arm, two of the fingers
    mug_position: tuple[float, ...]  # of its frame
    mug_orientation: tuple[float, ...]  # quaternion (x, y, z, w)


class GraspSimulation:
    """
    Robot, table and mug in a Bullet world of their own, without anything that is only to be seen.

    Every grasp starts from the same state of the world, whatever has been simulated before, so that its outcome is a
    function of state and pose alone.

    :param scene: The mug.
    :param motion: How a grasp is carried out.
    :param solver_iterations: Of Bullet's contact solver in a time step; ``None``: the motion's.
    """

    def __init__(self, scene: PandaScene, motion: Motion, solver_iterations: int | None = None) -> None:
        self.scene = scene
        self.motion = motion
        self.client = client = BulletClient()
        client.setGravity(0.0, 0.0, -9.81)
        client.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=solver_iterations or motion.solver_iterations,
            # Contacts are solved for one after the other. By default their order depends on what was simulated before,
            # and with it the mug's final pose in one trial of fifteen.
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
        self._put_arm(HOME)
        self._start = client.saveState()

    # -- one grasp ----------------------------------------------------------------------------------------------------

    def grasp(
        self, state: np.ndarray, pose: np.ndarray, watch: Callable[[Configuration], object] | None = None
    ) -> Outcome:
        """
        Carry out one grasp.

        :param state: Where the mug stands, ``(4,)``.
        :param pose: Where it is grasped, ``(4,)``.
        :param watch: Is shown the scene 30 times a second. This does not change the outcome.
        """
        motion, client = self.motion, self.client
        self._restore(state)
        x, y, z, yaw = pose.tolist()
        z += HAND_ABOVE_GRASP
        start_height = z + motion.start_height
        if motion.clears_rim:
            start_height = max(start_height, self.scene.mug_height + ABOVE_RIM + FINGERTIPS_BELOW_HAND)
        orientation = client.multiplyTransforms(
            (0.0, 0.0, 0.0), client.getQuaternionFromEuler((np.pi, 0.0, 0.0)),
            (0.0, 0.0, 0.0), client.getQuaternionFromEuler((0.0, 0.0, yaw + HAND_TURN)),
        )[1]  # fmt: skip
        low = self._joints_for((x, y, z), orientation)
        self._put_arm(low)
        start = self._joints_for((x, y, start_height), orientation)
        lift_to = motion.lift_to if motion.lift_by is None else z + motion.lift_by
        high = self._joints_for((x, y, lift_to), orientation)
        self._put_arm(start)
        self._run(motion.approach, low, FINGER_OPEN, lambda: self._is_at(low), watch)
        self._run(motion.close, low, 0.0, self._fingers_stand_still, watch)
        self._run(motion.lift, high, 0.0, lambda: self._is_decided() or self._is_at(high), watch)
        return Outcome(self._mug_state(state[3]), self._contacts())

    def _run(
        self,
        phase: Phase,
        joints: tuple[float, ...],
        fingers: float,
        is_over: Callable[[], bool],
        watch: Callable[[Configuration], object] | None,
    ) -> None:
        """Move arm and fingers towards a goal for as long as a phase lasts."""
        client, robot = self.client, self._robot
        for joint, goal in zip(ARM_JOINTS, joints, strict=True):
            client.setJointMotorControl2(
                robot, joint, client.POSITION_CONTROL, goal, force=ARM_FORCE, maxVelocity=phase.arm_speed
            )
        for joint in FINGER_JOINTS:
            client.setJointMotorControl2(
                robot, joint, client.POSITION_CONTROL, fingers, force=FINGER_FORCE, maxVelocity=phase.finger_speed
            )
        step = client.stepSimulation
        for i in range(phase.max_steps):
            if i % LOOK_EVERY == 0:
                if watch is not None:
                    watch(self._configuration())
                if self.motion.ends_early and i > 0 and is_over():
                    return
            step()
        if watch is not None:
            watch(self._configuration())

    # -- the world ----------------------------------------------------------------------------------------------------

    def _restore(self, state: np.ndarray) -> None:
        """Bring the world back to its saved state, and put the mug where a state has it."""
        client = self.client
        # restoreState does not take away contacts of the last trial; a step in which nothing touches does.
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
        """Place the arm at once, with the gripper open."""
        for joint, angle in zip((*ARM_JOINTS, *FINGER_JOINTS), (*joints, FINGER_OPEN, FINGER_OPEN), strict=True):
            self.client.resetJointState(self._robot, joint, angle, 0.0)

    def _joints_for(self, position: tuple[float, ...], orientation: tuple[float, ...]) -> tuple[float, ...]:
        """Solve for the arm's joints by inverse kinematics, from where the arm is."""
        joints = self.client.calculateInverseKinematics(
            self._robot, HAND, position, orientation,
            jointDamping=[1e-5] * 9, maxNumIterations=200, residualThreshold=1e-6,
        )  # fmt: skip
        return tuple(joints[:7])

    def _is_at(self, joints: tuple[float, ...]) -> bool:
        states = self.client.getJointStates(self._robot, ARM_JOINTS)
        return all(abs(state[0] - goal) < NEAR_TARGET for state, goal in zip(states, joints, strict=True))

    def _fingers_stand_still(self) -> bool:
        """Tell whether they hold something, or each other."""
        return all(
            abs(state[1]) < FINGERS_STAND_STILL for state in self.client.getJointStates(self._robot, FINGER_JOINTS)
        )

    def _is_decided(self) -> bool:
        """Tell whether the mug has been lost, or is so high that it counts as lifted."""
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
        """Where the mug is; its yaw goes on from what it was, without a jump by a whole turn."""
        origin, axes, _ = self._mug_frame()
        turned = np.arctan2(axes[1, 0], axes[0, 0]) - yaw_before
        return np.append(origin, yaw_before + (turned + np.pi) % (2 * np.pi) - np.pi)

    def _configuration(self) -> Configuration:
        origin, _, orientation = self._mug_frame()
        states = self.client.getJointStates(self._robot, (*ARM_JOINTS, *FINGER_JOINTS))
        return Configuration(tuple(state[0] for state in states), tuple(origin.tolist()), tuple(orientation))

    def close(self) -> None:
        """Close the Bullet world."""
        self.client.close()
