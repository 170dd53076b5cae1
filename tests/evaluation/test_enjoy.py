"""``python -m sb3_tdpg enjoy``: episodes of a saved model, printed and recorded as a video."""

import math
import re
import shutil
import sys
from functools import partial
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
from gymnasium import spaces
from PIL import Image
from small_problems import ToyEnv, error_line, tiny_tdpg
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize, unwrap_vec_normalize

from sb3_tdpg.cli import main, parse_keywords
from sb3_tdpg.evaluation.animation import Episode, save_animation
from sb3_tdpg.evaluation.enjoy import enjoy
from sb3_tdpg.evaluation.loading import load_model
from sb3_tdpg.evaluation.randomness import evaluation_seeds

pytest.importorskip("matplotlib")

# Every episode starts alike, so that only the policy's noise can make a difference.
SAME_START = dict(renderer="fast", robot_range=[0.5, 0.5])


class PictureEnv(ToyEnv):
    """A discrete problem whose picture is small, and which ends early now and then."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}

    def __init__(self, render_mode=None):
        super().__init__(action_space=spaces.Discrete(2), horizon=3)
        self.render_mode = render_mode

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated or self.x > 0, truncated, info

    def action_masks(self):
        return np.array([False, True])

    def render(self):
        return np.full((30, 50, 3), int(100 * (self.x + 1)), np.uint8)


@pytest.fixture(scope="module")
def lava(tmp_path_factory):
    path = tmp_path_factory.mktemp("lava") / "model.zip"
    tiny_tdpg().save(path)
    return path


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    path = tmp_path_factory.mktemp("ball") / "model.zip"
    tiny_tdpg("BallCatch-v0", beta=1.0).save(path)
    return path


@pytest.fixture
def own(registry, tmp_path):
    """Register PictureEnv for one test; the file of a model for it."""
    gym.register("Own-v0", PictureEnv)
    path = tmp_path / "own.zip"
    tiny_tdpg("Own-v0").save(path)
    return path


def frames_of(path):
    """Every frame of a GIF as an array, and for how many ms it is shown."""
    with Image.open(path) as film:
        frames, durations = [], []
        for i in range(film.n_frames):
            film.seek(i)
            frames.append(np.asarray(film.convert("RGB")))
            durations.append(film.info["duration"])
    return frames, durations


def animate(path, n_trvs, trv=0.0):
    """Record three steps with white pictures and constant TRVs."""
    pictures = [np.full((40, 400, 3), 255, np.uint8)] * 4
    save_animation([Episode(pictures, np.full((3, n_trvs), trv), np.ones(3))], path, horizon=3, fps=1000)
    return path


def costs_printed(text):
    return [float(cost) for cost in re.findall(r"episode \d+: cost (\S+)(?:,|\n)", text)]


def test_each_episodes_cost_and_final_state_are_printed_and_no_file_is_written(lava, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["enjoy", str(lava), "--env", "Lava-v0", "--n-episodes", "3"]) == 0
    printed = capsys.readouterr().out
    assert re.search(r"episode 3: cost \d+\.\d\d, final state \[.+\]\n", printed)
    costs = costs_printed(printed)
    assert len(set(costs)) == 3
    mean = float(re.search(r"mean cost (\S+)", printed)[1])
    assert mean == pytest.approx(np.mean(costs), abs=0.01)
    assert not list(tmp_path.iterdir())


def test_the_same_seed_gives_the_same_episodes_and_another_seed_others(lava, capsys):
    printed = []
    for arguments in (["--seed", "1"], ["--seed", "1", "--n-episodes", "2"], ["--seed", "2"]):
        main(["enjoy", str(lava), "--env", "Lava-v0", *arguments])
        printed.append(capsys.readouterr().out.splitlines()[1])
    assert printed[0] == printed[1] != printed[2]


def test_a_deterministic_policy_repeats_an_episode_that_starts_alike(ball):
    first, second = enjoy(ball, "BallCatch-v0", SAME_START, n_episodes=2, deterministic=True)
    np.testing.assert_array_equal(first.signals, second.signals)
    np.testing.assert_array_equal(first.costs, second.costs)
    first, second = enjoy(ball, "BallCatch-v0", SAME_START, n_episodes=2)
    assert not np.array_equal(first.signals, second.signals)


def test_recording_does_not_change_the_episodes(ball, tmp_path):
    settings = dict(env_kwargs=dict(SAME_START, pixel_noise_std=0.1, renderer="fast"), n_episodes=1)
    episodes = enjoy(ball, "BallCatch-v0", **settings)
    recorded = enjoy(ball, "BallCatch-v0", **settings, record=tmp_path / "film.mp4")
    for episode, seen in zip(episodes, recorded, strict=True):
        np.testing.assert_array_equal(episode.signals, seen.signals)
        np.testing.assert_array_equal(episode.costs, seen.costs)


def test_keywords_of_the_environment_reach_it(ball, tmp_path, capsys):
    keywords = ["renderer=fast", "texture=violet_dots", "robot_range=[0.5, 0.5]", "control_gain=1.0e-9"]
    film = tmp_path / "film.gif"
    command = ["enjoy", str(ball), "--env", "BallCatch-v0", "--record", str(film)]
    assert main([*command, "--env-kwargs", *keywords[:2], "--env-kwargs", *keywords[2:]]) == 0
    printed = capsys.readouterr().out
    assert "final state [ 0.5 " in printed, "a robot that starts there and cannot move ends there"
    assert f"the video is {film}\n" in printed
    red, green, blue = frames_of(film)[0][0][:200, 400:500].reshape(-1, 3).mean(0)
    assert min(red, blue) > 1.2 * green, "the wall is not violet"


def test_a_gif_has_a_frame_for_each_state_and_holds_the_last_one(lava, tmp_path):
    path = tmp_path / "made" / "film.gif"
    assert main(["enjoy", str(lava), "--env", "Lava-v0", "--n-episodes", "2", "--record", str(path)]) == 0
    frames, durations = frames_of(path)
    assert durations == 2 * (5 * [500] + [1000])  # lava is drawn twice a second
    assert {frame.shape for frame in frames} == {(96 + 216, 480, 3)}
    assert [file.name for file in path.parent.iterdir()] == ["film.gif"]


def test_a_frame_has_the_environments_picture_above_the_lines_up_to_the_present(lava, tmp_path):
    (episode,) = enjoy(lava, "Lava-v0", record=tmp_path / "film.gif")
    frames, _ = frames_of(tmp_path / "film.gif")
    for frame, picture in zip(frames, episode.pictures, strict=True):
        assert np.abs(frame[: len(picture)].astype(int) - picture).mean() < 4  # a GIF has 256 colours
        # Neither the axis of the TRVs moves, nor that of the time.
        np.testing.assert_array_equal(frame[137:, :70], frames[0][137:, :70])
        np.testing.assert_array_equal(frame[272:], frames[0][272:])
    # The first TRV is drawn in vermillion, in columns 74 to 389; right of them is the legend.
    lines = [(np.abs(frame[127:262, 74:389].astype(int) - (0xD5, 0x5E, 0x00)).sum(-1) < 60) for frame in frames]
    reach = [np.flatnonzero(line.any(0)).max() for line in lines]
    assert reach == sorted(reach)
    assert reach[0] < 10
    steps = np.diff(reach[:5])
    np.testing.assert_allclose(steps, (389 - 74) / 5, atol=3)  # the axis goes to the horizon of 5
    assert reach[5] == reach[4], "there is no x~_T"


def test_a_small_picture_is_enlarged_and_an_episode_may_end_early(own, tmp_path):
    episodes = enjoy(own, "Own-v0", n_episodes=6, record=tmp_path / "film.gif")
    assert {len(episode.signals) for episode in episodes} == {1, 3}
    frames, _ = frames_of(tmp_path / "film.gif")
    assert len(frames) == sum(len(episode.signals) + 1 for episode in episodes)
    assert frames[0].shape == (8 * 30 + 180, 8 * 50, 3)


@pytest.mark.parametrize(("render", "message"), [
    (dict(return_value=None), "must return an array (height, width, 3) of uint8"),
    (dict(side_effect=gym.error.DependencyNotInstalled("no pygame")), "cannot be drawn: no pygame"),
], ids=["nothing", "no package"])  # fmt: skip
def test_an_environment_that_cannot_draw_is_not_recorded(render, message, own, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(PictureEnv, "render", Mock(**render))
    assert message in error_line(capsys, "enjoy", own, "--env", "Own-v0", "--record", tmp_path / "film.gif")
    assert not (tmp_path / "film.gif").exists()


def test_few_trvs_are_lines_and_many_are_rows_of_colours_up_to_the_present_step(tmp_path):
    for n_trvs, trv, is_coloured in ((8, 5.0, False), (9, 5.0, True), (20, 0.0, False)):
        frames, durations = frames_of(animate(tmp_path / "film.gif", n_trvs, trv))
        assert durations == [20, 20, 20, 1000]  # viewers slow down frames of less than 20 ms
        panels = [frame[40 + 26 : -42, 62:-76].astype(int) for frame in frames]
        # The largest value is dark red, and so is the whole row up to the present step.
        red = [((x[..., 0] > x[..., 1] + 60) & (x[..., 0] > x[..., 2] + 60)).mean() for x in panels]
        assert (red[2] > 0.5) == is_coloured
        if is_coloured:
            assert red[0] < red[1] < red[2]
            assert red[0] == pytest.approx(red[2] / 3, abs=0.05)


def test_an_mp4_is_written_without_an_ffmpeg_on_the_path(lava, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", "")
    enjoy(lava, "Lava-v0", record=tmp_path / "film.mp4")
    assert (tmp_path / "film.mp4").read_bytes()[4:8] == b"ftyp"
    assert [file.name for file in tmp_path.iterdir()] == ["film.mp4"]


def test_a_grasp_is_shown_from_beginning_to_end(tmp_path):
    env = gym.make("PandaGrasp-v0")
    tiny_tdpg(env).save(tmp_path / "model.zip")
    (episode,) = enjoy(tmp_path / "model.zip", "PandaGrasp-v0", record=tmp_path / "film.gif")
    frames, _ = frames_of(tmp_path / "film.gif")
    assert len(episode.between[0]) > 5
    assert len(frames) == len(episode.pictures) + len(episode.between[0])
    times = [time for time, _ in episode.film()]
    assert [times[0], *times, times[-1]] == [0.0, *sorted(times), 1.0]


def test_keywords_are_read_as_yaml():
    values = {
        "violet_dots": "violet_dots", "0.2": 0.2, "1e-3": 0.001, "[[8.0, 1], [8, 1e0]]": [[8.0, 1], [8, 1.0]],
        "null": None, "true": True, "7": 7, "x=y": "x=y", "'007'": "007", "info": "info", "-.5": -0.5, "inf": math.inf,
        "1/25": "1/25",
    }  # fmt: skip
    read = parse_keywords([f"{chr(97 + i)}={text}" for i, text in enumerate(values)])
    assert [(type(value), value) for value in read.values()] == [(type(value), value) for value in values.values()]


@pytest.mark.parametrize(("texts", "message"), [
    (["texture"], "'texture' is not a keyword .* key=value"),
    (["=3"], "'=3' is not a keyword"),
    (["a b=3"], "'a b=3' is not a keyword"),
    (["a=[1, 2"], "must be YAML"),
    (["a=1", "a=2"], "a is given twice"),
], ids=str)  # fmt: skip
def test_a_keyword_that_cannot_be_read_is_refused(texts, message):
    with pytest.raises(ValueError, match=message):
        parse_keywords(texts)


@pytest.mark.parametrize(("arguments", "fragments"), [
    (["--env", "Nope-v0"], ["Nope", "cannot be made"]),
    (["--env", "BallCatch-v0", "--env-kwargs", "renderer=fast"], ["observation_space", "does not fit"]),
    (["--env", "Lava-v0", "--env-kwargs", "horizon=7"], ["horizon of 5", "has 7"]),
    (["--env", "Lava-v0", "--env-kwargs", "depth=1"], ["depth"]),
    (["--env", "Lava-v0", "--seed", "-1"], ["seed=-1 must be an integer of at least 0"]),
    (["--env", "Lava-v0", "--record", "film.avi"], ["film.avi", "'.avi'", ".gif or .mp4"]),
    (["--env", "Lava-v0", "--record", "film.gif", "--env-kwargs", "render_mode=null"], ["None", "'rgb_array'"]),
], ids=str)  # fmt: skip
def test_bad_input_is_reported_in_one_line_with_exit_code_2(arguments, fragments, lava, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["enjoy", str(lava), *arguments]) == 2
    captured = capsys.readouterr()
    (line,) = captured.err.strip().splitlines()
    assert line.startswith("error: ")
    assert all(fragment in line for fragment in fragments), line
    assert "episode 1" not in captured.out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("make", "message"), [
    (lambda path: None, "cannot be read (No such file"),
    (lambda path: path.mkdir(), "cannot be read (Is a directory)"),
    (lambda path: path.write_text("text"), "cannot be read (File is not a zip file)"),
], ids=["nothing", "folder", "text"])  # fmt: skip
def test_what_is_no_model_is_reported_in_one_line_with_exit_code_2(make, message, tmp_path, capsys):
    make(tmp_path / "model.zip")
    assert message in error_line(capsys, "enjoy", tmp_path / "model.zip", "--env", "Lava-v0")


def test_without_ffmpeg_an_mp4_is_refused_before_an_episode_is_run(lava, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("PATH", "")
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main(["enjoy", str(lava), "--env", "Lava-v0", "--record", str(tmp_path / "film.mp4")]) == 2
    captured = capsys.readouterr()
    assert "ffmpeg" in captured.err
    assert "use .gif" in captured.err
    assert "episode 1" not in captured.out


def test_ctrl_c_has_exit_code_130_and_leaves_no_file(lava, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sb3_tdpg.envs.lava.LavaEnv.step", Mock(side_effect=KeyboardInterrupt))
    assert main(["enjoy", str(lava), "--env", "Lava-v0", "--record", str(tmp_path / "film.gif")]) == 130
    assert capsys.readouterr().err.strip() == "interrupted"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("algorithm", ["A2C", "DQN", "MaskablePPO", "PPO", "RecurrentPPO", "TRPO"])
def test_models_of_other_algorithms_are_played(algorithm, own, tmp_path, capsys):
    make = getattr(stable_baselines3, algorithm, None) or getattr(sb3_contrib, algorithm)
    policy = "MlpLstmPolicy" if algorithm == "RecurrentPPO" else "MlpPolicy"
    make(policy, "Own-v0", seed=0, device="cpu").save(own)
    assert type(load_model(own, "Own-v0", {})) is make
    film = tmp_path / "film.gif"
    episodes = enjoy(own, "Own-v0", n_episodes=3, record=film)
    costs = [episode.costs.sum() for episode in episodes]
    assert costs_printed(capsys.readouterr().out) == pytest.approx(costs, abs=0.01)
    for episode in episodes:
        assert episode.signals.shape == (len(episode.costs), 1)  # the actions
        assert set(episode.signals.ravel()) <= ({1} if algorithm == "MaskablePPO" else {0, 1})
    assert len(frames_of(film)[0]) == sum(len(episode.costs) + 1 for episode in episodes)


@pytest.mark.filterwarnings("ignore:You are trying to run PPO")
@pytest.mark.parametrize("is_normalized_first", [True, False])  # as the zoo does it
def test_a_model_plays_with_the_statistics_and_the_stack_of_its_training(is_normalized_first, tmp_path):
    def wrapped(env, normalized):
        return VecFrameStack(normalized(env), 3) if is_normalized_first else normalized(VecFrameStack(env, 3))

    trained = wrapped(make_vec_env("Pendulum-v1", 2, seed=0), partial(VecNormalize, norm_reward=False))
    model = PPO("MlpPolicy", trained, n_steps=20, batch_size=10, seed=0, device="cpu").learn(40)
    model.save(tmp_path / "Pendulum-v1.zip")
    (tmp_path / "Pendulum-v1").mkdir()
    statistics = tmp_path / "Pendulum-v1" / "vecnormalize.pkl"
    model.get_vec_normalize_env().save(statistics)
    (episode,) = enjoy(tmp_path / "Pendulum-v1.zip", "Pendulum-v1", deterministic=True)

    env = wrapped(make_vec_env("Pendulum-v1", 1), partial(VecNormalize.load, statistics))
    env.unwrapped.seed(evaluation_seeds(0).env)
    unwrap_vec_normalize(env).training = False
    observation = env.reset()
    for expected in episode.signals:
        action, _ = model.predict(observation, deterministic=True)
        np.testing.assert_allclose(action[0], expected, rtol=1e-5)
        observation, *_ = env.step(action)


def test_an_unknown_environment_is_told_in_a_line_also_for_a_model_with_statistics(lava, tmp_path, capsys):
    model = shutil.copy(lava, tmp_path)
    (tmp_path / "vecnormalize.pkl").touch()
    assert "Nope-v0 cannot be made" in error_line(capsys, "enjoy", model, "--env", "Nope-v0")


def test_a_model_of_another_environment_is_not_taken_for_a_stack(tmp_path, capsys):
    PPO("MlpPolicy", "CartPole-v1", n_steps=10, batch_size=10, device="cpu").save(tmp_path / "model.zip")
    # 4 components there, 2 here.
    assert "does not fit" in error_line(capsys, "enjoy", tmp_path / "model.zip", "--env", "Lava-v0")
