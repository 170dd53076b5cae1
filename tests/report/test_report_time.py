"""What a report costs: a budget of steps, a page that fills as rows finish, information only where it is asked for."""

import re
from unittest.mock import Mock

import gymnasium as gym
import pytest
from small_problems import CountdownEnv, tiny_tdpg
from stable_baselines3 import PPO

from sb3_tdpg.cli import main
from sb3_tdpg.report import main as report_main
from sb3_tdpg.report import plan, robustness_report

pytest.importorskip("matplotlib")
pytest.importorskip("rliable")
pytest.importorskip("markdown_it")


@pytest.mark.parametrize(("kind", "horizon", "n_episodes"), [
    ("vector", 5, 500),
    ("vector", 150, 50),  # of 66: each of 50 environments runs as many
    ("vector", 500, 20),
    ("vector", 27_000, 1),
    ("vector", None, 10),
    (None, 200, 50),
    ("image", 5, 100),
])  # fmt: skip
def test_long_episodes_are_fewer(kind, horizon, n_episodes):
    assert plan.default_episodes(kind, horizon, 10_000) == n_episodes


def report_of(out, models=None, env_id="Lava-v0", **settings):
    defaults = dict(perturbations=["vector_bias"], severities=[1, 5], scenarios=(), n_episodes=3, progress_bar=False)
    models = {"A": tiny_tdpg()} if models is None else models
    return robustness_report(models, env_id, out=out, **(defaults | settings))


def test_a_budget_of_steps_sets_the_episodes(tmp_path):
    assert "every model runs 12 episodes" in report_of(tmp_path, n_episodes=None, n_steps=60)
    with pytest.raises(ValueError, match="n_steps=0 must be an integer of at least 1"):
        report_of(tmp_path / "none", n_steps=0)


def test_the_time_is_estimated_before_the_rows_run(tmp_path, capsys):
    report_of(tmp_path, progress_bar=True)
    assert re.match(r"3 rows of 3 episodes of each model: about \d+ seconds with 1 process;", capsys.readouterr().err)
    report_of(tmp_path, progress_bar=True)
    assert "about" not in capsys.readouterr().err  # nothing is left to run


def test_the_page_of_an_interrupted_report_has_what_is_finished(tmp_path, monkeypatch):
    """A perturbation without its strong severities would look better than it is, so it is left out."""
    run_row, titles = plan.run_row, []

    def interrupted(plan, row, models):
        titles.append(row.title)
        if row.title == "vector_noise 5":
            raise KeyboardInterrupt
        return run_row(plan, row, models)

    monkeypatch.setattr(plan, "run_row", interrupted)
    monkeypatch.setattr(report_main, "PAUSE", 0)
    settings = dict(perturbations=["vector_bias", "vector_noise"])
    with pytest.raises(KeyboardInterrupt):
        report_of(tmp_path, **settings)
    page, html = ((tmp_path / f"report.{suffix}").read_text() for suffix in ("md", "html"))
    assert "**Unfinished**: 3 of 5 conditions so far" in page
    assert "vector_bias" in page
    assert "vector_noise" not in page
    assert '<meta http-equiv="refresh"' in html

    monkeypatch.setattr(plan, "run_row", run_row)
    page = report_of(tmp_path, **settings)
    assert "Unfinished" not in page
    assert "vector_noise" in page
    assert "refresh" not in (tmp_path / "report.html").read_text()


def test_unfinished_pages_take_a_small_share_of_the_time(tmp_path, monkeypatch):
    written, write = [], report_main.to_html
    monkeypatch.setattr(report_main, "to_html", lambda *args, **how: written.append(how) or write(*args, **how))
    names = ["vector_bias", "vector_noise", "vector_scale"]
    report_of(tmp_path, perturbations=names, severities=[5])
    # The first one has a perturbation, and the other rows take less time than four pages.
    assert written == [dict(reload=True), dict(reload=False)]


@pytest.fixture
def few_information_episodes(monkeypatch):
    """Measuring the information takes long."""
    monkeypatch.setattr(report_main, "N_INFORMATION", 150)


@pytest.mark.slow
def test_the_estimates_of_the_information_show_their_progress(tmp_path, capsys, few_information_episodes):
    free = PPO("MlpPolicy", "Lava-v0", n_steps=10, batch_size=10, device="cpu")  # has none
    models = {str(number): model for number, model in enumerate((tiny_tdpg(), free, tiny_tdpg(seed=1)))}
    page = report_of(tmp_path, models, information=True, progress_bar=True)
    shown = capsys.readouterr().err
    assert re.search(r"100%.* 4/4 .*estimate", shown)
    assert "information, 2" in shown
    for words in ("What the policies know", "about the state", "PPO has no task-relevant variables"):
        assert words in page
    report_of(tmp_path, models, information=True)
    assert capsys.readouterr().err == ""


def test_the_command_takes_a_budget_of_steps_and_measures_information_if_asked(tmp_path, monkeypatch):
    given = Mock()
    monkeypatch.setattr("sb3_tdpg.report.robustness_report", given)
    tiny_tdpg().save(tmp_path / "model.zip")
    arguments = ["report", str(tmp_path / "model.zip"), "--env", "Lava-v0", "--out", str(tmp_path / "out")]
    for flags, expected in (([], (10_000, False)), (["--steps", "60", "--information"], (60, True))):
        assert main([*arguments, *flags]) == 0
        assert (given.call_args.kwargs["n_steps"], given.call_args.kwargs["information"]) == expected


class FirstEpisodeEnv(CountdownEnv):
    """All episodes go through the same states."""

    def reset(self, **kwargs):
        self.episode = -1
        return super().reset(**kwargs)


def test_there_is_a_page_where_the_information_cannot_be_measured(tmp_path, registry, few_information_episodes):
    gym.register("Countdown-v0", FirstEpisodeEnv, kwargs=dict(name=0, lengths=(2,)))
    text = report_of(tmp_path, {"A": tiny_tdpg("Countdown-v0")}, "Countdown-v0", information=True)
    assert "not measured: the frame has no component" in text
    assert (tmp_path / "report.html").exists()
