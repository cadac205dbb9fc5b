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
    """Return differences of success counts, and numbers of episodes, each shape [M]."""
    first = rows["success"].astype(int)
    second = rows["success_other"].astype(int)
    gain = first - second
    by_unit = gain.groupby(rows["group"].to_numpy())
    gains = by_unit.sum().to_numpy()
    n_episodes = by_unit.size().to_numpy()
    return gains, n_episodes


def mean_differences(rows: pd.DataFrame, column: str = "total_time_s") -> np.ndarray:
    """Return `by_map` of the difference in a column, shape [M]."""
    return by_map(*_differences(rows, column))


def summed_differences(rows: pd.DataFrame, column: str = "total_time_s") -> np.ndarray:
    """Return `sums_by_map` of the difference in a column, for sign and rank tests.

    The result has shape [M].
    """
    return sums_by_map(*_differences(rows, column))


def _differences(
    rows: pd.DataFrame, column: str
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return differences by episode, their maps, and the largest magnitude of values."""
    paired = rows[[column, f"{column}_other"]].to_numpy(dtype=float)
    differences = paired[:, 0] - paired[:, 1]
    maps = rows["group"].to_numpy()
    scale = float(np.abs(paired).max(initial=0))
    return differences, maps, scale


def interval_of(rows: pd.DataFrame, column: str, confidence: float = 0.95) -> Interval:
    """Return the mean difference in a column with its interval.

    Args:
        rows: paired episodes; see the module.
        column: column to compare. `success` has the interval of `success_interval`,
            `total_time_s` that of `time_difference`, any other Student's interval.
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
            difference = float(gain.sum() / max(len(rows), 1))
            return difference, np.nan, np.nan
        interval = success_interval(gain, draws, confidence)
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
        gain, _ = gain_by_map(rows)
        return sign_flip_p(gain.astype(int), direction)
    return mean_flip_p(summed_differences(rows, column), direction)


def time_difference(rows: pd.DataFrame, confidence: float = 0.95) -> Interval:
    """Return the difference in T_total, with the interval of `total_time_interval`.

    Args:
        rows: paired episodes; see the module.
        confidence: nominal coverage.

    Returns:
        Difference and ends in seconds.
    """
    maps_of_success = []
    success_s = []
    budget_s = []
    for suffix in ("", "_other"):
        success = rows[f"success{suffix}"].astype(bool)
        maps_of_success.append(set(rows.loc[success, "group"]))
        success_s.append(rows.loc[success, f"total_time_s{suffix}"])
        budget_s.append(rows[f"time_budget_s{suffix}"])
    times_s = pd.concat(success_s)
    # Without any success, a failure costs at most the whole T.
    mean_time_s = times_s.mean() if len(times_s) else 0.0
    mean_budget_s = pd.concat(budget_s).mean()
    gain, draws = gain_by_map(rows)
    _, low, high = success_interval(gain, draws, confidence)
    failed = rows["success_other"].astype(float) - rows["success"]
    common_maps = set.intersection(*maps_of_success)
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
    """Return whether T of the two conditions differs on any map."""
    first = rows["time_budget_s"]
    second = rows["time_budget_s_other"]
    # T of an episode that began at its goal is NaN.
    is_known = first.notna() & second.notna()
    return not np.allclose(first[is_known], second[is_known], rtol=1e-6)


def in_budgets(rows: pd.DataFrame) -> pd.DataFrame:
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
