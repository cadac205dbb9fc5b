import numpy as np
import pandas as pd

from benchnav.eval.folder.sameness import differences, differing_columns


def rows(**changes: list[object]) -> pd.DataFrame:
    columns = {
        "condition": ["a", "a", "b"], "seed": [0, 0, 0], "realisation": [0, 1, 0], "map": [4, 4, 4],
        "outcome": ["success", "timeout", "success"], "total_time_s": [1.0, 40.0, 3.0],
        "time_ratio": [1.5, np.nan, 1.25], "planning_ms": [0.1, 0.2, 0.3],
    }  # fmt: skip
    return pd.DataFrame(columns | changes)


def test_the_same_rows_in_another_order_are_the_same() -> None:
    again = rows(planning_ms=[7.0, 8.0, 9.0]).iloc[::-1]
    assert differences(rows(), again) == []
    assert differing_columns(rows(), again) == []


def test_the_last_bit_counts_and_is_named() -> None:
    nearly = np.nextafter(3.0, 4.0)
    (found,) = differences(rows(), rows(total_time_s=[1.0, 40.0, nearly]))
    assert found.episode == ("b", 0, 0, 4)
    assert found.columns == {"total_time_s": (3.0, nearly)}


def test_a_value_that_is_missing_on_one_side_is_a_difference() -> None:
    first, second = differences(rows(), rows(time_ratio=[np.nan, 2.0, 1.25]))
    assert (first.episode, second.episode) == (("a", 0, 0, 4), ("a", 0, 1, 4))
    assert list(first.columns) == list(second.columns) == ["time_ratio"]


def test_every_column_of_a_row_that_differs_is_named() -> None:
    (found,) = differences(
        rows(), rows(outcome=["success", "timeout", "stuck"], total_time_s=[1.0, 40.0, 40.0])
    )
    assert found.columns == {"outcome": ("success", "stuck"), "total_time_s": (3.0, 40.0)}


def test_episodes_that_one_table_lacks_are_differences() -> None:
    for one, other in ((rows(), rows().iloc[:2]), (rows().iloc[:2], rows())):
        (found,) = differences(one, other)
        assert found.episode == ("b", 0, 0, 4)
        assert found.columns == {}


def test_columns_of_one_table_alone_are_told_and_not_compared() -> None:
    assert differing_columns(rows(), rows(rejected_draws=[0, 0, 0])) == ["rejected_draws"]
    assert differences(rows(), rows(rejected_draws=[0, 0, 0])) == []
