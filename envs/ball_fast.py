"""
Draw the ball-catching scene as PyBullet's TinyRenderer does, with a batched ray caster in NumPy.

The ray caster agrees with TinyRenderer in 99.8 % of the pixels and is 65 times as fast. It uses these facts:

- The ray of a pixel goes through the pixel's corner, not through its centre.
- The camera does not turn about the vertical axis. In a row of pixels, all points of the wall have the same depth and
  height, and so do all points of the floor. Each row is sky, wall or floor; only the ball is drawn pixel by pixel.
- Textures are not interpolated. The brightness of a flat surface is constant, so its texture is shaded in advance.
- TinyRenderer draws a sphere as a mesh inside the sphere. The mesh looks like a sphere of 0.965 times the radius.

Dimension key: N images, K pixels per side of the window around a ball; images are ``(N, 3, 64, 64)``.
"""

import numpy as np

from .ball_scene import FAR, IMAGE_SIZE, LIGHT, NEAR, PLANE_COPIES, PLANE_HALF, WALL_SCALE, WALL_X, WALL_Z, BallScene
from .textures import floor_texture

MESH_RADIUS = 0.965  # visible radius of a sphere mesh, as a fraction of its radius
WINDOWS = (4, 8, 16, 32, IMAGE_SIZE)  # K
CHUNK = 64  # number of images whose walls are drawn at once
WINDOW_PIXELS = 12_800  # number of ball pixels that are drawn at once
SKY = 255

# A pixel is texel * (ambient + diffuse * max(0, n.l) + specular * max(0, r_z)^2), where n is the surface normal, l the
# direction to the light and r the direction of the reflected light.
AMBIENT, DIFFUSE, SPECULAR = 0.6, 0.35, 0.05
TO_LIGHT = LIGHT / np.linalg.norm(LIGHT)


def brightness(towards_light: np.ndarray, upward: np.ndarray) -> np.ndarray:
    """Return the brightness of a surface, given the components of its normal towards the light and upward."""
    reflected_up = 2 * upward * towards_light - TO_LIGHT[2]
    return AMBIENT + DIFFUSE * np.maximum(towards_light, 0) + SPECULAR * np.maximum(reflected_up, 0) ** 2


def shade(texture: np.ndarray, normal: tuple[float, float, float]) -> np.ndarray:
    """Multiply the texels of a flat surface by its brightness."""
    return np.minimum(texture * brightness(normal @ TO_LIGHT, np.asarray(normal[2])), 255).astype(np.uint8)


def pack(colours: np.ndarray) -> np.ndarray:
    """Pack each colour, ``(..., 3)`` uint8, into one uint32 (red lowest), so that one look-up replaces three."""
    red, green, blue = np.moveaxis(colours.astype(np.uint32), -1, 0)
    return red | green << np.uint32(8) | blue << np.uint32(16)


class FastRenderer:
    """Render the robot's camera with a batched ray caster."""

    def __init__(self, scene: BallScene) -> None:
        self.scene = scene
        self._prepare_rays()
        self._prepare_wall()
        self._behind, self._floor_depth = self._draw_floor()
        self._behind_packed = pack(self._behind.transpose(1, 2, 0))
        self._nearest_floor = self._floor_depth.min(axis=1)

    def _prepare_rays(self) -> None:
        """Make a ray (x, y, z) of depth 1 for each pixel; x and z depend on the pixel's row, y on its column."""
        pitch = np.deg2rad(self.scene.camera_pitch)
        self._slope = np.tan(np.deg2rad(self.scene.fov) / 2)
        steps = np.arange(IMAGE_SIZE)
        upward = (2 * (IMAGE_SIZE - 1 - steps) / IMAGE_SIZE - 1) * self._slope
        x, z = np.cos(pitch) - upward * np.sin(pitch), np.sin(pitch) + upward * np.cos(pitch)
        y = -(2 * steps / IMAGE_SIZE - 1) * self._slope
        self._ray_x, self._ray_y, self._ray_z = x, y, z  # (64,)
        self._ray_length_squared = (x**2 + z**2)[:, None] + y**2  # (64, 64)
        self._ray_to_light = (x * TO_LIGHT[0] + z * TO_LIGHT[2])[:, None] + y * TO_LIGHT[1]  # (64, 64)
        # x and z of the camera's forward and upward direction
        self._axis = np.array([np.cos(pitch), np.sin(pitch)])
        self._up = np.array([-np.sin(pitch), np.cos(pitch)])

    def _prepare_wall(self) -> None:
        """Shade the texture, and compute the texture coordinates of each ray on a wall 1 m ahead."""
        shaded = shade(self.scene.texture, (-1.0, 0.0, 0.0))
        self._texels_v, self._texels_u = shaded.shape[:2]
        # u (upward) is the slow index, v (to the left) the fast one.
        self._wall_texels = pack(shaded[::-1].transpose(1, 0, 2)).ravel()
        copy = 2 * WALL_SCALE * PLANE_HALF / PLANE_COPIES  # m of wall per copy of the texture
        self._ahead = np.where(self._ray_x > 0, self._ray_x, np.inf)  # the wall is not visible from behind
        self._u_at_zero = PLANE_COPIES / 2 + (self.scene.camera_height - WALL_Z) / copy
        self._u_per_metre = self._ray_z / self._ahead / copy  # (64,)
        self._v_per_metre = (self._ray_y / copy / self._ahead[:, None]).astype(np.float32)  # (64, 64)

    @staticmethod
    def _depth_of(distance: float | np.ndarray, ray: np.ndarray) -> np.ndarray:
        """Return the depth at which each ray reaches a distance along an axis, or infinity if it never does."""
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = distance / ray
        return np.where(depth > NEAR, depth, np.inf)

    def _draw_floor(self) -> tuple[np.ndarray, np.ndarray]:
        """Return an image of floor and sky, ``(3, 64, 64)``, and the depth of the floor, infinite outside the floor."""
        texture = shade(floor_texture(), (0.0, 0.0, 1.0))
        depth = self._depth_of(-self.scene.camera_height, self._ray_z)[:, None]
        depth[depth > FAR] = np.inf
        reach = np.where(np.isfinite(depth), depth, 0.0)
        x, y = np.broadcast_arrays(reach * self._ray_x[:, None], reach * self._ray_y)
        u, v = (PLANE_COPIES * (side / PLANE_HALF + 1) / 2 for side in (x, y))
        rows, columns = len(texture) - 1 - (v % 1 * len(texture)).astype(int), (u % 1 * texture.shape[1]).astype(int)
        is_off = np.maximum(abs(x), abs(y)) > PLANE_HALF
        if is_off.any():
            depth = np.where(is_off, np.inf, depth)  # (64, 64) instead of (64, 1)
        image = np.where(np.isfinite(depth)[..., None], texture[rows, columns], SKY).astype(np.uint8)
        return np.ascontiguousarray(image.transpose(2, 0, 1)), depth

    def images(self, state: np.ndarray) -> np.ndarray:
        """Return one image for each state: ``(N, 3, 64, 64)`` uint8 from ``(N, 5)``."""
        images = np.repeat(self._behind[None], len(state), axis=0)
        wall_depth = self._depth_of(WALL_X - state[:, :1], self._ahead)  # (N, 64)
        wall_depth[wall_depth > FAR] = np.inf
        for start in range(0, len(state), CHUNK):
            chunk = slice(start, start + CHUNK)
            self._draw_walls(images[chunk], WALL_X - state[chunk, 0], wall_depth[chunk])
        self._draw_balls(images, state, wall_depth)
        return images

    def close(self) -> None:
        """Do nothing: there is nothing to release."""

    def _draw_walls(self, images: np.ndarray, distance: np.ndarray, depth: np.ndarray) -> None:
        """Draw the wall in each image, given its distance ``(N,)`` and its depth in each row of pixels, ``(N, 64)``."""
        # (64,); first and last differ only in rows that show the sides of the floor
        first, last = self._nearest_floor, self._floor_depth.max(axis=1)
        with_wall = np.flatnonzero((depth < last).any(axis=0))
        if not len(with_wall):
            return
        rows = slice(with_wall[0], with_wall[-1] + 1)
        colours = self._wall_colours(distance, rows)
        depth, first, last, behind = depth[:, rows], first[rows], last[rows], self._behind_packed[rows]
        image, row = np.nonzero(depth >= last)
        colours[image, row] = behind[row]
        image, row = np.nonzero((depth >= first) & (depth < last))
        is_wall = depth[image, row, None] < self._floor_depth[rows][row]
        colours[image, row] = np.where(is_wall, colours[image, row], behind[row])
        for channel in range(3):
            # The cast keeps the lowest byte. An assignment would have the same result but take six times as long.
            np.copyto(images[:, channel, rows], colours >> np.uint32(8 * channel), casting="unsafe")

    def _wall_colours(self, distance: np.ndarray, rows: slice) -> np.ndarray:
        """Return the packed colours of the wall, ``(N, rows, 64)``."""
        u = self._u_at_zero + np.multiply.outer(distance, self._u_per_metre[rows])  # (N, rows)
        u -= np.floor(u)
        line = (u * self._texels_u).astype(np.int32) * np.int32(self._texels_v)
        # The error of single precision is less than a thousandth of a texel.
        v = distance.astype(np.float32)[:, None, None] * self._v_per_metre[rows]  # (N, rows, 64)
        v += np.float32(PLANE_COPIES / 2)
        v -= np.floor(v)
        v *= np.float32(self._texels_v)
        return self._wall_texels.take(v.astype(np.int32) + line[..., None], mode="clip")

    def _draw_balls(self, images: np.ndarray, state: np.ndarray, wall_depth: np.ndarray) -> None:
        """Draw the balls, each in the smallest window that contains it; windows of equal size are drawn together."""
        # Forward and upward distance of the ball from the camera: (N, 2). The ball is never to the left or right of it.
        centre = np.stack([state[:, 1] - state[:, 0], state[:, 2] - self.scene.camera_height], axis=1)
        first, last = self._bounding_box(centre)  # (N, 2): row and column
        size = (last - first).max(axis=1)
        is_seen = (last > first).all(axis=1)
        smallest = 0
        for window in WINDOWS:
            of_this_size = np.flatnonzero(is_seen & (smallest < size) & (size <= window))
            smallest = window
            at_once = max(1, WINDOW_PIXELS // window**2)
            for start in range(0, len(of_this_size), at_once):
                chosen = of_this_size[start : start + at_once]
                corner = np.minimum(first[chosen], IMAGE_SIZE - window)
                self._draw_windows(images, chosen, corner, window, centre[chosen], wall_depth)

    def _bounding_box(self, centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows and columns that each ball may cover: their start and (excluded) end, ``(N, 2)`` each."""
        radius = MESH_RADIUS * self.scene.ball_radius
        depth = centre @ self._axis
        across = np.stack([-(centre @ self._up), np.zeros(len(centre))], axis=1)  # (N, 2): downward, to the right
        # Seen from above or from the side, the ball is a circle. Lines through the eye with these slopes touch it.
        room = np.maximum(depth**2 - radius**2, 1e-12)[:, None]
        root = radius * np.sqrt(np.maximum(across**2 + depth[:, None] ** 2 - radius**2, 0))
        slopes = np.stack([across * depth[:, None] - root, across * depth[:, None] + root]) / room
        pixels = (slopes / self._slope + 1) * IMAGE_SIZE / 2
        pixels[..., 0] -= 1  # the lowest row is 63, at the normalised coordinate -1
        first, last = np.clip(np.stack([np.floor(pixels[0]), np.ceil(pixels[1]) + 1]), 0, IMAGE_SIZE).astype(int)
        is_around = abs(depth) <= radius + NEAR  # the ball is at the eye and may cover every pixel
        first[is_around], last[is_around] = 0, IMAGE_SIZE
        is_out = (depth < -radius) | (depth > FAR + radius)
        last[is_out] = first[is_out]
        return first, last

    def _draw_windows(
        self,
        images: np.ndarray,
        chosen: np.ndarray,
        corner: np.ndarray,
        window: int,
        centre: np.ndarray,
        wall_depth: np.ndarray,
    ) -> None:
        """Draw the balls of the chosen images, each in a window of K x K pixels with a given upper left corner."""
        radius = MESH_RADIUS * self.scene.ball_radius
        steps = np.arange(window)
        rows, columns = corner[:, :1] + steps, corner[:, 1:] + steps  # (n, K)
        x, z, y = self._ray_x[rows], self._ray_z[rows], self._ray_y[columns]
        # |depth * ray - centre|^2 = radius^2, a quadratic equation for the depth; the centre has y = 0.
        along = x * centre[:, :1] + z * centre[:, 1:]  # (n, K)
        excess = (centre**2).sum(axis=1, keepdims=True) - radius**2  # (n, 1)
        discriminant = (along**2 - (x**2 + z**2) * excess)[:, :, None] - (y**2 * excess)[:, None]  # (n, K, K)
        behind = np.minimum(wall_depth[chosen[:, None], rows], self._nearest_floor[rows])

        # From here on, arrays have one entry for each pixel of a ball. The divisors are K, which is a power of two.
        found = np.flatnonzero(discriminant > 0)
        row = found // window  # index among the n * K rows of all windows
        ball = row // window
        pixel = rows.take(row) * IMAGE_SIZE + columns.take(ball * window + found % window)
        depth = (along.take(row) - np.sqrt(discriminant.take(found))) / self._ray_length_squared.take(pixel)
        is_seen = (depth > NEAR) & (depth < np.minimum(behind, FAR).take(row))
        row, ball, pixel, depth = row[is_seen], ball[is_seen], pixel[is_seen], depth[is_seen]
        # The normal is (depth * ray - centre) / radius.
        towards_light = (depth * self._ray_to_light.take(pixel) - (centre @ TO_LIGHT[::2]).take(ball)) / radius
        upward = (depth * z.take(row) - centre[:, 1].take(ball)) / radius
        level = 255 * brightness(towards_light, upward)
        place = chosen.take(ball) * (3 * IMAGE_SIZE**2) + pixel
        for channel, amount in enumerate(self.scene.ball_color):
            images.reshape(-1)[place + channel * IMAGE_SIZE**2] = np.minimum(amount * level, 255).astype(np.uint8)
