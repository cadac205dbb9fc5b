import numpy as np
import pytest

from benchnav.stats.by_map import by_map


def test_by_map_has_the_mean_of_all_and_that_of_each_map_where_they_are_alike() -> None:
    values = np.array([1.0, 3, 5, 7, 9, 20])
    np.testing.assert_allclose(
        by_map(values, np.array([4, 2, 2, 4, 7, 7])), [4, 4, 14.5]
    )
    found = by_map(values, np.array([0, 0, 0, 0, 1, 2]))
    assert found.mean() == pytest.approx(values.mean())
    # Contribution of the first map: 4 values, 14 under 4 times the mean of 7.5, where a
    # map has 2 on average.
    assert found[0] == pytest.approx(7.5 + (16 - 4 * 7.5) / 2)
