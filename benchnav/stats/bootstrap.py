"""Bootstrap samples of maps, for intervals and the best set.

The seed is fixed, so that identical values have identical intervals.
Source: Efron and Tibshirani (1993), "An Introduction to the Bootstrap", 13.3.
"""

from functools import lru_cache

import numpy as np

LEAST_MAPS = 8  # minimum number of maps for an interval over maps
_RESAMPLES = 2_000


@lru_cache(maxsize=4)
def bootstrap_counts(maps: int, pseudo_maps: int = 0) -> np.ndarray:
    """Return the frequency of each map in 2 000 samples of M maps with replacement.

    Args:
        maps: number of maps M.
        pseudo_maps: number of pseudo-maps from which samples are also drawn.

    Returns:
        Whole numbers that sum to M in each row, float64, read-only, shape
        [2000, M + `pseudo_maps`].
    """
    population = maps + pseudo_maps
    probabilities = np.full(population, 1 / population)
    generator = np.random.default_rng(0)
    counts = generator.multinomial(maps, probabilities, _RESAMPLES).astype(float)
    counts.flags.writeable = False
    return counts


def percentile_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the ends of the 95 % percentile interval; NaN if any value is not finite.

    Args:
        values: value in each of R bootstrap samples, shape [R].
    """
    if not np.isfinite(values).all():
        return np.nan, np.nan
    low, high = np.quantile(values, [0.025, 0.975])
    return float(low), float(high)
