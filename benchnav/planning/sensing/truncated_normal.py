"""Moments of truncated normals, also far out in a tail.

In NumPy and float64; all arrays have the shape [N] of the intervals.
"""

import math

import numpy as np
from numpy import ndarray
from scipy.special import log_ndtr

MIN_FRACTION = 1e-9
"""Minimum fraction of the variance that remains in an interval."""


@np.errstate(over="ignore")
def interval_moments(
    mean: ndarray, variance: ndarray, lower: ndarray, upper: ndarray
) -> tuple[ndarray, ndarray]:
    """Return mean and variance of truncated normals, also far out in a tail.

    Args:
        mean: mean before truncation, float64.
        variance: variance before truncation, > 0.
        lower: lower bound, −∞ if unbounded.
        upper: upper bound, above `lower`; ∞ if unbounded.
    """
    low, high, log_mass, flipped = standardise(mean, variance, lower, upper)
    at_low, at_high = _density(low, log_mass), _density(high, log_mass)
    shift = at_low - at_high
    low_term = _finite(low) * at_low
    high_term = _finite(high) * at_high
    fraction = 1 + low_term - high_term - np.square(shift)
    fraction = fraction.clip(MIN_FRACTION, 1)
    shift = shift.clip(low, high)
    signed_shift = np.where(flipped, -shift, shift)
    return mean + np.sqrt(variance) * signed_shift, variance * fraction


@np.errstate(over="ignore", invalid="ignore")
def third_cumulant(
    mean: ndarray, variance: ndarray, lower: ndarray, upper: ndarray
) -> ndarray:
    """Return the third cumulant of truncated normals."""
    low, high, log_mass, flipped = standardise(mean, variance, lower, upper)
    at_low, at_high = _density(low, log_mass), _density(high, log_mass)
    low, high = _finite(low), _finite(high)
    first = at_low - at_high
    second = 1 + low * at_low - high * at_high
    third = (low**2 + 2) * at_low - (high**2 + 2) * at_high
    # Far out in a tail, where all digits cancel, the limit is an exponential.
    bound = 2 * (second - first**2).clip(0) ** 1.5
    cumulant = (third - 3 * first * second + 2 * first**3).clip(-bound, bound)
    return variance**1.5 * np.where(flipped, -cumulant, cumulant)


def standardise(
    mean: ndarray, variance: ndarray, lower: ndarray, upper: ndarray
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Return an interval in standard deviations, its log probability, and a flip mask.

    Flipped intervals are mirrored to the lower tail, where Φ loses no digits.
    """
    std = np.sqrt(variance)
    low, high = (lower - mean) / std, (upper - mean) / std
    flipped = low > -high
    low, high = np.where(flipped, -high, low), np.where(flipped, -low, high)
    log_high = log_ndtr(high)
    apart = (log_ndtr(low) - log_high).clip(max=-1e-300)
    return low, high, log_high + np.log(-np.expm1(apart)), flipped


def _finite(ends: ndarray) -> ndarray:
    """Replace infinite ends of intervals by 0."""
    return np.where(np.isinf(ends), 0.0, ends)


def _density(at: ndarray, log_mass: ndarray) -> ndarray:
    return np.exp(-0.5 * np.square(at) - 0.5 * math.log(2 * math.pi) - log_mass)
