"""The set of conditions that are not significantly worse than the best.

One max-T test covers all pairs of a block's conditions. It resamples maps with
replacement for all pairs jointly, which retains the correlation between conditions.
The difference of each pair in a sample is divided by its standard error in the same
sample (bootstrap-t).

Four pseudo-maps are added to the maps: on two of them only the first condition of a
pair succeeds, on the other two only the second. Without pseudo-maps, samples that lack
the few maps on which a condition fails would underestimate that condition's variance.
Unlike a sign-flip test, this test does not assume that differences are symmetric.

The test is stepwise, as in the model confidence set: it removes the condition with the
largest deficit and compares the remaining conditions again. The probability that any
condition as good as the best is called worse is at most about 5 %, for any number of
conditions and any shape of their distributions (`studies/statistics`).

Sources: Efron and Tibshirani (1993), "An Introduction to the Bootstrap", 12.5 and 16.4;
Silverman and Young (1987), "The bootstrap: to smooth or not to smooth?"; Romano and
Wolf (2005), "Exact and approximate stepdown methods for multiple hypothesis testing";
Hansen, Lunde and Nason (2011), "The model confidence set", for the order.

Letters in shapes: M maps; K conditions; R samples; J pairs.
"""

import math

import numpy as np
from scipy.stats import norm

from benchnav.stats.bootstrap import bootstrap_counts
from benchnav.stats.holm import ALPHA
from benchnav.stats.power import POWER

# Minimum number of maps for calling a condition worse. A sign-flip test of five maps
# cannot reach 0.05 either.
FEWEST_MAPS = 6

# Number of pseudo-maps on which the first condition of a pair wins; it loses on the same
# number of pseudo-maps.
_PSEUDO_WINS = 2
_WON_MAPS = slice(_PSEUDO_WINS)
_LOST_MAPS = slice(_PSEUDO_WINS, None)
# Number of samples in a chunk times number of conditions: a chunk fits in the CPU's
# cache.
_CHUNK_SIZE = 150_000
# Relative tolerance within which two statistics in float32 count as equal.
_ROUNDING = 1e-5


def best_set_p(
    wins: np.ndarray, episodes_per_map: np.ndarray | int
) -> tuple[np.ndarray, np.ndarray]:
    """Test each condition against the best condition.

    Args:
        wins: number of successes by map and condition, shape [M, K].
        episodes_per_map: number of episodes of each condition on each map, a single
            number or shape [M].

    Returns:
        Two float64 arrays by condition, each of shape [K]. The first is p, corrected
        for the number of conditions. It is 1 for the best condition, and for all
        conditions if there are fewer than `FEWEST_MAPS` maps. The second is the minimum
        detectable difference from the condition with the most successes, with 80 %
        power at the level of the first step; infinite if no result would be
        significant.
    """
    n_maps, n_conditions = wins.shape
    if n_maps < FEWEST_MAPS or n_conditions < 2:
        return np.ones(n_conditions), np.full(n_conditions, np.inf)
    order = np.argsort(-wins.sum(0), kind="stable")
    episodes = np.broadcast_to(episodes_per_map, n_maps)
    values, size = _canonical(wins[:, order], episodes)
    each_once = np.ones((1, n_maps))  # a sample that contains each map once
    observed = _Samples(values.astype(float), size.astype(float), each_once)
    # Sums of whole numbers below 2²⁴ are exact in float32, in any order.
    is_exact = n_maps * int(size.max()) ** 2 < 2**24
    dtype = np.float32 if is_exact else np.float64
    counts = bootstrap_counts(n_maps, 2 * _PSEUDO_WINS).astype(dtype)
    removed, statistics = _removal_order(observed, n_conditions)
    exceeding = np.zeros(n_conditions)
    max_statistics = []
    n_chunks = math.ceil(len(counts) * n_conditions / _CHUNK_SIZE)
    for chunk in np.array_split(counts, n_chunks):
        samples = _Samples(values.astype(dtype), size.astype(dtype), chunk)
        max_t = np.zeros(len(chunk), dtype)
        for step in reversed(range(n_conditions - 1)):
            first = removed[step]
            others = np.array(removed[step + 1 :])
            (centre,) = observed.centre(first, others)
            t = samples.t_of(first, others, centre.astype(dtype))
            max_t = np.maximum(max_t, np.abs(t).max(1))
            threshold = statistics[step] * (1 - _ROUNDING)
            exceeding[first] += (max_t >= threshold).sum()
        max_statistics.append(max_t)
    p = (1 + exceeding) / (1 + len(counts))
    stepwise_p = np.maximum.accumulate(p[removed[:-1]])
    p[removed] = [*stepwise_p, 1.0]
    detectable = np.full(n_conditions, np.inf)
    critical = np.quantile(np.concatenate(max_statistics), 1 - ALPHA)
    # In the largest possible difference, one condition always succeeds and the other
    # never does.
    extreme = np.stack([size, 0 * size], axis=1).astype(float)
    largest = _Samples(extreme, size.astype(float), each_once)
    if largest.t_of(0, np.array([1]), 0.0).item() > critical:
        (error,) = observed.error(0, np.arange(1, n_conditions))
        detectable[1:] = (critical + norm.ppf(POWER)) * error
    original_order = np.argsort(order)
    return p[original_order], detectable[original_order]


def _removal_order(
    observed: "_Samples", n_conditions: int
) -> tuple[list[int], list[float]]:
    """Return conditions in the order of removal, and the statistic of each removed one.

    A condition's statistic is the largest t of any remaining condition against it. The
    last condition is not removed and has no statistic.
    """
    # t of the row's condition against the column's condition.
    t_over = np.full((n_conditions, n_conditions), -np.inf)
    for first in range(n_conditions - 1):
        others = np.arange(first + 1, n_conditions)
        (t,) = observed.t_of(first, others, 0.0)
        t_over[first, others] = t
        t_over[others, first] = -t
    removed: list[int] = []
    statistics: list[float] = []
    remaining = np.ones(n_conditions, dtype=bool)
    while remaining.sum() > 1:
        deficit = np.where(remaining, t_over.max(0), -np.inf)
        worst = int(deficit.argmax())
        removed.append(worst)
        statistics.append(deficit[worst])
        remaining[worst] = False
        t_over[worst] = -np.inf
    removed.append(int(remaining.argmax()))
    return removed, statistics


def _canonical(wins: np.ndarray, episodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return wins and episodes by map, with maps in sorted order.

    Both are divided by their greatest common divisor, so that repeating the same
    episodes changes nothing.
    """
    table = np.column_stack([wins, episodes]).astype(np.int64)
    divisor = max(np.gcd.reduce(table, axis=None), 1)
    table //= divisor
    table = table[np.lexsort(table.T)]
    return table[:, :-1], table[:, -1]


class _Samples:
    """Differences of conditions in samples of maps and pseudo-maps.

    A pseudo-map has as many episodes as the root mean square over maps. Rates are
    ratios of sums over maps.

    Args:
        values: successes by map and condition, shape [M, K].
        size: episodes by map, shape [M].
        counts: frequencies of maps in each sample, shape [R, M]; if samples also
            contain pseudo-maps, followed by their frequencies, shape
            [R, M + 2 · `_PSEUDO_WINS`].
    """

    def __init__(
        self, values: np.ndarray, size: np.ndarray, counts: np.ndarray
    ) -> None:
        n_maps = len(values)
        pseudo_size = np.sqrt((size**2).mean())
        pseudo_counts = counts[:, n_maps:]
        won = pseudo_counts[:, _WON_MAPS].sum(1, keepdims=True)
        lost = pseudo_counts[:, _LOST_MAPS].sum(1, keepdims=True)
        n_pseudo = won + lost
        pseudo_square = pseudo_size**2
        column = size[:, None]
        self.values = values
        self.counts = np.ascontiguousarray(counts[:, :n_maps])
        self.sums = self.counts @ values
        self.pseudo_sums = (won - lost) * pseudo_size
        self.products = self.counts @ (values * column)
        self.pseudo_products = self.pseudo_sums * pseudo_size
        self.size = self.counts @ column + n_pseudo * pseudo_size
        self.size_with_pseudo = self.size + 2 * _PSEUDO_WINS * pseudo_size
        squares = self.counts @ column**2 + n_pseudo * pseudo_square
        self.squares = squares + 2 * _PSEUDO_WINS * pseudo_square
        self.pseudo_squares = (n_pseudo + 2 * _PSEUDO_WINS) * pseudo_square

    def centre(self, first: int, others: np.ndarray) -> np.ndarray:
        """Return differences of rates, pseudo-maps included, shape [R, J].

        Args:
            first: index of the first condition.
            others: indices of the conditions whose rates are subtracted, shape [J].
        """
        difference = self._difference(self.sums, first, others, self.pseudo_sums)
        return difference / self.size_with_pseudo

    def error(self, first: int, others: np.ndarray) -> np.ndarray:
        """Return standard errors of the differences in `centre`, shape [R, J]."""
        centre = self.centre(first, others)
        squares = self._squared_errors(first, others, centre)
        return np.sqrt(squares) / self.size_with_pseudo

    def t_of(
        self, first: int, others: np.ndarray, centre: float | np.ndarray
    ) -> np.ndarray:
        """Return (difference − centre) / standard error, shape [R, J]."""
        # Computed in place, because this dominates the time with many conditions.
        t = self._difference(self.sums, first, others, self.pseudo_sums)
        observed_centre = t / self.size_with_pseudo
        errors = self._squared_errors(first, others, observed_centre)
        np.sqrt(errors, out=errors)
        t *= self.size_with_pseudo / self.size
        t -= centre * self.size_with_pseudo
        t /= errors
        return t

    def _squared_errors(
        self, first: int, others: np.ndarray, centre: np.ndarray
    ) -> np.ndarray:
        """Return the sums of squared deviations from the centre, shape [R, J].

        The sums are over maps and pseudo-maps.
        """
        squared_gaps = self.values[:, [first]] - self.values[:, others]
        squared_gaps *= squared_gaps
        squares = self.counts @ squared_gaps
        squares += self.pseudo_squares
        products = self._difference(self.products, first, others, self.pseudo_products)
        products *= -2
        products += centre * self.squares
        products *= centre
        squares += products
        return squares

    @staticmethod
    def _difference(
        sums: np.ndarray, first: int, others: np.ndarray, pseudo_sums: np.ndarray
    ) -> np.ndarray:
        difference = sums[:, [first]] - sums[:, others]
        difference += pseudo_sums
        return difference
