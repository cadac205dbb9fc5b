"""Differences between two trials that met the same maps and the same luck, with intervals and tests.

The map is the unit: all episodes on a map, under other seeds or realisations, make one number.
Letters in shapes: M maps; a leading `...` is any number of comparisons.
"""

from collections.abc import Sequence

import numpy as np
from scipy.stats import binom, bootstrap, t, wilcoxon

LEAST_MAPS = 6  # for a bootstrap over them

_RESAMPLES = 9_999
# Indices of resamples that are held at once, for a vectorised bootstrap within some 50 MB.
_HELD = 3_000_000


def success_interval(
    gain: np.ndarray, draws: float, confidence: float = 0.95
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Difference of success rates, with the adjusted Wald interval for paired proportions.

    To the maps two are added, on one of which one trial, on the other the other trial, arrived once more often.
    With one episode a map this is the interval of Bonett and Price, with the t quantile in place of the normal
    one. Unlike a bootstrap it is no point where the two trials ended alike on every map. The difference itself
    is given as it was seen.
    Source: Bonett and Price (2012), "Adjusted Wald confidence interval for a difference of binomial proportions
    based on paired data".

    Args:
        gain: successes of the one trial less those of the other by map, whole numbers, shape [..., M], M ≥ 2.
        draws: episodes of a trial on each map, their mean where the numbers differ.
        confidence: coverage asked for.

    Returns:
        Difference, lower and upper end, in [−1, 1], each of shape [...].
    """
    share = gain / draws
    maps = gain.shape[-1]
    centre = share.sum(-1) / (maps + 2)
    half = t.ppf((1 + confidence) / 2, maps - 1) * standard_deviation(gain, draws) / np.sqrt(maps + 2)
    return share.mean(-1), np.maximum(centre - half, -1), np.minimum(centre + half, 1)


def standard_deviation(gain: np.ndarray, draws: float) -> np.ndarray:
    """Standard deviation over maps of the difference of success, with the two maps that `success_interval` adds.

    Args:
        gain: as there, shape [..., M].
        draws: as there.

    Returns:
        Shape [...], above 0.
    """
    share = gain / draws
    maps = gain.shape[-1] + 2
    return np.sqrt(((share**2).sum(-1) + 2 / draws**2) / maps - (share.sum(-1) / maps) ** 2)


def sign_flip_p(gain: np.ndarray) -> float:
    """Two-sided p of no difference in success, if on each map either trial might have been the other.

    The sign of each map's gain is flipped in all ways, and each way counted, however many maps there are: of
    n maps with the same size of gain the number of those kept positive is binomial, so that the sum over all maps
    is a convolution of as many binomials as there are sizes. With one episode a map it is the exact McNemar test.
    Source: Fisher (1935), "The Design of Experiments", 21.

    Args:
        gain: successes of the one trial less those of the other by map, whole numbers, shape [M].

    Returns:
        Share of all ways with a sum at least as far from 0.
    """
    sizes, counts = np.unique(np.abs(gain[gain != 0]), return_counts=True)
    chances = np.ones(1)
    for size, count in zip(sizes, counts, strict=True):
        spread = np.zeros(2 * size * count + 1)
        spread[:: 2 * size] = binom.pmf(np.arange(count + 1), count, 0.5)
        chances = np.convolve(chances, spread)
    total = np.abs(gain).sum()
    far = np.abs(np.arange(-total, total + 1)) >= abs(gain.sum())
    return min(float(chances[far].sum()), 1.0)


def mean_interval(
    values: np.ndarray, confidence: float = 0.95, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean over maps with its bootstrap interval (bias-corrected and accelerated).

    Args:
        values: one a map, shape [..., M]; all rows are resampled alike.
        confidence: coverage asked for.
        seed: of the resampling.

    Returns:
        Mean, lower and upper end, each of shape [...]. Where there are fewer than two maps, the ends are NaN; where
        all maps are alike, they are the mean.
    """
    values = np.asarray(values, dtype=float)
    mean, maps = np.asarray(values.mean(-1)), values.shape[-1]
    if maps < 2:
        return mean, np.full_like(mean, np.nan), np.full_like(mean, np.nan)
    alike = np.asarray(np.ptp(values, axis=-1) == 0)
    rows = values[~alike]
    low, high = mean.copy(), mean.copy()
    if len(rows):
        found = bootstrap(
            (rows,), np.mean, axis=-1, confidence_level=confidence, n_resamples=_RESAMPLES,
            batch=max(1, _HELD // rows.size), vectorized=True, rng=np.random.default_rng(seed),
        ).confidence_interval  # fmt: skip
        low[~alike], high[~alike] = found.low, found.high
    return mean, low, high


def mean_intervals(values: Sequence[np.ndarray]) -> np.ndarray:
    """Does `mean_interval` for several trials or pairs at once; those with as many maps are resampled together.

    Args:
        values: N of them, each of shape [M], M its own.

    Returns:
        Means, lower and upper ends, shape [3, N]; NaN where there are no maps. Under `LEAST_MAPS` maps there is a
        mean and no interval.
    """
    made = np.full((3, len(values)), np.nan)
    sizes = np.array([len(one) for one in values])
    for size in np.unique(sizes[sizes > 0]):
        alike = sizes == size
        rows = [one for one, same in zip(values, alike, strict=True) if same]
        made[:, alike] = mean_interval(np.stack(rows))
    made[1:, sizes < LEAST_MAPS] = np.nan
    return made


def signed_rank_p(late: np.ndarray) -> float:
    """Two-sided p of Wilcoxon's signed-rank test that neither trial takes longer; 1 where no map differs.

    Args:
        late: difference of time by map, shape [M].
    """
    return float(wilcoxon(late).pvalue) if np.any(late) else 1.0
