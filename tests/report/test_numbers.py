"""The numbers of a report and what its page concludes from them."""

import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from sb3_tdpg.report.charts import comparison_figure
from sb3_tdpg.report.numbers import make_numbers, p_value
from sb3_tdpg.report.page import Page, write_page
from sb3_tdpg.report.plan import Plan
from sb3_tdpg.report.rows import ALL, UNPERTURBED

pytest.importorskip("matplotlib")
pytest.importorskip("rliable")

ROWS = ((UNPERTURBED, 0, "unperturbed"), ("x", 1, "sensor"), ("x", 2, "sensor"), ("Own row", 0, "own"))


def made_up(n_seeds, control=10.0, method=8.0, spread=0.1, rows=ROWS):
    """Records of two methods of which the second is cheaper, if the seeds do not spread much, and suffers more."""
    return pd.DataFrame(
        dict(model=m, train_seed=s, perturbation=p, severity=v, kind=k, episode=e, cost=c + v * slope + spread * s)
        for m, c, slope in (("A", control, 1.0), ("B", method, 1.2))
        for s in range(n_seeds)
        for p, v, k in rows
        for e in range(2)
    )


def numbers_of(*args, **kwargs):
    return make_numbers(made_up(*args, **kwargs))


def page_of(numbers):
    names = {label: [f"{label}{i}.zip" for i in range(numbers.n_models(label))] for label in numbers.models}
    plan = Plan("Mine-v0", {}, {}, 2, 0, False, None)
    return write_page(numbers, Page(plan, (), names, {}, (), "Made.", n_rows=0))


def test_cheaper_and_more_robust_are_two_things():
    (row,) = numbers_of(4).comparisons.query("perturbation == 'x'").to_dict("records")
    assert (row["p_cost"], row["cost"]) == (1.0, "less")
    assert (row["p_added"], row["added"]) == (0.0, "more")


@pytest.mark.parametrize("n_seeds", [1, 2, 3])
def test_nothing_is_clear_of_few_models(n_seeds):
    numbers = numbers_of(n_seeds)
    assert set(numbers.comparisons["cost"]) == set(numbers.comparisons["added"]) == {"undecided"}
    page = page_of(numbers)
    assert "**B compared with A**: undecided." in page
    assert "Which is more robust" not in page
    assert "%" not in page.split("## In short")[1].split("##")[0]
    table = page.split("## Cost under perturbation")[1].split("##")[0]
    assert "**" not in table


def test_of_four_models_each_a_difference_without_exception_is_clear():
    page = page_of(numbers_of(4))
    assert (
        "**B compared with A**: it clearly costs less (a lower cost in 100 % of the pairs of models, p = 0.029)."
        in page
    )
    assert "| x | B | 100% (p = 0.029) | 0% (p = " in page
    assert "| x | 11.65 [" in page  # A, not bold
    assert "**9.95 [" in page


def test_what_overlaps_is_not_bold():
    """The test is clear and the intervals, which are about the middle half of the models, overlap a little."""
    records = made_up(5)
    records.loc[(records["model"] == "B") & (records["train_seed"] == 4), "cost"] += 4
    numbers = make_numbers(records)
    of_b = numbers.groups.query("model == 'B' and perturbation == 'x'").iloc[0]
    of_a = numbers.groups.query("model == 'A' and perturbation == 'x'").iloc[0]
    assert of_b["iqm"] < of_a["low"] < of_b["high"]
    assert not numbers.groups["lowest"].any()
    assert make_numbers(made_up(5)).groups["lowest"].tolist() == [False] * 3 + [True] * 3


@pytest.mark.parametrize(("ours", "theirs", "least"), [
    ([1, 1, 1], [2, 2, 2], 0.1), ([1, 1, 1, 1], [2, 3, 4], 0.05), ([1] * 5, [2, 2], 0.09),
])  # fmt: skip
def test_models_of_equal_cost_are_not_more_certain(ours, theirs, least):
    assert p_value(np.array(ours, dtype=float), np.array(theirs, dtype=float)) >= least


def test_equal_costs_are_no_difference():
    numbers = numbers_of(5, control=8.0, rows=ROWS[:1])
    assert numbers.comparisons["p_cost"].tolist() == [0.5]
    assert "no clear difference (a lower cost in 50 % of the pairs" in page_of(numbers)


def test_there_is_one_verdict_over_all_perturbations_and_then_one_for_each():
    rows = (*ROWS[:3], ("y", 1, "sensor"), ("y", 2, "sensor"))
    page = page_of(numbers_of(4, rows=rows))
    assert "**B compared with A**, mean over all perturbations: it clearly costs less" in page
    assert "One by one, it costs less under 2 of 2 perturbations (x, y)." in page
    assert numbers_of(4, rows=rows).comparisons["perturbation"].tolist() == [UNPERTURBED, "x", "y", ALL]


def test_the_dots_of_a_comparison_are_shares_of_the_first_methods_models():
    records = made_up(4, control=8.0, rows=ROWS[:1])
    records.loc[(records["model"] == "B") & (records["train_seed"] == 0), "cost"] = 8.15  # below two of four
    (axes,) = comparison_figure(make_numbers(records)).axes
    (dots,) = [line for line in axes.lines if line.get_marker() == "." and len(line.get_xdata()) == 4]
    assert sorted(dots.get_xdata()) == [0.125, 0.375, 0.5, 0.625]


def test_of_one_policy_that_fails_or_not_the_share_has_wilsons_interval():
    failures = np.random.default_rng(0).random((3, 40)) < np.array([[0.0], [0.2], [0.4]])
    rows = [("unperturbed", 0, "unperturbed"), ("x", 1, "sensor"), ("x", 2, "sensor")]
    records = pd.DataFrame(
        dict(model="A", train_seed=0, perturbation=p, severity=v, kind=k, episode=e, cost=float(failures[i, e]))
        for i, (p, v, k) in enumerate(rows)
        for e in range(40)
    )
    numbers = make_numbers(records)
    for fails, row in zip(failures, numbers.levels.to_dict("records"), strict=True):
        expected = binomtest(int(fails.sum()), 40).proportion_ci(0.95, "wilson")
        assert (row["low"], row["high"]) == pytest.approx(tuple(expected))
    # The mean of two rows is known better than one row, and never below 0.
    group = numbers.groups.set_index("perturbation").loc["x"]
    assert 0 < group["low"] < group["iqm"] < group["high"]
    assert group["high"] - group["low"] < (numbers.levels["high"] - numbers.levels["low"]).iloc[1:].min()
    records["cost"] += 0.5  # no shares any more
    assert make_numbers(records).levels["low"][0] == 0.5
