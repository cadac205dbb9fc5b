"""Samples of maps, drawn with replacement, for intervals and the best set.

All draws have one fixed seed: the same numbers give the same interval.
Source: Efron and Tibshirani (1993), "An Introduction to the Bootstrap", 13.3.
"""

from functools import lru_cache

import numpy as np

LEAST_MAPS = 8  # for an interval of a quantity with any distribution
_RESAMPLES = 2_000


@lru_cache(maxsize=4)
def bootstrap_counts(maps: int, added: int = 0) -> np.ndarray:
    """Return how often each map is in each of 2 000 samples of as many maps.

    Args:
        maps: M.
        added: pseudo-maps that samples are drawn from too.

    Returns:
        Whole numbers whose rows add up to M, float64, read-only, shape [2000, M +
        added].
    """
    drawn_from = maps + added
    generator = np.random.default_rng(0)
    counts = generator.multinomial(
        maps, np.full(drawn_from, 1 / drawn_from), _RESAMPLES
    ).astype(float)
    counts.flags.writeable = False
    return counts


def percentile_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the ends of the 95 % percentile interval; NaN if a sample has no finite
    value.

    Args:
        values: one a sample, shape [R].
    """
    if not np.isfinite(values).all():
        return np.nan, np.nan
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)
