"""What a mean over maps might have been: ways to flip signs, for tests, and to draw maps anew, for intervals.

`holm` corrects the p of several tests.

All draws are those of one fixed seed, so that the same numbers give the same p and the same interval.
"""

from functools import lru_cache

import numpy as np

LEAST_MAPS = 8  # for an interval of what may have any distribution

# Up to so many maps signs are flipped in all ways, beyond in so many drawn ones.
_ALL_FLIPPED, _FLIPS = 13, 9_999
_RESAMPLES = 2_000


def sign_flips(maps: int) -> np.ndarray:
    """Ways to flip the sign of each map's differences: all of them on few maps, else as they are and 9 999 draws.

    Args:
        maps: M.

    Returns:
        ±1, shape [ways, M].
    """
    if maps <= _ALL_FLIPPED:
        bits = np.arange(2**maps)[:, None] >> np.arange(maps) & 1
        return 1.0 - 2.0 * bits
    drawn = np.random.default_rng(0).integers(0, 2, (_FLIPS, maps), dtype=np.int8)
    return np.concatenate([np.ones((1, maps)), 1.0 - 2.0 * drawn])


@lru_cache(maxsize=4)
def bootstrap_counts(maps: int, added: int = 0) -> np.ndarray:
    """How often each map is in one of 2 000 samples of as many maps, drawn with replacement (Efron, 1979).

    Args:
        maps: M.
        added: pseudo-maps that samples are drawn from too.

    Returns:
        Whole numbers whose rows add up to M, float64, read-only, shape [2000, M + added].
    """
    drawn_from = maps + added
    generator = np.random.default_rng(0)
    counts = generator.multinomial(maps, np.full(drawn_from, 1 / drawn_from), _RESAMPLES).astype(float)
    counts.flags.writeable = False
    return counts


def holm(p: np.ndarray) -> np.ndarray:
    """Corrects p-values for their number, shape [N]. Source: Holm (1979).

    statsmodels' `multipletests` gives the same, but collects garbage at each call, which takes longer than the tests.
    """
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * np.arange(len(p), 0, -1)).clip(max=1)
    return stepped[np.argsort(order)]
