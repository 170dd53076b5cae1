"""Simulate, phase by phase, a Panda arm that grasps or squeezes a body on a table."""

import functools
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import NamedTuple

from .bullet import UNTURNED, BulletWorld
from .panda_scene import TABLE_FILE, TABLE_POSITION

Joints = tuple[float, ...]  # rad, of the arm
Pose = tuple[tuple[float, ...], tuple[float, ...]]  # position in m, and orientation as a quaternion (x, y, z, w)

TIME_STEP = 1 / 240  # s
HAND = 8  # link number
ARM_JOINTS = tuple(range(7))
FINGER_JOINTS = (9, 10)  # the finger links have the same numbers
HOME: Joints = (0.0, -0.215, 0.0, -2.57, 0.0, 2.356, -0.785)  # rad, where inverse kinematics starts
FINGER_OPEN = 0.04  # m, position of each finger in the open gripper
ARM_FORCE, FINGER_FORCE = 70.0, 20.0
FINGERTIPS_BELOW_HAND = 0.1123  # m
LOOK_EVERY = 8  # number of steps between two checks whether a phase can end
NEAR_TARGET = 0.01  # rad: the arm has arrived if all joints are closer than this to their goals
FAR_AWAY = (5.0, 5.0, 5.0)  # m


class Phase(NamedTuple):
    """The length and the speeds of one phase of a motion."""

    max_steps: int
    arm_speed: float  # rad/s, of each joint
    finger_speed: float  # m/s, of each finger


class Configuration(NamedTuple):
    """The positions of the joints and of the body at one time."""

    joints: tuple[float, ...]  # seven of the arm and two of the fingers
    position: tuple[float, ...]  # of the mug's frame or of the part's middle
    orientation: tuple[float, ...]  # quaternion (x, y, z, w)


Watch = Callable[[Configuration], object]


class ArmSimulation(BulletWorld):
    """
    Simulate a table, a robot and one body in a separate Bullet world, without visual shapes of table and robot.

    A subclass loads the robot and the body. It sets all positions before a motion. So the outcome of the motion depends
    only on the arguments of the method that starts it.
    """

    _robot: int
    _body: int
    _watch: Watch | None = None
    _ends_early = True  # a phase ends when its goal is reached, not after all its steps
    _still = 0.01  # m/s: slower fingers count as standing still

    def __init__(self, solver_iterations: int) -> None:
        super().__init__()
        client = self.client
        client.setGravity(0.0, 0.0, -9.81)
        client.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP,
            numSolverIterations=solver_iterations,
            # By default Bullet solves contacts in an order that depends on earlier simulations. This changes the body's
            # final pose in one of fifteen trials.
            deterministicOverlappingPairs=1,
        )
        self._unseen = client.URDF_IGNORE_VISUAL_SHAPES
        self._table = client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True, flags=self._unseen)

    @abstractmethod
    def _pose(self) -> Pose:
        """Return the pose of the body for pictures."""

    def _run(self, phase: Phase, joints: Joints, fingers: float, is_over: Callable[[], bool]) -> None:
        """Move arm and fingers towards their goals until a phase is over."""
        control = functools.partial(self.client.setJointMotorControl2, self._robot)
        position = self.client.POSITION_CONTROL
        for joint, goal, speed in zip(ARM_JOINTS, joints, self._speeds(phase, joints), strict=True):
            control(joint, position, goal, force=ARM_FORCE, maxVelocity=speed)
        for joint in FINGER_JOINTS:
            control(joint, position, fingers, force=FINGER_FORCE, maxVelocity=phase.finger_speed)
        step = self.client.stepSimulation
        for i in range(phase.max_steps):
            if i % LOOK_EVERY == 0:
                self._show()
                if self._ends_early and i > 0 and is_over():
                    return
            step()
        self._show()

    def _speeds(self, phase: Phase, joints: Joints) -> Sequence[float]:
        """Return the maximum speed of each joint on its way to its goal, in rad/s."""
        return [phase.arm_speed] * len(joints)

    def _show(self) -> None:
        if self._watch is not None:
            states = self._states((*ARM_JOINTS, *FINGER_JOINTS))
            self._watch(Configuration(tuple(state[0] for state in states), *self._pose()))

    def _states(self, joints: Sequence[int]) -> list[tuple[float, ...]]:
        """Return PyBullet's state of each joint: a tuple that begins with position and velocity."""
        return self.client.getJointStates(self._robot, joints)

    def _clear_contacts(self) -> None:
        """Simulate a step with the body far away, because contacts of the last motion would change the next motion."""
        self.client.resetBasePositionAndOrientation(self._body, FAR_AWAY, UNTURNED)
        self.client.stepSimulation()

    def _put_body(self, position: tuple[float, ...], yaw: float) -> None:
        """Put the body at a position, upright and at rest."""
        client = self.client
        upright = client.getQuaternionFromEuler((0.0, 0.0, yaw))
        client.resetBasePositionAndOrientation(self._body, position, upright)
        client.resetBaseVelocity(self._body, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

    def _put_arm(self, joints: Joints, fingers: float = FINGER_OPEN) -> None:
        for joint, angle in zip((*ARM_JOINTS, *FINGER_JOINTS), (*joints, fingers, fingers), strict=True):
            self.client.resetJointState(self._robot, joint, angle, 0.0)

    def _joints_for(self, position: tuple[float, ...], orientation: tuple[float, ...], accuracy: float) -> Joints:
        """Solve the inverse kinematics of the arm for a pose of the hand, starting from the present joint angles."""
        joints = self.client.calculateInverseKinematics(
            self._robot, HAND, position, orientation,
            jointDamping=[1e-5] * 9, maxNumIterations=200, residualThreshold=accuracy,
        )  # fmt: skip
        return tuple(joints[:7])

    def _is_at(self, joints: Joints) -> bool:
        states = self._states(ARM_JOINTS)
        return all(abs(state[0] - goal) < NEAR_TARGET for state, goal in zip(states, joints, strict=True))

    def _fingers_stand_still(self) -> bool:
        return all(abs(state[1]) < self._still for state in self._states(FINGER_JOINTS))
