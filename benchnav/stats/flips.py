"""Tests of paired differences: signs of maps are flipped, or two contestants are
exchanged on each map.

Under the hypothesis the two are exchangeable on each map. All ways are counted where
that is possible, else 9 999 drawn ones with a fixed seed. Before signs are drawn, maps
are put into an order that neither their own order nor that of the two contestants
decides, so p depends on neither. Maps without a difference do not count.
Sources: Fisher (1935), "The Design of Experiments", 21; Phipson and Smyth (2010),
"Permutation p-values should never be zero", for the way that was observed, which counts
too.
Letters in shapes: M maps, P parts of a difference, R ways.
"""

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy.stats import binom, rankdata, wilcoxon

# Up to this many maps all ways are counted.
_EXACT, _DRAWN = 13, 9_999
_ROUNDING = 1e-9  # of the largest difference: ways that tie with the observed one count


@lru_cache(maxsize=2)
def _signs(maps: int) -> np.ndarray:
    """Return ±1, all ways for few maps, else drawn ones; shape [R, M]."""
    if maps <= _EXACT:
        bits = np.arange(2**maps)[:, None] >> np.arange(maps) & 1
        return 1.0 - 2.0 * bits
    return 1.0 - 2.0 * np.random.default_rng(0).integers(
        0, 2, (_DRAWN, maps), dtype=np.int8
    )


def exchange_p(
    one: np.ndarray,
    other: np.ndarray,
    difference: Callable[..., np.ndarray],
    direction: str = "",
) -> float:
    """Return p of no difference in any function of sums over maps: the fraction of ways
    that are as far out.

    Args:
        one: parts of the first contestant by map, shape [M, P].
        other: those of the second.
        difference: of two sums of parts, each of shape [..., P]: shape [...];
            antisymmetric.
        direction: in which the first is thought to lie, `higher` or `lower`; two-sided
            if empty.
    """
    gap, total = one - other, (one + other).sum(0)
    gap = gap[gap.any(1)]
    first = (gap != 0).argmax(1)
    oriented = gap * np.sign(gap[np.arange(len(gap)), first])[:, None]
    gaps = _signs(len(gap)) @ oriented[np.lexsort(oriented.T[::-1])[::-1]]
    ways = difference(_half(total, gaps), _half(total, -gaps))
    observed = float(difference(one.sum(0), other.sum(0)))
    tolerance = _ROUNDING * np.abs(ways).max()
    if not direction:
        ways, observed = np.abs(ways), abs(observed)
    elif direction == "lower":
        observed = -observed
    beyond = int((ways >= observed - tolerance).sum())
    return beyond / len(ways) if len(gap) <= _EXACT else (1 + beyond) / (1 + len(ways))


def _half(total: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """Return half of their sum; what rounding leaves of 0, whose root would be far from
    0, is 0.
    """
    half = (total + gap) / 2
    return np.where(np.abs(half) < 1e-12 * np.abs(total), 0, half)


def mean_flip_p(differences: np.ndarray, direction: str = "") -> float:
    """Return p of a mean difference of 0.

    Args:
        differences: by map, without rounding (see `by_map.alike`), shape [M].
        direction: `higher` or `lower` for a one-sided test; two-sided if empty.
    """
    one = differences[:, None]
    return exchange_p(one, 0 * one, lambda a, b: (a - b)[..., 0], direction)


def sign_flip_p(gain: np.ndarray, direction: str = "") -> float:
    """Return p of no difference in counts, such as successes, over all ways however
    many maps there are.

    Of n maps with the same size of gain the number of those kept positive is binomial,
    so that the sum over all maps is a convolution of as many binomials as there are
    sizes. With one episode a map it is the exact McNemar test.

    Args:
        gain: count of the first less that of the second by map, whole numbers, shape
            [M].
        direction: `higher` or `lower` for a one-sided test; two-sided if empty.
    """
    gain = gain // max(np.gcd.reduce(gain), 1)  # repeated episodes count once
    sizes, counts = np.unique(np.abs(gain[gain != 0]), return_counts=True)
    probabilities = np.ones(1)
    for size, count in zip(sizes, counts, strict=True):
        spread = np.zeros(2 * size * count + 1)
        spread[:: 2 * size] = binom.pmf(np.arange(count + 1), count, 0.5)
        probabilities = np.convolve(probabilities, spread)
    total = np.abs(gain).sum()
    sums, observed = np.arange(-total, total + 1), gain.sum()
    far = {"higher": sums >= observed, "lower": sums <= observed}.get(
        direction, np.abs(sums) >= abs(observed)
    )
    return min(float(probabilities[far].sum()), 1.0)


def signed_rank_p(differences: np.ndarray) -> float:
    """Return two-sided p of Wilcoxon's signed-rank test; 1 if no map differs.

    If few maps differ the test is exact with ties too: the ranks' signs are flipped in
    all ways. SciPy's p is the same there, but it calls a function for each way.

    Args:
        differences: by map without rounding, as from `by_map.sums_by_map`, shape [M].
    """
    differing = differences[differences != 0]
    if len(differing) > _EXACT:
        return float(wilcoxon(differing).pvalue)
    # Whole numbers, those of ties too.
    twice_ranks = np.rint(2 * rankdata(np.abs(differing))) * np.sign(differing)
    return sign_flip_p(twice_ranks.astype(np.int64))
