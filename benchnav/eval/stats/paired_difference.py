"""Differences between conditions that met the same maps under the same noise, with intervals and tests.

The map is the unit: all episodes on a map, under other seeds or realisations, make one number; where a dataset has
groups of maps, all episodes of a group do, and "map" means group in what follows.
Letters in shapes: N episodes; M maps; a leading `...` is any number of comparisons.
"""

import math

import numpy as np
from scipy.stats import binom, norm, rankdata, t, wilcoxon

from benchnav.core.resampling import LEAST_MAPS

POWER = 0.8
# Up to so many maps that differ a test is exact.
_EXACT = 13
# Of the scale of what is summed: far more than rounding, far less than a time step.
_ROUNDING = 1e-9
# Pseudo-maps of an interval are as if this share of the maps had ended wholly unlike.
UNSEEN = 0.01


def alike(values: np.ndarray, scale: float) -> np.ndarray:
    """Return values in which sizes that differ by rounding are one size, and 0 where they are as small.

    Tests by ranks and by signs ask which values are 0 and which are equal. Sums of times on a grid of steps answer that
    but for rounding, which the order of episodes decides.

    Args:
        values: shape [M].
        scale: largest number that the values were computed from.

    Returns:
        Shape [M], within a few `_ROUNDING` of the scale.
    """
    order = np.argsort(np.abs(values))
    sizes = np.concatenate([[0.0], np.abs(values)[order]])
    is_new = ~(np.diff(sizes) <= _ROUNDING * scale)
    first = np.maximum.accumulate(np.where(is_new, np.arange(1, len(sizes)), 0))
    snapped = np.empty(len(values))
    snapped[order] = sizes[first]
    return np.copysign(snapped, values) + 0.0


def sums_by_map(values: np.ndarray, maps: np.ndarray, scale: float | None = None) -> np.ndarray:
    """Return the sum of each map over the mean number of episodes a map, without rounding (see `alike`).

    Args:
        values: one an episode, shape [N].
        maps: which map each was on, any labels, shape [N].
        scale: largest number that the values were computed from; their own where not given.

    Returns:
        Shape [M], in the order of sorted labels.
    """
    if not len(values):
        return np.empty(0)
    _, member, size = np.unique(maps, return_inverse=True, return_counts=True)
    sums = np.bincount(member, weights=values) / size.mean()
    return alike(sums, float(np.abs(values).max()) if scale is None else scale)


def by_map(values: np.ndarray, maps: np.ndarray, scale: float | None = None) -> np.ndarray:
    """Return one number a map, whose mean over maps is that over episodes.

    Of maps with equally many episodes it is the mean of each. Else it is the contribution of each map to the mean of
    all, Σ(v − v̄)·M/N + v̄, whose standard deviation is that of a ratio estimator.
    Source: Cochran (1977), "Sampling Techniques", 6.3.

    Args:
        values: one an episode, shape [N].
        maps: which map each was on, any labels, shape [N].
        scale: as in `sums_by_map`.

    Returns:
        Shape [M], in the order of sorted labels.
    """
    sums = sums_by_map(values, maps, scale)
    _, size = np.unique(maps, return_counts=True)
    if np.all(size == size[:1]):
        return sums
    return sums + values.mean() * (1 - size / size.mean())


def success_interval(
    gain: np.ndarray, draws: float | np.ndarray, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Difference of success rates, with the adjusted Wald interval for paired proportions.

    To the maps two are added, on which the conditions differ by ±c. c is the size of a difference on a map, each map
    weighted by its own, as if one map in a hundred had ended wholly unlike: (mean d² + 0.01) / (mean |d| + 0.01). With
    one episode a map c is 1, and this is the interval of Bonett and Price, with the t quantile in place of the normal
    one. Where no map differs c is 1 too, so that unlike a bootstrap it is no point. Twice the same episodes give the
    same interval. Where maps have unequally many episodes the rate is a ratio of sums. The difference itself is as it
    was seen.
    Sources: Bonett and Price (2012), "Adjusted Wald confidence interval for a difference of binomial proportions
    based on paired data"; Cochran (1977), "Sampling Techniques", 6.3, for the ratio. How often the interval covers the
    truth on few, large groups: `studies/statistics`, part `groups`.

    Args:
        gain: successes of the one condition less those of the other by map, whole numbers, shape [..., M], M ≥ 2.
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
    """Standard deviation over maps of the difference of success, with the two maps that `success_interval` adds.

    Args:
        gain: as there, shape [..., M].
        draws: as there.

    Returns:
        Shape [...], above 0.
    """
    return _smoothed(gain, draws)[1]


def _smoothed(gain: np.ndarray, draws: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of the difference over the maps and the two that `success_interval` adds."""
    maps, episodes = gain.shape[-1], np.broadcast_to(draws, gain.shape)
    total = episodes.sum(-1)
    size = episodes * (maps / total)[..., None]
    share = gain * (maps / total)[..., None]
    c = ((gain**2 / episodes).sum(-1) / total + UNSEEN) / (np.abs(gain).sum(-1) / total + UNSEEN)
    added = np.sqrt((size**2).mean(-1))  # the size of an added map
    centre = share.sum(-1) / (maps + 2 * added)
    squares = ((share - centre[..., None] * size) ** 2).sum(-1) + 2 * added**2 * (c**2 + centre**2)
    return centre, np.sqrt(squares * (maps + 2)) / (maps + 2 * added)


def sign_flip_p(gain: np.ndarray, direction: str = "") -> float:
    """p of no difference in success, if on each map either condition might have been the other.

    The sign of each map's gain is flipped in all ways, and each way counted, however many maps there are: of
    n maps with the same size of gain the number of those kept positive is binomial, so that the sum over all maps
    is a convolution of as many binomials as there are sizes. With one episode a map it is the exact McNemar test.
    Source: Fisher (1935), "The Design of Experiments", 21.

    Args:
        gain: successes of the one condition less those of the other by map, whole numbers, shape [M].
        direction: in which the one is thought to lie, `higher` or `lower`; two-sided when empty.

    Returns:
        Share of all ways with a sum at least as far from 0, or as far in the direction.
    """
    gain = gain // max(np.gcd.reduce(gain), 1)  # of repeated episodes as of each once
    sizes, counts = np.unique(np.abs(gain[gain != 0]), return_counts=True)
    chances = np.ones(1)
    for size, count in zip(sizes, counts, strict=True):
        spread = np.zeros(2 * size * count + 1)
        spread[:: 2 * size] = binom.pmf(np.arange(count + 1), count, 0.5)
        chances = np.convolve(chances, spread)
    total = np.abs(gain).sum()
    sums, seen = np.arange(-total, total + 1), gain.sum()
    far = {"higher": sums >= seen, "lower": sums <= seen}.get(direction, np.abs(sums) >= abs(seen))
    return min(float(chances[far].sum()), 1.0)


def mean_interval(values: np.ndarray, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over maps with Student's interval.

    Args:
        values: one a map, shape [..., M].
        confidence: coverage asked for.

    Returns:
        Mean, lower and upper end, each of shape [...]; the mean is NaN where there are no maps, the ends where there
        are fewer than `LEAST_MAPS`.
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
    """Mean of T_total over maps, or of its difference, where a failure costs many seconds and is rare.

    Few maps seldom show a rare failure, so that neither a bootstrap nor Student's interval of T_total knows what it
    would cost: where 19 in 20 arrive, a bootstrap over 20 maps covers 85 % in place of 95 %. So the interval is put
    together from two: that of the share of failures, times what a failure costs, and Student's of the time without it
    (the method of variance estimates recovery).
    Source: Zou and Donner (2008), "Construction of confidence limits about effect measures: a general approach".

    Args:
        time_s: mean of T_total by map, a failure counted as T, or its difference, shape [..., M].
        failed: share of failures by map, or its difference, shape [..., M].
        failed_interval: ends of the interval of its mean, each of shape [...].
        penalty_s: by how much a failure takes longer than an arrival, of shape [...].
        arrived: on how many maps there was an arrival, of shape [...].
        confidence: coverage asked for, that of `failed_interval` too.

    Returns:
        Mean, lower and upper end, each of shape [...]; the ends are NaN where there are fewer than `LEAST_MAPS`.
    """
    mean, share = time_s.mean(-1), failed.mean(-1)
    without = time_s - np.expand_dims(penalty_s, -1) * failed
    half = _half_width(without, np.maximum(arrived - 1, 1), confidence)
    fewer, more = share - failed_interval[0], failed_interval[1] - share
    return mean, mean - np.hypot(half, penalty_s * fewer), mean + np.hypot(half, penalty_s * more)


def _half_width(values: np.ndarray, freedom: np.ndarray | int, confidence: float) -> np.ndarray:
    maps = values.shape[-1]
    if maps < LEAST_MAPS:
        return np.full(values.shape[:-1], np.nan)
    return t.ppf((1 + confidence) / 2, freedom) * values.std(-1, ddof=1) / np.sqrt(maps)


def signed_rank_p(late: np.ndarray) -> float:
    """Two-sided p of Wilcoxon's signed-rank test that neither condition takes longer; 1 where no map differs.

    Maps without a difference count for nothing. On few that differ the test is exact with ties too: the ranks' signs
    are flipped in all ways. SciPy's p is the same there, but it calls a function for each way.

    Args:
        late: difference of time by map without rounding, as `sums_by_map` returns it, shape [M].
    """
    differing = late[late != 0]
    if len(differing) > _EXACT:
        return float(wilcoxon(differing).pvalue)
    # Whole numbers, those of ties too.
    twice_ranks = np.rint(2 * rankdata(np.abs(differing))) * np.sign(differing)
    return sign_flip_p(twice_ranks.astype(np.int64))


# --- what a number of maps can show -----------------------------------------------------------------
# For a mean of differences over maps that is nearly normal, which from some twenty maps on it is: a difference d with
# standard deviation σ is shown with a chance of `POWER` where d·√M/σ is the quantile of 1 − α/2 and that of `POWER`
# together. Source: Chow, Shao and Wang (2008), "Sample Size Calculations in Clinical Research", 3.1.


def smallest_difference(std: float, maps: int, alpha: float) -> float:
    """Difference that a study of so many maps would show, with a chance of `POWER`.

    Args:
        std: standard deviation over maps of the difference, in its unit.
        maps: number of maps.
        alpha: p under which a difference counts as shown; after a correction over K pairs, that of the first, 0.05/K.

    Returns:
        In the unit of `std`; infinite where no sign-flip test of so many maps can reach `alpha`, whatever they show.
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
