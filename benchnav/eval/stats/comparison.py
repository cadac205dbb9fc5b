"""Tables of comparisons: one row per pair of conditions, with Holm's correction."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.eval.stats.hypotheses import comparable, means_and_difference
from benchnav.eval.stats.pairs import Pair
from benchnav.stats.episodes import (
    Interval,
    as_fractions_of_budget,
    budgets_differ,
    difference_p,
    gain_by_map,
    interval_of,
    mean_differences,
    summed_differences,
)
from benchnav.stats.flips import signed_rank_p
from benchnav.stats.holm import ALPHA, holm
from benchnav.stats.intervals import mean_interval, standard_deviation
from benchnav.stats.power import maps_needed, smallest_difference


def compare(pairs: Sequence[Pair], difference: float = 0.05) -> pd.DataFrame:
    """Compare each pair per map, with Holm's correction for success and for time.

    Args:
        pairs: pairs from `pairs.find_pairs`.
        difference: difference in success rate for which the required number of maps is
            computed, in (0, 1].

    Returns:
        One row per pair, with these columns:

        - common labels; `one` and `other`, the labels of the pair; `n_maps`;
          `n_groups`, the number of statistical units, which is `n_maps` unless maps are
          grouped; `n_episodes`, the number of episodes of each condition.
        - `success_one` and `success_other`, the success rates; `success_difference`,
          with the limits `success_low` and `success_high` of its 95 % interval;
          `success_p`, and
          `success_p_holm` after Holm's correction; `success_detectable`, the minimum
          detectable difference with 80 % power, and `maps_needed`, the number of maps
          for `difference`, both at the level of the first step of Holm's correction.
        - `time_difference_s`, `time_low_s`, `time_high_s`, `time_p` and `time_p_holm`,
          the same for T_total, where a failure counts as T. If T differs between the
          conditions of any pair, all times are fractions of T and these columns end in
          `_share`, since failures would otherwise be penalised differently.
        - `arrival_time_…`, the same over episodes in which both conditions reach the
          goal. There is no test, since the outcomes select these episodes.
    """
    alpha = ALPHA / len(pairs)
    as_fractions = any(budgets_differ(pair.episodes) for pair in pairs)
    rows = []
    for pair in pairs:
        labels = _labels(pair, pair.episodes)
        columns = _compare(pair.episodes, alpha, difference, as_fractions)
        rows.append(labels | columns)
    return _corrected(rows, "success_p", "time_p")


def compare_by(pairs: Sequence[Pair], quantity: Quantity) -> pd.DataFrame:
    """Compare each pair by one metric, over episodes in which both have a value.

    Args:
        pairs: pairs from `pairs.find_pairs`.
        quantity: the compared quantity.

    Returns:
        One row per pair: common labels, `one`, `other`, `n_maps`, `n_groups` and
        `n_episodes`, as in `compare`; `metric`; `unit` of the following columns;
        `mean_one`, `mean_other`; `difference`, with the limits `low` and `high` of its
        95 % interval; `p` of a sign-flip test, and `p_holm` after Holm's correction.
        The difference and its interval are NaN without episodes.
    """
    rows = []
    for pair in pairs:
        first, second = pair.members
        episodes = comparable(first.episodes, second.episodes, quantity)
        row = _labels(pair, episodes)
        row |= {"metric": quantity.name, "unit": quantity.unit}
        row |= means_and_difference(quantity, episodes)
        row["p"] = difference_p(episodes, quantity.column)
        rows.append(row)
    return _corrected(rows, "p")


def _labels(pair: Pair, episodes: pd.DataFrame) -> dict[str, Any]:
    """Return the labels of a pair, and its numbers of maps, groups and episodes."""
    return {
        **pair.shared,
        "one": pair.one,
        "other": pair.other,
        "n_maps": episodes["map"].nunique(),
        "n_groups": episodes["group"].nunique(),
        "n_episodes": len(episodes),
    }


def _corrected(rows: Sequence[Mapping[str, Any]], *names: str) -> pd.DataFrame:
    """Return the table of rows, with a Holm-corrected copy of each column in `names`."""
    table = pd.DataFrame(rows)
    corrected = {f"{name}_holm": holm(table[name].to_numpy()) for name in names}
    return table.assign(**corrected)


def _compare(
    rows: pd.DataFrame, alpha: float, difference: float, as_fractions: bool
) -> dict[str, Any]:
    timed = as_fractions_of_budget(rows) if as_fractions else rows
    time_unit = "_share" if as_fractions else "_s"
    time_interval = interval_of(timed, "total_time_s")
    gain, draws = gain_by_map(rows)
    std = float(standard_deviation(gain, draws))
    both_succeeded = rows["success"] & rows["success_other"]
    arrival_differences = mean_differences(rows[both_succeeded])
    mean, low, high = map(float, mean_interval(arrival_differences))
    row: dict[str, Any] = {}
    row["success_one"] = rows["success"].mean()
    row["success_other"] = rows["success_other"].mean()
    row |= named("success", interval_of(rows, "success"))
    row["success_p"] = difference_p(rows, "success")
    row["success_detectable"] = smallest_difference(std, len(gain), alpha)
    row["maps_needed"] = maps_needed(std, difference, alpha)
    row |= named("time", time_interval, time_unit)
    row["time_p"] = signed_rank_p(summed_differences(timed))
    row |= named("arrival_time", (mean, low, high), "_s")
    row["arrival_time_n_maps"] = len(arrival_differences)
    return row


def named(name: str, interval: Interval, unit: str = "") -> dict[str, float]:
    """Return a difference and the limits of its interval, keyed by column name.

    Args:
        name: start of the columns, such as `time`.
        interval: difference, lower limit and upper limit.
        unit: end of the columns, such as `_s`.
    """
    difference, low, high = interval
    return {
        f"{name}_difference{unit}": difference,
        f"{name}_low{unit}": low,
        f"{name}_high{unit}": high,
    }
