"""Simulate a squeeze with PyBullet: move the arm down, close the jaws on the part, open them, and move up."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .panda_arm import (
    ARM_JOINTS,
    FINGER_JOINTS,
    FINGER_OPEN,
    FINGERTIPS_BELOW_HAND,
    HOME,
    NEAR_TARGET,
    ArmSimulation,
    Configuration,
    Joints,
    Phase,
    Pose,
    Watch,
)
from .squeeze_scene import (
    JAW_BEFORE_PAD,
    JAW_BELOW_FINGER,
    PART,
    SLOT_HEIGHT,
    SLOT_PLACE,
    WORK_PLACE,
    SqueezeScene,
    add_part,
    add_slot,
    load_robot,
)

SOLVER_ITERATIONS = 50
TABLE_FRICTION = 0.3  # between table and part
GEAR_FORCE = 100.0  # N, force of the gear that couples the fingers
JAW_ABOVE_TABLE = 0.002  # m, height of the jaws during the squeeze
HOVER = 0.045  # m, lift above the pose of the squeeze, so that the jaws are above the part
ABOVE_SLOT = 0.002  # m, gap between the part on the slot and the jaws before the insertion
PRESS_FORCE = 20.0  # N: the insertion ends at this force, because more would turn a misaligned part until it fits
INSERTED = 0.003  # m: an inserted part is below this height
SLOWEST = 0.02  # rad/s, lowest speed of a joint

APPROACH = Phase(80, 1.0, 0.2)
CLOSE = Phase(240, 1.0, 0.1)
OPEN = Phase(80, 1.0, 0.2)
LIFT = Phase(80, 1.0, 0.2)
INSERT = Phase(240, 0.05, 0.2)


class Squeezed(NamedTuple):
    """The pose of a part after a squeeze."""

    yaw: float  # rad; half a turn does not change the part
    offset: tuple[float, float]  # m, from the middle of the hand to the middle of the part, in the table's axes
    tilt: float  # rad, between the part's vertical axis and the vertical


class SqueezeSimulation(ArmSimulation):
    """
    Simulate squeezes with robot, table, part and slot in a separate Bullet world. The robot has no visual shapes.

    Every squeeze sets all positions and velocities, so that its outcome depends only on its arguments.
    """

    _still = 0.001

    def __init__(self, scene: SqueezeScene) -> None:
        super().__init__(SOLVER_ITERATIONS)
        self.scene, client = scene, self.client
        self._robot = load_robot(client, flags=self._unseen)
        self._slot = add_slot(client, scene)
        self._body = add_part(client)
        # Bullet multiplies the friction coefficients of two bodies that touch, so the part's coefficient is 1.
        client.changeDynamics(self._body, -1, lateralFriction=1.0, spinningFriction=0.0, rollingFriction=0.0)
        client.changeDynamics(self._table, -1, lateralFriction=TABLE_FRICTION)
        client.changeDynamics(self._slot, -1, lateralFriction=scene.friction)
        for finger in FINGER_JOINTS:
            client.changeDynamics(self._robot, finger, lateralFriction=scene.friction, spinningFriction=0.0)
        # The two fingers of a Panda move together, but PyBullet ignores the `mimic` entry in the robot's file.
        gear = client.createConstraint(
            self._robot, FINGER_JOINTS[0], self._robot, FINGER_JOINTS[1],
            client.JOINT_GEAR, (1, 0, 0), (0, 0, 0), (0, 0, 0),
        )  # fmt: skip
        client.changeConstraint(gear, gearRatio=-1, erp=0.2, maxForce=GEAR_FORCE)
        low = FINGERTIPS_BELOW_HAND + JAW_BELOW_FINGER + JAW_ABOVE_TABLE
        self._low, self._high = self._solve(WORK_PLACE, low, low + HOVER)
        press = FINGERTIPS_BELOW_HAND + JAW_BELOW_FINGER + PART[2]
        self._slot_low, self._slot_high = self._solve(SLOT_PLACE, press, press + SLOT_HEIGHT + ABOVE_SLOT)

    def _solve(self, place: tuple[float, float], *heights: float) -> list[Joints]:
        """Return the joint angles of the arm for each height of the hand, with the jaws along x."""
        # Two yaws of the hand put the jaws along x; this one is in the middle of the wrist's range.
        down = self.client.getQuaternionFromEuler((math.pi, 0.0, 0.0))
        joints = HOME
        solutions = []
        for height in heights:
            for _ in range(5):
                self._put_arm(joints)
                joints = self._joints_for((*place, height), down, 1e-8)
            solutions.append(joints)
        return solutions

    def _turned(self, yaw: float) -> tuple[Joints, Joints]:
        """
        Return the joint angles for a yaw of the jaws: for the pose of the squeeze, and for the pose above it.

        The hand's axis is vertical, so that only the last joint turns the hand. Half a turn does not change the jaws.
        """
        wanted = self._low[6] - yaw
        turn = (wanted + math.pi / 2) % math.pi - math.pi / 2 - self._low[6]
        return (*self._low[:6], self._low[6] + turn), (*self._high[:6], self._high[6] + turn)

    def squeeze(self, yaw: float, jaws: float, offset: tuple[float, float], watch: Watch | None = None) -> Squeezed:
        """
        Squeeze a part once.

        :param yaw: Yaw of the part, in rad.
        :param jaws: Yaw of the jaws, in rad.
        :param offset: Vector from the middle of the hand to the part, in m, in the table's axes.
        :param watch: Function that is called 30 times per simulated second; it does not change the outcome.
        """
        self._watch = watch
        x, y = WORK_PLACE
        self._put_part((x + offset[0], y + offset[1], PART[2] / 2), yaw)
        low, high = self._turned(jaws)
        self._put_arm(high)
        self._run(APPROACH, low, FINGER_OPEN, lambda: self._is_at(low))
        self._run(CLOSE, low, 0.0, self._fingers_stand_still)
        self._run(OPEN, low, FINGER_OPEN, self._fingers_are_open)
        self._run(LIFT, high, FINGER_OPEN, lambda: self._is_at(high))
        position, orientation = self._pose()
        axes = self._axes(orientation)
        away = (position[0] - x, position[1] - y)
        return Squeezed(math.atan2(axes[1, 0], axes[0, 0]), away, math.acos(min(1.0, float(axes[2, 2]))))

    def insert(self, yaw: float, watch: Watch | None = None) -> float:
        """
        Press a part from the mouth of the slot into the slot, with closed jaws.

        :param yaw: Angle between part and slot, in rad.
        :param watch: As in :meth:`squeeze`.
        :return: Height of the middle of the part's lower side above the table, in m; an inserted part is below
            :data:`INSERTED`.
        """
        self._watch = watch
        self._put_part((*SLOT_PLACE, SLOT_HEIGHT + PART[2] / 2), yaw)
        self._put_arm(self._slot_high, fingers=JAW_BEFORE_PAD)
        self._run(INSERT, self._slot_low, JAW_BEFORE_PAD, lambda: self._height() < INSERTED or self._presses_hard())
        return self._height()

    def squeezes(
        self, yaws: np.ndarray, jaws: np.ndarray, offsets: np.ndarray, watch: Watch | None = None
    ) -> list[Squeezed]:
        """Squeeze N parts; the arrays are ``(N,)``, ``(N,)`` and ``(N, 2)``. See :meth:`squeeze`."""
        given = zip(yaws.tolist(), jaws.tolist(), offsets.tolist(), strict=True)
        return [self.squeeze(yaw, jaw, (x, y), watch) for yaw, jaw, (x, y) in given]

    def inserts(self, yaws: np.ndarray, watch: Watch | None = None) -> list[float]:
        """Press N parts with the given yaws, ``(N,)``, into the slot. See :meth:`insert`."""
        return [self.insert(yaw, watch) for yaw in yaws.tolist()]

    def at_rest(self, yaw: float) -> Configuration:
        """Return the configuration before the first squeeze, given the yaw of the part in rad."""
        upright = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        return Configuration((*self._high, FINGER_OPEN, FINGER_OPEN), (*WORK_PLACE, PART[2] / 2), upright)

    def _speeds(self, phase: Phase, joints: Joints) -> Sequence[float]:
        # All joints arrive at the same time. Otherwise the hand would leave the vertical by some millimetres.
        ways = [abs(state[0] - goal) for state, goal in zip(self._states(ARM_JOINTS), joints, strict=True)]
        longest = max(*ways, NEAR_TARGET)
        return [max(phase.arm_speed * way / longest, SLOWEST) for way in ways]

    def _put_part(self, position: tuple[float, ...], yaw: float) -> None:
        """Put the part at a position. After this call, the caller must put the arm at a position."""
        self._clear_contacts()
        self._put_body(position, yaw)

    def _fingers_are_open(self) -> bool:
        return all(state[0] > FINGER_OPEN - 0.001 for state in self._states(FINGER_JOINTS))

    def _height(self) -> float:
        return self._pose()[0][2] - PART[2] / 2

    def _presses_hard(self) -> bool:
        """Return whether the hand presses on the part with more than ``PRESS_FORCE``."""
        return sum(point[9] for point in self.client.getContactPoints(self._robot, self._body)) > PRESS_FORCE

    def _pose(self) -> Pose:
        return self.client.getBasePositionAndOrientation(self._body)

    def _axes(self, orientation: tuple[float, ...]) -> np.ndarray:
        return np.array(self.client.getMatrixFromQuaternion(orientation)).reshape(3, 3)
