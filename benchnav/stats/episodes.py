"""Paired differences of two conditions over episodes, with intervals and tests.

All functions take `rows`: episodes that both conditions have in common, one a row.
`success`, `total_time_s`, `time_budget_s` and other columns are of the first condition,
those that end in `_other` of the second. `group` is the statistical unit, a map or a
group of maps. A difference is of the first less the second.
Letters in shapes: M maps.
"""

import numpy as np
import pandas as pd

from benchnav.stats.by_map import by_map, sums_by_map
from benchnav.stats.flips import mean_flip_p, sign_flip_p
from benchnav.stats.intervals import (
    mean_interval,
    success_interval,
    total_time_interval,
)

Interval = tuple[float, float, float]


def gain_by_map(rows: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return the difference of the number of successes, and the number of episodes, by
    map, both of shape [M].
    """
    gain = rows["success"].astype(int) - rows["success_other"].astype(int)
    by_unit = gain.groupby(rows["group"].to_numpy())
    return by_unit.sum().to_numpy(), by_unit.size().to_numpy()


def mean_differences(rows: pd.DataFrame, column: str = "total_time_s") -> np.ndarray:
    """Return the difference of a column as one number a map whose mean is that over
    episodes, shape [M].
    """
    return by_map(*_differences(rows, column))


def summed_differences(rows: pd.DataFrame, column: str = "total_time_s") -> np.ndarray:
    """Return the difference of a column as tests by signs and ranks need it:
    `sums_by_map`, shape [M].
    """
    return sums_by_map(*_differences(rows, column))


def _differences(
    rows: pd.DataFrame, column: str
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return differences by episode, their maps, and the largest value that they are
    computed from.
    """
    sides = rows[[column, f"{column}_other"]].to_numpy(dtype=float)
    scale = float(np.abs(sides).max(initial=0))
    return sides[:, 0] - sides[:, 1], rows["group"].to_numpy(), scale


def interval_of(rows: pd.DataFrame, column: str, confidence: float = 0.95) -> Interval:
    """Return the mean difference of a column with its interval.

    Args:
        rows: see the module.
        column: `success` has the interval of `success_interval`, `total_time_s` that of
            `time_difference`, others Student's.
        confidence: nominal coverage.

    Returns:
        Difference and ends in the column's unit; the ends are NaN if there are too few
        maps.
    """
    if column == "total_time_s" and len(rows):
        return time_difference(rows, confidence)
    if column == "success":
        gain, draws = gain_by_map(rows)
        if len(gain) < 2:
            return float(gain.sum() / max(len(rows), 1)), np.nan, np.nan
        ends = success_interval(gain, draws, confidence)
    else:
        ends = mean_interval(mean_differences(rows, column), confidence)
    difference, low, high = map(float, ends)
    return difference, low, high


def difference_p(rows: pd.DataFrame, column: str, direction: str = "") -> float:
    """Return p of no difference of a column by flipping the signs of maps; 1 if there
    is no episode.

    Args:
        rows: see the module.
        column: counted exactly for `success`.
        direction: `higher` or `lower` for a one-sided test; two-sided if empty.
    """
    if column == "success":
        return sign_flip_p(gain_by_map(rows)[0].astype(int), direction)
    return mean_flip_p(summed_differences(rows, column), direction)


def time_difference(rows: pd.DataFrame, confidence: float = 0.95) -> Interval:
    """Return the difference of T_total, a failure counted as T, with the interval of
    `total_time_interval`.

    Args:
        rows: see the module.
        confidence: nominal coverage.

    Returns:
        Difference and ends in seconds.
    """
    arrived, arrival_s, budget_s = [], [], []
    for suffix in ("", "_other"):
        success = rows[f"success{suffix}"].astype(bool)
        arrived.append(set(rows.loc[success, "group"]))
        arrival_s.append(rows.loc[success, f"total_time_s{suffix}"])
        budget_s.append(rows[f"time_budget_s{suffix}"])
    arrivals = pd.concat(arrival_s)
    # No arrival takes less than nothing, where there is none to go by.
    arrival = arrivals.mean() if len(arrivals) else 0.0
    gain, draws = gain_by_map(rows)
    _, low, high = success_interval(gain, draws, confidence)
    failed = rows["success_other"].astype(float) - rows["success"]
    mean, low_s, high_s = total_time_interval(
        mean_differences(rows),
        by_map(failed.to_numpy(), rows["group"].to_numpy()),
        (-high, -low),
        pd.concat(budget_s).mean() - arrival,
        len(set.intersection(*arrived)),
        confidence,
    )
    return float(mean), float(low_s), float(high_s)


def budgets_differ(rows: pd.DataFrame) -> bool:
    """Return whether T of the two conditions differs on some map."""
    one, other = rows["time_budget_s"], rows["time_budget_s_other"]
    # of an episode that began at its goal T is unknown
    known = one.notna() & other.notna()
    return not np.allclose(one[known], other[known], rtol=1e-6)


def in_budgets(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with times as fractions of each condition's own T."""
    fractions: dict[str, pd.Series | float] = {}
    for suffix in ("", "_other"):
        # An episode that began at its goal took nothing of a T that is unknown.
        taken = rows[f"total_time_s{suffix}"] / rows[f"time_budget_s{suffix}"]
        fractions |= {
            f"total_time_s{suffix}": taken.fillna(0),
            f"time_budget_s{suffix}": 1.0,
        }
    return rows.assign(**fractions)
