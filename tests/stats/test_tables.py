import pytest

from benchnav.stats.tables import (
    Column,
    cell_of,
    labels_of,
    p_value,
    signed,
    signed_interval,
    table_of,
)


def test_columns_write_their_cells_and_explain_themselves_once() -> None:
    columns = [
        *labels_of("name"),
        Column("Δ\n[m]", cell_of("gap", signed), "difference.", "Δ [m], 95 %"),
        Column("95 %", lambda row: signed_interval(row["low"], row["high"], 2)),
        Column("p\n", cell_of("p", p_value), "test."),
    ]
    rows = [{"name": 3, "gap": -0.04, "low": 0.1, "high": 0.256, "p": 0.0123}]
    table = table_of(rows, columns, title="t")
    assert table.headings == ("name", "Δ\n[m]", "95 %", "p\n")
    assert table.rows == (("3", "+0.0", "+0.10 to +0.26", "0.012"),)
    assert table.explained == (("Δ [m], 95 %", "difference."), ("p", "test."))
    assert table.title == "t"


@pytest.mark.parametrize(
    ("p", "text"), [(1.0, "1"), (0.00011, "0.00011"), (0.0001, "≤ 0.0001")]
)
def test_the_minimum_of_drawn_flips_is_said_to_be_one(p: float, text: str) -> None:
    assert p_value(p) == text


def test_what_is_missing_is_a_dash() -> None:
    nan = float("nan")
    assert signed(nan) == signed_interval(nan, 1.0) == "–"
