"""The tables of comparisons: a row a pair of conditions, corrected over all rows
together.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from benchnav.core.quantity import Quantity
from benchnav.eval.stats.hypotheses import comparable, means_and_difference
from benchnav.eval.stats.pairs import Pair
from benchnav.stats.episodes import (
    Interval,
    budgets_differ,
    difference_p,
    gain_by_map,
    in_budgets,
    interval_of,
    mean_differences,
    summed_differences,
)
from benchnav.stats.flips import signed_rank_p
from benchnav.stats.holm import ALPHA, holm
from benchnav.stats.intervals import mean_interval, standard_deviation
from benchnav.stats.power import maps_needed, smallest_difference


def compare(pairs: Sequence[Pair], difference: float = 0.05) -> pd.DataFrame:
    """Compare each pair map by map; Holm's correction is over all of them, for success
    and for time apart.

    Args:
        pairs: from `pairs.find_pairs`.
        difference: of success, for which the maps that it would need are counted, in
            (0, 1].

    Returns:
        A row a pair: labels of the two, `one`, `other`; `n_maps`, `n_groups`, the
        statistical units, which are as many unless maps are grouped, and `n_episodes`
        of each condition; `success_one`, `success_other`; `success_difference` with its
        95 % interval `_low`, `_high`, `success_p` and, corrected, `success_p_holm`;
        `success_detectable`, the minimum detectable difference with 80 % power, and
        `maps_needed` for `difference`, both at the level of the first step of Holm. The
        same of `time`, T_total in seconds, where a failure counts as T:
        `time_difference_s`, `time_low_s`, `time_high_s`. Where the two conditions of
        some pair have unlike T, whose difference would else be that of the penalty, all
        are in shares of T and end in `_share`. And of `arrival_time`, over episodes in
        which both arrived: no test, since both conditions decide which episodes these
            are.
    """
    alpha = ALPHA / len(pairs)
    in_shares = any(budgets_differ(pair.episodes) for pair in pairs)
    rows = [
        _labels(pair, pair.episodes)
        | _compare(pair.episodes, alpha, difference, in_shares)
        for pair in pairs
    ]
    return _corrected(rows, "success_p", "time_p")


def compare_by(pairs: Sequence[Pair], quantity: Quantity) -> pd.DataFrame:
    """Compare each pair by one metric, over the episodes in which both conditions have
    a value.

    Args:
        pairs: from `pairs.find_pairs`.
        quantity: what is compared.

    Returns:
        A row a pair: labels of the two, `one`, `other`; `n_maps`, `n_groups`,
        `n_episodes` of each condition; `metric`, `unit` of all that follows;
        `mean_one`, `mean_other`, `difference` with its 95 % interval `low`, `high`; `p`
        of a test by flipping signs and, corrected, `p_holm`. A difference and its ends
        are NaN without episodes.
    """
    rows = []
    for pair in pairs:
        one, other = pair.members
        episodes = comparable(one.episodes, other.episodes, quantity)
        rows.append(
            {
                **_labels(pair, episodes),
                "metric": quantity.name,
                "unit": quantity.unit,
                **means_and_difference(quantity, episodes),
                "p": difference_p(episodes, quantity.column),
            }
        )
    return _corrected(rows, "p")


def _labels(pair: Pair, episodes: pd.DataFrame) -> dict[str, Any]:
    """Return the columns that say what a row is of, and how many maps and episodes it
    has.
    """
    return {
        **pair.shared,
        "one": pair.one,
        "other": pair.other,
        "n_maps": episodes["map"].nunique(),
        "n_groups": episodes["group"].nunique(),
        "n_episodes": len(episodes),
    }


def _corrected(rows: Sequence[Mapping[str, Any]], *names: str) -> pd.DataFrame:
    """Return the table of rows with p-values corrected over all of them, each kind
    apart.
    """
    table = pd.DataFrame(rows)
    return table.assign(
        **{f"{name}_holm": holm(table[name].to_numpy()) for name in names}
    )


def _compare(
    rows: pd.DataFrame, alpha: float, difference: float, in_shares: bool
) -> dict[str, Any]:
    timed = in_budgets(rows) if in_shares else rows
    gain, draws = gain_by_map(rows)
    std = float(standard_deviation(gain, draws))
    arrived = mean_differences(rows[rows["success"] & rows["success_other"]])
    mean, low, high = map(float, mean_interval(arrived))
    return {
        "success_one": rows["success"].mean(),
        "success_other": rows["success_other"].mean(),
        **named("success", interval_of(rows, "success")),
        "success_p": difference_p(rows, "success"),
        "success_detectable": smallest_difference(std, len(gain), alpha),
        "maps_needed": maps_needed(std, difference, alpha),
        **named(
            "time", interval_of(timed, "total_time_s"), "_share" if in_shares else "_s"
        ),
        "time_p": signed_rank_p(summed_differences(timed)),
        **named("arrival_time", (mean, low, high), "_s"),
        "arrival_time_n_maps": len(arrived),
    }


def named(name: str, interval: Interval, unit: str = "") -> dict[str, float]:
    """Return a difference and the ends of its interval by the names of columns."""
    columns = (f"{name}_{value}{unit}" for value in ("difference", "low", "high"))
    return dict(zip(columns, interval, strict=True))
