"""
Define the grasping scene as data, for the simulation and all pictures.

Coordinates: the robot is at the origin and looks along +x. The y axis points to the robot's left, z upward. The table's
top is at z = 0. Lengths are in metres, angles in radians.

In the cup's frame, the z axis is the cup's axis, and the handle points along +y. The state of the environment is the
pose of another frame, the mug's frame, whose origin is beside the cup's axis. ``cup_origin``, ``(3,)``, is the origin
of the cup's frame in the mug's frame.
"""

import os
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
MUG_RADIUS = float(0.041 * MESH_SCALE[0])  # outer radius of the cup
MUG_HEIGHT = float(0.1 * MESH_SCALE[2])  # of the rim above the table
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
FRICTION = 0.5  # of the mug and of the fingers; Bullet multiplies the coefficients of two bodies that touch
INERTIA = 2e-4  # kg m^2, about each axis
CENTRE_OF_MASS = np.array([0.0, 0.004, 0.03645])  # in the cup's frame; it is slightly towards the handle


def mug_shapes() -> list[dict[str, Any]]:
    """
    Return the mug's shapes in the cup's frame: a disc, twelve staves around it and three bars for the handle.

    Bullet would replace a moving mesh by its convex hull, and the hull of a cup is not hollow.
    """
    # Only the base touches the table: the staves begin at half the height of the base.
    shapes = [dict(radius=0.93 * MUG_RADIUS, length=BASE_HEIGHT, position=(0.0, 0.0, BASE_HEIGHT / 2), yaw=0.0)]
    stave = (WALL_THICKNESS / 2, MUG_RADIUS * np.tan(np.pi / N_STAVES), (MUG_HEIGHT - BASE_HEIGHT / 2) / 2)
    for yaw in 2 * np.pi * np.arange(N_STAVES) / N_STAVES:
        across = MUG_RADIUS - WALL_THICKNESS / 2
        position = (across * np.cos(yaw), across * np.sin(yaw), BASE_HEIGHT / 2 + stave[2])
        shapes.append(dict(half_extents=stave, position=position, yaw=yaw))
    scale_x, scale_y, scale_z = MESH_SCALE
    half_width, half_thickness = BAR_HALF_WIDTH * scale_x, BAR_THICKNESS * min(scale_x, scale_z) / 2
    for (y_0, z_0), (y_1, z_1) in np.array(HANDLE_BARS) * (scale_y, scale_z):
        bar = (half_width, (y_1 - y_0) / 2 + half_thickness, (z_1 - z_0) / 2 + half_thickness)
        shapes.append(dict(half_extents=bar, position=(0.0, (y_0 + y_1) / 2, (z_0 + z_1) / 2), yaw=0.0))
    return shapes


def add_mug_picture(client: BulletClient, cup_origin: np.ndarray) -> int:
    """Add the mug's visual mesh; return the id of a body whose base position is the origin of the mug's frame."""
    shape = client.createVisualShape(
        client.GEOM_MESH,
        fileName=MUG_FILE,
        meshScale=MESH_SCALE.tolist(),
        visualFramePosition=cup_origin.tolist(),
        rgbaColor=MUG_COLOR,
        specularColor=(0.3, 0.3, 0.3),
    )
    return int(client.createMultiBody(baseVisualShapeIndex=shape))


def add_mug_body(client: BulletClient, cup_origin: np.ndarray) -> int:
    """Add the mug's collision shapes; return the id of a body whose base position is the mug's centre of mass."""
    shapes = mug_shapes()
    body = client.createCollisionShapeArray(
        [client.GEOM_BOX if "half_extents" in shape else client.GEOM_CYLINDER for shape in shapes],
        halfExtents=[shape.get("half_extents", (0.0, 0.0, 0.0)) for shape in shapes],
        radii=[shape.get("radius", 0.0) for shape in shapes],
        lengths=[shape.get("length", 0.0) for shape in shapes],
        collisionFramePositions=[(cup_origin + shape["position"]).tolist() for shape in shapes],
        collisionFrameOrientations=[client.getQuaternionFromEuler([0.0, 0.0, shape["yaw"]]) for shape in shapes],
    )
    mug = client.createMultiBody(MASS, body, baseInertialFramePosition=(cup_origin + CENTRE_OF_MASS).tolist())
    client.changeDynamics(mug, -1, lateralFriction=FRICTION, spinningFriction=0.0, localInertiaDiagonal=[INERTIA] * 3)
    return int(mug)
