"""How runs and frames are written, and what is recorded about their making."""

import json
import math
import subprocess
import sys
from functools import partial

import numpy as np
import pandas as pd
import pytest
import torch as th
from gymnasium import spaces

from sb3_tdpg.common.provenance import (
    check_same_config,
    how_made,
    jsonable,
    provenance,
    write_frame_atomically,
    write_run_config,
)
from sb3_tdpg.paper.ball import gamma
from sb3_tdpg.robustness import PerturbedVecEnv


def test_the_provenance_is_complete_and_plain_json():
    found = provenance()
    assert json.loads(json.dumps(found)) == found
    assert {"python", "sb3_tdpg", "stable-baselines3", "torch", "gymnasium", "numpy"} <= set(found["versions"])
    assert found["versions"]["torch"] in (th.__version__, th.__version__.split("+")[0])
    assert found["git"] is None or (len(found["git"]["commit"]) == 40 and isinstance(found["git"]["dirty"], bool))
    assert {"platform", "cpu_count", "utc_time", "command"} <= set(found)


def test_the_command_is_told_without_the_folders_of_the_machine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    out = tmp_path / "results" / "a b"
    monkeypatch.setattr(
        sys, "orig_argv", [str(tmp_path / "bin" / "python3"), "-m", "sb3_tdpg", "--out", str(out), "./x"]
    )
    assert provenance()["command"] == "python3 -m sb3_tdpg --out 'results/a b' ./x"
    monkeypatch.setattr(sys, "orig_argv", ["/venv/bin/python3", "/venv/bin/sb3-tdpg", "demo", "--out", str(out)])
    assert provenance()["command"] == "sb3-tdpg demo --out 'results/a b'"
    monkeypatch.setattr(sys, "orig_argv", ["python", "train.py"])
    assert provenance()["command"] == "python train.py"


@pytest.mark.parametrize("in_checkout_of_something_else", [False, True])
def test_the_provenance_knows_no_commit_of_an_installed_package(in_checkout_of_something_else, monkeypatch, tmp_path):
    if in_checkout_of_something_else:
        subprocess.run(["git", "init", "-q", tmp_path], check=True)
    package = tmp_path / ".venv" / "sb3_tdpg"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    monkeypatch.setattr("sb3_tdpg.common.provenance.__file__", str(package / "provenance.py"))
    assert provenance()["git"] is None
    assert how_made("make", provenance()).startswith("Made by `make`, 2")


def test_a_run_configuration_holds_what_was_given_and_where_it_came_from(tmp_path):
    path = tmp_path / "new" / "config.json"
    config = dict(beta=math.inf, seeds=np.arange(2), lr=np.float32(0.5), folder=tmp_path, space=spaces.Discrete(2))
    write_run_config(path, config)
    read = json.loads(path.read_text())
    assert float(read["beta"]) == math.inf
    assert (read["seeds"], read["lr"], read["folder"]) == ([0, 1], 0.5, str(tmp_path))
    assert read["provenance"]["versions"]["numpy"] == np.__version__
    assert "provenance" not in config
    assert [file.name for file in path.parent.iterdir()] == ["config.json"]


@pytest.mark.parametrize(("found", "wanted", "told"), [
    (dict(settings=dict(lr=0.001, beta=math.inf)), dict(settings=dict(lr=0.0005, beta=math.inf)),
     "settings.lr: 0.001 there, 0.0005 here"),
    (dict(settings=dict(lr=1)), dict(settings=dict(lr=1, normalize=dict(norm_obs=True))),
     "settings.normalize.norm_obs: not there, true here"),
    (dict(wrappers=[dict(Blind={})]), dict(wrappers=[dict(Faulty={})]),
     "wrappers.0.Blind: {} there, not here; wrappers.0.Faulty: not there, {} here"),
    (dict(seed=0, start=None), dict(seed=0), "start: null there, not here"),
    (dict(rows=[dict(name="a", std=1), dict(name="b", std=1)]), dict(rows=[dict(name="a", std=1), dict(name="b")]),
     "rows.1.std: 1 there, not here"),
    (dict(rows=[dict(name="a")]), dict(rows=[dict(name="a"), dict(name="b")]),
     'rows.1.name: not there, "b" here'),
    (dict(sizes=[64, 64]), dict(sizes=[32, 32]), "sizes: [64, 64] there, [32, 32] here"),
    (dict(a=1, b=1, c=1, d=1, e=1, f=0), dict(a=2, b=2, c=2, d=2, e=2, f=0),
     "a: 1 there, 2 here; b: 1 there, 2 here; c: 1 there, 2 here; and 2 more"),
], ids=str)  # fmt: skip
def test_a_folder_of_another_run_is_refused_with_what_differs(found, wanted, told, tmp_path):
    write_run_config(tmp_path / "config.json", found)
    check_same_config(tmp_path / "config.json", found, "run")
    with pytest.raises(ValueError) as refused:
        check_same_config(tmp_path / "config.json", wanted, "run")
    mend = "choose another folder or remove it"
    assert str(refused.value) == f"{tmp_path} holds a run with other settings, {told}: {mend}"


@pytest.mark.parametrize("name", ["episodes.csv", "episodes.csv.gz", "episodes.csv.xz"])
def test_a_frame_is_written_and_read_back_bit_for_bit(name, tmp_path):
    costs, path = np.random.default_rng(0).standard_normal(40), tmp_path / "new" / name
    records = pd.DataFrame(dict(model="TDPG", scenario=["a", "b"] * 20, cost=costs, length=5))
    write_frame_atomically(records, path)
    pd.testing.assert_frame_equal(pd.read_csv(path), records)
    # pandas' own reader was not exact to the last bit before its version 3.
    assert pd.read_csv(path, converters={"cost": float})["cost"].equals(records["cost"])
    first = path.read_bytes()
    write_frame_atomically(records, path)
    assert path.read_bytes() == first
    assert [file.name for file in path.parent.iterdir()] == [name]
    with pytest.raises(ValueError, match=r"must end in \.csv, \.csv\.gz or \.csv\.xz"):
        write_frame_atomically(records, tmp_path / "episodes.parquet")


def test_what_changes_a_sensor_is_told_alike_by_every_process_and_a_closure_apart():
    sensor = partial(PerturbedVecEnv, perturbation={"images": gamma}, severity=3)
    code = "from sb3_tdpg.paper.ball import *; from sb3_tdpg.common.provenance import jsonable; import json;"
    code += "print(json.dumps(jsonable(partial(PerturbedVecEnv, perturbation={'images': gamma}, severity=3))))"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert json.loads(found) == jsonable(sensor)
    assert jsonable(sensor)["perturbation"] == {"images": "sb3_tdpg.paper.ball.gamma"}
    assert jsonable(partial(PerturbedVecEnv, severity=4)) != jsonable(partial(PerturbedVecEnv, severity=5))
    assert jsonable(lambda x: x) != jsonable(lambda x: x)
