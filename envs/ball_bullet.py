"""Draw the ball-catching scene with PyBullet: the reference images of the camera, and a side view for pictures."""

from typing import Any

import numpy as np

from .ball_scene import FAR, IMAGE_SIZE, LIGHT, NEAR, PLANE_COPIES, PLANE_HALF, WALL_SCALE, WALL_X, WALL_Z, BallScene
from .bullet import UNTURNED, BulletWorld, beside
from .textures import floor_texture

HEIGHT, WIDTH = 256, 512  # pixels of the side view
MIDDLE = (4.0, 0.0, 2.6)  # m, the point at which the side view looks
BESIDE = 9.5  # m, distance between the side view's camera and the line of the robot


class BulletScene(BulletWorld):
    """Put floor, wall and ball into a separate Bullet world."""

    def __init__(self, scene: BallScene) -> None:
        super().__init__()
        self.scene = scene
        self._add_plane(PLANE_HALF, floor_texture())
        self._wall = self._add_plane(WALL_SCALE * PLANE_HALF, scene.texture)
        self._ball = self._add(scene.ball_color, 1.0, shapeType=self.client.GEOM_SPHERE, radius=scene.ball_radius)
        # Turn a level plane upright: its x axis then points up, and its normal points towards the robot.
        self._upright = self.client.getQuaternionFromEuler([0.0, -np.pi / 2, 0.0])

    def _move(self, body: int, position: tuple[float, ...], orientation: tuple[float, ...] = UNTURNED) -> None:
        self.client.resetBasePositionAndOrientation(body, position, orientation)

    def _add(self, color: tuple[float, ...], specular: float, **shape: Any) -> int:
        """Add a body of one colour; return its id."""
        shape_id = self.client.createVisualShape(**shape, rgbaColor=[*color, 1.0], specularColor=[specular] * 3)
        return int(self.client.createMultiBody(baseVisualShapeIndex=shape_id))

    def _add_plane(self, half: float, texture: np.ndarray) -> int:
        """Add a horizontal textured square; return the id of its body."""
        corners = [(half, -half), (half, half), (-half, half), (-half, -half)]
        shape = self.client.createVisualShape(
            self.client.GEOM_MESH,
            vertices=[(x, y, 0.0) for x, y in corners],
            indices=[0, 1, 2, 0, 2, 3],
            uvs=[(PLANE_COPIES * (x > 0), PLANE_COPIES * (y > 0)) for x, y in corners],
            normals=[(0.0, 0.0, 1.0)] * 4,
        )
        body = self.client.createMultiBody(baseVisualShapeIndex=shape)
        self.client.changeVisualShape(body, -1, textureUniqueId=self.client.upload_texture(texture))
        return int(body)


class BulletRenderer(BulletScene):
    """Render the robot's camera. The camera is fixed; wall and ball move relative to it."""

    def __init__(self, scene: BallScene) -> None:
        super().__init__(scene)
        pitch = np.deg2rad(scene.camera_pitch)
        ahead = (np.cos(pitch), 0.0, scene.camera_height + np.sin(pitch))
        view = self.client.computeViewMatrix((0.0, 0.0, scene.camera_height), ahead, (0.0, 0.0, 1.0))
        self._camera = view, self.client.computeProjectionMatrixFOV(scene.fov, 1.0, NEAR, FAR), LIGHT.tolist()

    def images(self, state: np.ndarray) -> np.ndarray:
        """Return one image for each state: ``(N, 3, 64, 64)`` uint8 from ``(N, 5)``."""
        images = np.empty((len(state), 3, IMAGE_SIZE, IMAGE_SIZE), np.uint8)
        for image, (d, ball_x, ball_y) in zip(images, state[:, :3].tolist(), strict=True):
            self._move(self._wall, (WALL_X - d, 0.0, WALL_Z), self._upright)
            self._move(self._ball, (ball_x - d, 0.0, ball_y))
            image[...] = self.client.picture(IMAGE_SIZE, IMAGE_SIZE, *self._camera).transpose(2, 0, 1)
        return images


class SideView(BulletScene):
    """Draw a side view with the robot, for pictures, not for observations."""

    def __init__(self, scene: BallScene) -> None:
        super().__init__(scene)
        self._move(self._wall, (WALL_X, 0.0, WALL_Z), self._upright)
        self._mast = self._add_box((0.06, 0.06, scene.camera_height / 2), (0.25, 0.25, 0.28))
        self._head = self._add_box((0.22, 0.16, 0.16), (0.15, 0.25, 0.55))
        self._base = self._add_box((0.35, 0.3, 0.12), (0.15, 0.25, 0.55))

    def _add_box(self, half_sizes: tuple[float, float, float], color: tuple[float, float, float]) -> int:
        return self._add(color, 0.0, shapeType=self.client.GEOM_BOX, halfExtents=half_sizes)

    def place(self, state: np.ndarray) -> None:
        """Move robot and ball to the positions that a state, ``(5,)``, contains."""
        d, ball_x, ball_y = state[:3].tolist()
        height = self.scene.camera_height
        tilt = self.client.getQuaternionFromEuler([0.0, -np.deg2rad(self.scene.camera_pitch), 0.0])
        self._move(self._ball, (ball_x, 0.0, ball_y))
        self._move(self._mast, (d, 0.0, height / 2))
        self._move(self._base, (d, 0.0, 0.12))
        self._move(self._head, (d, 0.0, height), tilt)

    def picture(self, camera_image: np.ndarray) -> np.ndarray:
        """Draw side view and camera image, ``(3, 64, 64)``, side by side in one picture, ``(256, 772, 3)`` uint8."""
        view = self.client.computeViewMatrix((MIDDLE[0] - 1.5, -BESIDE, 3.4), MIDDLE, (0.0, 0.0, 1.0))
        projection = self.client.computeProjectionMatrixFOV(38.0, WIDTH / HEIGHT, 0.1, 60.0)
        scene = self.client.picture(HEIGHT, WIDTH, view, projection, LIGHT.tolist(), shadow=1)
        return beside(scene, camera_image.transpose(1, 2, 0))
