"""Perturbations of the scene reach the image and never the task; the gallery and the page show what there is."""

from pathlib import Path

import numpy as np
import pytest
from gymnasium import spaces
from perturbed_problems import differs, run
from small_problems import lava_env, toy_vec_env

from sb3_tdpg import make_episodes_env
from sb3_tdpg.envs.textures import TRAINING_TEXTURE, load_texture, random_texture
from sb3_tdpg.robustness import PERTURBATIONS, SCENES, perturbation_gallery, scene_perturbations, severity_table

PAGE = Path(__file__).parents[2] / "docs" / "guide" / "perturbations.md"
BASE = {"BallCatch-v0": dict(renderer="fast", horizon=4), "PandaGrasp-v0": {}}
ROWS = [pytest.param(env_id, name, id=f"{env_id}, {name}") for env_id in SCENES for name in SCENES[env_id]]


def rolled_out(env_id, **scene):
    return run(make_episodes_env(env_id, 3, env_kwargs={**BASE[env_id], **scene}, use_processes=False))


@pytest.mark.parametrize(("env_id", "name"), ROWS)
def test_a_scene_reaches_the_image_in_every_episode_and_touches_neither_state_nor_cost(env_id, name):
    expected, distances = rolled_out(env_id), [0.0]
    for scene in scene_perturbations(env_id)[name]:
        shown = rolled_out(env_id, **scene)
        assert differs(shown.observations, expected.observations).all()
        np.testing.assert_array_equal(shown.states, expected.states)
        np.testing.assert_array_equal(shown.rewards, expected.rewards)
        distances.append(np.abs(shown.observations[0].astype(float) - expected.observations[0]).mean())
    assert (np.diff(distances) > 0).all(), distances


def test_an_environment_without_scenes_has_none_and_the_module_may_stand_before_an_id():
    assert scene_perturbations("Pendulum-v1") == {}
    assert scene_perturbations("sb3_tdpg:BallCatch-v0") == scene_perturbations("BallCatch-v0")


def test_a_scene_of_ones_own_needs_five_severities(monkeypatch):
    monkeypatch.setitem(SCENES, "Mine-v0", {"light": (dict(lux=1.0),)})
    with pytest.raises(ValueError, match="has 1 severities, expected 5"):
        scene_perturbations("Mine-v0")


def test_a_texture_gives_way_to_another_one_by_its_share():
    lower, upper = (load_texture(name).astype(float) for name in (TRAINING_TEXTURE, "violet_dots"))
    np.testing.assert_array_equal(load_texture("0%-violet_dots"), lower)
    np.testing.assert_array_equal(load_texture("100%-violet_dots"), upper)
    np.testing.assert_allclose(load_texture("40%-violet_dots"), 0.6 * lower + 0.4 * upper, atol=0.5)
    np.testing.assert_array_equal(load_texture("100%-random-3"), random_texture(3))


@pytest.mark.parametrize("name", ["140%-violet_dots", "40%-drawing.png", "40%-20%-violet_dots"])
def test_a_blend_that_cannot_be_made_is_refused(name):
    with pytest.raises(ValueError, match=r"must be '<0 to 100>%-<name>'"):
        load_texture(name)


def pictures(figure):
    """What is drawn, by row: ``(6, H, W)`` or ``(6, H, W, 3)``."""
    images = [np.asarray(axes.images[0].get_array()) for axes in figure.axes]
    names = [axes.get_ylabel() for axes in figure.axes[::6]]
    return {name: np.stack(images[6 * i : 6 * i + 6]) for i, name in enumerate(names)}


def test_the_gallery_has_a_row_for_all_that_applies_and_no_two_pictures_of_a_row_are_equal():
    rows = pictures(perturbation_gallery("BallCatch-v0", env_kwargs=dict(renderer="fast")))
    of_images = [name for name, row in PERTURBATIONS.items() if row.kind == "image"]
    assert list(rows) == [*of_images, "texture", "camera_pose"]
    for name, row in rows.items():
        assert (row[0] != row[5]).any(), name
        if name != "dropped_frames":  # the same frame may be the last one that arrived
            assert len({picture.tobytes() for picture in row}) == 6, name


def test_the_gallery_takes_an_environment_and_names():
    actions = spaces.Box(0.5, 1, (1,), np.float32)  # without 0
    env = toy_vec_env(observation_space=spaces.Box(0, 255, (3, 36, 36), np.uint8), action_space=actions)
    rows = pictures(perturbation_gallery(env, ["hue", "delay"]))
    assert list(rows) == ["hue", "delay"]


def test_the_gallery_refuses_what_it_cannot_show():
    with pytest.raises(ValueError, match="a gallery shows images"):
        perturbation_gallery(lava_env(2))
    with pytest.raises(ValueError, match="'texture' is unknown"):
        perturbation_gallery(make_episodes_env("BallCatch-v0", 1, env_kwargs=dict(renderer="fast")), ["texture"])
    with pytest.raises(ValueError, match=r"names=\[\] leaves nothing to draw"):
        perturbation_gallery("BallCatch-v0", [])
    with pytest.raises(ValueError, match="give its id in place of it"):
        perturbation_gallery(toy_vec_env(), env_kwargs=dict(renderer="fast"))


@pytest.mark.parametrize("kind", ["image", "vector", "any", "action"])
def test_the_page_has_the_table_of_the_severities(kind):
    lines = [
        f"| `{name}` | {PERTURBATIONS[name].summary} | {row['parameter']} | "
        + " | ".join(f"{row[severity]:g}" for severity in "12345")
        + " |"
        for name, row in severity_table(kind).iterrows()
    ]
    text = PAGE.read_text(encoding="utf-8")
    missing = [line for line in lines if line not in text]
    assert not missing, "\n".join(["put into the page:", *lines])
    assert sum(line.startswith("| `") and "standard deviation, scales" in line for line in text.splitlines()) == 1


def test_the_page_has_the_scenes():
    text = PAGE.read_text(encoding="utf-8")
    for env_id, rows in SCENES.items():
        for name, severities in rows.items():
            values = " | ".join(", ".join(f"{value}" for value in scene.values()) for scene in severities)
            line = f"| `{env_id}` | `{name}` | {', '.join(f'`{key}`' for key in severities[0])} | {values} |"
            assert line in text, f"put into the page: {line}"
