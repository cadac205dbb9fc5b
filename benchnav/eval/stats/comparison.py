"""The table of a comparison: a row a pair of trials, corrected over all rows together."""

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

ALPHA = 0.05


def compare(pairs: Sequence[Pair], difference: float = 0.05) -> pd.DataFrame:
    """Compares each pair map by map; Holm's correction is over all of them, for success and for time apart.

    Args:
        pairs: from `pairing.find_pairs`.
        difference: of success, for which the maps that it would need are counted, in (0, 1].

    Returns:
        A row a pair: labels of the two, `one`, `other`; `n_maps`, `n_draws` (episodes of a trial on a map);
        `success_one`, `success_other`; `success_difference` with its 95 % interval `_low`, `_high`, `success_p`
        and, corrected, `success_p_holm`; `success_shown`, the smallest difference that so many maps show with a
        chance of 80 %, and `maps_needed` for `difference`, both at the level of the first step of Holm. The same of
        `time`, T_total in seconds, where a failure counts as T; and of `arrival_time`, over episodes in which both
        arrived: no test, since which these are hangs on both trials.
    """
    alpha = ALPHA / len(pairs)
    table = pd.DataFrame([_compare_success(pair, alpha, difference) for pair in pairs])
    late = [_late(pair.episodes) for pair in pairs]
    table = table.join(_intervals(late, "time"))
    table["time_p"] = [signed_rank_p(values) for values in late]
    arrived = [
        _late(pair.episodes[pair.episodes["success"] & pair.episodes["success_other"]]) for pair in pairs
    ]
    table = table.join(_intervals(arrived, "arrival_time"))
    table["arrival_time_n_maps"] = [len(values) for values in arrived]
    for name in ("success_p", "time_p"):
        table[f"{name}_holm"] = multipletests(table[name], ALPHA, method="holm")[1]
    return table


def _compare_success(pair: Pair, alpha: float, difference: float) -> dict[str, object]:
    rows = pair.episodes
    one, other = rows["success"].astype(int), rows["success_other"].astype(int)
    gain = (one - other).groupby(rows["instance"]).sum().to_numpy()
    draws = len(rows) // len(gain)
    mean, low, high = success_interval(gain, draws)
    std = float(standard_deviation(gain, draws))
    return {
        **pair.shared,
        "one": pair.one,
        "other": pair.other,
        "n_maps": len(gain),
        "n_draws": draws,
        "success_one": one.mean(),
        "success_other": other.mean(),
        "success_difference": float(mean),
        "success_low": float(low),
        "success_high": float(high),
        "success_p": sign_flip_p(gain),
        "success_shown": smallest_difference(std, len(gain), alpha),
        "maps_needed": maps_needed(std, difference, alpha),
    }


def _late(rows: pd.DataFrame) -> np.ndarray:
    """By how much longer one trial took, by map, shape [M]."""
    return (rows["total_time_s"] - rows["total_time_s_other"]).groupby(rows["instance"]).mean().to_numpy()


def _intervals(late: Sequence[np.ndarray], name: str) -> pd.DataFrame:
    columns = [f"{name}_difference_s", f"{name}_low_s", f"{name}_high_s"]
    return pd.DataFrame(dict(zip(columns, mean_intervals(late), strict=True)))
