"""
Define the grasping scene as data, for the simulation and all pictures.

Coordinates: the robot is at the origin and looks along +x. The y axis points to the robot's left, z upward. The table's
top is at z = 0. Lengths are in metres, angles in radians.
"""

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import pybullet_data

from .bullet import BulletClient

ASSETS = pybullet_data.getDataPath()
ROBOT_FILE = os.path.join(ASSETS, "franka_panda", "panda.urdf")
TABLE_FILE = os.path.join(ASSETS, "table", "table.urdf")
MUG_FILE = os.path.join(ASSETS, "objects", "mug.obj")

TABLE_POSITION = (0.4, 0.0, -0.625)  # puts the table's top at z = 0
MUG_COLOR = (0.9, 0.22, 0.18, 1.0)

# PyBullet's mug, scaled to the size of the paper's mug: 93 mm across and 81 mm high. It is wider than the open gripper,
# so that it can be grasped only by its rim, with one finger inside.
MESH_SCALE = np.array([1.134, 1.134, 0.81])
MESH_RADIUS, MESH_HEIGHT = 0.041, 0.1  # of the cup in the file
N_STAVES = 12  # with base and handle the mug has 16 shapes; PyBullet silently drops further shapes
WALL_THICKNESS = 0.0075
BASE_HEIGHT = 0.006
# The ends (y, z) of the handle's three bars in the file, and the half width and the thickness of a bar.
HANDLE_BARS = (
    ((0.0768, 0.0225), (0.0768, 0.0775)),
    ((0.039, 0.0775), (0.0768, 0.0775)),
    ((0.039, 0.0225), (0.0768, 0.0225)),
)
BAR_HALF_WIDTH, BAR_THICKNESS = 0.0055, 0.0085
MASS = 0.1  # kg
INERTIA = 2e-4  # kg m^2, about each axis
CENTRE_OF_MASS = np.array([0.0, 0.004, 0.03645])  # in the cup's frame; it is slightly towards the handle


@dataclass(frozen=True)
class PandaScene:
    """
    The size, the frame and the friction of the mug.

    In the cup's frame, the z axis is the cup's axis, and the handle points along +y. The state of the environment is
    the pose of another frame, the mug's frame, whose origin is beside the cup's axis.

    The parameters are those of :class:`~sb3_tdpg.envs.panda_grasp.PandaGraspEnv`.
    """

    mug_scale: float
    frame_offset: float
    friction: float

    @property
    def mesh_scale(self) -> np.ndarray:
        """Scale factors of the mesh file, ``(3,)``."""
        return self.mug_scale * MESH_SCALE

    @property
    def mug_radius(self) -> float:
        """Outer radius of the cup."""
        return float(self.mesh_scale[0] * MESH_RADIUS)

    @property
    def mug_height(self) -> float:
        """Height of the rim above the table."""
        return float(self.mesh_scale[2] * MESH_HEIGHT)

    @property
    def cup_origin(self) -> np.ndarray:
        """Origin of the cup's frame in the mug's frame, ``(3,)``."""
        return np.array([0.0, -self.frame_offset, 0.0])

    @property
    def centre_of_mass(self) -> np.ndarray:
        """Centre of mass in the mug's frame, ``(3,)``, which Bullet uses as base position."""
        return self.cup_origin + self.mug_scale * CENTRE_OF_MASS

    def collision_shapes(self) -> list[dict[str, Any]]:
        """
        Return the mug's shapes in the cup's frame: a disc, twelve staves around it and three bars for the handle.

        Bullet would replace a moving mesh by its convex hull, and the hull of a cup is not hollow.
        """
        radius, height, thickness = self.mug_radius, self.mug_height, self.mug_scale * WALL_THICKNESS
        base = self.mug_scale * BASE_HEIGHT
        # Only the base touches the table: the staves begin at half the height of the base.
        shapes = [dict(radius=0.93 * radius, length=base, position=(0.0, 0.0, base / 2), yaw=0.0)]
        stave = (thickness / 2, radius * np.tan(np.pi / N_STAVES), (height - base / 2) / 2)
        for yaw in 2 * np.pi * np.arange(N_STAVES) / N_STAVES:
            across = radius - thickness / 2
            position = (across * np.cos(yaw), across * np.sin(yaw), base / 2 + stave[2])
            shapes.append(dict(half_extents=stave, position=position, yaw=yaw))
        scale_x, scale_y, scale_z = self.mesh_scale
        half_width, half_thickness = BAR_HALF_WIDTH * scale_x, BAR_THICKNESS * min(scale_x, scale_z) / 2
        for (y_0, z_0), (y_1, z_1) in np.array(HANDLE_BARS) * (scale_y, scale_z):
            bar = (half_width, (y_1 - y_0) / 2 + half_thickness, (z_1 - z_0) / 2 + half_thickness)
            shapes.append(dict(half_extents=bar, position=(0.0, (y_0 + y_1) / 2, (z_0 + z_1) / 2), yaw=0.0))
        return shapes


def add_mug_picture(client: BulletClient, scene: PandaScene) -> int:
    """Add the mug's visual mesh; return the id of a body whose base position is the origin of the mug's frame."""
    shape = client.createVisualShape(
        client.GEOM_MESH,
        fileName=MUG_FILE,
        meshScale=scene.mesh_scale.tolist(),
        visualFramePosition=scene.cup_origin.tolist(),
        rgbaColor=MUG_COLOR,
        specularColor=(0.3, 0.3, 0.3),
    )
    return int(client.createMultiBody(baseVisualShapeIndex=shape))


def add_mug_body(client: BulletClient, scene: PandaScene) -> int:
    """Add the mug's collision shapes; return the id of a body whose base position is the mug's centre of mass."""
    shapes = scene.collision_shapes()
    body = client.createCollisionShapeArray(
        [client.GEOM_BOX if "half_extents" in shape else client.GEOM_CYLINDER for shape in shapes],
        halfExtents=[shape.get("half_extents", (0.0, 0.0, 0.0)) for shape in shapes],
        radii=[shape.get("radius", 0.0) for shape in shapes],
        lengths=[shape.get("length", 0.0) for shape in shapes],
        collisionFramePositions=[(scene.cup_origin + shape["position"]).tolist() for shape in shapes],
        collisionFrameOrientations=[client.getQuaternionFromEuler([0.0, 0.0, shape["yaw"]]) for shape in shapes],
    )
    mug = client.createMultiBody(MASS, body, baseInertialFramePosition=scene.centre_of_mass.tolist())
    client.changeDynamics(
        mug, -1, lateralFriction=scene.friction, spinningFriction=0.0, localInertiaDiagonal=[INERTIA] * 3
    )
    return int(mug)
