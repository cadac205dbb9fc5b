import numpy as np
import pandas as pd

from benchnav.eval.folder.run_folder import differences, differing_columns


def rows(**changes: list[object]) -> pd.DataFrame:
    columns = {
        "condition": ["a", "a", "b"], "seed": [0, 0, 0], "realisation": [0, 1, 0], "map": [4, 4, 4],
        "outcome": ["success", "timeout", "success"], "total_time_s": [1.0, 40.0, 3.0],
        "time_ratio": [1.5, np.nan, 1.25], "planning_ms": [0.1, 0.2, 0.3],
    }  # fmt: skip
    return pd.DataFrame(columns | changes)


def told(
    one: pd.DataFrame, other: pd.DataFrame
) -> dict[tuple[object, ...], tuple[object, object]]:
    """What each cell that differs holds in two tables, by episode and column."""
    cells, lacking = differences(one, other)
    assert lacking.empty
    return {
        place: tuple(values)
        for place, values in zip(cells.index, cells.to_numpy(), strict=True)
    }


def test_the_same_rows_in_another_order_are_the_same() -> None:
    again = rows(planning_ms=[7.0, 8.0, 9.0]).iloc[::-1]
    assert told(rows(), again) == {}
    assert differing_columns(rows(), again) == []


def test_the_last_bit_counts_and_is_named() -> None:
    nearly = np.nextafter(3.0, 4.0)
    found = told(rows(), rows(total_time_s=[1.0, 40.0, nearly]))
    assert found == {("b", 0, 0, 4, "total_time_s"): (3.0, nearly)}


def test_a_value_that_is_missing_on_one_side_is_a_difference() -> None:
    found = told(rows(), rows(time_ratio=[np.nan, 2.0, 1.25]))
    assert list(found) == [("a", 0, 0, 4, "time_ratio"), ("a", 0, 1, 4, "time_ratio")]


def test_every_column_of_a_row_that_differs_is_named() -> None:
    found = told(
        rows(),
        rows(outcome=["success", "timeout", "stuck"], total_time_s=[1.0, 40.0, 40.0]),
    )
    assert found == {
        ("b", 0, 0, 4, "outcome"): ("success", "stuck"),
        ("b", 0, 0, 4, "total_time_s"): (3.0, 40.0),
    }


def test_episodes_that_one_table_lacks_are_differences() -> None:
    for one, other in ((rows(), rows().iloc[:2]), (rows().iloc[:2], rows())):
        cells, lacking = differences(one, other)
        assert cells.empty
        assert list(lacking) == [("b", 0, 0, 4)]


def test_columns_of_one_table_alone_are_told_and_not_compared() -> None:
    assert differing_columns(rows(), rows(rejected_draws=[0, 0, 0])) == [
        "rejected_draws"
    ]
    assert told(rows(), rows(rejected_draws=[0, 0, 0])) == {}
