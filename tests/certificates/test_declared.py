"""Certificates for a declared nuisance: no random member costs more than its bound."""

import pandas as pd
import pytest
from small_problems import tiny_tdpg, train_epochs

from sb3_tdpg.certificates.declared import FAMILY, nuisance_table
from sb3_tdpg.cli import main


def test_certified_bounds_hold_for_random_members(tmp_path):
    model = tiny_tdpg("Lava-v0", n_episodes=100, nuisance="vector_bias")
    train_epochs(model, 3)
    model.save(tmp_path / "model.zip")
    declared = "{vector_noise: [1, 5], vector_bias: 2}"
    command = ["certify", str(tmp_path / "model.zip"), "--env", "Lava-v0", "--nuisance", declared, "--members", "20"]
    main([*command, "--n-episodes", "2000", "--n-test-episodes", "200", "--out", str(tmp_path / "out")])
    records = pd.read_csv(tmp_path / "out" / "nuisance.csv")
    assert len(records) == 21
    assert (records["clipped_cost"] <= records["bound"]).all()
    assert records["kl"].nunique() > 15  # another member, another divergence
    assert (records["measured_kl"] <= records["kl"] + 1e-6).mean() > 0.9
    assert "random members" in (tmp_path / "out" / "summary.md").read_text()


def test_the_two_kinds_of_certificates_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tiny_tdpg("Lava-v0", n_episodes=2).save("model.zip")
    command = ["certify", "model.zip", "--env", "Lava-v0", "--n-episodes", "500"]
    assert main(command) == 0
    assert main([*command, "--nuisance", "vector_bias", "--members", "1", "--n-test-episodes", "2"]) == 0
    assert {path.parent.name for path in tmp_path.glob("results/*/summary.md")} == {"certificate", "nuisance"}


@pytest.mark.parametrize(("arguments", "fragment"), [
    (["--nuisance", "vector_bias", "--random-shifts", "3"], "leave them or --nuisance out"),
    (["--nuisance", "{"], "is not YAML"),
    (["--nuisance", "fog"], "perturbation='fog' is unknown"),
    (["--nuisance", "auto"], "is none for"),
    (["--nuisance", "actuator_gain"], "changes the actions"),
])  # fmt: skip
def test_wrong_arguments_of_certify_are_explained(arguments, fragment, tmp_path, capsys):
    model = tiny_tdpg("Lava-v0")
    model.save(tmp_path / "model.zip")
    assert main(["certify", str(tmp_path / "model.zip"), "--env", "Lava-v0", "--out", str(tmp_path), *arguments]) != 0
    assert fragment in capsys.readouterr().err


def test_a_cost_above_its_bound_counts_from_three_standard_errors_on():
    errors_above = [-5.0, 0.0, 2.0, 2.9, 3.1, 10.0]
    numbers = dict(model="policy", training_cost=1.0, bound=10.0, standard_error=0.5)
    rows = [dict(shift=FAMILY, clipped_cost=5.0, **numbers)]
    rows += [dict(shift=f"member {x}", clipped_cost=10.0 + 0.5 * x, **numbers) for x in errors_above]
    heads, _, cells = (
        [x.strip() for x in line.split("|")] for line in nuisance_table(pd.DataFrame(rows), 50.0).split("\n")
    )
    table = dict(zip(heads, cells, strict=True))
    assert (table["random members"], table["cost above the bound"]) == ("6", "4")
    assert table["by more than 3 standard errors"] == "2"
