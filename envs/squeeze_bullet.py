"""The simulation of a squeeze: PyBullet moves the arm down, closes the jaws on the part, opens them, and moves up."""

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
GEAR_FORCE = 100.0  # N, of the gear that couples the fingers
JAW_ABOVE_TABLE = 0.002  # m, during the squeeze
HOVER = 0.045  # m, above the pose of the squeeze: the jaws are above the part
ABOVE_SLOT = 0.002  # m, between the part on the slot and the jaws before the insertion
PRESS_FORCE = 20.0  # N, at which the insertion ends; harder, a part that does not fit is turned until it does
INSERTED = 0.003  # m, above the table: an inserted part is lower
SLOWEST = 0.02  # rad/s, of a joint that has hardly any way to go

APPROACH = Phase(80, 1.0, 0.2)
CLOSE = Phase(240, 1.0, 0.1)
OPEN = Phase(80, 1.0, 0.2)
LIFT = Phase(80, 1.0, 0.2)
INSERT = Phase(240, 0.05, 0.2)


class Squeezed(NamedTuple):
    """What a squeeze leaves."""

    yaw: float  # of the part, in rad; modulo pi it does not matter
    offset: tuple[float, float]  # m, of the part's middle from the hand's, in the table's axes
    tilt: float  # rad, between the part's vertical axis and the vertical


class Inserted(NamedTuple):
    """What a push into the slot leaves."""

    height: float  # m, of the middle of the part's lower side above the table
    yaw: float  # rad

    @property
    def success(self) -> bool:
        """Whether the part is in the slot."""
        return self.height < INSERTED


class SqueezeSimulation(ArmSimulation):
    """
    Robot, table, part and slot in a Bullet world of their own, without visual shapes of the robot.

    Every squeeze sets all positions and velocities, so that its outcome is a function of its arguments alone.
    """

    _still = 0.001

    def __init__(self, scene: SqueezeScene) -> None:
        super().__init__(SOLVER_ITERATIONS)
        self.scene, client = scene, self.client
        self._robot = load_robot(client, flags=self._unseen)
        self._slot = add_slot(client, scene)
        self._body = add_part(client)
        # Bullet multiplies the coefficients of two bodies that touch; the part's is 1.
        client.changeDynamics(self._body, -1, lateralFriction=1.0, spinningFriction=0.0, rollingFriction=0.0)
        client.changeDynamics(self._table, -1, lateralFriction=TABLE_FRICTION)
        client.changeDynamics(self._slot, -1, lateralFriction=scene.friction)
        for finger in FINGER_JOINTS:
            client.changeDynamics(self._robot, finger, lateralFriction=scene.friction, spinningFriction=0.0)
        # The Panda's fingers move together; PyBullet ignores the `mimic` of its file.
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
        """Return the joints of the arm with the jaws along x for each height of the hand."""
        # Of the two yaws of the hand with the jaws along x, this one is in the middle of the wrist's range.
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
        Return the joints of the squeeze and above it for a yaw of the jaws.

        The hand's axis is vertical, so that the last joint alone turns it; half a turn does not change the jaws.
        """
        wanted = self._low[6] - yaw
        turn = (wanted + math.pi / 2) % math.pi - math.pi / 2 - self._low[6]
        return (*self._low[:6], self._low[6] + turn), (*self._high[:6], self._high[6] + turn)

    def squeeze(self, yaw: float, jaws: float, offset: tuple[float, float], watch: Watch | None = None) -> Squeezed:
        """
        Squeeze a part once.

        :param yaw: Yaw of the part, in rad.
        :param jaws: Their yaw, in rad.
        :param offset: Vector from the middle of the hand to the part, in m, in the table's axes.
        :param watch: Called 30 times a second; it does not change the outcome.
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

    def insert(self, yaw: float, watch: Watch | None = None) -> Inserted:
        """
        Press a part into the slot: it lies on the mouth, and the closed jaws come down on it.

        :param yaw: Between part and slot, in rad.
        :param watch: As in :meth:`squeeze`.
        """
        self._watch = watch
        self._put_part((*SLOT_PLACE, SLOT_HEIGHT + PART[2] / 2), yaw)
        self._put_arm(self._slot_high, fingers=JAW_BEFORE_PAD)
        self._run(INSERT, self._slot_low, JAW_BEFORE_PAD, lambda: self._is_inserted() or self._presses_hard())
        position, orientation = self._pose()
        axes = self._axes(orientation)
        return Inserted(position[2] - PART[2] / 2, math.atan2(axes[1, 0], axes[0, 0]))

    def squeezes(
        self, yaws: np.ndarray, jaws: np.ndarray, offsets: np.ndarray, watch: Watch | None = None
    ) -> list[Squeezed]:
        """Squeeze N parts: arrays ``(N,)``, ``(N,)`` and ``(N, 2)``; see :meth:`squeeze`."""
        given = zip(yaws.tolist(), jaws.tolist(), offsets.tolist(), strict=True)
        return [self.squeeze(yaw, jaw, (x, y), watch) for yaw, jaw, (x, y) in given]

    def inserts(self, yaws: np.ndarray, watch: Watch | None = None) -> list[Inserted]:
        """Press N parts into the slot: ``(N,)``; see :meth:`insert`."""
        return [self.insert(yaw, watch) for yaw in yaws.tolist()]

    def at_rest(self, yaw: float) -> Configuration:
        """Return the scene before the first squeeze."""
        upright = (0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
        return Configuration((*self._high, FINGER_OPEN, FINGER_OPEN), (*WORK_PLACE, PART[2] / 2), upright)

    def _speeds(self, phase: Phase, joints: Joints) -> Sequence[float]:
        # All joints arrive together: otherwise the hand would swerve by some millimetres on its way down.
        ways = [abs(state[0] - goal) for state, goal in zip(self._states(ARM_JOINTS), joints, strict=True)]
        longest = max(*ways, NEAR_TARGET)
        return [max(phase.arm_speed * way / longest, SLOWEST) for way in ways]

    def _put_part(self, position: tuple[float, ...], yaw: float) -> None:
        """Put the part somewhere; the arm must be put somewhere after this."""
        self._clear_contacts()
        self._put_body(position, yaw)

    def _fingers_are_open(self) -> bool:
        return all(state[0] > FINGER_OPEN - 0.001 for state in self._states(FINGER_JOINTS))

    def _is_inserted(self) -> bool:
        return self._pose()[0][2] - PART[2] / 2 < INSERTED

    def _presses_hard(self) -> bool:
        """Return whether the hand presses on the part with the force at which it gives up."""
        return sum(point[9] for point in self.client.getContactPoints(self._robot, self._body)) > PRESS_FORCE

    def _pose(self) -> Pose:
        return self.client.getBasePositionAndOrientation(self._body)

    def _axes(self, orientation: tuple[float, ...]) -> np.ndarray:
        return np.array(self.client.getMatrixFromQuaternion(orientation)).reshape(3, 3)
