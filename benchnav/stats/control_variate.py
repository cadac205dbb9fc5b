"""Control variates: a mean of costly values, made more precise by cheap ones.

A contrast in a costly world, such as one of rigid bodies, is measured on few maps. The
same contrast in a cheap world is measured on these maps and on many others. If both
correlate over maps, the cheap values tell how far the costly maps are from average.
Sources: Owen (2013), "Monte Carlo theory, methods and examples", 8.9; Zhang, Brown and
Cai (2019), "Semi-supervised inference: general theory and estimation of means".
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student_t

from benchnav.core.errors import expect

MIN_MAPS = 4
"""Minimum number of maps with both values."""


@dataclass(frozen=True)
class ControlledMean:
    """Mean of a costly value with its interval, by a control variate.

    Args:
        mean: estimate of the mean.
        low: lower end of the interval.
        high: upper end of the interval.
        slope: change of the costly value per unit of the cheap value.
        correlation: correlation of both values over maps.
        variance_ratio: variance of the estimate as a fraction of that of the plain mean
            of the costly values. Above 1 if the cheap values do not help.
    """

    mean: float
    low: float
    high: float
    slope: float
    correlation: float
    variance_ratio: float


def controlled_mean(
    costly: np.ndarray,
    cheap: np.ndarray,
    more_cheap: np.ndarray,
    confidence: float = 0.95,
) -> ControlledMean:
    """Estimate the mean of a costly value from few costly and many cheap values.

    The interval is that of a normal mean. It does not include the small error of the
    fitted slope.

    Args:
        costly: costly value of each of N maps, shape [N].
        cheap: cheap value of the same maps, shape [N].
        more_cheap: cheap values of other, independent maps, shape [M]; may be empty.
        confidence: confidence of the interval.

    Returns:
        The estimate. Without other maps, it is the plain mean of `costly`.

    Raises:
        ConfigError: If the two values do not have the same N ≥ 4 maps.
    """
    n_both = len(costly)
    n_other = len(more_cheap)
    expect(
        len(cheap) == n_both >= MIN_MAPS,
        f"costly and cheap values of the same maps, at least {MIN_MAPS}, got {n_both} "
        f"and {len(cheap)}.",
    )
    variance_costly = float(np.var(costly, ddof=1))
    variance_cheap = float(np.var(cheap, ddof=1))
    covariance = float(np.cov(costly, cheap)[0, 1])
    slope = covariance / variance_cheap if variance_cheap > 0 else 0.0
    all_cheap = np.concatenate((cheap, more_cheap))
    offset = float(all_cheap.mean() - np.mean(cheap))
    mean = float(np.mean(costly)) + slope * offset
    explained = slope * covariance
    residual = (variance_costly - explained) * (n_both - 1) / (n_both - 2)
    residual = max(residual, 0.0)
    # Other maps remove the variance that the cheap value explains, in proportion to
    # their fraction of all maps.
    weight = n_other / (n_both + n_other)
    variance = (residual * weight + variance_costly * (1 - weight)) / n_both
    plain = variance_costly / n_both
    margin = float(student_t.ppf((1 + confidence) / 2, n_both - 2))
    half_width = margin * math.sqrt(variance)
    correlation = math.nan
    if variance_costly > 0 and variance_cheap > 0:
        correlation = covariance / math.sqrt(variance_costly * variance_cheap)
    return ControlledMean(
        mean=mean,
        low=mean - half_width,
        high=mean + half_width,
        slope=slope,
        correlation=correlation,
        variance_ratio=variance / plain if plain > 0 else math.nan,
    )
