"""Which of several conditions are as good as the best: one max-T test of rates over
maps.

One max-T test looks at all pairs of a block's conditions at once: maps are drawn with
replacement for all pairs together, so that what the conditions share counts, and each
pair's difference is over its standard error in the sample (bootstrap-t). To the maps
four pseudo-maps are added, on two of which the one condition succeeds and the other
does not, and on two the reverse. Without them a condition that fails wholly on rare
maps, none of which was drawn, seems sure. The test does not assume that differences are
symmetric, as flipping signs would. It goes step by step, as
the model confidence set does: the condition that another beats by most is set aside,
and the rest are compared again. So the chance that any condition which is as good as
the best is called worse is at most about 5 % however many there are and whatever their
shapes (`studies/statistics`).
Sources: Efron and Tibshirani (1993), "An Introduction to the Bootstrap", 12.5 and 16.4;
Silverman and Young (1987), "The bootstrap: to smooth or not to smooth?"; Romano and
Wolf (2005), "Exact and approximate stepdown methods for multiple hypothesis testing";
Hansen, Lunde and Nason (2011), "The model confidence set", for the order.
"""

import math

import numpy as np
from scipy.stats import norm

from benchnav.stats.bootstrap import bootstrap_counts
from benchnav.stats.holm import ALPHA
from benchnav.stats.power import POWER

# On fewer maps nothing is called worse: no sign-flip test of five maps can reach 0.05
# either.
FEWEST_MAPS = 6

# Pseudo-maps on which a condition of a pair wins, and as many on which it loses.
_ADDED = 2
# Samples times conditions that are computed at once, which stay in a processor's cache.
_BLOCK = 150_000
_SIDES = slice(_ADDED), slice(_ADDED, None)
# Of a statistic in float32: what is as far but for rounding is as far.
_ROUNDING = 1e-5


def best_set_p(
    wins: np.ndarray, draws: np.ndarray | int
) -> tuple[np.ndarray, np.ndarray]:
    """Test of each condition whether it is as good as the best.

    Args:
        wins: successes by map and condition, whole numbers, shape [M, K].
        draws: episodes of a condition on each map, one number or of shape [M].

    Returns:
        p by condition, corrected for their number, shape [K], 1 for the best and all
        where there are fewer than `FEWEST_MAPS` maps; and by condition the minimum
        detectable difference to the one with most successes, with 80 % power at the
        level of the first step, infinite where no result would be significant, shape
        [K].
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
    # t of the row's condition before the column's
    ahead = np.full((count, count), -np.inf)
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
            most = np.maximum(
                most, np.abs(drawn.t_of(one, rest, truth.astype(dtype))).max(1)
            )
            beyond[one] += (most >= statistic[step] * (1 - _ROUNDING)).sum()
        furthest.append(most)
    p = (1 + beyond) / (1 + len(counts))
    p[steps] = [*np.maximum.accumulate(p[steps[:-1]]), 1.0]
    shown = np.full(count, np.inf)
    critical = np.quantile(np.concatenate(furthest), 1 - ALPHA)
    always = _Samples(
        np.stack([size, 0 * size], axis=1).astype(float),
        size.astype(float),
        np.ones((1, maps)),
    )
    if always.t_of(0, np.array([1]), 0.0).item() > critical:
        (error,) = seen.error(0, np.arange(1, count))
        shown[1:] = (critical + norm.ppf(POWER)) * error
    back = np.argsort(order)
    return p[back], shown[back]


def _canonical(wins: np.ndarray, episodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wins and episodes by map, in one order of maps, of repeated episodes as of each
    once.
    """
    table = np.column_stack([wins, episodes]).astype(np.int64)
    table //= max(np.gcd.reduce(table, axis=None), 1)
    table = table[np.lexsort(table.T)]
    return table[:, :-1], table[:, -1]


class _Samples:
    """Differences of conditions in samples of maps and pseudo-maps.

    A pseudo-map has as many episodes as a map (the root mean square of their numbers).
    Rates are ratios of sums over
    maps. Letters in shapes: R samples; J pairs.

    Args:
        values: successes by map and condition, shape [M, K].
        size: episodes by map, shape [M].
        counts: how often each map is in a sample and, after them, each pseudo-map where
            these are drawn too, shape [R, M] or [R, M + 2 · `_ADDED`].
    """

    def __init__(
        self, values: np.ndarray, size: np.ndarray, counts: np.ndarray
    ) -> None:
        maps = len(values)
        added = np.sqrt((size**2).mean())
        won, lost = (counts[:, maps:][:, part].sum(1, keepdims=True) for part in _SIDES)
        self.values, self.counts = values, np.ascontiguousarray(counts[:, :maps])
        self.sums, self.more = self.counts @ values, (won - lost) * added
        self.products, self.more_products = (
            self.counts @ (values * size[:, None]),
            self.more * added,
        )
        self.size = self.counts @ size[:, None] + (won + lost) * added
        self.size_with_added = self.size + 2 * _ADDED * added
        self.squares = (
            self.counts @ size[:, None] ** 2
            + (won + lost) * added**2
            + 2 * _ADDED * added**2
        )
        self.more_squares = (won + lost + 2 * _ADDED) * added**2

    def centre(self, one: int, rest: np.ndarray) -> np.ndarray:
        """Difference of rates of one condition and each of the rest with the
        pseudo-maps, shape [R, J].
        """
        return self._difference(self.sums, one, rest, self.more) / self.size_with_added

    def error(self, one: int, rest: np.ndarray) -> np.ndarray:
        """Its standard error, shape [R, J]."""
        return (
            np.sqrt(self._spread(one, rest, self.centre(one, rest)))
            / self.size_with_added
        )

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
    def _difference(
        sums: np.ndarray, one: int, rest: np.ndarray, more: np.ndarray
    ) -> np.ndarray:
        difference = sums[:, [one]] - sums[:, rest]
        difference += more
        return difference
