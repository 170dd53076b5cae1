"""Squeeze a part with the Panda's hand in PyBullet: SqueezeInsert-v0 with contact and friction from an engine."""

import math
import os
import tempfile
from functools import cached_property
from typing import NamedTuple

import numpy as np

from . import checks
from .bullet import UNTURNED, BulletClient, BulletWorld
from .panda_bullet import ARM_FORCE, ARM_JOINTS, FAR_AWAY, FINGER_FORCE, FINGER_OPEN, HAND, HOME, TIME_STEP
from .panda_scene import ROBOT_FILE, TABLE_FILE, TABLE_POSITION
from .squeeze_insert import SqueezeInsertEnv, wrap

PART = (0.08, 0.026, 0.03)  # m: length, width, height
PART_MASS = 0.1  # kg
PART_POSITION = (0.5, 0.0, PART[2] / 2)  # m
JAW = (0.09, 0.008, 0.03)  # m: length, thickness, height
JAW_ABOVE_TABLE = 0.004  # m
JAW_OFFSET = 0.01  # m, outwards of the inner face of the finger: the jaws open 10 cm and close to 2 cm
FINGER_LENGTH = 0.0539  # m, from the frame of a finger to its tip, where the jaw begins
HAND_HEIGHT = JAW_ABOVE_TABLE + JAW[2] + FINGER_LENGTH + 0.0584  # m, above the table, of the frame of the hand
FINGERS = ("panda_finger_joint1", "panda_finger_joint2")
TABLE_FRICTION = 0.4  # of the part on the table
CLOSING_SPEED, OPENING_SPEED = 0.1, 0.2  # m/s, of each finger
MAX_CLOSING_STEPS, OPENING_STEPS = 240, 24
LOOK_EVERY = 8  # steps
STANDS_STILL = 1e-3  # m/s, of each finger
SOLVER_ITERATIONS = 100
HEIGHT, WIDTH = 240, 320  # pixels of a picture
MIDDLE = (0.5, 0.0, 0.06)  # m, its target
DISTANCE, YAW, PITCH, FOV = 0.42, 60.0, -28.0, 45.0  # m and degrees
LIGHT = (1.0, 1.2, 2.5)  # direction
RAISED = 0.08  # m, of the hand in a picture before the first squeeze
PART_COLOR, JAW_COLOR = (0.92, 0.51, 0.12, 1.0), "0.35 0.4 0.5 1"


def robot_with_jaws() -> str:
    """Return the URDF of the Panda with a flat jaw fixed to each finger."""
    with open(ROBOT_FILE, encoding="utf-8") as file:
        text = file.read().replace("package://", os.path.dirname(ROBOT_FILE) + "/")
    length, thickness, height = JAW
    shape = f'<geometry><box size="{length} {thickness} {height}"/></geometry>'
    jaws = ""
    for name, side in (("left", 1), ("right", -1)):
        place = f"0 {side * (JAW_OFFSET + thickness / 2)} {FINGER_LENGTH + height / 2}"
        jaws += f"""
          <link name="{name}_jaw">
            <inertial><mass value="0.05"/><inertia ixx="4e-5" ixy="0" ixz="0" iyy="4e-5" iyz="0" izz="4e-5"/></inertial>
            <visual>{shape}<material name="jaw"><color rgba="{JAW_COLOR}"/></material></visual>
            <collision>{shape}</collision>
          </link>
          <joint name="{name}_jaw_joint" type="fixed">
            <parent link="panda_{name}finger"/><child link="{name}_jaw"/><origin xyz="{place}"/>
          </joint>"""
    return text.replace("</robot>", jaws + "</robot>")


def load_robot(client: BulletClient, *, flags: int = 0) -> int:
    """Load the Panda with its jaws; return its body's id."""
    with tempfile.TemporaryDirectory(prefix="sb3_tdpg_") as folder:
        path = os.path.join(folder, "panda_with_jaws.urdf")
        with open(path, "w", encoding="utf-8") as file:
            file.write(robot_with_jaws())
        return int(client.loadURDF(path, useFixedBase=True, flags=flags))


def joints_of(client: BulletClient, robot: int) -> dict[str, int]:
    """Return the index of each joint, and of the link behind it, by the joint's name."""
    return {client.getJointInfo(robot, i)[1].decode(): i for i in range(client.getNumJoints(robot))}


class Squeezed(NamedTuple):
    """Positions of everything that moves, at one instant."""

    joints: tuple[float, ...]  # seven of the arm, two of the fingers
    part_position: tuple[float, ...]
    part_orientation: tuple[float, ...]  # quaternion (x, y, z, w)

    @property
    def jaw_gap(self) -> float:
        """Distance between the jaws in m."""
        return sum(self.joints[7:]) + 2 * JAW_OFFSET


class SqueezeSimulation(BulletWorld):
    """
    Robot, table and part in a Bullet world of their own, without visual shapes.

    Every squeeze starts from the same state of the world, so that its outcome is a function of the two yaws alone.

    :param friction: Coefficient of friction between part and jaws.
    """

    def __init__(self, friction: float) -> None:
        super().__init__()
        client = self.client
        client.setGravity(0.0, 0.0, -9.81)
        client.setPhysicsEngineParameter(
            fixedTimeStep=TIME_STEP, numSolverIterations=SOLVER_ITERATIONS, deterministicOverlappingPairs=1
        )
        unseen = client.URDF_IGNORE_VISUAL_SHAPES
        table = client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True, flags=unseen)
        client.changeDynamics(table, -1, lateralFriction=TABLE_FRICTION)
        self._robot = load_robot(client, flags=unseen)
        joints = joints_of(client, self._robot)
        self._fingers = [joints[name] for name in FINGERS]
        for name in ("left_jaw_joint", "right_jaw_joint"):
            client.changeDynamics(self._robot, joints[name], lateralFriction=friction)
        body = client.createCollisionShape(client.GEOM_BOX, halfExtents=[side / 2 for side in PART])
        self._part = client.createMultiBody(PART_MASS, body)
        client.changeDynamics(self._part, -1, lateralFriction=1.0)  # Bullet multiplies those of two bodies
        # Only the last joint turns the hand about the vertical: inverse kinematics is solved once for each height.
        self._put_arm((*HOME[:6], math.pi / 4))
        self._raised = self._arm_for(HAND_HEIGHT + RAISED)
        self._arm = self._arm_for(HAND_HEIGHT)
        self._start = client.saveState()

    def squeeze(self, part: float, hand: float) -> tuple[float, Squeezed]:
        """
        Squeeze a part of some yaw with jaws of another, in rad.

        The hand descends with its jaws 10 cm apart and touches nothing on its way, so that the simulation begins below.

        :return: The yaw of the part after the jaws have opened, and the moment before they do.
        """
        client = self.client
        client.resetBasePositionAndOrientation(self._part, FAR_AWAY, UNTURNED)
        client.stepSimulation()  # removes the contacts of the last squeeze, which restoreState keeps
        client.restoreState(self._start)
        arm = (*self._arm[:6], self._arm[6] - float(wrap(np.array(hand))))
        self._put_arm(arm)
        client.resetBasePositionAndOrientation(
            self._part, PART_POSITION, client.getQuaternionFromEuler((0.0, 0.0, part))
        )
        client.resetBaseVelocity(self._part, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        for joint, angle in zip(ARM_JOINTS, arm, strict=True):
            client.setJointMotorControl2(self._robot, joint, client.POSITION_CONTROL, angle, force=ARM_FORCE)
        self._move_fingers(0.0, CLOSING_SPEED)
        for i in range(1, MAX_CLOSING_STEPS + 1):
            client.stepSimulation()
            if i % LOOK_EVERY == 0 and self._fingers_stand_still():
                break
        squeezed = self._configuration()
        self._move_fingers(FINGER_OPEN, OPENING_SPEED)
        for _ in range(OPENING_STEPS):
            client.stepSimulation()
        turned = client.getMatrixFromQuaternion(client.getBasePositionAndOrientation(self._part)[1])
        return math.atan2(turned[3], turned[0]), squeezed

    def before(self, part: float) -> Squeezed:
        """Return the hand above a part of some yaw, for a picture."""
        upright = (0.0, 0.0, math.sin(part / 2), math.cos(part / 2))
        return Squeezed((*self._raised, FINGER_OPEN, FINGER_OPEN), PART_POSITION, upright)

    def _arm_for(self, height: float) -> tuple[float, ...]:
        """Solve for the arm's joints with the hand above the part, and put the arm there."""
        arm, client = (), self.client
        for _ in range(3):  # each time from a nearer start
            arm = client.calculateInverseKinematics(
                self._robot, HAND, (*PART_POSITION[:2], height), client.getQuaternionFromEuler((math.pi, 0.0, 0.0)),
                jointDamping=[1e-5] * 9, maxNumIterations=200, residualThreshold=1e-8,
            )[:7]  # fmt: skip
            self._put_arm(arm)
        return arm

    def _put_arm(self, arm: tuple[float, ...]) -> None:
        """Set the joints of the arm, and open the jaws."""
        for joint, value in zip((*ARM_JOINTS, *self._fingers), (*arm, FINGER_OPEN, FINGER_OPEN), strict=True):
            self.client.resetJointState(self._robot, joint, value, 0.0)

    def _move_fingers(self, goal: float, speed: float) -> None:
        for joint in self._fingers:
            self.client.setJointMotorControl2(
                self._robot, joint, self.client.POSITION_CONTROL, goal, force=FINGER_FORCE, maxVelocity=speed
            )

    def _fingers_stand_still(self) -> bool:
        return all(abs(state[1]) < STANDS_STILL for state in self.client.getJointStates(self._robot, self._fingers))

    def _configuration(self) -> Squeezed:
        states = self.client.getJointStates(self._robot, (*ARM_JOINTS, *self._fingers))
        return Squeezed(tuple(state[0] for state in states), *self.client.getBasePositionAndOrientation(self._part))


class SqueezeView(BulletWorld):
    """Robot, table and part in a Bullet world of their own, without physics, seen obliquely from the front."""

    def __init__(self) -> None:
        super().__init__()
        client = self.client
        client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True)
        self._robot = load_robot(client)
        joints = joints_of(client, self._robot)
        self._joints = (*ARM_JOINTS, *(joints[name] for name in FINGERS))
        box = client.createVisualShape(
            client.GEOM_BOX, halfExtents=[side / 2 for side in PART], rgbaColor=PART_COLOR, specularColor=[0.2] * 3
        )
        self._part = client.createMultiBody(baseVisualShapeIndex=box)

    def picture(self, squeezed: Squeezed) -> np.ndarray:
        """Draw a configuration: ``(240, 320, 3)`` uint8."""
        client = self.client
        for joint, value in zip(self._joints, squeezed.joints, strict=True):
            client.resetJointState(self._robot, joint, value)
        client.resetBasePositionAndOrientation(self._part, squeezed.part_position, squeezed.part_orientation)
        view = client.computeViewMatrixFromYawPitchRoll(MIDDLE, DISTANCE, YAW, PITCH, 0.0, 2)
        projection = client.computeProjectionMatrixFOV(FOV, WIDTH / HEIGHT, 0.05, 5.0)
        return client.picture(HEIGHT, WIDTH, view, projection, LIGHT, shadow=1)


class PandaSqueezeEnv(SqueezeInsertEnv):
    r"""
    Turn a rectangular part between two flat jaws of the Panda's hand, in PyBullet, then push it into a slot.

    State, observation, action and cost are those of :class:`~sb3_tdpg.envs.squeeze_insert.SqueezeInsertEnv` without a
    cue, so that a policy trained there acts here unchanged. Only the dynamics differ: the contacts and the friction of
    the engine decide how a squeeze turns the part. A part of 8 by 2.6 by 3 cm and 0.1 kg lies between jaws that are
    10 cm apart; they close with 20 N until they stand still, and open again. The next yaw is a function of yaw and
    action alone.

    Without friction the part would turn towards the jaws if it is within :math:`\arctan(8 / 2.6) = 72^\circ` of them,
    and across them otherwise. With friction, a part within :math:`\arctan(\text{friction})` of 72° jams and stays.

    Each squeeze begins with the part in the middle between the jaws: the state has no position.

    After the step, ``info`` has ``success`` (``is_success`` for SB3: the error is at most ``tolerance``), ``yaw_error``
    (in rad) and ``jaw_gap`` (in m, between the closed jaws). They are those of the step; the last step's count.

    :param friction: Coefficient of friction between part and jaws; that of part and table is 0.4.
    :param tolerance: Angle in rad that the slot forgives.
    :param sensor_noise_std: Standard deviation of the noise of both components of the yaw.
    :param horizon: Number of squeezes T.
    :param render_mode: ``None`` or ``"rgb_array"``.
    :raises ValueError: for a keyword out of its range.
    """

    def __init__(
        self,
        *,
        friction: float = 0.1,
        tolerance: float = 0.05,
        sensor_noise_std: float = 0.01,
        horizon: int = 4,
        render_mode: str | None = None,
    ) -> None:
        super().__init__(
            tolerance=tolerance, sensor_noise_std=sensor_noise_std, horizon=horizon, render_mode=render_mode
        )
        del self.turn, self.basin  # the engine decides
        self.friction = checks.not_negative("friction", friction)
        self._squeezed: Squeezed | None = None  # the last squeeze, for render()
        self._is_closed = False

    # The Bullet worlds are made at their first use, and so in the process that uses them.

    @cached_property
    def _simulation(self) -> SqueezeSimulation:
        self._check_open()
        return SqueezeSimulation(self.friction)

    @cached_property
    def _view(self) -> SqueezeView:
        self._check_open()
        return SqueezeView()

    def _check_open(self) -> None:
        if self._is_closed:  # perhaps before there was a BulletClient, which says the same
            raise RuntimeError("this environment has been closed: make a new one")

    def initial_state(self, n: int) -> np.ndarray:
        self._squeezed = None
        return super().initial_state(n)

    def dynamics(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        pairs = zip(self.yaw(state).tolist(), action[:, 0].tolist(), strict=True)
        outcomes = [self._simulation.squeeze(part, hand) for part, hand in pairs]
        self._squeezed = outcomes[0][1]
        next_state = self._with_yaw(np.array([yaw for yaw, _ in outcomes]), state[:, 2:])
        errors = self.error(next_state).tolist()
        fits = [error <= self.tolerance for error in errors]
        self._details = [
            dict(success=fit, is_success=fit, yaw_error=error, jaw_gap=squeezed.jaw_gap)
            for fit, error, (_, squeezed) in zip(fits, errors, outcomes, strict=True)
        ]
        return next_state

    def render(self) -> np.ndarray | None:
        """Draw hand and part, ``(240, 320, 3)`` uint8: before the first squeeze the hand is raised, later closed."""
        if self.render_mode is None:
            return None
        state = self._current_state()
        squeezed = self._squeezed or self._simulation.before(float(self.yaw(state)[0]))
        return self._view.picture(squeezed)

    def close(self) -> None:
        """Close the Bullet worlds; closing twice is fine."""
        self._is_closed = True
        for name in {"_simulation", "_view"} & set(self.__dict__):
            getattr(self, name).close()
