"""Simulate the depth camera of the grasping scene: PyBullet draws the mug, and geometry gives the table's depth."""

import numpy as np

from .bullet import BulletWorld
from .panda_scene import add_mug_picture

IMAGE_SIZE = 128  # pixels per side

TARGET, DISTANCE, YAW, PITCH = (0.5, 0.0, 0.02), 0.4, 225.0, -45.0  # m and degrees
NEAR, FAR = 0.01, 1000.0  # m
# Edges of the image at the depth NEAR: left, right, bottom, top.
EDGES = (-0.0035555558, 0.0035555558, -0.0023333333, 0.003)


class DepthCamera(BulletWorld):
    """
    Draw depth images of table and mug in a separate Bullet world.

    PyBullet takes 5 ms for an image of table and mug, but 1.4 ms for the mug alone. So the world contains only the mug,
    and the depth of the table is computed. Each pixel has the smaller of the two depths, which agrees with PyBullet's
    depth to 3e-6 m.
    """

    def __init__(self, cup_origin: np.ndarray) -> None:
        super().__init__()
        client = self.client
        self._mug = add_mug_picture(client, cup_origin)
        view = client.computeViewMatrixFromYawPitchRoll(TARGET, DISTANCE, YAW, PITCH, 0.0, 2)
        projection = client.computeProjectionMatrix(*EDGES, NEAR, FAR)
        self._camera = IMAGE_SIZE, IMAGE_SIZE, view, projection
        # In the single precision of a projection matrix, 1000 m become 998.65 m.
        matrix = np.array(projection, np.float32)
        self._far = float(matrix[14] / (matrix[10] + np.float32(1)))
        turn_and_shift = np.array(view).reshape(4, 4).T
        self.rotation = turn_and_shift[:3, :3]  # from the world's axes to right, up and backward
        self.eye = -self.rotation.T @ turn_and_shift[:3, 3]
        # The ray of each pixel to a depth of 1 m, top row first. TinyRenderer samples a pixel at its lower left corner.
        left, right, bottom, top = EDGES
        corner = np.arange(IMAGE_SIZE) / IMAGE_SIZE
        to_right = (left + (right - left) * corner) / NEAR
        upward = (bottom + (top - bottom) * corner[::-1]) / NEAR
        rays = np.stack(np.broadcast_arrays(to_right[None, :], upward[:, None], -1.0), axis=-1)
        self._rays_z = (rays @ self.rotation)[..., 2]  # (128, 128)

    def table_depth(self, below: float = 0.0) -> np.ndarray:
        """Return the depth along the optical axis of a table that is lowered by ``below`` m: ``(128, 128)`` in m."""
        return (-below - self.eye[2]) / self._rays_z

    def images(self, state: np.ndarray) -> np.ndarray:
        """
        Draw a depth image for each state of the mug: ``(N, 1, 128, 128)`` float32 in m.

        States are ``(N, 4)`` or ``(N, 5)``. The fifth component is the height of the camera above its usual height, in
        m.
        """
        images = np.empty((len(state), 1, IMAGE_SIZE, IMAGE_SIZE), np.float32)
        client = self.client
        for image, (x, y, z, yaw, *raised) in zip(images, state.tolist(), strict=True):
            below = sum(raised)  # raising the camera has the same effect as lowering the scene
            orientation = client.getQuaternionFromEuler((0, 0, yaw))
            client.resetBasePositionAndOrientation(self._mug, (x, y, z - below), orientation)
            buffer = client.getCameraImage(*self._camera, shadow=0, renderer=client.ER_TINY_RENDERER)[3]
            buffer = np.asarray(buffer, np.float64).reshape(IMAGE_SIZE, IMAGE_SIZE)
            mug = self._far * NEAR / (self._far - (self._far - NEAR) * buffer)
            image[0] = np.minimum(mug, self.table_depth(below))
        return images
