"""Minimum detectable differences and numbers of maps for a given power.

The mean difference is taken as normal, which is accurate from about twenty maps on. A
difference d with standard deviation σ is significant with probability `POWER` if d·√M/σ
is the quantile of 1 − α/2 plus that of `POWER`.
Source: Chow, Shao and Wang (2008), "Sample Size Calculations in Clinical Research",
3.1.
"""

import math

from scipy.stats import norm

POWER = 0.8


def smallest_difference(std: float, maps: int, alpha: float) -> float:
    """Return the minimum detectable difference at a power of `POWER`.

    Args:
        std: standard deviation over maps of the difference, in its unit.
        maps: number of maps.
        alpha: level of significance; with a correction over K pairs, that of the first,
            0.05/K.

    Returns:
        A difference in the unit of `std`; infinite if no sign-flip test of this number
        of maps can reach `alpha`.
    """
    if 2.0 ** (1 - maps) >= alpha:
        return math.inf
    return _quantiles(alpha) * std / math.sqrt(maps)


def maps_needed(std: float, difference: float, alpha: float) -> int:
    """Return the minimum number of maps to detect a difference at a power of `POWER`.

    Args:
        std: as in `smallest_difference`.
        difference: above 0, in the unit of `std`.
        alpha: as in `smallest_difference`.
    """
    return math.ceil((_quantiles(alpha) * std / difference) ** 2)


def _quantiles(alpha: float) -> float:
    return float(norm.ppf(1 - alpha / 2) + norm.ppf(POWER))
