"""Moments of truncated normals, accurate also far out in a tail.

All arrays are NumPy arrays of float64 and shape [N]: one value per interval.
"""

import math

import numpy as np
from numpy import ndarray
from scipy.special import log_ndtr

MIN_FRACTION = 1e-9
"""Minimum ratio of the variance after truncation to the variance before."""


@np.errstate(over="ignore")
def interval_moments(
    mean: ndarray, variance: ndarray, lower: ndarray, upper: ndarray
) -> tuple[ndarray, ndarray]:
    """Return mean and variance of truncated normals.

    Args:
        mean: mean before truncation.
        variance: variance before truncation, > 0.
        lower: lower bound; −∞ if unbounded.
        upper: upper bound, above `lower`; ∞ if unbounded.
    """
    low, high, log_mass, flipped = standardise(mean, variance, lower, upper)
    at_low = _density(low, log_mass)
    at_high = _density(high, log_mass)
    shift = at_low - at_high
    low_term = _finite(low) * at_low
    high_term = _finite(high) * at_high
    fraction = 1 + low_term - high_term - np.square(shift)
    fraction = fraction.clip(MIN_FRACTION, 1)
    shift = shift.clip(low, high)
    signed_shift = np.where(flipped, -shift, shift)
    new_mean = mean + np.sqrt(variance) * signed_shift
    return new_mean, variance * fraction


@np.errstate(over="ignore", invalid="ignore")
def third_cumulant(
    mean: ndarray, variance: ndarray, lower: ndarray, upper: ndarray
) -> ndarray:
    """Return the third cumulant of truncated normals; see `interval_moments`."""
    low, high, log_mass, flipped = standardise(mean, variance, lower, upper)
    at_low = _density(low, log_mass)
    at_high = _density(high, log_mass)
    low = _finite(low)
    high = _finite(high)
    # Raw moments.
    first = at_low - at_high
    second = 1 + low * at_low - high * at_high
    low_third = (low**2 + 2) * at_low
    high_third = (high**2 + 2) * at_high
    third = low_third - high_third
    # Far out in a tail all digits cancel. There the distribution tends to an
    # exponential one, whose third cumulant is 2 σ³.
    bound = 2 * (second - first**2).clip(0) ** 1.5
    cumulant = third - 3 * first * second + 2 * first**3
    cumulant = cumulant.clip(-bound, bound)
    signed = np.where(flipped, -cumulant, cumulant)
    return variance**1.5 * signed


def standardise(
    mean: ndarray, variance: ndarray, lower: ndarray, upper: ndarray
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Return intervals in standard deviations from the mean, and their probability.

    Intervals in the upper tail are mirrored to the lower tail, where Φ loses no digits.

    Args:
        mean: mean before truncation.
        variance: variance before truncation, > 0.
        lower: lower bound; −∞ if unbounded.
        upper: upper bound, above `lower`; ∞ if unbounded.

    Returns:
        Lower bounds, upper bounds, log probabilities of the intervals, and a mask of
        mirrored intervals (bool).
    """
    std = np.sqrt(variance)
    low = (lower - mean) / std
    high = (upper - mean) / std
    flipped = low > -high
    mirrored_low = np.where(flipped, -high, low)
    mirrored_high = np.where(flipped, -low, high)
    log_high = log_ndtr(mirrored_high)
    log_ratio = (log_ndtr(mirrored_low) - log_high).clip(max=-1e-300)
    log_mass = log_high + np.log(-np.expm1(log_ratio))
    return mirrored_low, mirrored_high, log_mass, flipped


def _finite(ends: ndarray) -> ndarray:
    """Replace infinite ends of intervals by 0: their terms vanish."""
    return np.where(np.isinf(ends), 0.0, ends)


def _density(z: ndarray, log_mass: ndarray) -> ndarray:
    """Return φ(z) divided by the probability of the interval; 0 for infinite z."""
    half_log_tau = 0.5 * math.log(2 * math.pi)
    log_density = -0.5 * np.square(z) - half_log_tau
    return np.exp(log_density - log_mass)
