"""
Define the squeezing scene as data, for the simulation and the pictures: a part, two jaws and a slot.

Coordinates are as in :mod:`.panda_scene`: the robot is at the origin and looks along +x. The table's top is at z = 0.
Lengths are in metres, angles in radians.
"""

import math
import os
import tempfile
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np

from .bullet import BulletClient
from .panda_scene import ROBOT_FILE

# Without friction a part turns towards the jaws from angles of up to atan(length / width), here 65 degrees (Goldberg,
# "Orienting polygonal parts without sensors", 1993). The part's diagonal (66 mm) is shorter than the opening of the
# jaws (77 mm).
PART = (0.060, 0.028, 0.030)  # length, width, height
PART_MASS = 0.1  # kg
PART_COLOR = (0.92, 0.51, 0.12, 1.0)

# Each finger carries a jaw, a plate that is longer than the part. The jaw's face is in front of the finger's pad, which
# is curved by a millimetre.
JAW = (0.090, 0.008, 0.030)  # along the face, thickness, height
JAW_BEFORE_PAD = 0.0015
JAW_BELOW_FINGER = 0.004  # the jaw ends below the fingertip
JAW_COLOR = (0.25, 0.45, 0.75, 1.0)
FINGERTIP_IN_FINGER = 0.0539  # from the origin of the finger's link

WORK_PLACE = (0.5, 0.0)  # where the parts are squeezed
SLOT_PLACE = (0.5, 0.18)
SLOT_CLEARANCE = 0.0003  # gap between part and slot on each side
SLOT_HEIGHT = 0.020
SLOT_RIM = 0.012  # width of the walls around the mouth
SLOT_COLOR = (0.42, 0.44, 0.48, 1.0)


@dataclass(frozen=True)
class SqueezeScene:
    """
    The part, the jaws and the slot. The slot lies along x.

    The parameters are those of :class:`~sb3_tdpg.envs.panda_squeeze.PandaSqueezeEnv`.
    """

    friction: float
    tolerance: float

    @property
    def chamfer(self) -> float:
        """
        Width of the chamfer on each side of the slot.

        With this width, the corners of a part that is turned by the tolerance are just above the edge of the mouth.
        """
        length, width, _ = PART
        reach = (length * math.sin(self.tolerance) + width * math.cos(self.tolerance)) / 2
        return max(reach - width / 2 - SLOT_CLEARANCE, 0.0)

    def slot_boxes(self) -> list[dict[str, Any]]:
        """Return the boxes of wall, rim and chamfer on each side of the slot, in a frame with x along the slot."""
        boxes: list[dict[str, Any]] = []
        half = np.array(PART[:2]) / 2 + SLOT_CLEARANCE
        chamfer, height = self.chamfer, SLOT_HEIGHT
        outer = half + chamfer + SLOT_RIM
        for axis in (0, 1):
            for side in (-1.0, 1.0):
                # The distance from the middle at which a box begins, and the height of its top.
                for begin, top in ((half[axis], height - chamfer), (half[axis] + chamfer, height)):
                    boxes.append(_wall(axis, side, begin, outer[axis], outer[1 - axis], top))
                if chamfer > 0:
                    boxes.append(_chamfer(axis, side, half[axis], outer[1 - axis], chamfer, height))
        return boxes


def _wall(axis: int, side: float, begin: float, end: float, reach: float, top: float) -> dict[str, Any]:
    position, extents = np.zeros(3), np.zeros(3)
    position[axis], position[2] = side * (begin + end) / 2, top / 2
    extents[axis], extents[1 - axis], extents[2] = (end - begin) / 2, reach, top / 2
    return dict(half_extents=extents.tolist(), position=position.tolist(), euler=(0.0, 0.0, 0.0))


def _chamfer(axis: int, side: float, begin: float, reach: float, chamfer: float, height: float) -> dict[str, Any]:
    """Return a box whose upper face is the chamfer, a slope of 45 degrees that rises outwards to the wall's top."""
    half_thickness = chamfer / 2
    outward = begin + chamfer / 2 + half_thickness * math.sqrt(0.5)
    position, extents = np.zeros(3), np.full(3, half_thickness)
    position[axis], position[2] = side * outward, height - chamfer / 2 - half_thickness * math.sqrt(0.5)
    extents[axis], extents[1 - axis] = chamfer * math.sqrt(0.5), reach
    tilt = side * math.pi / 4
    euler = (0.0, -tilt, 0.0) if axis == 0 else (tilt, 0.0, 0.0)
    return dict(half_extents=extents.tolist(), position=position.tolist(), euler=euler)


def load_robot(client: BulletClient, *, flags: int = 0) -> int:
    """Load PyBullet's Panda with a jaw on each finger; return its body's id."""
    tree = ElementTree.parse(ROBOT_FILE)
    for mesh in tree.iter("mesh"):
        folder = os.path.dirname(ROBOT_FILE)
        mesh.set("filename", mesh.get("filename", "").replace("package://", f"{folder}/"))
    for name, side in (("panda_leftfinger", 1.0), ("panda_rightfinger", -1.0)):
        link = next(link for link in tree.iter("link") if link.get("name") == name)
        for kind in ("visual", "collision"):
            element = ElementTree.SubElement(link, kind)
            outward = side * (JAW[1] / 2 - JAW_BEFORE_PAD)
            below = FINGERTIP_IN_FINGER + JAW_BELOW_FINGER - JAW[2] / 2
            ElementTree.SubElement(element, "origin", rpy="0 0 0", xyz=f"0 {outward} {below}")
            ElementTree.SubElement(ElementTree.SubElement(element, "geometry"), "box", size=" ".join(map(str, JAW)))
            if kind == "visual":
                material = ElementTree.SubElement(element, "material", name="jaw")
                ElementTree.SubElement(material, "color", rgba=" ".join(map(str, JAW_COLOR)))
    with tempfile.TemporaryDirectory(prefix="sb3_tdpg_") as folder:
        path = os.path.join(folder, "panda.urdf")
        tree.write(path)
        return int(client.loadURDF(path, useFixedBase=True, flags=flags))


def add_part(client: BulletClient) -> int:
    """Add the part, with a visual shape; return the id of a body whose base position is the part's middle."""
    half = [size / 2 for size in PART]
    body = client.createCollisionShape(client.GEOM_BOX, halfExtents=half)
    picture = client.createVisualShape(client.GEOM_BOX, halfExtents=half, rgbaColor=PART_COLOR)
    return int(client.createMultiBody(PART_MASS, body, picture))


def add_slot(client: BulletClient, scene: SqueezeScene) -> int:
    """Add the slot, with visual shapes; return its body's id."""
    boxes = scene.slot_boxes()
    extents = [box["half_extents"] for box in boxes]
    positions = [box["position"] for box in boxes]
    turns = [client.getQuaternionFromEuler(box["euler"]) for box in boxes]
    kinds = [client.GEOM_BOX] * len(boxes)
    body = client.createCollisionShapeArray(
        kinds, halfExtents=extents, collisionFramePositions=positions, collisionFrameOrientations=turns
    )
    picture = client.createVisualShapeArray(
        kinds, halfExtents=extents, visualFramePositions=positions, visualFrameOrientations=turns,
        rgbaColors=[SLOT_COLOR] * len(boxes),
    )  # fmt: skip
    return int(client.createMultiBody(0.0, body, picture, basePosition=(*SLOT_PLACE, 0.0)))
