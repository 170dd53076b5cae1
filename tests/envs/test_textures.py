"""Results depend on the walls, so each must stay the picture that it is."""

import numpy as np
import pytest
from PIL import Image

from sb3_tdpg.envs.textures import TEST_TEXTURES, floor_texture, load_texture, random_texture

# Mean of each colour, the mean step between neighbouring texels along rows and columns, and what the first half of the
# rows and of the columns is brighter than the rest.
PICTURES = {
    "floor": (214.000, 227.000, 247.000, 0.100, 0.100, 0.000, 0.000),
    "brick": (159.725, 96.929, 85.205, 9.746, 14.470, 3.231, 2.945),
    "blue_tiles": (87.898, 129.138, 179.005, 9.115, 9.056, -1.639, 3.727),
    "green_leaves": (70.909, 121.098, 39.669, 8.960, 8.966, -10.139, -3.831),
    "yellow_stripes": (197.440, 173.944, 67.919, 6.467, 11.635, -0.026, 0.016),
    "grey_plaster": (145.067, 143.080, 140.092, 13.421, 13.511, 5.302, -6.805),
    "violet_dots": (142.889, 98.381, 159.315, 15.523, 15.522, 0.069, -0.069),
    "turquoise_waves": (76.636, 157.193, 153.722, 7.764, 11.260, 6.308, 2.701),
    "red_planks": (133.929, 54.528, 40.735, 14.662, 5.812, 2.781, -0.353),
    "random-100": (160.696, 143.650, 117.039, 9.720, 9.817, -2.315, -0.592),
    "random-101": (26.182, 149.188, 83.112, 6.914, 5.827, 0.014, 0.099),
    "random-102": (93.637, 131.449, 134.047, 8.541, 8.579, -1.162, -2.124),
    "40%-violet_dots": (152.993, 97.507, 114.846, 10.271, 12.961, 1.967, 1.738),
}


def described(picture):
    pixels = picture.astype(float)
    steps = [np.abs(np.diff(pixels, axis=axis)).mean() for axis in (0, 1)]
    rows, columns = pixels.mean(axis=(1, 2)), pixels.mean(axis=(0, 2))
    halves = [x[: len(x) // 2].mean() - x[len(x) // 2 :].mean() for x in (rows, columns)]
    return [*pixels.mean(axis=(0, 1)), *steps, *halves]


@pytest.mark.parametrize("name", PICTURES)
def test_a_wall_is_the_picture_that_the_results_were_measured_with(name):
    picture = floor_texture() if name == "floor" else load_texture(name)
    # A texel may be rounded the other way on another machine.
    assert described(picture) == pytest.approx(PICTURES[name], abs=0.01)


def test_the_built_in_textures_differ_in_hue_and_the_seventh_is_reddish_like_the_brick():
    mean = {name: load_texture(name).reshape(-1, 3).mean(axis=0) for name in ("brick", *TEST_TEXTURES)}
    assert len(TEST_TEXTURES) == 7
    assert set(TEST_TEXTURES) < set(PICTURES)
    redness = {name: red / max(green, blue) for name, (red, green, blue) in mean.items()}
    reddish = ("brick", TEST_TEXTURES[6])
    assert min(redness[name] for name in reddish) > 1.4
    assert max(redness[name] for name in TEST_TEXTURES[:6]) < 1.25
    hues = np.array([color / color.sum() for color in mean.values()])
    apart = np.linalg.norm(hues[:, None] - hues, axis=-1) + 9 * np.eye(8)
    assert apart[:7, :7].min() > 0.05


def test_a_texture_is_the_same_every_time_and_a_random_one_follows_its_seed():
    np.testing.assert_array_equal(load_texture("random-11"), random_texture(11))
    assert len({random_texture(seed).tobytes() for seed in range(50)}) == 50


def test_a_texture_continues_over_its_edges():
    for name in ("brick", *TEST_TEXTURES):
        texture = load_texture(name).astype(int)
        for rows in (texture, texture.transpose(1, 0, 2)):
            inside = abs(np.diff(rows, axis=0)).mean(axis=(1, 2)).max()
            assert abs(rows[0] - rows[-1]).mean() <= 1.1 * inside, name


def test_a_file_whose_grey_values_have_more_than_eight_bits_is_refused(tmp_path):
    Image.fromarray(np.full((4, 4), 1000, np.uint16)).save(tmp_path / "16.png")
    with pytest.raises(ValueError, match=r"16.png' has grey values of more than 8 bits"):
        load_texture(tmp_path / "16.png")
