"""The zoo's programs and the folders of others: nothing that stands in a file is run."""

import json

import pytest
from small_problems import error_line, tiny_tdpg

from sb3_tdpg.cli import main
from tests.zoo.test_zoo import folder_of, here  # noqa: F401

pytest.importorskip("rl_zoo3")


@pytest.fixture
def folder(here):  # noqa: F811
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


def test_damaged_statistics_are_told_in_a_line(folder, capsys):
    (folder / "Lava-v0" / "config.yml").write_text("normalize: dict(norm_reward=False)\n")
    (folder / "Lava-v0" / "vecnormalize.pkl").write_bytes(b"\x80")
    line = error_line(capsys, "enjoy", "--env", "Lava-v0", "--no-render", "-n", "5")
    assert line.startswith("error: a vecnormalize.pkl in logs is damaged ")


@pytest.mark.parametrize("arguments", [
    ["-params", "n_episodes:[open('{marker}', 'w'), 20][1]"],
    ["--hyperparam", "n_episodes:[open('{marker}', 'w'), 20][1]"],  # the zoo's parser takes abbreviations
    ["--env-kwargs", "action_cost:open('{marker}', 'w')"],
    ["-params", "policy_kwargs:\"open('{marker}', 'w')\""],  # the zoo evaluates this text again
    ["--conf-file", "evil.yml"],
], ids=lambda arguments: arguments[0])  # fmt: skip
def test_a_record_that_would_run_code_is_not_resumed(arguments, folder, here, capsys):  # noqa: F811
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


@pytest.mark.parametrize("content", ["[]", "{", "3", '{"arguments": 3, "seed": 0}', '{"arguments": [], "seed": "a"}'])
def test_a_damaged_record_is_told_in_a_line(content, folder, capsys):
    (folder / "run.json").write_text(content)
    line = error_line(capsys, "train", "--resume", folder)
    assert "run.json does not say how its training was started " in line
