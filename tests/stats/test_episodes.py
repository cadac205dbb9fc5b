import numpy as np
import pandas as pd
import pytest
from scipy.stats import binomtest

from benchnav.stats.episodes import (
    budgets_differ,
    difference_p,
    interval_of,
    time_difference,
)


def side_by_side(
    one: list[float], other: list[float], budget_s: float = 100.0
) -> pd.DataFrame:
    """Times of two conditions, an episode a map; T of a failure."""
    rows = pd.DataFrame({"group": np.arange(len(one))})
    for suffix, times in (("", one), ("_other", other)):
        rows[f"success{suffix}"] = np.array(times) < budget_s
        rows[f"total_time_s{suffix}"] = times
        rows[f"time_budget_s{suffix}"] = budget_s
    return rows


def test_success_on_many_maps_is_tested_by_mcnemars_exact_test() -> None:
    rows = side_by_side([30.0] * 24 + [100.0] * 6, [100.0] * 20 + [30.0] * 10)
    for direction, alternative in (
        ("", "two-sided"),
        ("higher", "greater"),
        ("lower", "less"),
    ):
        expected = binomtest(20, 26, alternative=alternative).pvalue
        assert difference_p(rows, "success", direction) == pytest.approx(expected)


def test_each_column_has_its_interval() -> None:
    rows = side_by_side(
        [30.0, 31, 100, 33, 30, 34, 36, 30, 39, 31],
        [40.0, 100, 41, 43, 40, 40, 40, 44, 40, 40],
    )
    assert interval_of(rows, "total_time_s", 0.9) == time_difference(rows, 0.9)
    assert np.isfinite(interval_of(rows[:2], "success")).all()
    assert interval_of(rows[1:2], "success") == pytest.approx(
        (1, np.nan, np.nan), nan_ok=True
    )


def test_an_unknown_budget_does_not_differ() -> None:
    rows = side_by_side([0.0, 30.0], [0.0, 40.0])
    rows.loc[0, "time_budget_s"] = np.nan
    assert not budgets_differ(rows)
    rows.loc[1, "time_budget_s"] = 120.0
    assert budgets_differ(rows)
