"""The best condition of each block of a run, and which others are significantly worse.

One max-T test looks at all pairs of a block's conditions at once: maps are drawn with replacement for all pairs
together, so that what the conditions share counts, and each pair's difference is over its standard error in the
sample (bootstrap-t). To the maps four pseudo-maps are added, on two of which the one condition succeeds and the other
does not, and on two the reverse. Without them a condition that fails wholly on rare maps, none of which was drawn,
seems sure. The test does not assume that differences are symmetric, as flipping signs would. It goes step by step, as
the model confidence set does: the condition that another beats by most is set aside, and the rest are compared again.
So the chance that any condition which is as good as the best is called worse is at most about 5 % however many there
are and whatever their shapes (`studies/statistics`).
Sources: Efron and Tibshirani (1993), "An Introduction to the Bootstrap", 12.5 and 16.4; Silverman and Young (1987),
"The bootstrap: to smooth or not to smooth?"; Romano and Wolf (2005), "Exact and approximate stepdown methods for
multiple hypothesis testing"; Hansen, Lunde and Nason (2011), "The model confidence set", for the order.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import norm

from benchnav.core.resampling import bootstrap_counts
from benchnav.eval.experiment.condition import NOT_USED
from benchnav.eval.experiment.unit import DRAW
from benchnav.eval.stats.comparison import ALPHA
from benchnav.eval.stats.paired_difference import POWER, alike, success_interval

# Conditions of a block met the same maps and the same noise, and were asked the same.
BLOCK = ("data", "scenario", "world", "robot", "objective")
# On fewer maps nothing is called worse: no sign-flip test of five maps can reach 0.05 either.
FEWEST_MAPS = 6
# Privileged models, the one that knows most first.
PRIVILEGED = ("clairvoyant", "oracle", "ideal")

# Pseudo-maps on which a condition of a pair wins, and as many on which it loses.
_ADDED = 2
# Samples times conditions that are computed at once, which stay in a processor's cache.
_BLOCK = 150_000
_SIDES = slice(_ADDED), slice(_ADDED, None)
# Of a statistic in float32: what is as far but for rounding is as far.
_ROUNDING = 1e-5

_COLUMNS = (
    *("condition", "best", "best_rivals", "best_episodes", "best_maps", "best_difference", "best_low"),
    *("best_high", "best_p", "best_shown", "best_alike", "best_marked"),
)


def privileged_models(conditions: Mapping[str, Any]) -> dict[str, str]:
    """Which conditions' models are privileged: given part of the truth.

    Args:
        conditions: by id what `run.json` knows of them.

    Returns:
        By id one of `PRIVILEGED`.
    """
    looking = {
        condition: about["value"]["model"]["part"]
        for condition, about in conditions.items()
        if about["labels"]["model"] != NOT_USED
    }
    return {condition: part for condition, part in looking.items() if part in PRIVILEGED}


def competing(rows: pd.DataFrame) -> pd.Series:
    """Tells which conditions of a block compete for the best.

    A privileged model is a reference and no rival, unless nothing else is there that looks at a prediction.

    Args:
        rows: of the summary, of one block, with `privileged` as of `against_best`.

    Returns:
        Bool, by the index of `rows`.
    """
    for out in (list(PRIVILEGED), list(PRIVILEGED)[:1]):
        left = ~rows["privileged"].isin(out)
        if (left & (rows["model"] != NOT_USED)).any():
            return left
    return pd.Series(True, index=rows.index)


def best_set_p(wins: np.ndarray, draws: np.ndarray | int) -> tuple[np.ndarray, np.ndarray]:
    """Test of each condition whether it is as good as the best.

    Args:
        wins: successes by map and condition, whole numbers, shape [M, K].
        draws: episodes of a condition on each map, one number or of shape [M].

    Returns:
        p by condition, corrected for their number, shape [K], 1 for the best and all where there are fewer than
        `FEWEST_MAPS` maps; and by condition the minimum detectable difference to the one with most successes, with
        80 % power at the level of the first step, infinite where no result would be significant, shape [K].
    """
    maps, count = wins.shape
    if maps < FEWEST_MAPS or count < 2:
        return np.ones(count), np.full(count, np.inf)
    order = np.argsort(-wins.sum(0), kind="stable")
    values, size = _canonical(wins[:, order], np.broadcast_to(draws, maps))
    seen = _Samples(values.astype(float), size.astype(float), np.ones((1, maps)))
    # Sums of whole numbers under 2²⁴ are exact in float32, in whatever order.
    dtype = np.float32 if maps * int(size.max()) ** 2 < 2**24 else np.float64
    counts = bootstrap_counts(maps, 2 * _ADDED).astype(dtype)
    ahead = np.full((count, count), -np.inf)  # t of the row's condition before the column's
    for one in range(count - 1):
        rest = np.arange(one + 1, count)
        (t,) = seen.t_of(one, rest, 0.0)
        ahead[one, rest], ahead[rest, one] = t, -t
    left, statistic, steps = np.ones(count, dtype=bool), [], []
    while left.sum() > 1:
        most = np.where(left, ahead.max(0), -np.inf)
        steps.append(int(most.argmax()))
        statistic.append(most[steps[-1]])
        left[steps[-1]], ahead[steps[-1]] = False, -np.inf
    steps += [int(left.argmax())]
    beyond, furthest = np.zeros(count), []
    for block in np.array_split(counts, math.ceil(len(counts) * count / _BLOCK)):
        drawn = _Samples(values.astype(dtype), size.astype(dtype), block)
        most = np.zeros(len(block), dtype)
        for step in reversed(range(count - 1)):
            one, rest = steps[step], np.array(steps[step + 1 :])
            (truth,) = seen.centre(one, rest)
            most = np.maximum(most, np.abs(drawn.t_of(one, rest, truth.astype(dtype))).max(1))
            beyond[one] += (most >= statistic[step] * (1 - _ROUNDING)).sum()
        furthest.append(most)
    p = (1 + beyond) / (1 + len(counts))
    p[steps] = [*np.maximum.accumulate(p[steps[:-1]]), 1.0]
    shown = np.full(count, np.inf)
    critical = np.quantile(np.concatenate(furthest), 1 - ALPHA)
    always = _Samples(
        np.stack([size, 0 * size], axis=1).astype(float), size.astype(float), np.ones((1, maps))
    )
    if always.t_of(0, np.array([1]), 0.0).item() > critical:
        (error,) = seen.error(0, np.arange(1, count))
        shown[1:] = (critical + norm.ppf(POWER)) * error
    back = np.argsort(order)
    return p[back], shown[back]


def _canonical(wins: np.ndarray, episodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wins and episodes by map, in one order of maps, of repeated episodes as of each once."""
    table = np.column_stack([wins, episodes]).astype(np.int64)
    table //= max(np.gcd.reduce(table, axis=None), 1)
    table = table[np.lexsort(table.T)]
    return table[:, :-1], table[:, -1]


class _Samples:
    """Differences of conditions in samples of maps and pseudo-maps.

    A pseudo-map has as many episodes as a map (the root mean square of their numbers). Rates are ratios of sums over
    maps. Letters in shapes: R samples; J pairs.

    Args:
        values: successes by map and condition, shape [M, K].
        size: episodes by map, shape [M].
        counts: how often each map is in a sample and, after them, each pseudo-map where these are drawn too, shape
            [R, M] or [R, M + 2 · `_ADDED`].
    """

    def __init__(self, values: np.ndarray, size: np.ndarray, counts: np.ndarray) -> None:
        maps = len(values)
        added = np.sqrt((size**2).mean())
        won, lost = (counts[:, maps:][:, part].sum(1, keepdims=True) for part in _SIDES)
        self.values, self.counts = values, np.ascontiguousarray(counts[:, :maps])
        self.sums, self.more = self.counts @ values, (won - lost) * added
        self.products, self.more_products = self.counts @ (values * size[:, None]), self.more * added
        self.size = self.counts @ size[:, None] + (won + lost) * added
        self.size_with_added = self.size + 2 * _ADDED * added
        self.squares = self.counts @ size[:, None] ** 2 + (won + lost) * added**2 + 2 * _ADDED * added**2
        self.more_squares = (won + lost + 2 * _ADDED) * added**2

    def centre(self, one: int, rest: np.ndarray) -> np.ndarray:
        """Difference of rates of one condition and each of the rest with the pseudo-maps, shape [R, J]."""
        return self._difference(self.sums, one, rest, self.more) / self.size_with_added

    def error(self, one: int, rest: np.ndarray) -> np.ndarray:
        """Its standard error, shape [R, J]."""
        return np.sqrt(self._spread(one, rest, self.centre(one, rest))) / self.size_with_added

    def t_of(self, one: int, rest: np.ndarray, truth: float | np.ndarray) -> np.ndarray:
        """By how many standard errors a difference is above the truth, shape [R, J]."""
        # In place, as this is nearly all the time that many conditions take.
        t = self._difference(self.sums, one, rest, self.more)
        spread = self._spread(one, rest, t / self.size_with_added)
        np.sqrt(spread, out=spread)
        t *= self.size_with_added / self.size
        t -= truth * self.size_with_added
        t /= spread
        return t

    def _spread(self, one: int, rest: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Sum over maps and pseudo-maps of the squares about the centre."""
        gaps = self.values[:, [one]] - self.values[:, rest]
        gaps *= gaps
        spread = self.counts @ gaps
        spread += self.more_squares
        products = self._difference(self.products, one, rest, self.more_products)
        products *= -2
        products += centre * self.squares
        products *= centre
        spread += products
        return spread

    @staticmethod
    def _difference(sums: np.ndarray, one: int, rest: np.ndarray, more: np.ndarray) -> np.ndarray:
        difference = sums[:, [one]] - sums[:, rest]
        difference += more
        return difference


def against_best(
    episodes: pd.DataFrame, summary: pd.DataFrame, privileged: Mapping[str, str] | None = None
) -> pd.DataFrame:
    """Compares the conditions of each block that compete, map by map, and tells which are worse than the best.

    All of them on the episodes that they have in common, so that one which was run on more maps is not judged by
    others. The best has the highest success rate there and, of several, the least mean T_total.

    Args:
        episodes: rows of episodes.
        summary: of them, from `summary.summarise`.
        privileged: from `privileged_models`; none where not given.

    Returns:
        A row a condition, in the order of the summary: `condition`; `privileged`, of `PRIVILEGED`, empty
        where nothing is; `best`, the condition that is the best of its block; `best_rivals`, how many others compete;
        `best_episodes`, of each of them in common, on `best_maps`, of which a group counts as one;
        `best_difference`, by how much the best's success rate is higher, with its 95 % interval `_low`, `_high`, of
        the pair alone; `best_p`, from `best_set_p`; `best_shown`, the minimum detectable difference with 80 % power;
        `best_alike`, true where it competes and is not significantly worse than the best; and `best_marked`, true
        where it is alike and something in its block is worse. NaN where a condition does not compete, and for the best
        itself.
    """
    groups = dict(list(episodes.groupby("condition", sort=False)))
    summary = summary.assign(privileged=summary["condition"].map(privileged or {}).fillna(""))
    found: list[dict[str, Any]] = []
    for _, rows in summary.groupby(list(BLOCK), sort=False, dropna=False):
        about, compared = _compare(
            {condition: groups[condition] for condition in rows.loc[competing(rows), "condition"]}
        )
        some_worse = not all(one["best_alike"] for one in compared.values())
        for condition in rows["condition"]:
            one = compared.get(condition, {"best_alike": False})
            marked = {"best_marked": one["best_alike"] and some_worse}
            found.append({"condition": condition, **about, **one, **marked})
    table = pd.DataFrame(found).reindex(columns=_COLUMNS)
    return summary[["condition", "privileged"]].merge(table, on="condition", how="left", validate="1:1")


def _compare(rivals: Mapping[str, pd.DataFrame]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Columns of `against_best` that are those of the block, and by condition its own."""
    met = [set(rows[DRAW].itertuples(index=False, name=None)) for rows in rivals.values()]
    common = pd.DataFrame(sorted(set.intersection(*met)), columns=DRAW)
    judged = rivals
    if len(common):
        judged = {condition: common.merge(rows, on=DRAW) for condition, rows in rivals.items()}
    names = sorted(judged)  # those that are as good and as fast, in the order of their digests
    times = np.array([judged[name]["total_time_s"].mean() for name in names])
    mean_s = dict(zip(names, alike(times, times.max()), strict=True))
    best, *others = sorted(names, key=lambda name: (-judged[name]["success"].mean(), mean_s[name]))
    episodes, maps = len(judged[best]), judged[best]["group"].nunique()
    about = {"best": best, "best_rivals": len(others), "best_episodes": episodes, "best_maps": maps}
    made: dict[str, dict[str, Any]] = {best: {"best_alike": True}}
    if common.empty:  # nothing to compare
        return about, made | {condition: {"best_alike": True, "best_p": 1.0} for condition in others}
    wins = [judged[one].groupby("group")["success"].sum() for one in (best, *others)]
    values = np.stack([won.to_numpy(dtype=int) for won in wins], axis=1)
    draws = judged[best].groupby("group").size().to_numpy()
    p, shown = best_set_p(values, draws)
    for place, condition in enumerate(others, start=1):
        gain = values[:, 0] - values[:, place]
        entry = {"best_p": p[place], "best_alike": bool(p[place] >= ALPHA)}
        entry["best_difference"] = gain.sum() / episodes
        if maps > 1:
            _, entry["best_low"], entry["best_high"] = map(float, success_interval(gain, draws))
            entry["best_shown"] = shown[place]
        made[condition] = entry
    return about, made
