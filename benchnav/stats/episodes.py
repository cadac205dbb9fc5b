"""Paired differences of two conditions over episodes, with intervals and tests.

All functions take `rows`, a table with one row per episode that both conditions have in
common. The columns `success`, `total_time_s`, `time_budget_s`, … belong to the first
condition, and the columns that end in `_other` to the second. The column `group` is the
statistical unit, a map or a group of maps. Differences are the first condition minus
the second.
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
    """Return differences of success counts, and counts of episodes, each shape [M]."""
    first = rows["success"].astype(int)
    second = rows["success_other"].astype(int)
    differences = first - second
    by_unit = differences.groupby(rows["group"].to_numpy())
    gains = by_unit.sum().to_numpy()
    n_episodes = by_unit.size().to_numpy()
    return gains, n_episodes


def mean_differences(rows: pd.DataFrame, column: str = "total_time_s") -> np.ndarray:
    """Return one difference in a column per map, shape [M].

    Their mean over maps is the mean difference over episodes; see `by_map`.
    """
    return by_map(*_differences(rows, column))


def summed_differences(rows: pd.DataFrame, column: str = "total_time_s") -> np.ndarray:
    """Return each map's scaled sum of the differences in a column, shape [M].

    Sign and rank tests take these sums; see `sums_by_map`.
    """
    return sums_by_map(*_differences(rows, column))


def _differences(
    rows: pd.DataFrame, column: str
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return differences by episode, their maps, and the largest compared magnitude.

    It is the largest magnitude in the columns of both conditions.
    """
    paired = rows[[column, f"{column}_other"]].to_numpy(dtype=float)
    differences = paired[:, 0] - paired[:, 1]
    maps = rows["group"].to_numpy()
    scale = float(np.abs(paired).max(initial=0))
    return differences, maps, scale


def interval_of(rows: pd.DataFrame, column: str, confidence: float = 0.95) -> Interval:
    """Return the mean difference in a column with its interval.

    Args:
        rows: paired episodes; see the module.
        column: column to compare. The interval is that of `success_interval` for
            `success`, that of `time_difference` for `total_time_s`, and Student's for
            any other column.
        confidence: nominal coverage.

    Returns:
        Difference and both ends in the column's unit. The ends are NaN if there are too
        few maps.
    """
    if column == "total_time_s" and len(rows):
        return time_difference(rows, confidence)
    if column == "success":
        gains, n_episodes = gain_by_map(rows)
        if len(gains) < 2:
            difference = float(gains.sum() / max(len(rows), 1))
            return difference, np.nan, np.nan
        interval = success_interval(gains, n_episodes, confidence)
    else:
        differences = mean_differences(rows, column)
        interval = mean_interval(differences, confidence)
    difference, low, high = map(float, interval)
    return difference, low, high


def difference_p(rows: pd.DataFrame, column: str, direction: str = "") -> float:
    """Return the p-value of a sign-flip test over maps; 1 if there is no episode.

    Args:
        rows: paired episodes; see the module.
        column: column to compare; the test of `success` is exact.
        direction: `higher` or `lower` for a one-sided test; two-sided if empty.
    """
    if column == "success":
        gains, _ = gain_by_map(rows)
        return sign_flip_p(gains.astype(int), direction)
    return mean_flip_p(summed_differences(rows, column), direction)


def time_difference(rows: pd.DataFrame, confidence: float = 0.95) -> Interval:
    """Return the difference in T_total, with the interval of `total_time_interval`.

    Args:
        rows: paired episodes; see the module.
        confidence: nominal coverage.

    Returns:
        Difference and both ends in seconds.
    """
    maps_with_success = []
    times_of_success_s = []
    budgets_s = []
    for suffix in ("", "_other"):
        success = rows[f"success{suffix}"].astype(bool)
        maps_with_success.append(set(rows.loc[success, "group"]))
        times_of_success_s.append(rows.loc[success, f"total_time_s{suffix}"])
        budgets_s.append(rows[f"time_budget_s{suffix}"])
    times_s = pd.concat(times_of_success_s)
    # If no episode succeeded, assume that a success takes no time, so that a failure
    # costs the whole T.
    mean_time_s = times_s.mean() if len(times_s) else 0.0
    mean_budget_s = pd.concat(budgets_s).mean()
    gains, n_episodes = gain_by_map(rows)
    _, low, high = success_interval(gains, n_episodes, confidence)
    failed = rows["success_other"].astype(float) - rows["success"]
    common_maps = set.intersection(*maps_with_success)
    mean, low_s, high_s = total_time_interval(
        mean_differences(rows),
        by_map(failed.to_numpy(), rows["group"].to_numpy()),
        (-high, -low),
        mean_budget_s - mean_time_s,
        len(common_maps),
        confidence,
    )
    return float(mean), float(low_s), float(high_s)


def budgets_differ(rows: pd.DataFrame) -> bool:
    """Return whether the time budgets T of the two conditions differ in any episode."""
    first = rows["time_budget_s"]
    second = rows["time_budget_s_other"]
    # T of an episode that began at its goal is NaN.
    is_known = first.notna() & second.notna()
    return not np.allclose(first[is_known], second[is_known], rtol=1e-6)


def as_fractions_of_budget(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the rows with times as fractions of each condition's T."""
    fractions: dict[str, pd.Series | float] = {}
    for suffix in ("", "_other"):
        time_column = f"total_time_s{suffix}"
        budget_column = f"time_budget_s{suffix}"
        fraction = rows[time_column] / rows[budget_column]
        # T of an episode that began at its goal is NaN; the episode took no time.
        fractions[time_column] = fraction.fillna(0)
        fractions[budget_column] = 1.0
    return rows.assign(**fractions)
