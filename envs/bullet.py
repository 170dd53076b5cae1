"""Connect to separate Bullet worlds, and draw pictures of them."""

import functools
import os
import tempfile
import weakref
from collections.abc import Sequence
from typing import Any

import numpy as np
import pybullet
from PIL import Image

Matrix = tuple[float, ...]  # 4 x 4

UNTURNED = (0.0, 0.0, 0.0, 1.0)  # quaternion (x, y, z, w)


class BulletClient:
    """
    Connect to a new Bullet world and call PyBullet's functions for this world.

    ``client.createMultiBody(...)`` calls ``pybullet.createMultiBody(..., physicsClientId=...)``. A process can have
    several clients; each world has its own bodies. A client is closed by :meth:`close`, by garbage collection, or when
    Python exits.
    """

    def __init__(self) -> None:
        self.client_id = pybullet.connect(pybullet.DIRECT)
        self._close = weakref.finalize(self, pybullet.disconnect, self.client_id)

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(pybullet, name)
        return functools.partial(attribute, physicsClientId=self.client_id) if callable(attribute) else attribute

    def upload_texture(self, image: np.ndarray) -> int:
        """
        Upload an image, ``(H, W, 3)`` uint8, and return its texture id.

        PyBullet reads textures only from files. It misreads grey images, so the file is written as RGB.
        """
        with tempfile.TemporaryDirectory(prefix="sb3_tdpg_") as folder:
            path = os.path.join(folder, "texture.png")
            Image.fromarray(image).save(path)
            return int(self.loadTexture(path))

    def picture(
        self, height: int, width: int, view: Matrix, projection: Matrix, light: Sequence[float], *, shadow: int = 0
    ) -> np.ndarray:
        """Draw the world with TinyRenderer: ``(height, width, 3)`` uint8."""
        renderer = pybullet.ER_TINY_RENDERER
        rgba = self.getCameraImage(width, height, view, projection, light, shadow=shadow, renderer=renderer)[2]
        return np.asarray(rgba, dtype=np.uint8).reshape(height, width, 4)[..., :3]

    def close(self) -> None:
        """Close the world; a second call does nothing."""
        self._close()
        self.client_id = -1  # the next client may get the old number


class BulletWorld:
    """Base class of objects that have their own Bullet world, :attr:`client`."""

    def __init__(self) -> None:
        self.client = BulletClient()

    def close(self) -> None:
        """Close the Bullet world; a second call does nothing."""
        self.client.close()


def enlarge(image: np.ndarray, factor: int) -> np.ndarray:
    """Enlarge an image ``(H, W, 3)``: repeat each pixel ``factor`` times in both directions."""
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def beside(scene: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Put a picture of the scene and an enlarged observation side by side; images are ``(H, W, 3)`` uint8."""
    gap = np.full((len(scene), 4, 3), 255, np.uint8)
    return np.concatenate([scene, gap, enlarge(seen, len(scene) // len(seen))], axis=1)
