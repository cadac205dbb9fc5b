"""The table of a comparison: a row a pair of conditions, corrected over all rows together."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from statsmodels.stats.multitest import multipletests

from benchnav.eval.stats.difference import (
    mean_intervals,
    sign_flip_p,
    signed_rank_p,
    standard_deviation,
    success_interval,
)
from benchnav.eval.stats.pairing import Pair
from benchnav.eval.stats.power import maps_needed, smallest_difference
from benchnav.eval.stats.summary import units_of

ALPHA = 0.05


def compare(pairs: Sequence[Pair], difference: float = 0.05) -> pd.DataFrame:
    """Compares each pair map by map; Holm's correction is over all of them, for success and for time apart.

    Args:
        pairs: from `pairing.find_pairs`.
        difference: of success, for which the maps that it would need are counted, in (0, 1].

    Returns:
        A row a pair: labels of the two, `one`, `other`; `n_maps`, `n_groups`, the statistical units, which are as many
        unless maps are grouped, and `n_episodes` of each condition; `success_one`, `success_other`;
        `success_difference` with its 95 % interval `_low`, `_high`, `success_p`
        and, corrected, `success_p_holm`; `success_shown`, the smallest difference that so many maps show with a
        chance of 80 %, and `maps_needed` for `difference`, both at the level of the first step of Holm. The same of
        `time`, T_total in seconds, where a failure counts as T: `time_difference_s`, `time_low_s`, `time_high_s`. Where
        the two conditions of some pair have unlike T, whose difference would else be that of the penalty, all are in
        shares of T and end in `_share`. And of `arrival_time`, over episodes in which both arrived: no test, since
        which these are hangs on both conditions.
    """
    alpha = ALPHA / len(pairs)
    table = pd.DataFrame([_compare_success(pair, alpha, difference) for pair in pairs])
    unit = "share" if any(map(budgets_differ, pairs)) else "s"
    late = [_late(pair.episodes, unit) for pair in pairs]
    table = table.join(_intervals(late, "time", unit))
    table["time_p"] = [signed_rank_p(values) for values in late]
    arrived = [
        _late(pair.episodes[pair.episodes["success"] & pair.episodes["success_other"]]) for pair in pairs
    ]
    table = table.join(_intervals(arrived, "arrival_time", "s"))
    table["arrival_time_n_maps"] = [len(values) for values in arrived]
    for name in ("success_p", "time_p"):
        table[f"{name}_holm"] = multipletests(table[name], ALPHA, method="holm")[1]
    return table


def budgets_differ(pair: Pair) -> bool:
    """Whether T of the two differs on some map."""
    one, other = pair.episodes["time_budget_s"], pair.episodes["time_budget_s_other"]
    known = one.notna() & other.notna()  # of an episode that began at its goal T is not known
    return not np.allclose(one[known], other[known], rtol=1e-6)


def _compare_success(pair: Pair, alpha: float, difference: float) -> dict[str, object]:
    rows = pair.episodes
    one, other = rows["success"].astype(int), rows["success_other"].astype(int)
    gain = (one - other).groupby(units_of(rows)).sum().to_numpy()
    draws = len(rows) / len(gain)  # their mean where maps have unequally many
    mean, low, high = success_interval(gain, draws)
    std = float(standard_deviation(gain, draws))
    return {
        **pair.shared,
        "one": pair.one,
        "other": pair.other,
        "n_maps": rows["instance"].nunique(),
        "n_groups": len(gain),
        "n_episodes": len(rows),
        "success_one": one.mean(),
        "success_other": other.mean(),
        "success_difference": float(mean),
        "success_low": float(low),
        "success_high": float(high),
        "success_p": sign_flip_p(gain),
        "success_shown": smallest_difference(std, len(gain), alpha),
        "maps_needed": maps_needed(std, difference, alpha),
    }


def _late(rows: pd.DataFrame, unit: str = "s") -> np.ndarray:
    """By how much longer one condition took, by map or group of maps, in seconds or shares of T, shape [M]."""
    one, other = rows["total_time_s"], rows["total_time_s_other"]
    if unit == "share":
        # An episode that began at its goal took no share of a T that is not known.
        one = (one / rows["time_budget_s"]).fillna(0)
        other = (other / rows["time_budget_s_other"]).fillna(0)
    return (one - other).groupby(units_of(rows)).mean().to_numpy()


def _intervals(late: Sequence[np.ndarray], name: str, unit: str) -> pd.DataFrame:
    columns = [f"{name}_{value}_{unit}" for value in ("difference", "low", "high")]
    return pd.DataFrame(dict(zip(columns, mean_intervals(late), strict=True)))
