"""The table of a comparison: a row a pair of conditions, corrected over all rows together."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from benchnav.core.resampling import holm
from benchnav.eval.stats.paired_difference import (
    by_map,
    maps_needed,
    mean_interval,
    sign_flip_p,
    signed_rank_p,
    smallest_difference,
    standard_deviation,
    success_interval,
    sums_by_map,
    total_time_interval,
)
from benchnav.eval.stats.pairs import Pair

ALPHA = 0.05


def compare(pairs: Sequence[Pair], difference: float = 0.05) -> pd.DataFrame:
    """Compares each pair map by map; Holm's correction is over all of them, for success and for time apart.

    Args:
        pairs: from `pairs.find_pairs`.
        difference: of success, for which the maps that it would need are counted, in (0, 1].

    Returns:
        A row a pair: labels of the two, `one`, `other`; `n_maps`, `n_groups`, the statistical units, which are as many
        unless maps are grouped, and `n_episodes` of each condition; `success_one`, `success_other`;
        `success_difference` with its 95 % interval `_low`, `_high`, `success_p`
        and, corrected, `success_p_holm`; `success_detectable`, the minimum detectable difference with 80 %
        power, and `maps_needed` for `difference`, both at the level of the first step of Holm. The same of
        `time`, T_total in seconds, where a failure counts as T: `time_difference_s`, `time_low_s`, `time_high_s`. Where
        the two conditions of some pair have unlike T, whose difference would else be that of the penalty, all are in
        shares of T and end in `_share`. And of `arrival_time`, over episodes in which both arrived: no test, since
        both conditions decide which episodes these are.
    """
    alpha = ALPHA / len(pairs)
    table = pd.DataFrame([_compare_success(pair, alpha, difference) for pair in pairs])
    unit = "share" if any(map(budgets_differ, pairs)) else "s"
    rows = [_in_shares(pair.episodes) if unit == "share" else pair.episodes for pair in pairs]
    table = table.join(_columns("time", unit, [time_difference(one) for one in rows]))
    table["time_p"] = [signed_rank_p(summed_differences(one)) for one in rows]
    arrived = [
        mean_differences(pair.episodes[pair.episodes["success"] & pair.episodes["success_other"]])
        for pair in pairs
    ]
    table = table.join(_columns("arrival_time", "s", [mean_interval(values) for values in arrived]))
    table["arrival_time_n_maps"] = [len(values) for values in arrived]
    for name in ("success_p", "time_p"):
        table[f"{name}_holm"] = holm(table[name].to_numpy())
    return table


def time_difference(rows: pd.DataFrame, confidence: float = 0.95) -> tuple[float, float, float]:
    """Difference of T_total of a pair, a failure counted as T, with the interval of `total_time_interval`.

    Args:
        rows: as `Pair.episodes`.
        confidence: coverage asked for.

    Returns:
        Difference and the ends of its interval in seconds.
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
    failed = by_map(
        (rows["success_other"].astype(float) - rows["success"]).to_numpy(), rows["group"].to_numpy()
    )
    mean, low_s, high_s = total_time_interval(
        mean_differences(rows), failed, (-high, -low), pd.concat(budget_s).mean() - arrival,
        len(set.intersection(*arrived)), confidence,
    )  # fmt: skip
    return float(mean), float(low_s), float(high_s)


def gain_by_map(rows: pd.DataFrame) -> tuple[np.ndarray, np.ndarray]:
    """Successes of the one less those of the other, and the number of episodes, by map, both of shape [M]."""
    gain = rows["success"].astype(int) - rows["success_other"].astype(int)
    by_unit = gain.groupby(rows["group"].to_numpy())
    return by_unit.sum().to_numpy(), by_unit.size().to_numpy()


def budgets_differ(pair: Pair) -> bool:
    """Whether T of the two differs on some map."""
    one, other = pair.episodes["time_budget_s"], pair.episodes["time_budget_s_other"]
    known = one.notna() & other.notna()  # of an episode that began at its goal T is not known
    return not np.allclose(one[known], other[known], rtol=1e-6)


def _compare_success(pair: Pair, alpha: float, difference: float) -> dict[str, object]:
    rows = pair.episodes
    gain, draws = gain_by_map(rows)
    mean, low, high = success_interval(gain, draws)
    std = float(standard_deviation(gain, draws))
    return {
        **pair.shared,
        "one": pair.one,
        "other": pair.other,
        "n_maps": rows["map"].nunique(),
        "n_groups": len(gain),
        "n_episodes": len(rows),
        "success_one": rows["success"].mean(),
        "success_other": rows["success_other"].mean(),
        "success_difference": mean,
        "success_low": low,
        "success_high": high,
        "success_p": sign_flip_p(gain),
        "success_detectable": smallest_difference(std, len(gain), alpha),
        "maps_needed": maps_needed(std, difference, alpha),
    }


def mean_differences(rows: pd.DataFrame, column: str = "total_time_s") -> np.ndarray:
    """By how much one condition has more of a column, such as time, by map or group of maps, shape [M]."""
    return by_map(*_differences(rows, column))


def summed_differences(rows: pd.DataFrame, column: str = "total_time_s") -> np.ndarray:
    """What tests by signs and ranks ask for: `sums_by_map` of the differences, shape [M]."""
    return sums_by_map(*_differences(rows, column))


def _differences(rows: pd.DataFrame, column: str) -> tuple[np.ndarray, np.ndarray, float]:
    """Differences by episode, their maps, and the largest value that they are made of."""
    one, other = (rows[name].to_numpy(dtype=float) for name in (column, f"{column}_other"))
    return (
        one - other,
        rows["group"].to_numpy(),
        float(max(np.abs(one).max(initial=0), np.abs(other).max(initial=0))),
    )


def _in_shares(rows: pd.DataFrame) -> pd.DataFrame:
    """Rows of a pair with times in shares of each condition's own T."""
    made: dict[str, Any] = {}
    for suffix in ("", "_other"):
        # An episode that began at its goal took no share of a T that is not known.
        share = (rows[f"total_time_s{suffix}"] / rows[f"time_budget_s{suffix}"]).fillna(0)
        made |= {f"total_time_s{suffix}": share, f"time_budget_s{suffix}": 1.0}
    return rows.assign(**made)


def _columns(name: str, unit: str, intervals: Sequence[Sequence[float | np.ndarray]]) -> pd.DataFrame:
    columns = [f"{name}_{value}_{unit}" for value in ("difference", "low", "high")]
    return pd.DataFrame(np.array(intervals, dtype=float), columns=columns)
