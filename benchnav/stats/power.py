"""What a number of maps can show of a mean difference that is nearly normal, which it
is from some twenty maps on.

A difference d with standard deviation σ is significant with probability `POWER` if
d·√M/σ is the quantile of 1 − α/2
plus that of `POWER`. Source: Chow, Shao and Wang (2008), "Sample Size Calculations in
Clinical Research", 3.1.
"""

import math

from scipy.stats import norm

POWER = 0.8


def smallest_difference(std: float, maps: int, alpha: float) -> float:
    """Difference that a study of so many maps would show, with a chance of `POWER`.

    Args:
        std: standard deviation over maps of the difference, in its unit.
        maps: number of maps.
        alpha: p under which a difference counts as shown; after a correction over K
            pairs, that of the first, 0.05/K.

    Returns:
        In the unit of `std`; infinite where no sign-flip test of so many maps can reach
        `alpha`, whatever they show.
    """
    if 2.0 ** (1 - maps) >= alpha:
        return math.inf
    return _quantiles(alpha) * std / math.sqrt(maps)


def maps_needed(std: float, difference: float, alpha: float) -> int:
    """Smallest number of maps that would show a difference with a chance of `POWER`.

    Args:
        std: as in `smallest_difference`.
        difference: above 0, in the unit of `std`.
        alpha: as there.
    """
    return math.ceil((_quantiles(alpha) * std / difference) ** 2)


def _quantiles(alpha: float) -> float:
    return float(norm.ppf(1 - alpha / 2) + norm.ppf(POWER))
