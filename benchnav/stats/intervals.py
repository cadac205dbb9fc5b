"""Intervals of rates, of means over maps, and of their paired differences.

Letters in shapes: N episodes; M maps; a leading `...` is any number of comparisons.
"""

import numpy as np
from scipy.stats import norm, t
from statsmodels.stats.proportion import proportion_confint

from benchnav.stats.bootstrap import LEAST_MAPS

# Pseudo-maps of an interval are as if this fraction of the maps had ended wholly
# different.
UNSEEN = 0.01


def wilson_interval(rate: float, n: float) -> tuple[float, float]:
    """Wilson's 95 % score interval for a rate. Source: Wilson (1927).

    Args:
        rate: share of successes, in [0, 1].
        n: number of independent trials, > 0; an effective number need not be whole.

    Returns:
        Lower and upper end, in [0, 1].
    """
    low, high = proportion_confint(rate * n, n, method="wilson")
    return float(low), float(high)


def design_effect(success: np.ndarray, maps: np.ndarray) -> float:
    """Return how many episodes tell as much as one on a map of its own would.

    It is the number of episodes over n = M·k, with k the variance of one episode, p(1 −
    p), over that of the rates of maps, both as if one map in a hundred had shown no
    more than one episode would. Above 1, k is divided by (t/z)² of M − 1 degrees of
    freedom, down to 1, since few maps tell their variance badly. With one episode a
    map, or where all episodes end alike, n is M; twice the same episodes have the same
    n.
    Sources: Korn and Graubard (1998), "Confidence intervals for proportions with small
    expected number of positive counts estimated from survey data", for n and Student's
    quantile; Cochran (1977), "Sampling Techniques", 6.3, for the variance where maps
    have unequally many episodes. How often the interval covers the truth:
    `studies/statistics`, parts `intervals` and `groups`.

    Args:
        success: bool, shape [N].
        maps: which map each episode was on, any labels, shape [N].

    Returns:
        Above 0, N on one map.
    """
    _, member, episodes = np.unique(maps, return_inverse=True, return_counts=True)
    count, rate = len(episodes), success.mean()
    if count == 1:
        return float(len(success))
    size = episodes / episodes.mean()
    residual = size * (np.bincount(member, weights=success) / episodes - rate)
    gain = (rate * (1 - rate) + UNSEEN) / (
        (residual**2).mean() + UNSEEN * (size**2).mean()
    )
    if gain > 1:
        gain = max(gain * (norm.ppf(0.975) / t.ppf(0.975, count - 1)) ** 2, 1.0)
    return float(len(success) / (count * gain))


def success_interval(
    gain: np.ndarray, draws: float | np.ndarray, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Difference of success rates, with the adjusted Wald interval for paired
    proportions.

    To the maps two are added, on which the conditions differ by ±c. c is the size of a
    difference on a map, each map weighted by its own, as if one map in a hundred had
    ended wholly unlike: (mean d² + 0.01) / (mean |d| + 0.01). With one episode a map c
    is 1, and this is the interval of Bonett and Price, with the t quantile in place of
    the normal one. Where no map differs c is 1 too, so that unlike a bootstrap it is no
    point. Twice the same episodes give the same interval. Where maps have unequally
    many episodes the rate is a ratio of sums. The difference itself is as it was seen.
    Sources: Bonett and Price (2012), "Adjusted Wald confidence interval for a
    difference of binomial proportions based on paired data"; Cochran (1977), "Sampling
    Techniques", 6.3, for the ratio. How often the interval covers the
    truth on few, large groups: `studies/statistics`, part `groups`.

    Args:
        gain: successes of the one condition less those of the other by map, whole
            numbers, shape [..., M], M ≥ 2.
        draws: episodes of a condition on each map, one number or of shape [M].
        confidence: coverage asked for.

    Returns:
        Difference, lower and upper end, in [−1, 1], each of shape [...].
    """
    maps, (centre, std) = gain.shape[-1], _smoothed(gain, draws)
    half = t.ppf((1 + confidence) / 2, maps - 1) * std / np.sqrt(maps + 2)
    mean = gain.sum(-1) / np.broadcast_to(draws, gain.shape).sum(-1)
    return mean, np.maximum(centre - half, -1), np.minimum(centre + half, 1)


def standard_deviation(gain: np.ndarray, draws: float | np.ndarray) -> np.ndarray:
    """Standard deviation over maps of the difference of success, with the two maps that
    `success_interval` adds.

    Args:
        gain: as there, shape [..., M].
        draws: as there.

    Returns:
        Shape [...], above 0.
    """
    return _smoothed(gain, draws)[1]


def _smoothed(
    gain: np.ndarray, draws: float | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the difference over the maps and the two that
    `success_interval` adds.
    """
    maps, episodes = gain.shape[-1], np.broadcast_to(draws, gain.shape)
    total = episodes.sum(-1)
    size = episodes * (maps / total)[..., None]
    share = gain * (maps / total)[..., None]
    c = ((gain**2 / episodes).sum(-1) / total + UNSEEN) / (
        np.abs(gain).sum(-1) / total + UNSEEN
    )
    added = np.sqrt((size**2).mean(-1))  # the size of an added map
    centre = share.sum(-1) / (maps + 2 * added)
    squares = ((share - centre[..., None] * size) ** 2).sum(-1) + 2 * added**2 * (
        c**2 + centre**2
    )
    return centre, np.sqrt(squares * (maps + 2)) / (maps + 2 * added)


def mean_interval(
    values: np.ndarray, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over maps with Student's interval.

    Args:
        values: one a map, shape [..., M].
        confidence: coverage asked for.

    Returns:
        Mean, lower and upper end, each of shape [...]; the mean is NaN where there are
        no maps, the ends where there are fewer than `LEAST_MAPS`.
    """
    maps = values.shape[-1]
    mean = values.mean(-1) if maps else np.full(values.shape[:-1], np.nan)
    half = _half_width(values, maps - 1, confidence)
    return mean, mean - half, mean + half


def total_time_interval(
    time_s: np.ndarray,
    failed: np.ndarray,
    failed_interval: tuple[float | np.ndarray, float | np.ndarray],
    penalty_s: float | np.ndarray,
    arrived: int | np.ndarray,
    confidence: float = 0.95,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean of T_total over maps, or of its difference, where a failure costs many
    seconds and is rare.

    Few maps seldom show a rare failure, so that neither a bootstrap nor Student's
    interval of T_total knows what it
    would cost: where 19 in 20 arrive, a bootstrap over 20 maps covers 85 % in place of
    95 %. So the interval is put
    together from two: that of the share of failures, times what a failure costs, and
    Student's of the time without it (the method of variance estimates recovery).
    Source: Zou and Donner (2008), "Construction of confidence limits about effect
    measures: a general approach".

    Args:
        time_s: mean of T_total by map, a failure counted as T, or its difference, shape
            [..., M].
        failed: share of failures by map, or its difference, shape [..., M].
        failed_interval: ends of the interval of its mean, each of shape [...].
        penalty_s: by how much a failure takes longer than an arrival, of shape [...].
        arrived: on how many maps there was an arrival, of shape [...].
        confidence: coverage asked for, that of `failed_interval` too.

    Returns:
        Mean, lower and upper end, each of shape [...]; the ends are NaN where there are
        fewer than `LEAST_MAPS`.
    """
    mean, share = time_s.mean(-1), failed.mean(-1)
    without = time_s - np.expand_dims(penalty_s, -1) * failed
    half = _half_width(without, np.maximum(arrived - 1, 1), confidence)
    fewer, more = share - failed_interval[0], failed_interval[1] - share
    return (
        mean,
        mean - np.hypot(half, penalty_s * fewer),
        mean + np.hypot(half, penalty_s * more),
    )


def _half_width(
    values: np.ndarray, freedom: np.ndarray | int, confidence: float
) -> np.ndarray:
    maps = values.shape[-1]
    if maps < LEAST_MAPS:
        return np.full(values.shape[:-1], np.nan)
    return t.ppf((1 + confidence) / 2, freedom) * values.std(-1, ddof=1) / np.sqrt(maps)
