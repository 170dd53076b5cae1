"""The gallery and the page show what perturbations there are."""

from pathlib import Path

import numpy as np
import pytest

from sb3_tdpg.envs.textures import TRAINING_TEXTURE, load_texture, random_texture
from sb3_tdpg.robustness import PERTURBATIONS, perturbation_gallery

PAGE = Path(__file__).parents[2] / "docs" / "guide" / "perturbations.md"


def test_a_texture_gives_way_to_another_one_by_its_share():
    lower, upper = (load_texture(name).astype(float) for name in (TRAINING_TEXTURE, "violet_dots"))
    np.testing.assert_array_equal(load_texture("0%-violet_dots"), lower)
    np.testing.assert_array_equal(load_texture("100%-violet_dots"), upper)
    np.testing.assert_allclose(load_texture("40%-violet_dots"), 0.6 * lower + 0.4 * upper, atol=0.5)
    np.testing.assert_array_equal(load_texture("100%-random-3"), random_texture(3))


@pytest.mark.parametrize("name", ["140%-violet_dots", "40%-drawing.png", "40%-20%-violet_dots"])
def test_a_blend_that_cannot_be_made_is_refused(name):
    with pytest.raises(ValueError, match=r"'<0 to 100>%-<name>'"):
        load_texture(name)


def pictures(figure):
    """What is drawn, by row: ``(6, H, W)`` or ``(6, H, W, 3)``."""
    images = [np.asarray(axes.images[0].get_array()) for axes in figure.axes]
    names = [axes.get_ylabel() for axes in figure.axes[::6]]
    return {name: np.stack(images[6 * i : 6 * i + 6]) for i, name in enumerate(names)}


def test_the_gallery_has_a_row_for_all_that_applies_and_no_two_pictures_of_a_row_are_equal():
    rows = pictures(perturbation_gallery("BallCatch-v0", env_kwargs=dict(renderer="fast")))
    of_images = [name for name, row in PERTURBATIONS.items() if row.kind == "image"]
    assert list(rows) == of_images
    for name, row in rows.items():
        assert (row[0] != row[5]).any(), name
        if name != "dropped_frames":  # the same frame may be the last one that arrived
            assert len({picture.tobytes() for picture in row}) == 6, name


def test_the_gallery_refuses_what_it_cannot_show():
    with pytest.raises(ValueError, match="a gallery shows images"):
        perturbation_gallery("Lava-v0")
    with pytest.raises(ValueError, match="'texture' is unknown"):
        perturbation_gallery("BallCatch-v0", ["texture"], env_kwargs=dict(renderer="fast"))


@pytest.mark.parametrize("kind", ["image", "vector", "any", "action"])
def test_the_page_has_the_table_of_the_severities(kind):
    lines = [
        f"| `{name}` | {row.summary} | {row.parameter} | {' | '.join(f'{value:g}' for value in row.severities)} |"
        for name, row in PERTURBATIONS.items()
        if row.kind == kind
    ]
    text = PAGE.read_text(encoding="utf-8")
    missing = [line for line in lines if line not in text]
    assert not missing, "\n".join(["put into the page:", *lines])
    assert sum(line.startswith("| `") and "standard deviation, scales" in line for line in text.splitlines()) == 1
