"""Randomisation tests of paired differences, by sign flips or exchanges on each map.

Under H₀ the two contestants are exchangeable on each map. An assignment exchanges them
on some of the maps. With up to 13 maps, all assignments are enumerated; with more,
9 999 are drawn at random with a fixed seed. Maps are first sorted by their differences,
so that p depends neither on the order of maps nor on the order of the contestants. Maps
without a difference do not affect p.
Sources: Fisher (1935), "The Design of Experiments", section 21; Phipson and Smyth
(2010), "Permutation p-values should never be zero", for counting the observed
assignment.
Letters in shapes: M maps; P numbers per contestant and map; R assignments.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy.stats import binom, rankdata, wilcoxon

# Maximum number of maps for an exact test.
_MAX_EXACT_MAPS = 13
# Number of random assignments for a larger number of maps.
_N_RANDOM = 9_999
# Tolerance relative to the largest difference. If the difference of an assignment is
# within the tolerance of the observed difference, the two are tied, and the assignment
# counts.
_ROUNDING = 1e-9


@lru_cache(maxsize=2)
def _signs(maps: int) -> np.ndarray:
    """Return signs ±1 of assignments, float64, shape [R, M].

    These are all assignments, or random ones if there are more than 13 maps.
    """
    if maps <= _MAX_EXACT_MAPS:
        assignments = np.arange(2**maps)[:, None]
        bits = assignments >> np.arange(maps) & 1
    else:
        generator = np.random.default_rng(0)
        bits = generator.integers(0, 2, (_N_RANDOM, maps), dtype=np.int8)
    return 1.0 - 2.0 * bits


def exchange_p(
    first: np.ndarray,
    second: np.ndarray,
    difference: Callable[..., np.ndarray],
    direction: str = "",
) -> float:
    """Return the p-value of H₀: a function of the sums is equal for both contestants.

    p is the fraction of assignments whose difference is at least the observed value.

    Args:
        first: values of the first contestant on each map, whose sums over maps
            `difference` takes, shape [M, P].
        second: such values of the second contestant, shape [M, P].
        difference: function of the sums of the first and of the second contestant, each
            of shape [..., P], that returns the difference of the contestants, shape
            [...]. Exchanging them must change only the sign of the result.
        direction: `higher` or `lower`, the alternative for the first contestant in a
            one-sided test; two-sided if empty.
    """
    gap = first - second
    total = (first + second).sum(0)
    gap = gap[gap.any(1)]
    leading_part = (gap != 0).argmax(1)
    leading_gap = gap[np.arange(len(gap)), leading_part]
    oriented = gap * np.sign(leading_gap)[:, None]
    descending = np.lexsort(oriented.T[::-1])[::-1]
    gaps = _signs(len(gap)) @ oriented[descending]
    differences = difference(_half(total, gaps), _half(total, -gaps))
    observed = float(difference(first.sum(0), second.sum(0)))
    tolerance = _ROUNDING * np.abs(differences).max()
    if not direction:
        differences = np.abs(differences)
        observed = abs(observed)
    elif direction == "lower":
        observed = -observed
    beyond = int((differences >= observed - tolerance).sum())
    if len(gap) <= _MAX_EXACT_MAPS:
        return beyond / len(differences)
    return (1 + beyond) / (1 + len(differences))


def _half(total: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Return (total + gap) / 2; values that differ from 0 only by rounding become 0.

    A function such as a root would amplify these rounding errors.
    """
    half = (total + gap) / 2
    tolerance = 1e-12 * np.abs(total)
    return np.where(np.abs(half) < tolerance, 0, half)


def mean_flip_p(differences: np.ndarray, direction: str = "") -> float:
    """Return the p-value of H₀: the mean difference is 0.

    Args:
        differences: difference on each map, where tied values must be exactly equal
            (see `by_map.alike`), shape [M].
        direction: `higher` or `lower` for a one-sided test; two-sided if empty.
    """

    def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return (a - b)[..., 0]

    column = differences[:, None]
    return exchange_p(column, 0 * column, difference, direction)


def sign_flip_p(gains: np.ndarray, direction: str = "") -> float:
    """Return the exact p-value of H₀: counts do not differ.

    Among n maps with the same absolute gain, the number of positive gains has a
    binomial distribution. The distribution of the sum of gains is therefore the
    convolution of one binomial distribution per absolute gain, for any number of maps.
    With one episode per map, the test is the exact McNemar test.

    Args:
        gains: count of the first condition minus count of the second on each map, such
            as numbers of successes; whole numbers, shape [M].
        direction: `higher` or `lower` for a one-sided test; two-sided if empty.
    """
    divisor = max(np.gcd.reduce(gains), 1)
    # p does not depend on a common factor, such as that of repeated episodes.
    gains = gains // divisor
    nonzero_gains = np.abs(gains[gains != 0])
    sizes, counts = np.unique(nonzero_gains, return_counts=True)
    probabilities = np.ones(1)
    for size, count in zip(sizes, counts, strict=True):
        n_positive = np.arange(count + 1)
        spread = np.zeros(2 * size * count + 1)
        spread[:: 2 * size] = binom.pmf(n_positive, count, 0.5)
        probabilities = np.convolve(probabilities, spread)
    total = np.abs(gains).sum()
    sums = np.arange(-total, total + 1)
    observed = gains.sum()
    if direction == "higher":
        is_extreme = sums >= observed
    elif direction == "lower":
        is_extreme = sums <= observed
    else:
        is_extreme = np.abs(sums) >= abs(observed)
    p = float(probabilities[is_extreme].sum())
    return min(p, 1.0)


def signed_rank_p(differences: np.ndarray) -> float:
    """Return the two-sided p-value of Wilcoxon's signed-rank test; 1 if no map differs.

    If at most 13 maps differ, the test is exact even with ties: all signs of the ranks
    are enumerated. SciPy returns the same p, but is slower, because it calls a function
    for each assignment of signs.

    Args:
        differences: difference on each map, where tied values must be exactly equal,
            such as differences from `by_map.sums_by_map`, shape [M].
    """
    differing = differences[differences != 0]
    if len(differing) > _MAX_EXACT_MAPS:
        return float(wilcoxon(differing).pvalue)
    ranks = rankdata(np.abs(differing))
    # Ranks of ties are multiples of 1/2.
    twice_ranks = np.rint(2 * ranks)
    signed_ranks = twice_ranks * np.sign(differing)
    return sign_flip_p(signed_ranks.astype(np.int64))
