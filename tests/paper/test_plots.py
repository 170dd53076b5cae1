"""The figures of the reproduction."""

import math

import numpy as np
import pytest
from small_problems import tiny_tdpg

from sb3_tdpg.envs.scenarios import LAVA
from sb3_tdpg.evaluation import evaluate_scenarios, save_figure
from sb3_tdpg.paper.plots import cost_histograms, lava_trajectories

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def models():
    return {"PG": tiny_tdpg(beta=math.inf), "TDPG": tiny_tdpg(seed=1)}


def test_the_histograms_have_a_panel_for_each_noise_level_and_show_every_episode(models):
    records = evaluate_scenarios(models, LAVA, 20)
    figure = cost_histograms(records, LAVA[1:])
    assert [axes.get_title() for axes in figure.axes] == [
        r"$\sigma^2 = 10^{-3}$", r"$\sigma^2 = 10^{-2}$", r"$\sigma^2 = 10^{-1}$", r"$\sigma^2 = 1$"
    ]  # fmt: skip
    for axes in figure.axes:
        filled = [sum(bar.get_height() for bar in bars) for bars in axes.containers if len(bars) > 1]
        assert filled == pytest.approx([1.0, 1.0])


def test_the_trajectories_have_a_panel_for_each_model_and_noise_level(models, tmp_path):
    figure = lava_trajectories(models, n_episodes=4)
    panels = figure.axes[:4]
    assert [axes.get_title().splitlines()[0] for axes in panels] == [
        r"PG, $\sigma^2 = 10^{-4}$", r"TDPG, $\sigma^2 = 10^{-4}$", r"PG, $\sigma^2 = 1$", r"TDPG, $\sigma^2 = 1$"
    ]  # fmt: skip
    paths = [[line.get_ydata() for line in axes.lines if len(line.get_ydata()) == 6] for axes in panels]
    assert [len(each) for each in paths] == [4, 4, 4, 4]
    np.testing.assert_array_equal([p[0] for p in paths[0]], [p[0] for p in paths[3]])
    save_figure(figure, tmp_path / "new" / "trajectories.png", dpi=50)
    assert (tmp_path / "new" / "trajectories.png").read_bytes().startswith(b"\x89PNG")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["trajectories.png"]
