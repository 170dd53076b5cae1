"""The depth camera of the grasping problem: where things are in the image, and how deep."""

import numpy as np
import pytest
from panda_oracle import random_states

from sb3_tdpg.envs.bullet import BulletClient
from sb3_tdpg.envs.panda_camera import DISTANCE, EDGES, FAR, IMAGE_SIZE, NEAR, PITCH, TARGET, YAW, DepthCamera
from sb3_tdpg.envs.panda_grasp import PandaGraspEnv
from sb3_tdpg.envs.panda_scene import TABLE_FILE, TABLE_POSITION, PandaScene, add_mug_picture

SCENE = PandaScene(mug_scale=1.0, frame_offset=0.012, friction=0.5)

# By hand: 0.4 m from the target, which is seen at an angle of 45 degrees from the side of the robot's left hand.
EYE = np.array([0.3, 0.2, 0.02 + 0.4 * np.sqrt(0.5)])
AXIS = (np.array(TARGET) - EYE) / 0.4


def depth_by_hand(point):
    return float((np.asarray(point) - EYE) @ AXIS)


def pixel(camera, point):
    """Row, column and depth of a point of the world."""
    left, right, bottom, top = EDGES
    to_right, upward, backward = camera.rotation @ (np.asarray(point) - camera.eye)
    depth = -backward
    column = (NEAR * to_right / depth - left) / (right - left) * IMAGE_SIZE
    row = IMAGE_SIZE - 1 - (NEAR * upward / depth - bottom) / (top - bottom) * IMAGE_SIZE
    return row, column, depth


@pytest.fixture(scope="module")
def camera():
    camera = DepthCamera(SCENE)
    yield camera
    camera.close()


def test_the_eye_is_where_it_is_by_hand(camera):
    np.testing.assert_allclose(camera.eye, EYE, atol=1e-6)
    np.testing.assert_allclose(-camera.rotation[2], AXIS, atol=1e-6)


@pytest.mark.parametrize("point", [
    (0.5, 0.0, 0.0), (0.6, -0.13, 0.0), (0.42, -0.04, 0.0)
], ids=str)  # fmt: skip
def test_a_point_of_the_table_has_the_depth_computed_by_hand(camera, point):
    nowhere = np.array([[0.5, 0.0, -1.0, 0.0]])  # the mug below the table
    (image,) = camera.images(nowhere)
    row, column, depth = pixel(camera, point)
    assert depth == pytest.approx(depth_by_hand(point), abs=1e-6)
    around = image[0, int(row) : int(row) + 2, int(column) : int(column) + 2]
    assert around.min() - 1e-4 < depth < around.max() + 1e-4
    assert np.ptp(around) < 0.008  # one pixel of table


@pytest.mark.parametrize("yaw", [0.0, 0.7, np.pi, 4.0])
def test_points_of_the_mug_have_the_depths_computed_by_hand(camera, yaw):
    x, y = 0.52, 0.02
    (image,) = camera.images(np.array([[x, y, 0.0, yaw]]))
    # The cup's axis lies 12 mm off the frame's origin, away from the handle, which is in the direction yaw + pi / 2.
    axis = np.array([x - 0.012 * np.cos(yaw + np.pi / 2), y - 0.012 * np.sin(yaw + np.pi / 2)])
    middle_of_the_rim = 0.0418  # m, of a ring that is flat for 3 mm
    for angle in (np.pi * 0.75, np.pi / 4, -np.pi * 0.75):
        along = np.array([np.cos(angle), np.sin(angle)])
        point = np.append(axis + middle_of_the_rim * along, 0.081)
        row, column, depth = pixel(camera, point)
        assert depth == pytest.approx(depth_by_hand(point), abs=1e-6)
        assert image[0, round(row), round(column)] == pytest.approx(depth, abs=0.002)


def test_one_sees_into_the_mug_and_the_handle_where_the_yaw_has_it(camera):
    (image,) = camera.images(np.array([[0.5, 0.012, 0.0, 0.0]]))  # its axis through (0.5, 0)
    row, column, lid = pixel(camera, (0.5, 0.0, 0.081))
    assert image[0, round(row), round(column)] > lid + 0.01
    for yaw in (0.3, 0.8, 1.2):  # towards the camera
        (image,) = camera.images(np.array([[0.5, 0.0, 0.0, yaw]]))
        outermost = 0.0805 * 1.134 - 0.012  # from the frame's origin to the outer side of the handle
        towards = yaw + np.pi / 2
        point = (0.5 + outermost * np.cos(towards), outermost * np.sin(towards), 0.0405)
        row, column, depth = pixel(camera, point)
        assert image[0, round(row), round(column)] == pytest.approx(depth, abs=0.002)
        assert camera.table_depth()[round(row), round(column)] > depth + 0.02


def test_the_image_is_a_part_of_what_pybullet_draws_of_mug_and_table_with_a_field_of_view_of_90_degrees(camera):
    states = random_states(10, half_width=0.075)
    client = BulletClient()
    client.loadURDF(TABLE_FILE, TABLE_POSITION, useFixedBase=True)
    mug = add_mug_picture(client, SCENE)
    view = client.computeViewMatrixFromYawPitchRoll(TARGET, DISTANCE, YAW, PITCH, 0.0, 2)
    projection = client.computeProjectionMatrixFOV(90.0, 4 / 3, NEAR, FAR)
    far = 998.6538  # 1000 m in the single precision of the projection
    for (image,), (x, y, z, yaw) in zip(camera.images(states), states.tolist(), strict=True):
        client.resetBasePositionAndOrientation(mug, (x, y, z), client.getQuaternionFromEuler((0, 0, yaw)))
        buffer = client.getCameraImage(480, 480, view, projection, shadow=0, renderer=client.ER_TINY_RENDERER)[3]
        depth = far * NEAR / (far - (far - NEAR) * np.asarray(buffer, np.float64).reshape(480, 480))
        part = depth[168 : 168 + IMAGE_SIZE, 176 : 176 + IMAGE_SIZE]
        assert np.quantile(abs(image - part), 0.99) < 1e-5  # but for pixels on the outline of the mug
    client.close()


def test_depths_are_in_metres_within_the_space_and_finite():
    env = PandaGraspEnv()
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    assert observation.shape == (1, 128, 128)
    assert 0.3 < observation.min() < observation.max() < 0.62
    # Wherever the mug has got to: beside the table, lifted before the camera, around the eye.
    for state in ([0.5, 0.0, -3.0, 0.0], [0.4, 0.1, 0.15, 0.0], [*EYE, 0.0], [0.3, 0.25, 0.25, 1.0]):
        image = env.sensor(np.array([state]))[0]
        assert env.observation_space.contains(image)
    env.close()


def test_depth_noise_has_the_standard_deviation_asked_for():
    clean, noisy = PandaGraspEnv(), PandaGraspEnv(depth_noise_std=0.01)
    (expected, _), (observation, _) = (env.reset(seed=0) for env in (clean, noisy))
    assert (observation - expected).std() == pytest.approx(0.01, rel=0.03)
    assert abs((observation - expected).mean()) < 3e-4
    assert observation.dtype == np.float32
    clean.close(), noisy.close()
