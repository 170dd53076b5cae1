"""From per-episode records to statistics and tables."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from sb3_tdpg.envs.scenarios import PaperResult, Scenario
from sb3_tdpg.evaluation import (
    add_ratio,
    aggregate_seeds,
    comparison_markdown,
    paired_difference,
    probability_of_improvement,
    statistics,
    summary_table,
)


def some_records(costs_by_model, **columns):
    frames = [
        pd.DataFrame(dict(model=model, scenario=scenario, cost=costs, seed=0, deterministic=False, **columns))
        for model, by_scenario in costs_by_model.items()
        for scenario, costs in by_scenario.items()
    ]
    return pd.concat(frames, ignore_index=True)


def of_seeds(n, costs_of):
    """Records of training seeds, of which ``costs_of(i)`` gives the costs."""
    return pd.concat([some_records(costs_of(i), train_seed=i) for i in range(n)])


def test_the_summary_has_the_statistics_of_the_costs_in_the_order_of_the_records():
    costs = {"B": {"y": [1.0, 2.0, 6.0], "x": [4.0, 4.0, 4.0]}, "A": {"y": [0.0, 0.0, 3.0]}}
    table = summary_table(some_records(costs))
    assert table[["model", "scenario"]].to_numpy().tolist() == [["B", "y"], ["B", "x"], ["A", "y"]]
    assert table["n"].tolist() == [3, 3, 3]
    assert table["mean"].tolist() == [3.0, 4.0, 1.0]
    assert table["median"].tolist() == [2.0, 4.0, 0.0]
    assert table["std"][0] == pytest.approx(7**0.5)
    assert table["sem"][0] == pytest.approx((7 / 3) ** 0.5)
    assert "failure_share" not in table


def test_the_ratio_is_to_the_same_models_row_of_the_same_seed():
    first = some_records({"A": {"Training": [2.0], "x": [3.0]}, "B": {"Training": [4.0], "x": [4.0]}}, train_seed=0)
    second = some_records({"A": {"Training": [1.0], "x": [3.0]}}, train_seed=1)
    table = add_ratio(summary_table(pd.concat([first, second])))
    assert table["ratio"].tolist() == [1.0, 1.5, 1.0, 1.0, 1.0, 3.0]
    with pytest.raises(ValueError, match="'nowhere' is not a scenario"):
        add_ratio(table, "nowhere")


def test_the_aggregate_over_seeds_ignores_an_outlier_but_shows_it():
    means = [10.0, 11.0, 12.0, 13.0, 14.0, 15.0, 16.0, 500.0]
    records = of_seeds(8, lambda i: {"A": {"x": [means[i] - 1, means[i] + 1]}})
    (row,) = aggregate_seeds(records).to_dict("records")
    assert (row["n_seeds"], row["n"], row["min"], row["max"]) == (8, 2, 10.0, 500.0)
    assert row["iqm"] == 13.5
    assert 10.0 <= row["low"] < 13.5 < row["high"] < 500.0
    assert row["episode_std"] == pytest.approx(2**0.5)
    assert aggregate_seeds(records).equals(aggregate_seeds(records))


def test_the_bootstrap_interval_covers_the_truth_about_as_often_as_it_says(monkeypatch):
    monkeypatch.setattr(statistics, "LEVEL", 0.9)
    monkeypatch.setattr(statistics, "N_BOOTSTRAP", 300)
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(100):
        records = some_records({"A": {"x": [0.0]}}, train_seed=0).loc[[0] * 20]
        records = records.assign(train_seed=range(20), cost=rng.standard_normal(20))
        (row,) = aggregate_seeds(records).to_dict("records")
        hits += row["low"] <= 0.0 <= row["high"]
    assert 78 <= hits <= 98


def test_the_probability_of_improvement_is_that_of_a_seed_of_one_against_a_seed_of_the_other():
    """By hand: of the 9 pairs of seeds, by their means over both scenarios, A wins 4."""
    costs = {"A": {"x": [1.0, 2.0, 5.0], "y": [3.0, 4.0, 9.0]}, "B": {"x": [4.0, 6.0, 1.0], "y": [8.0, 4.0, 2.0]}}
    # means: A 2, 3, 7; B 6, 5, 1.5
    records = of_seeds(3, lambda i: {m: {s: [c[i], c[i]] for s, c in rows.items()} for m, rows in costs.items()})
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    value, low, high = probability_of_improvement(records, "A", "B")
    assert value == pytest.approx(4 / 9)
    assert 0 <= low < value < high <= 1
    assert probability_of_improvement(records, "A", "B") == (value, low, high)
    assert probability_of_improvement(records, "B", "A")[0] == pytest.approx(1 - value)
    assert (np.random.get_state()[1] == before).all()  # noqa: NPY002


def test_a_paired_difference_is_taken_seed_by_seed():
    """What the seeds have in common, here from 0 to 100, does not widen the interval."""
    common = [0.0, 30.0, 60.0, 100.0]
    gains = [1.0, 2.0, 1.0, 2.0]
    records = of_seeds(4, lambda i: {"A": {"x": [common[i] - gains[i]] * 2}, "B": {"x": [common[i]] * 2}})
    value, low, high = paired_difference(records, "A", "B")
    assert value == pytest.approx(-1.5)
    assert -2 <= low < -1.5 < high <= -1
    assert paired_difference(records.sample(frac=1, random_state=0), "A", "B") == (value, low, high)
    with pytest.raises(ValueError, match=r"the seeds of 'A' are \[0, 1, 2, 3\], those of 'B' \[0, 1\]"):
        paired_difference(records[(records["model"] == "A") | (records["train_seed"] < 2)], "A", "B")


def test_what_is_missing_does_not_change_a_comparison_in_silence():
    by_model = {"A": {"x": [1.0], "y": [10.0]}, "B": {"x": [2.0], "y": [11.0]}}
    records = of_seeds(2, lambda i: by_model)
    is_left = (records["model"] == "B") & (records["scenario"] == "y") & (records["train_seed"] == 1)
    for compare in (paired_difference, probability_of_improvement):
        with pytest.raises(ValueError, match=r"lack a scenario that others have: \[\('B', 1\)\]"):
            compare(records[~is_left], "B", "A")
    with pytest.raises(ValueError, match="1 of 8 episodes cost NaN"):
        summary_table(records.assign(cost=records["cost"].where(~is_left)))
    untrained = some_records({"C": {"x": [1.0]}})
    assert set(summary_table(pd.concat([records, untrained]))["model"]) == {"A", "B", "C"}


def test_scenarios_of_the_same_seeds_do_not_narrow_the_interval():
    """Seven copies of a scenario tell no more than one."""
    rng = np.random.default_rng(0)
    costs = {m: rng.normal(size=5) for m in ("A", "B")}
    widths = []
    for n in (1, 7):
        records = of_seeds(5, lambda i, n=n: {m: {f"s{j}": [c[i]] * 2 for j in range(n)} for m, c in costs.items()})
        _, low, high = probability_of_improvement(records, "A", "B")
        widths.append(high - low)
    assert widths[0] == pytest.approx(widths[1])


SCENARIOS = (
    Scenario("a|b", "Lava-v0", paper=dict(PG=PaperResult(1.0, 0.5), TDPG=PaperResult(2.0, 0.25))),
    Scenario("second", "Lava-v0"),
)


def test_the_markdown_table_has_ours_beside_the_papers_and_the_best_in_bold():
    records = some_records(
        {"PG": {"second": [9.0, 9.0], "a|b": [4.0, 6.0]}, "TDPG": {"a|b": [3.0, 3.0], "second": [9.5, 9.5]}}
    )
    lines = comparison_markdown(summary_table(records), SCENARIOS).splitlines()
    assert lines == [
        "| Scenario | PG | PG (paper) | TDPG | TDPG (paper) |",
        "| --- | ---: | ---: | ---: | ---: |",
        r"| a\|b | 5.00 (1.41) | **1.00 (0.50)** | **3.00 (0.00)** | 2.00 (0.25) |",
        "| second | **9.00 (0.00)** |  | 9.50 (0.00) |  |",
        "",
        "Mean episode cost (standard deviation over episodes); the paper's columns: mean (standard deviation). "
        "2 episodes per scenario, evaluation seed 0, stochastic policy. Lowest in bold.",
    ]
    without_std = [replace(SCENARIOS[0], paper=dict(PG=PaperResult(8.702, distance=0.085)))]
    lines = comparison_markdown(summary_table(records[:2].assign(scenario="a|b")), without_std).splitlines()
    assert lines[2] == r"| a\|b | 9.00 (0.00) | 8.70 |"
    assert "the paper's columns: mean. " in lines[4]


def test_the_markdown_table_over_seeds_shows_the_interval_if_there_are_several():
    records = of_seeds(4, lambda i: {"ours": {"a|b": [float(i)] * 2}})
    text = comparison_markdown(aggregate_seeds(records.assign(seed=records["train_seed"])), SCENARIOS[:1])
    assert r"| a\|b | 1.50 [" in text  # alone in its row: nothing to mark
    assert "over 4 training seeds [95% bootstrap interval over seeds]" in text
    assert "evaluation seed 0, 1, 2, 3, stochastic" in text
    assert "paper" not in text  # a model by another name than the paper's has nothing beside it
    alone = aggregate_seeds(records[records["train_seed"] == 1])
    (row,) = alone.to_dict("records")
    assert row["low"] == row["iqm"] == row["high"] == 1.0
    text = comparison_markdown(alone, SCENARIOS[:1])
    assert r"| a\|b | 1.00 |" in text
    assert "Mean episode cost of one training seed, hence without an interval." in text


def test_a_table_that_cannot_be_made_is_an_error_that_says_why():
    records = some_records({"A": {"x": [1.0]}})
    with pytest.raises(ValueError, match="no column train_seed"):
        aggregate_seeds(records)
    with pytest.raises(ValueError, match=r"no row for the scenarios \['second'\]"):
        comparison_markdown(summary_table(some_records({"A": {"a|b": [1.0]}})), SCENARIOS)
    twice = of_seeds(2, lambda i: {"A": {"a|b": [1.0]}})
    with pytest.raises(ValueError, match="use aggregate_seeds"):
        comparison_markdown(summary_table(twice), SCENARIOS[:1])
