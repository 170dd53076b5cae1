"""Bad input of the zoo's programs is told in one line, before anything is written; parallel trainings share nothing."""

import json
import re

import gymnasium as gym
import pytest
from gymnasium.envs.registration import EnvSpec
from programs import start
from small_problems import error_line, tiny_tdpg

from sb3_tdpg import TDPG
from sb3_tdpg.cli import main
from tests.zoo.test_zoo import SHORT, folder_of

pytest.importorskip("rl_zoo3")

TRAIN = ["train", "--env", "Lava-v0", "--block", "Lava-v0-logdet", "--verbose", "0"]
TUNE = ["tune", "--env", "Lava-v0", "--block", "Lava-v0-logdet", "-n", "200", "--n-trials", "1"]

BAD = {
    "wrapper": ([*TRAIN, "-params", "env_wrapper:'gymnasium.Nope'"], "AttributeError: .* 'Nope'"),
    "wrapper's keyword": ([*TRAIN, "-params", "env_wrapper:[{'gymnasium.wrappers.TimeLimit':{'foo':3}}]"],
                          "block Lava-v0-logdet of .* does not fit .TypeError: .*'foo'.*: correct it"),
    "callback's keyword": ([*TRAIN, "-params", "callback:[{'sb3_tdpg.SelectionCallback':{'cost_limt':3}}]"],
                           "does not fit .TypeError: SelectionCallback.*'cost_limt'"),
    "name of a policy": ([*TRAIN, "-params", "policy:'sb3_tdpg.Nope'"], "does not fit .AttributeError: .* 'Nope'"),
    "normalize": ([*TRAIN, "-params", "normalize:'foo'"], "does not fit .NameError: .*'foo' is not defined"),
    "lacking package": (["train", "--env", "Lacking-v0", "--conf-file", "lacking.yml"], "install Box2D"),
    "seed": ([*TRAIN, "-params", "seed:5"], "does not fit .TypeError: .* multiple values for keyword argument 'seed'"),
    "device": ([*TRAIN, "--device", "foo"], "device='foo' is unknown"),
    "infinite limit": ([*TUNE, "--cost-limit", "inf"], "a finite number other than 0: give --cost-limit"),
    "empty block": ([*TRAIN, "--block", "Empty-v0", "-conf", "empty.yml"], "has no readable block 'Empty-v0'"),
    "key of a space": ([*TUNE, "--space", "number.yml"], "5 of number.yml is no argument of TDPG"),
    "ending of the file": (["enjoy", "logs/tdpg_lava", "--env", "Lava-v0"], "give the .zip file"),
    "optimize": ([*TRAIN, "-optimize"], "sb3-tdpg tune"),
    "study": ([*TRAIN, "--storage", "none.log", "--study-name", "a"], "give the best.yml of a study with --conf-file"),
    "environment": (["train", "--env", "Lava-v9"], "Lava-v9 not found .* Lava-v0"),
    "key": ([*TRAIN, "-params", "foo:3"], "does not fit .TypeError: TDPG has no argument 'foo'.: correct it"),
    "number as text": ([*TRAIN[:3], "--conf-file", "text.yml"], "learning_rate: 1e-3.*write 0.001"),
    "no such file": ([*TRAIN, "--conf-file", "none.yml"], "none.yml has no readable block .*No such file"),
    "no YAML": ([*TRAIN, "--conf-file", "broken.yml"], "broken.yml has no readable block .*while parsing"),
    "no block": (["train", "--env", "MountainCar-v0"], "no readable block 'MountainCar-v0' for tdpg .* with --block"),
    "keyword": ([*TRAIN, "--env-kwargs", "bar:1"], "does not fit .TypeError: .*'bar'"),
    "unquoted text": ([*TRAIN, "--env-kwargs", "a:violet"], "'violet' is not defined: .* text in quotes"),
    "setting": ([*TRAIN, "-params", "n_episodes:0"], "n_episodes=0 must be an integer of at least 1"),
    "agent": ([*TRAIN, "-i", "none.zip"], "must be a valid path"),
    "resume": (["train", "--resume", "nothing"], "nothing is not the folder of a training"),
    "no shift": ([*TUNE, "--objective", "shift"], "--objective shift needs --eval-env-kwargs"),
    "no limit": ([*TUNE, "--env", "Pendulum-v1", "--block", "Pendulum-v1-pg"], "a limit on the .*give --cost-limit"),
    "threads": ([*TUNE, "--n-jobs", "2"], "--n-jobs 2 would be threads .* start the same command several times"),
    "space": ([*TUNE, "--space", "none.yml"], "the search space none.yml cannot be read"),
    "a share": ([*TUNE[:3], "--conf-file", "share.yml"], "a limit on the expected cost .*: give --cost-limit"),
    "a class": ([*TUNE[:3], "--conf-file", "class.yml"], "tune writes the best block as YAML.*ReLU"),
    "not for PPO": (["tune", "--algo", "ppo", "--env", "CartPole-v1", "-n", "100", "--cost-limit", "1"],
                    "--cost-limit and --space are for TDPG, not for ppo"),
}  # fmt: skip
BLOCKS = {
    "text": "learning_rate: 1e-3",
    "share": "beta: auto, cost_limit: 95%",
    "class": "policy_kwargs: dict(activation_fn=nn.ReLU)",
}


def lacking():
    raise gym.error.DependencyNotInstalled("install Box2D")


@pytest.mark.parametrize("arguments, message", BAD.values(), ids=BAD)
def test_bad_input_is_told_in_a_line_and_leaves_nothing_behind(arguments, message, here, capsys, monkeypatch):
    (here / "number.yml").write_text("5: {low: 1, high: 2}\n")
    (here / "empty.yml").write_text("Empty-v0:\n")
    (here / "broken.yml").write_text("Lava-v0: {policy\n")
    for name, settings in BLOCKS.items():
        (here / f"{name}.yml").write_text(f"Lava-v0: {{policy: TRVPolicy, n_timesteps: 100, {settings}}}\n")
    (here / "lacking.yml").write_text("Lacking-v0: {policy: TRVPolicy, n_timesteps: 100}\n")
    monkeypatch.setitem(gym.registry, "Lacking-v0", EnvSpec("Lacking-v0", entry_point=lacking))
    given = set(here.iterdir())
    assert re.search(message, error_line(capsys, *arguments))
    assert set(here.iterdir()) - given <= {here / "logs"}
    assert not list(here.glob("logs/*/*"))


def test_trainings_that_start_at_once_get_folders_of_their_own(here):
    processes = [start(["train", *SHORT, "--seed", str(seed)], here) for seed in range(3)]
    outputs = [process.communicate(timeout=300)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], outputs
    seeds = [json.loads((folder_of(here, n) / "run.json").read_text())["seed"] for n in (1, 2, 3)]
    assert sorted(seeds) == [0, 1, 2]
    for n, seed in enumerate(seeds, start=1):
        assert TDPG.load(folder_of(here, n) / "Lava-v0.zip", device="cpu").seed == seed


@pytest.fixture
def folder(here):
    """What a training leaves, without one."""
    folder = folder_of(here)
    tiny_tdpg().save(folder / "Lava-v0.zip")
    (folder / "Lava-v0").mkdir()
    (folder / "Lava-v0" / "args.yml").write_text("env_kwargs: null\n")
    (folder / "Lava-v0" / "config.yml").write_text("policy: TRVPolicy\n")
    return folder


@pytest.mark.parametrize("program", ["enjoy", "record-video"])
@pytest.mark.parametrize(("name", "text", "message"), [
    ("args.yml", "!!python/object/apply:pathlib.Path.touch [{marker}]", "is not plain data that rl-zoo3 wrote"),
    ("args.yml", "3", "expected a mapping, found int"),
    ("args.yml", "a: \0", "special characters are not allowed"),
    ("config.yml", "a: !!python/object/apply:os.system ['touch {marker}']", "is not plain data that rl-zoo3 wrote"),
    ("config.yml", "normalize: open('{marker}', 'w')", "is not evaluated"),
])  # fmt: skip
def test_a_file_that_would_run_code_is_refused_in_a_line(program, name, text, message, folder, capsys):
    marker = folder / "marker"
    (folder / "Lava-v0" / name).write_text(text.format(marker=marker))
    line = error_line(capsys, program, "--env", "Lava-v0", "--no-render", "-n", "5")
    assert name in line and message in line
    assert not marker.exists()


def test_a_folder_of_plain_files_is_played_and_its_author_is_named_first(folder, capsys):
    assert main(["enjoy", "--env", "Lava-v0", "--no-render", "-n", "5", "-f", "logs"]) == 0
    output = capsys.readouterr().out
    assert output.startswith("trusting whoever wrote logs: loading a model unpickles it, which can run any code\n")
    assert "Episode Length 5" in output


@pytest.mark.parametrize("arguments", [
    ["-params", "n_episodes:[open('{marker}', 'w'), 20][1]"],
    ["--hyperparam", "n_episodes:[open('{marker}', 'w'), 20][1]"],  # the zoo's parser takes abbreviations
    ["--env-kwargs", "action_cost:open('{marker}', 'w')"],
    ["-params", "policy_kwargs:\"open('{marker}', 'w')\""],  # the zoo evaluates this text again
    ["--conf-file", "evil.yml"],
], ids=lambda arguments: arguments[0])  # fmt: skip
def test_a_record_that_would_run_code_is_not_resumed(arguments, folder, here, capsys):
    marker = folder / "marker"
    (here / "evil.yml").write_text(
        f"Lava-v0: {{policy: TRVPolicy, n_timesteps: 100, policy_kwargs: \"open('{marker}', 'w')\"}}\n"
    )
    arguments = ["--env", "Lava-v0", "-n", "100", *(text.format(marker=marker) for text in arguments)]
    (folder / "run.json").write_text(json.dumps(dict(arguments=arguments, seed=0)))
    tiny_tdpg().save(folder / "checkpoint.zip")
    line = error_line(capsys, "train", "--resume", folder)
    assert line.endswith("is not evaluated: write numbers, text or lists")
    assert not marker.exists()
    assert (folder / "checkpoint.zip").exists()
