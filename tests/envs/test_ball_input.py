"""What the constructor of ball catching refuses, and how it says so."""

import numpy as np
import pytest
from small_problems import words

from sb3_tdpg.envs.ball_catch import BallCatchEnv


@pytest.mark.parametrize(("keywords", "message"), [
    (dict(pixel_noise_std=-0.1), "pixel_noise_std=-0.1 must be finite and not negative"),
    (dict(pixel_noise_std=np.nan), "pixel_noise_std=nan must be finite"),
    (dict(noise_mode="max"), r"noise_mode='max' must be one of \['minmax', 'clip'\]"),
    (dict(renderer="opengl"), r"renderer='opengl' must be one of \['pybullet', 'fast'\]"),
    (dict(horizon=0), "horizon=0 must be an integer of at least 1"),
    (dict(dt=0.0), "dt=0.0 must be finite and positive"),
    (dict(control_gain=-1.0), "control_gain=-1.0 must be finite and positive"),
    (dict(gravity=np.inf), "gravity=inf must be finite"),
    (dict(max_action=np.inf), "max_action=inf must be finite and positive"),
    (dict(robot_range=(1.0, -1.0)), r"robot_range=\(1.0, -1.0\) must be \(low, high\)"),
    (dict(robot_range=2.0), r"robot_range=2.0 must be \(low, high\)"),
    (dict(ball_start_range=(8.0, 1.0)), r"ball_start_range=\(8.0, 1.0\) must be \(\(low_x, low_y\)"),
    (dict(ball_speed_range=((-4, 8), (-5, 8))), r"ball_speed_range=.* must be \(\(low_x, low_y\).* low <= high"),
    (dict(ball_color=(0, 255, 0)), r"ball_color=\(0, 255, 0\) must be \(red, green, blue\), each between 0 and 1"),
    (dict(ball_radius=0.0), "ball_radius=0.0 must be finite and positive"),
    (dict(camera_height=-1.0), "camera_height=-1.0 must be finite and positive"),
    (dict(camera_pitch=90.0), "camera_pitch=90.0 must be between -90 and 90 degrees"),
    (dict(fov=np.nan), "fov=nan must be between 0 and 180 degrees"),
    (dict(render_mode="ansi"), r"render_mode='ansi' must be None or one of \['rgb_array', 'human'\]"),
    (dict(texture="bricks"), r"texture='bricks' is unknown: use one of \['brick', 'blue_tiles', .*'red_planks'\]"),
    (dict(texture=np.zeros((8, 8), np.uint8)), r"shape \(8, 8\) and dtype uint8; expected \(height, width, 3\)"),
    (dict(texture=np.zeros((8, 8, 3))), "dtype float64; expected"),
], ids=words)  # fmt: skip
def test_the_constructor_refuses_a_bad_keyword_and_names_the_mend(keywords, message):
    with pytest.raises(ValueError, match=message):
        BallCatchEnv(**{"renderer": "fast", **keywords})


def test_a_missing_or_broken_texture_file_is_an_error_that_names_it(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no_such_wall.png'.*no such image file"):
        BallCatchEnv(renderer="fast", texture=tmp_path / "no_such_wall.png")
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"\x89PNG\r\n\x1a\n but then nothing")
    with pytest.raises(ValueError, match=r"broken.png' cannot be read as an image"):
        BallCatchEnv(renderer="fast", texture=str(broken))
    text = tmp_path / "text.jpg"
    text.write_text("not an image")
    with pytest.raises(ValueError, match=r"text.jpg' cannot be read as an image"):
        BallCatchEnv(renderer="fast", texture=text)
