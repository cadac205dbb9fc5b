import numpy as np
import pandas as pd

from benchnav.eval.report.result_tables import comparison_table
from benchnav.eval.stats.comparison import compare
from tests.eval.stats.test_comparison import A, B, pair


def cells(table: pd.DataFrame, difference: float = 0.05) -> list[dict[str, str]]:
    shown = comparison_table(table, difference, "risk")
    names = [f"{heading}{i}" if heading == "95 %" else heading for i, heading in enumerate(shown.headings)]
    return [dict(zip(names, row, strict=True)) for row in shown.rows]


def test_success_is_in_points_and_p_is_the_corrected_one() -> None:
    table = compare([pair(A, B), pair(B, A, ("var", "mean"))])
    table["success_p_holm"], table["success_p"] = [0.032, 0.00001], 0.9
    first, second = cells(table)
    assert (first["risk"], first["against"], first["Succ. [%]"], first["Δ [points]"]) == (
        "cvar",
        "mean",
        "75 : 50",
        "+25.0",
    )
    low, high = 100 * table["success_low"][0], 100 * table["success_high"][0]
    assert f"{low:+.1f} to {high:+.1f}" in first.values()
    assert "0.032" in first.values()
    assert first["significant"] == "yes"
    assert "≤ 0.0001" in second.values()
    assert second["Δ [points]"] == "-25.0"


def test_shares_are_not_rounded_to_a_wrong_whole() -> None:
    table = compare([pair([30.0] * 121 + [100.0] * 79, [30.0] * 145 + [100.0] * 55)])
    assert cells(table)[0]["Succ. [%]"] == "60.5 : 72.5"


def test_what_is_not_significant_says_so() -> None:
    table = compare([pair(A, B)])
    assert table["success_p_holm"][0] > 0.05
    assert cells(table)[0]["significant"] == "no"


def test_no_minus_before_a_zero_and_a_dash_for_nothing() -> None:
    (row,) = cells(compare([pair([30.0, 30.0, 100.0], [30.001, 30.001, 100.0])]))
    assert row["Δ T_total [s]"] == "+0.0"
    (row,) = cells(compare([pair([30.0, 100.0], [100.0, 30.0])]))
    assert row["Δ T if both arrive [s]"] == "–"


def test_labels_that_differ_have_a_column_and_notes_name_the_family() -> None:
    table = compare([pair(A, B), pair(A, B)]).assign(planner=["mppi", "cl_rrt"], model="–")
    shown = comparison_table(table, 0.2, "risk")
    assert shown.headings[:3] == ("planner", "risk", "against")
    assert shown.labels == 3
    notes = " ".join(shown.notes)
    assert "Family: 2 pairs" in notes
    needed = np.unique(table["maps_needed"])
    assert f"A difference of 20 points needs {needed[0]} maps" in notes


def test_maps_too_few_to_show_any_difference_say_so() -> None:
    table = compare([pair(A[:4], B[:4]), pair(A * 10, B * 10)])
    few, many = cells(table)
    assert table["success_detectable"][0] > 1
    assert few["detectable"] == "–"
    assert many["detectable"] == f"{100 * table['success_detectable'][1]:.0f}"


def test_what_test_p_is_of_stands_in_heading_and_note() -> None:
    """An interval of the mean that leaves 0 out may stand beside a p of ranks of 1."""
    shown = comparison_table(compare([pair(A, B)]), 0.05, "risk")
    assert shown.headings[shown.headings.index("Δ T_total [s]") + 2] == "p (ranks)"
    notes = " ".join(shown.notes)
    assert "p (ranks): Wilcoxon's signed-rank test of T_total" in notes
    assert "Δ and 95 % are of the mean" in notes
    assert "shares" not in notes


def test_times_in_shares_of_unlike_budgets_say_so() -> None:
    table = compare([pair([30.0, 300, 60], [10.0, 50, 25], budgets_s=(300.0, 100.0))])
    shown = comparison_table(table, 0.05, "risk")
    (row,) = cells(table)
    assert row["Δ T_total [% of T]"] == "+15.0"  # shares 0.1, 1, 0.2 less 0.1, 0.5, 0.25
    assert not [heading for heading in shown.headings if "T_total [s]" in heading]
    assert "in shares of each condition's own T" in " ".join(shown.notes)
