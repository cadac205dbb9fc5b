"""Minimum detectable differences and numbers of maps for a given power.

The mean difference is assumed to be normally distributed, which is accurate from about
twenty maps on. A difference d with standard deviation σ over M maps is significant with
probability `POWER` if d·√M/σ equals the sum of the normal quantiles of 1 − α/2 and of
`POWER`.
Source: Chow, Shao and Wang (2008), "Sample Size Calculations in Clinical Research",
3.1.
"""

import math

from scipy.stats import norm

POWER = 0.8


def smallest_difference(std: float, maps: int, alpha: float) -> float:
    """Return the minimum detectable difference at a power of `POWER`.

    Args:
        std: standard deviation of the difference over maps, in the difference's unit.
        maps: number of maps.
        alpha: level of significance. With Holm's correction over K pairs, it is 0.05/K,
            the level of the first step.

    Returns:
        Difference in the unit of `std`; infinite if no sign-flip test of this number of
        maps can reach `alpha`.
    """
    if 2.0 ** (1 - maps) >= alpha:
        return math.inf
    return _quantiles(alpha) * std / math.sqrt(maps)


def maps_needed(std: float, difference: float, alpha: float) -> int:
    """Return the minimum number of maps to detect a difference at a power of `POWER`.

    Args:
        std: standard deviation of the difference over maps, in the difference's unit.
        difference: difference to detect, > 0, in the unit of `std`.
        alpha: level of significance, as in `smallest_difference`.
    """
    root = _quantiles(alpha) * std / difference
    return math.ceil(root**2)


def _quantiles(alpha: float) -> float:
    """Return the sum of the normal quantiles of 1 − α/2 and of `POWER`."""
    significance = norm.ppf(1 - alpha / 2)
    return float(significance + norm.ppf(POWER))
