"""Intervals of rates, of means over maps, and of their paired differences.

Letters in shapes: N episodes; M maps; a leading `...` is any number of comparisons.
"""

import numpy as np
from scipy.stats import norm, t
from statsmodels.stats.proportion import proportion_confint

from benchnav.stats.bootstrap import LEAST_MAPS

# Variance is added as if on this fraction of maps all episodes had ended differently.
_PSEUDO_FRACTION = 0.01


def wilson_interval(rate: float, n: float) -> tuple[float, float]:
    """Return Wilson's 95 % score interval for a rate. Source: Wilson (1927).

    Args:
        rate: fraction of successes, in [0, 1].
        n: number of independent trials, > 0; an effective number need not be whole.

    Returns:
        Lower and upper end, in [0, 1].
    """
    low, high = proportion_confint(rate * n, n, method="wilson")
    return float(low), float(high)


def design_effect(success: np.ndarray, maps: np.ndarray) -> float:
    """Return the design effect of success: episodes per effective episode.

    It is N / n with the effective number of episodes n = M·k. Here k is the variance of
    one episode, p(1 − p), over that of the rates of maps. To both, variance is added as
    if on one map in a hundred all episodes had ended differently. Where k exceeds 1, it
    is divided by (t/z)² of M − 1 degrees of freedom, but not below 1, because few maps
    estimate their variance poorly. With one episode per map, or if all episodes end
    identically, n is M. Repeating the same episodes does not change n.

    Sources: Korn and Graubard (1998), "Confidence intervals for proportions with small
    expected number of positive counts estimated from survey data", for n and Student's
    quantile; Cochran (1977), "Sampling Techniques", 6.3, for the variance where maps
    have different numbers of episodes. The empirical coverage of the interval is in
    `studies/statistics`, parts `intervals` and `groups`.

    Args:
        success: bool, shape [N].
        maps: label of each episode's map, shape [N].

    Returns:
        A number above 0; N if there is only one map.
    """
    _, index, episodes = np.unique(maps, return_inverse=True, return_counts=True)
    n_maps = len(episodes)
    rate = success.mean()
    if n_maps == 1:
        return float(len(success))
    size = episodes / episodes.mean()
    residual = size * (np.bincount(index, weights=success) / episodes - rate)
    episode_variance = rate * (1 - rate) + _PSEUDO_FRACTION
    map_variance = (residual**2).mean() + _PSEUDO_FRACTION * (size**2).mean()
    k = episode_variance / map_variance
    if k > 1:
        k = max(k * (norm.ppf(0.975) / t.ppf(0.975, n_maps - 1)) ** 2, 1.0)
    return float(len(success) / (n_maps * k))


def success_interval(
    gain: np.ndarray, draws: float | np.ndarray, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the difference of success rates, with an adjusted Wald interval.

    Two pseudo-maps are added, on which the conditions differ by ±c. With d the
    difference on a map, c = (mean d² + 0.01) / (mean |d| + 0.01), as if on one map in a
    hundred all episodes had ended differently. With one episode per map c is 1, and
    this is the interval of Bonett and Price with the t quantile instead of the normal
    one. If no map differs, c is also 1, so that the interval has a width, unlike that
    of a bootstrap. Repeating the same episodes does not change the interval. If maps
    have different numbers of episodes, the rate is a ratio of sums. The returned
    difference is the observed one.

    Sources: Bonett and Price (2012), "Adjusted Wald confidence interval for a
    difference of binomial proportions based on paired data"; Cochran (1977), "Sampling
    Techniques", 6.3, for the ratio. The empirical coverage with few, large groups is in
    `studies/statistics`, part `groups`.

    Args:
        gain: successes of the first condition minus those of the second by map, whole
            numbers, shape [..., M], M ≥ 2.
        draws: episodes of a condition on each map, one number or of shape [M].
        confidence: nominal coverage.

    Returns:
        Difference, lower and upper end, in [−1, 1], each of shape [...].
    """
    n_maps = gain.shape[-1]
    centre, std = _smoothed(gain, draws)
    quantile = t.ppf((1 + confidence) / 2, n_maps - 1)
    half_width = quantile * std / np.sqrt(n_maps + 2)
    mean = gain.sum(-1) / np.broadcast_to(draws, gain.shape).sum(-1)
    low = np.maximum(centre - half_width, -1)
    high = np.minimum(centre + half_width, 1)
    return mean, low, high


def standard_deviation(gain: np.ndarray, draws: float | np.ndarray) -> np.ndarray:
    """Return the standard deviation over maps of the difference of success.

    It includes the two pseudo-maps of `success_interval`.

    Args:
        gain: as in `success_interval`, shape [..., M].
        draws: as in `success_interval`.

    Returns:
        Values above 0, shape [...].
    """
    return _smoothed(gain, draws)[1]


def _smoothed(
    gain: np.ndarray, draws: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation over maps and the two pseudo-maps."""
    n_maps = gain.shape[-1]
    episodes = np.broadcast_to(draws, gain.shape)
    total = episodes.sum(-1)
    size = episodes * (n_maps / total)[..., None]
    contribution = gain * (n_maps / total)[..., None]
    mean_square = (gain**2 / episodes).sum(-1) / total
    mean_size = np.abs(gain).sum(-1) / total
    c = (mean_square + _PSEUDO_FRACTION) / (mean_size + _PSEUDO_FRACTION)
    added_size = np.sqrt((size**2).mean(-1))  # of a pseudo-map
    total_size = n_maps + 2 * added_size
    centre = contribution.sum(-1) / total_size
    residual = contribution - centre[..., None] * size
    squares = (residual**2).sum(-1) + 2 * added_size**2 * (c**2 + centre**2)
    return centre, np.sqrt(squares * (n_maps + 2)) / total_size


def mean_interval(
    values: np.ndarray, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean over maps with Student's interval.

    Args:
        values: value of each map, shape [..., M].
        confidence: nominal coverage.

    Returns:
        Mean, lower and upper end, each of shape [...]. The mean is NaN without maps,
        the ends are NaN with fewer than `LEAST_MAPS` maps.
    """
    n_maps = values.shape[-1]
    mean = values.mean(-1) if n_maps else np.full(values.shape[:-1], np.nan)
    half_width = _half_width(values, n_maps - 1, confidence)
    return mean, mean - half_width, mean + half_width


def total_time_interval(
    time_s: np.ndarray,
    failed: np.ndarray,
    failed_interval: tuple[float | np.ndarray, float | np.ndarray],
    penalty_s: float | np.ndarray,
    arrived: int | np.ndarray,
    confidence: float = 0.95,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean over maps of T_total, or of its difference, with an interval.

    A rare failure costs many seconds, and a sample of few maps may not contain any. A
    bootstrap or Student's interval of T_total then underestimates the cost of failures:
    at a success rate of 19 in 20, a bootstrap over 20 maps covers 85 % instead of 95 %.
    The interval is therefore combined from two by the method of variance estimates
    recovery: that of the failure rate times the cost of a failure, and Student's
    interval of the time without that cost.

    Source: Zou and Donner (2008), "Construction of confidence limits about effect
    measures: a general approach".

    Args:
        time_s: mean of T_total by map, where failures count as T, or its difference, in
            seconds, shape [..., M].
        failed: failure rate by map, or its difference, shape [..., M].
        failed_interval: ends of the interval of its mean, each of shape [...].
        penalty_s: cost of a failure compared with a success, in seconds, shape [...].
        arrived: number of maps with a success, shape [...].
        confidence: nominal coverage, the same as that of `failed_interval`.

    Returns:
        Mean, lower and upper end in seconds, each of shape [...]; the ends are NaN with
        fewer than `LEAST_MAPS` maps.
    """
    mean = time_s.mean(-1)
    failure_rate = failed.mean(-1)
    without_cost = time_s - np.expand_dims(penalty_s, -1) * failed
    freedom = np.maximum(arrived - 1, 1)
    half_width = _half_width(without_cost, freedom, confidence)
    below = failure_rate - failed_interval[0]
    above = failed_interval[1] - failure_rate
    low = mean - np.hypot(half_width, penalty_s * below)
    high = mean + np.hypot(half_width, penalty_s * above)
    return mean, low, high


def _half_width(
    values: np.ndarray, freedom: np.ndarray | int, confidence: float
) -> np.ndarray:
    n_maps = values.shape[-1]
    if n_maps < LEAST_MAPS:
        return np.full(values.shape[:-1], np.nan)
    quantile = t.ppf((1 + confidence) / 2, freedom)
    return quantile * values.std(-1, ddof=1) / np.sqrt(n_maps)
