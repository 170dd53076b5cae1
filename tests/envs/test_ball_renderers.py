"""Both renderers of the ball-catching camera draw one picture."""

import numpy as np
import pytest
from small_problems import words

from sb3_tdpg.envs.ball_bullet import BulletRenderer
from sb3_tdpg.envs.ball_fast import FastRenderer
from sb3_tdpg.envs.ball_scene import BallScene
from sb3_tdpg.envs.textures import TEST_TEXTURES, TRAINING_TEXTURE, load_texture


def scene(**changes):
    defaults = dict(
        texture=load_texture(TRAINING_TEXTURE), ball_color=(0.0, 1.0, 0.0), ball_radius=0.235, camera_height=2.0,
        camera_pitch=30.0, fov=90.0,
    )  # fmt: skip
    return BallScene(**{**defaults, **changes})


def random_states(n, seed=0):
    """States on the paper's flight, with the robot anywhere, and as many with the ball anywhere, too."""
    rng = np.random.default_rng(seed)
    t = rng.uniform(0, 25 / 15, n)
    on_its_way = np.stack([8 - 4.5 * t, 1 + 7.85 * t - 4.905 * t**2], axis=1)
    anywhere = rng.uniform((0, 0), (8, 4.5), (n, 2))
    states = np.zeros((n, 5))
    states[:, 0] = rng.uniform(-2.5, 2.5, n)
    states[:, 1:3] = np.where(np.arange(n)[:, None] % 2, on_its_way, anywhere)
    return states


def compare(scene, states):
    """Share of pixels within 2 of 255 in all channels, and the mean difference."""
    renderers = BulletRenderer(scene), FastRenderer(scene)
    reference, fast = (renderer.images(states).astype(int) for renderer in renderers)
    for renderer in renderers:
        renderer.close()
    difference = abs(reference - fast)
    return (difference.max(axis=1) <= 2).mean(), difference.mean()


@pytest.mark.parametrize("texture", [TRAINING_TEXTURE, *TEST_TEXTURES])
def test_the_renderers_agree_in_500_states_with_each_texture(texture):
    within_two, mean = compare(scene(texture=load_texture(texture)), random_states(500))
    assert within_two > 0.995
    assert mean < 0.2


@pytest.mark.parametrize(("changes", "lowest"), [
    (dict(ball_color=(1.0, 0.5, 0.2), ball_radius=0.5), 0.995),
    (dict(camera_height=0.7), 0.995),
    (dict(camera_pitch=-20.0), 0.99),
    (dict(camera_pitch=40.0, camera_height=2.5), 0.99),  # the strongest perturbation of the scene
    (dict(camera_pitch=70.0), 0.995),
    (dict(fov=40.0), 0.995),
    (dict(fov=120.0), 0.98),  # the sides of the floor are in view
    (dict(texture=np.random.default_rng(0).integers(0, 256, (75, 200, 3), dtype=np.uint8)), 0.995),
], ids=words)  # fmt: skip
def test_the_renderers_agree_in_other_scenes_too(changes, lowest):
    within_two, _ = compare(scene(**changes), random_states(100))
    assert within_two > lowest


@pytest.mark.parametrize(("robot", "ball", "height", "changes", "lowest"), [
    ((8, 14), (0, 16), (-0.3, 4), {}, 0.995),  # at the wall and beyond it
    ((-12, -5), (-5, 8), (-0.3, 4), {}, 0.995),  # the wall too far to be seen, the sides of the floor in view
    ((-2, 2), (9, 10.4), (-0.3, 4), {}, 0.995),  # the ball in the wall
    ((0, 0), (-0.6, 0.6), (1.4, 2.6), {}, 0.97),  # the ball around the eye
    # Rays that point back met the wall at a depth that was positive: minus over minus.
    ((11, 20), (0, 8), (0, 4.5), dict(fov=150.0), 0.995),
    ((11, 20), (0, 8), (0, 4.5), dict(camera_pitch=70.0), 0.995),
], ids=words)  # fmt: skip
def test_the_renderers_agree_far_from_the_task(robot, ball, height, changes, lowest):
    rng = np.random.default_rng(0)
    states = random_states(100)
    states[:, :3] = np.column_stack([rng.uniform(*limits, 100) for limits in (robot, ball, height)])
    within_two, _ = compare(scene(**changes), states)
    assert within_two > lowest


def test_an_image_does_not_depend_on_the_batch_that_it_is_drawn_in_and_is_not_overwritten():
    states = random_states(150)
    renderer = FastRenderer(scene())
    together = renderer.images(states)
    kept = together.copy()
    np.testing.assert_array_equal(kept, np.concatenate([renderer.images(state[None]) for state in states]))
    np.testing.assert_array_equal(kept[::-1], renderer.images(states[::-1]))
    np.testing.assert_array_equal(together, kept)
    assert renderer.images(states[:0]).shape == (0, 3, 64, 64)


def test_the_box_around_the_ball_cuts_nothing_off(monkeypatch):
    renderer = FastRenderer(scene())
    states = random_states(300, seed=5)
    states[:, 2] += np.linspace(-2, 4, 300)  # also where it leaves the picture above and below
    boxed = renderer.images(states).copy()

    def whole(self, centre):
        return np.zeros((len(centre), 2), int), np.full((len(centre), 2), 64)

    monkeypatch.setattr(FastRenderer, "_bounding_box", whole)
    np.testing.assert_array_equal(boxed, renderer.images(states))
