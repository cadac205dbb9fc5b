"""Intervals of rates, of means over maps, and of their paired differences.

Letters in shapes: N episodes; M maps; a leading `...` is any number of comparisons.
"""

import numpy as np
from scipy.stats import norm, t
from statsmodels.stats.proportion import proportion_confint

from benchnav.stats.bootstrap import LEAST_MAPS

# Fraction of maps. Variances are increased as if all episodes on this fraction of maps
# had ended differently.
_PSEUDO_FRACTION = 0.01


def wilson_interval(rate: float, n: float) -> tuple[float, float]:
    """Return Wilson's 95 % score interval for a rate.

    Source: Wilson (1927).

    Args:
        rate: fraction of successes, in [0, 1].
        n: number of independent Bernoulli trials, > 0. It may be an effective number,
            which need not be whole.

    Returns:
        Lower and upper end, in [0, 1].
    """
    successes = rate * n
    low, high = proportion_confint(successes, n, method="wilson")
    return float(low), float(high)


def design_effect(success: np.ndarray, maps: np.ndarray) -> float:
    """Return the design effect of success: N episodes per effective episode.

    The design effect is N / n, with the effective number of episodes n = M·k. The
    factor k is the variance of one episode, p(1 − p), divided by the variance of the
    maps' success rates. Both variances are increased as if all episodes on one map in a
    hundred had ended differently. If k exceeds 1, it is divided by (t/z)², but not
    below 1, because the variance of few maps is estimated poorly. Here t and z are the
    97.5 % quantiles of Student's distribution with M − 1 degrees of freedom and of the
    normal distribution. With one episode per map, or if all episodes end identically, n
    is M. Repeating the same episodes does not change n.

    Sources: Korn and Graubard (1998), "Confidence intervals for proportions with small
    expected number of positive counts estimated from survey data", for n and Student's
    quantile; Cochran (1977), "Sampling Techniques", 6.3, for the variance if maps have
    different numbers of episodes. The empirical coverage of the interval is in
    `studies/statistics`, parts `intervals` and `groups`.

    Args:
        success: whether each episode succeeded, bool, shape [N].
        maps: label of each episode's map, shape [N].

    Returns:
        Design effect, > 0; N if there is only one map.
    """
    _, index, episodes = np.unique(maps, return_inverse=True, return_counts=True)
    n_maps = len(episodes)
    rate = success.mean()
    if n_maps == 1:
        return float(len(success))
    size = episodes / episodes.mean()
    rate_by_map = np.bincount(index, weights=success) / episodes
    residual = size * (rate_by_map - rate)
    mean_residual_square = (residual**2).mean()
    mean_size_square = (size**2).mean()
    episode_variance = rate * (1 - rate) + _PSEUDO_FRACTION
    map_variance = mean_residual_square + _PSEUDO_FRACTION * mean_size_square
    k = episode_variance / map_variance
    if k > 1:
        normal_quantile = norm.ppf(0.975)
        student_quantile = t.ppf(0.975, n_maps - 1)
        k *= (normal_quantile / student_quantile) ** 2
        k = max(k, 1.0)
    effective_episodes = n_maps * k
    return float(len(success) / effective_episodes)


def success_interval(
    gains: np.ndarray, episodes: float | np.ndarray, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the difference of success rates, with an adjusted Wald interval.

    Two pseudo-maps are added, on which the conditions differ by c and by −c. If d is
    the difference on a map, c = (mean d² + 0.01) / (mean |d| + 0.01), as if all
    episodes on one map in a hundred had ended differently. With one episode per map,
    c is 1, and this is the interval of Bonett and Price with the t quantile instead of
    the normal quantile. If no map differs, c is also 1, and the interval has a width
    above 0, unlike a bootstrap interval. Repeating the same episodes does not change
    the interval. If maps have different numbers of episodes, the rate is a ratio of
    sums. The returned difference is the observed one, without pseudo-maps.

    Sources: Bonett and Price (2012), "Adjusted Wald confidence interval for a
    difference of binomial proportions based on paired data"; Cochran (1977), "Sampling
    Techniques", 6.3, for the ratio. The empirical coverage with few, large groups is in
    `studies/statistics`, part `groups`.

    Args:
        gains: number of successes of the first condition minus that of the second on
            each map, whole numbers, shape [..., M], M ≥ 2.
        episodes: number of episodes of each condition on each map, a single number or
            shape [M].
        confidence: nominal coverage, in (0, 1).

    Returns:
        Difference, lower end and upper end, in [−1, 1], each of shape [...].
    """
    n_maps = gains.shape[-1]
    centre, std = _smoothed(gains, episodes)
    quantile = t.ppf((1 + confidence) / 2, n_maps - 1)
    half_width = quantile * std / np.sqrt(n_maps + 2)
    n_episodes = np.broadcast_to(episodes, gains.shape).sum(-1)
    mean = gains.sum(-1) / n_episodes
    low = np.maximum(centre - half_width, -1)
    high = np.minimum(centre + half_width, 1)
    return mean, low, high


def standard_deviation(gains: np.ndarray, episodes: float | np.ndarray) -> np.ndarray:
    """Return the standard deviation over maps of the difference in success.

    The two pseudo-maps of `success_interval` are included.

    Args:
        gains: number of successes of the first condition minus that of the second on
            each map, shape [..., M].
        episodes: number of episodes of each condition on each map, a single number or
            shape [M].

    Returns:
        Standard deviations, > 0, shape [...].
    """
    _, std = _smoothed(gains, episodes)
    return std


def _smoothed(
    gains: np.ndarray, episodes: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation of `gains` over maps and two pseudo-maps."""
    n_maps = gains.shape[-1]
    size_of_map = np.broadcast_to(episodes, gains.shape)
    n_episodes = size_of_map.sum(-1)
    weight = (n_maps / n_episodes)[..., None]
    size = size_of_map * weight
    contribution = gains * weight
    square_sum = (gains**2 / size_of_map).sum(-1)
    mean_square = square_sum / n_episodes
    mean_size = np.abs(gains).sum(-1) / n_episodes
    c = (mean_square + _PSEUDO_FRACTION) / (mean_size + _PSEUDO_FRACTION)
    pseudo_size = np.sqrt((size**2).mean(-1))  # size of a pseudo-map
    total_size = n_maps + 2 * pseudo_size
    centre = contribution.sum(-1) / total_size
    residual = contribution - centre[..., None] * size
    map_squares = (residual**2).sum(-1)
    pseudo_squares = 2 * pseudo_size**2 * (c**2 + centre**2)
    squares = map_squares + pseudo_squares
    std = np.sqrt(squares * (n_maps + 2)) / total_size
    return centre, std


def mean_interval(
    values: np.ndarray, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean over maps with Student's interval.

    Args:
        values: value of each map, shape [..., M].
        confidence: nominal coverage, in (0, 1).

    Returns:
        Mean, lower end and upper end, each of shape [...]. The mean is NaN if there are
        no maps. The ends are NaN if there are fewer than `LEAST_MAPS` maps.
    """
    n_maps = values.shape[-1]
    mean = np.full(values.shape[:-1], np.nan)
    if n_maps:
        mean = values.mean(-1)
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

    A rare failure costs many seconds, and a sample of few maps may contain no failure.
    A bootstrap or Student's interval of T_total then underestimates the cost of failures:
    at a success rate of 19 in 20, a bootstrap over 20 maps covers 85 % instead of 95 %.
    The method of variance estimates recovery (MOVER) therefore combines two intervals:
    the interval of the failure rate times the cost of a failure, and Student's interval
    of the time without that cost.

    Source: Zou and Donner (2008), "Construction of confidence limits about effect
    measures: a general approach".

    Args:
        time_s: mean T_total of each map in seconds, where a failure counts as T; or
            the difference of two conditions in this mean; shape [..., M].
        failed: failure rate of each map, or the difference of two conditions in this
            rate, shape [..., M].
        failed_interval: lower and upper end of an interval of the mean of `failed`,
            each of shape [...].
        penalty_s: additional time of a failure compared with a success, in seconds,
            shape [...].
        arrived: number of maps with a success, shape [...].
        confidence: nominal coverage, in (0, 1), also of `failed_interval`.

    Returns:
        Mean, lower end and upper end in seconds, each of shape [...]. The ends are NaN
        if there are fewer than `LEAST_MAPS` maps.
    """
    mean = time_s.mean(-1)
    failure_rate = failed.mean(-1)
    cost_s = np.expand_dims(penalty_s, -1) * failed
    freedom = np.maximum(arrived - 1, 1)
    half_width = _half_width(time_s - cost_s, freedom, confidence)
    low_rate, high_rate = failed_interval
    below = failure_rate - low_rate
    above = high_rate - failure_rate
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
    std = values.std(-1, ddof=1)
    return quantile * std / np.sqrt(n_maps)
