"""Bad input of the zoo's programs is told in one line, before anything is written; parallel trainings share nothing."""

import json
import pickle
import re

import pytest
import yaml
from small_problems import error_line

from sb3_tdpg import TDPG
from tests.zoo.test_zoo import SHORT, folder_of, here, start  # noqa: F401

pytest.importorskip("rl_zoo3")

TRAIN = ["train", "--env", "Lava-v0", "--block", "Lava-v0-logdet", "--verbose", "0"]
TUNE = ["tune", "--env", "Lava-v0", "--block", "Lava-v0-logdet", "-n", "200", "--n-trials", "1"]

BAD = {
    "no steps": ([*TRAIN, "-n", "0"], "-n 0 must be at least 1"),
    "negative steps": ([*TRAIN, "-n", "-5"], "-n -5 must be at least 1"),
    "negative steps of a block": ([*TRAIN, "-params", "n_timesteps:-5"], "n_timesteps: -5, which must be a number of"),
    "no environments": ([*TRAIN, "-params", "n_envs:0"], "n_envs: 0, which must be a number of at least 1"),
    "callback": ([*TRAIN, "-params", "callback:5"], "callback: 5, which must be a class or a list"),
    "seed": ([*TRAIN, "-params", "seed:5"], "seed: 5: give --seed"),
    "device": ([*TRAIN, "--device", "foo"], "device='foo' is unknown"),
    "limit of 0": ([*TUNE, "--cost-limit", "0"], "--cost-limit 0.0 must be a finite number other than 0"),
    "limit of NaN": ([*TUNE, "--cost-limit", "nan"], "--cost-limit nan must be"),
    "infinite limit": ([*TUNE, "--cost-limit", "inf"], "--cost-limit inf must be"),
    "log": ([*TUNE, "--space", "space.yml"], "log: 'maybe', which must be true or false"),
    "record": (["train", "--resume", "empty"], "does not say how its training was started"),
    "empty block": ([*TRAIN, "--block", "Empty-v0", "-conf", "empty.yml"], "has no readable block 'Empty-v0'"),
    "key of a space": ([*TUNE, "--space", "number.yml"], "5 of number.yml is no argument of TDPG"),
    "file of results": (["plot", "--kind", "from-file", "-i", "results.pkl"], "results.pkl` names no results"),
    "optimize": ([*TRAIN, "-optimize"], "sb3-tdpg tune"),
}


@pytest.mark.parametrize("arguments, message", BAD.values(), ids=BAD)
def test_bad_input_is_told_in_a_line_and_leaves_nothing_behind(arguments, message, here, capsys):  # noqa: F811
    (here / "empty").mkdir()
    (here / "empty" / "run.json").write_text("{}")
    (here / "space.yml").write_text(yaml.safe_dump({"learning_rate": dict(low=1.0e-4, high=1.0e-3, log="maybe")}))
    (here / "number.yml").write_text("5: {low: 1, high: 2}\n")
    (here / "empty.yml").write_text("Empty-v0:\n")
    (here / "results.pkl").write_bytes(pickle.dumps({}))
    assert re.search(message, error_line(capsys, *arguments))
    assert not list(here.glob("logs/*/*"))


def test_trainings_that_start_at_once_get_folders_of_their_own(here):  # noqa: F811
    processes = [start(["train", *SHORT, "--seed", str(seed)], here) for seed in range(3)]
    outputs = [process.communicate(timeout=300)[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0, 0], outputs
    seeds = [json.loads((folder_of(here, n) / "run.json").read_text())["seed"] for n in (1, 2, 3)]
    assert sorted(seeds) == [0, 1, 2]
    for n, seed in enumerate(seeds, start=1):
        assert TDPG.load(folder_of(here, n) / "Lava-v0.zip", device="cpu").seed == seed
