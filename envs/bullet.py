"""A connection to a Bullet world of one's own, with PyBullet's functions bound to it."""

from __future__ import annotations

import functools
import os
import sys
import tempfile
import weakref
from typing import Any

import numpy as np
import pybullet
from PIL import Image


class BulletClient:
    """
    One Bullet world. ``client.createMultiBody(...)`` is ``pybullet.createMultiBody(..., physicsClientId=...)``.

    Several clients live side by side and do not see each other's bodies. A client is closed once: by :meth:`close`,
    or else when it is garbage-collected, or else when Python exits.

    :param gui: Open PyBullet's window in place of a world without one. A process can have one such window.
    :raises RuntimeError: if there is no display for the window, or no connection is left.
    """

    def __init__(self, *, gui: bool = False) -> None:
        if gui and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
            # PyBullet would end the whole process.
            raise RuntimeError(
                "render_mode='human' opens a window, but the environment variable DISPLAY is not set: run it in a "
                "desktop session, or use render_mode='rgb_array'"
            )
        client_id = pybullet.connect(pybullet.GUI if gui else pybullet.DIRECT)
        if client_id < 0:
            raise RuntimeError(
                "PyBullet gave no connection: too many environments of this process are open (close() those that "
                "are done), or its one window is in use"
            )
        self.client_id = client_id
        self._close = weakref.finalize(self, pybullet.disconnect, client_id)

    @property
    def is_open(self) -> bool:
        """Whether the world still exists."""
        return bool(self._close.alive)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # also keeps copy and pickle from asking for what __init__ has not set yet
            raise AttributeError(name)
        attribute = getattr(pybullet, name)
        if not callable(attribute):
            return attribute  # a constant
        if not self.is_open:
            raise RuntimeError("this environment has been closed: make a new one")
        return functools.partial(attribute, physicsClientId=self.client_id)

    def upload_texture(self, image: np.ndarray) -> int:
        """
        Hand over an image, ``(H, W, 3)`` uint8, and return its texture id.

        PyBullet reads textures from files only. The file is written as RGB, since its renderer takes a grey one for
        something else.
        """
        with tempfile.TemporaryDirectory(prefix="sb3_tdpg_") as folder:
            path = os.path.join(folder, "texture.png")
            Image.fromarray(image).save(path)
            return int(self.loadTexture(path))

    def close(self) -> None:
        """Close the world; later calls do nothing."""
        self._close()
