"""The ball-catching problem: dynamics by hand, camera, noise and launch."""

import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

import sb3_tdpg  # noqa: F401  (registers the environments)
from sb3_tdpg import make_episodes_env
from sb3_tdpg.envs.ball_catch import BallCatchEnv
from sb3_tdpg.envs.scenarios import BALL_CATCH, BALL_CATCH_VARYING_LAUNCH, BALL_PUBLISHED_READING, BALL_VARYING_LAUNCH
from sb3_tdpg.envs.textures import TEST_TEXTURES

READINGS = {"text": {}, "published": BALL_PUBLISHED_READING}
IMAGE = (3, 64, 64)


def ball_pixels(image):
    """Where an image (3, 64, 64) shows the green ball."""
    red, green, blue = image.astype(int)
    return (green > 100) & (red < 30) & (blue < 30)


def run_episode(env, controls, seed=0):
    """States x_0..x_T, observations y_0..y_T and costs c_0..c_(T-1) of an episode."""
    observation, info = env.reset(seed=seed)
    states, observations, costs = [info["state"]], [observation], []
    for u in controls:
        observation, reward, _, _, info = env.step(np.array([u]))
        states.append(info["state"])
        observations.append(observation)
        costs.append(-reward)
    return np.array(states), np.array(observations), np.array(costs)


@pytest.mark.parametrize(("reading", "robot", "fall"), [
    ("text", (2 / 15, 1 / 15), (7.196, 6.542)),
    ("published", (0.2, 0.1), (7.85 - 9.8 / 15, 7.85 - 2 * 9.8 / 15)),
])  # fmt: skip
def test_two_steps_have_the_states_computed_by_hand(reading, robot, fall):
    env = BallCatchEnv(robot_range=(0.0, 0.0), **READINGS[reading])
    states, _, costs = run_episode(env, [2.0, -1.0])
    expected = [
        [0.0, 8.0, 1.0, -4.5, 7.85],
        [robot[0], 7.7, 1 + 7.85 / 15, -4.5, fall[0]],
        [robot[1], 7.4, 1 + 7.85 / 15 + fall[0] / 15, -4.5, fall[1]],
    ]
    np.testing.assert_allclose(states, expected, atol=1e-9)
    np.testing.assert_allclose(costs, [0.02, 0.01])


@pytest.mark.parametrize(("reading", "steps", "lands", "height"), [
    ("text", 25, 0.5, 1.0033),
    ("published", 24, 0.8, 1.5387),
])  # fmt: skip
def test_the_ball_goes_from_eight_metres_to_where_the_reading_has_it_at_the_end(reading, steps, lands, height):
    env = BallCatchEnv(robot_range=(-1.0, -1.0), **READINGS[reading])
    assert env.horizon == steps
    states, _, costs = run_episode(env, [0.0] * steps)
    np.testing.assert_allclose(states[0, 1:3], [8.0, 1.0])
    np.testing.assert_allclose(states[-1, 1:3], [lands, height], atol=1e-4)
    assert (states[:, 2] > 0).all()
    np.testing.assert_allclose(costs[:-1], 0.0)
    assert costs[-1] == pytest.approx(100 * (1.0 + lands))


def test_an_episode_starts_with_the_robot_anywhere_in_its_range_and_the_ball_at_its_launch():
    states = BallCatchEnv().initial_state(20_000)
    np.testing.assert_allclose(np.quantile(states[:, 0], [0, 0.25, 0.5, 0.75, 1]), [-2, -1, 0, 1, 2], atol=0.05)
    np.testing.assert_array_equal(states[:, 1:], np.tile([8.0, 1.0, -4.5, 7.85], (20_000, 1)))


def test_a_launch_that_varies_fills_its_ranges_and_moves_the_landing_point():
    env = BallCatchEnv(**BALL_VARYING_LAUNCH)
    states = env.initial_state(20_000)
    np.testing.assert_allclose(states[:, [1, 3]].min(axis=0), [7.0, -5.0], atol=0.01)
    np.testing.assert_allclose(states[:, [1, 3]].max(axis=0), [9.0, -4.0], atol=0.01)
    np.testing.assert_array_equal(states[:, [2, 4]], np.tile([1.0, 7.85], (20_000, 1)))
    lands = states[:, 1] + states[:, 3] * env.horizon * env.dt
    assert lands.std() > 0.5
    assert -1.34 < lands.min() < lands.max() < 2.34


def test_the_observation_is_an_image_of_sky_wall_floor_and_ball():
    image = BallCatchEnv(robot_range=(0, 0)).reset(seed=0)[0]
    assert image.shape == IMAGE
    assert image.dtype == np.uint8
    assert (image[:, 0] == 255).all()  # sky
    red, green, blue = image[:, 20:50].reshape(3, -1).mean(axis=1)
    assert red > 1.3 * max(green, blue)  # brick
    floor = image[:, 62].astype(int)
    assert (floor[2] >= floor[0]).all()
    assert (floor[2] - floor[0]).max() > 40  # blue squares
    rows, columns = np.nonzero(ball_pixels(image))
    assert len(rows)
    assert (abs(rows - 55) < 4).all()  # a little below the horizon of a camera that looks up
    assert (abs(columns - 32) < 4).all()


def test_the_ball_grows_as_it_comes_nearer_and_the_wall_moves_with_the_robot():
    _, observations, _ = run_episode(BallCatchEnv(robot_range=(0, 0)), [0.0] * 20)
    sizes = [ball_pixels(image).sum() for image in observations]
    assert 3 <= sizes[0] <= 9
    assert sizes[19] > 3 * sizes[8] > 0
    left, right = (BallCatchEnv(robot_range=(d, d)).reset(seed=0)[0] for d in (-1.0, 1.0))
    assert (left[:, 10:50] != right[:, 10:50]).mean() > 0.3
    np.testing.assert_array_equal(left[:, 62:], right[:, 62:])  # the floor


def test_the_renderer_changes_neither_states_nor_costs():
    controls = np.random.default_rng(0).normal(size=25)
    (states, _, costs), (fast_states, _, fast_costs) = (
        run_episode(BallCatchEnv(renderer=renderer, pixel_noise_std=0.1), controls) for renderer in ("pybullet", "fast")
    )
    np.testing.assert_array_equal(fast_states, states)
    np.testing.assert_array_equal(fast_costs, costs)


def test_pixel_noise_has_the_standard_deviation_that_was_asked_for_and_is_rounded_to_bytes():
    keywords = dict(texture=np.full((4, 4, 3), 128, np.uint8), noise_mode="clip")
    clean, tiny, noisy = (BallCatchEnv(pixel_noise_std=std, **keywords).reset(seed=0)[0] for std in (0.0, 1e-4, 0.05))
    difference = (noisy.astype(float) - clean)[:, 20:50] / 255
    assert difference.std() == pytest.approx(0.05, rel=0.03)
    assert abs(difference.mean()) < 0.003
    np.testing.assert_array_equal(tiny, clean)  # a fortieth of a byte is rounded away


def test_minmax_spreads_each_image_over_the_whole_range_and_clip_leaves_its_contrast():
    def seen(**kwargs):  # from the same places
        return make_episodes_env("BallCatch-v0", 5, env_kwargs=kwargs, seed=0).reset().astype(float)

    images = {mode: seen(pixel_noise_std=0.25, noise_mode=mode) for mode in ("minmax", "clip")}
    for image in images["minmax"]:
        assert (image.min(), image.max()) == (0, 255)
        assert ((image == 0) | (image == 255)).sum() < 10
    clean = seen()

    def contrast(images):
        return (images[:, :, :3] - images[:, :, 30:40].mean(axis=2, keepdims=True)).mean()  # sky minus wall

    assert contrast(images["minmax"]) < 0.6 * contrast(clean)
    assert contrast(images["clip"]) > 0.7 * contrast(clean)


def test_two_environments_in_one_process_do_not_disturb_each_other():
    env, controls = BallCatchEnv(renderer="pybullet"), np.random.default_rng(0).normal(size=6)
    _, alone, _ = run_episode(env, controls)
    other = BallCatchEnv(renderer="pybullet", texture="blue_tiles", ball_color=(1, 1, 0))
    run_episode(other, -controls, seed=9)
    np.testing.assert_array_equal(run_episode(env, controls)[1], alone)
    other.close()
    np.testing.assert_array_equal(env.reset(seed=0)[0], alone[0])


def test_thousands_of_resets_leak_neither_memory_nor_clients():
    resource = pytest.importorskip("resource")
    env = BallCatchEnv(renderer="pybullet")
    bodies = env._world.client.getNumBodies()
    for _ in range(200):
        env.reset()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # kB
    for _ in range(2000):
        env.reset()
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 10_000
    assert env._world.client.getNumBodies() == bodies == 3


def test_the_camera_image_in_the_picture_is_the_observation():
    env = BallCatchEnv(render_mode="rgb_array")
    observation, _ = env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (256, 772, 3)
    np.testing.assert_array_equal(picture[2::4, 518::4], observation.transpose(1, 2, 0))
    env.step(np.array([2.0]))
    assert not np.array_equal(env.render()[:, :512], picture[:, :512])


def test_table_two_has_its_twelve_rows_and_each_can_be_made():
    assert len(BALL_CATCH) == len(BALL_CATCH_VARYING_LAUNCH) == 12
    noise = [row.env_kwargs["pixel_noise_std"] for row in BALL_CATCH if "pixel_noise_std" in row.env_kwargs]
    assert noise == [0.10, 0.15, 0.20, 0.25]
    assert [row.env_kwargs["texture"] for row in BALL_CATCH if "texture" in row.env_kwargs] == list(TEST_TEXTURES)
    for row in BALL_CATCH + BALL_CATCH_VARYING_LAUNCH:
        gym.make(row.env_id, **row.with_kwargs(**BALL_PUBLISHED_READING).env_kwargs).close()
    for row, ours in zip(BALL_CATCH, BALL_CATCH_VARYING_LAUNCH, strict=True):
        assert (ours.name, dict(ours.env_kwargs)) == (row.name, {**row.env_kwargs, **BALL_VARYING_LAUNCH})
        assert not ours.paper
        for result in row.paper.values():
            assert result.std is None
            # The cost is 100 times the distance and a little for the controls; but for a misprint of the paper.
            if row.name != "Test background 6":
                assert result.mean == pytest.approx(100 * result.distance, abs=2)


@pytest.mark.parametrize("mode", ["RGB", "L", "RGBA", "P"])
@pytest.mark.parametrize("renderer", ["pybullet", "fast"])
def test_an_image_file_of_any_mode_becomes_the_wall(tmp_path, mode, renderer):
    path = tmp_path / f"wall {mode}.png"
    Image.fromarray(np.full((30, 50, 3), 204, np.uint8)).convert(mode).save(path)
    image = BallCatchEnv(texture=path, renderer=renderer).reset(seed=0)[0]
    np.testing.assert_allclose(image[:, 20:40].reshape(3, -1).T, 204 * 0.751, atol=2)


@pytest.mark.parametrize("renderer", ["pybullet", "fast"])
def test_with_a_wall_at_rest_only_the_ball_tells_where_the_robot_is(renderer):
    """Robot and ball moved together: the picture is the same; the ball moved alone: it is not. The state is true."""
    env = BallCatchEnv(renderer=renderer, wall_stands_still=True)
    state = np.array([[0.5, 4.0, 2.5, -4.5, 1.0]])
    together = state + np.array([[1.0, 1.0, 0.0, 0.0, 0.0]])
    alone = state + np.array([[0.0, 1.0, 0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(env.sensor(state), env.sensor(together))
    assert (env.sensor(state) != env.sensor(alone)).any()
    ordinary = BallCatchEnv(renderer=renderer)
    assert (ordinary.sensor(state) != ordinary.sensor(together)).any()
    _, info = env.reset(seed=0)
    np.testing.assert_array_equal(info["state"], ordinary.reset(seed=0)[1]["state"])
    env.close()
    ordinary.close()


def test_the_ray_caster_needs_no_processes():
    assert BallCatchEnv(n_processes=4).n_processes == 1
