"""Statistics of means over maps, each with its standard error by the bootstrap over
maps.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from benchnav.core import rng

RESAMPLES = 1000
SLOPE_EDGES, SHARE_EDGES = np.linspace(0, 60, 6001), np.linspace(0, 1, 2001)

Maps = Mapping[str, np.ndarray]
Statistic = Callable[[np.ndarray], np.ndarray]


def histogram(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Counts the cells of each map in bins, shape [B, bins]."""
    return np.stack([np.histogram(entry, edges)[0] for entry in values])


def estimate(
    columns: Sequence[np.ndarray], statistic: Statistic
) -> tuple[float, float]:
    """A statistic of means over maps, and its standard error by the bootstrap over
    maps.

    Args:
        columns: [B], [B, K] or, to be averaged over the cells, [B, H, W]; put side by
            side.
        statistic: from means [*, K] to values [*].
    """
    flat = [
        c.reshape(len(c), -1) if c.ndim < 3 else c.mean(axis=(1, 2))[:, None]
        for c in columns
    ]
    numbers = np.hstack(flat).astype(np.float64)
    maps = len(numbers)
    drawn = (
        rng.uniform(
            rng.stream_key(0, "docs", "bootstrap"), np.arange(RESAMPLES), (maps,)
        )
        * maps
    )
    times = np.stack(
        [np.bincount(row, minlength=maps) for row in drawn.astype(np.int64)]
    )
    return float(statistic(numbers.mean(0))), float(
        statistic(times @ numbers / maps).std(ddof=1)
    )


def show(
    columns: Sequence[np.ndarray],
    statistic: str = "first",
    scale: float = 1,
    digits: int = 1,
) -> str:
    """Write `value ± standard error`, or only the value if it cannot vary."""
    value, error = (
        scale * number for number in estimate(columns, STATISTICS[statistic])
    )
    return f"{value:.{digits}f}".replace("-", "−") + (
        f" ± {error:.{digits}f}" if error > 0 else ""
    )


def first(means: np.ndarray) -> np.ndarray:
    """The first of the means."""
    return means[..., 0]


def ratio(means: np.ndarray) -> np.ndarray:
    """The first of the means over the second."""
    return means[..., 0] / means[..., 1]


def rms(means: np.ndarray) -> np.ndarray:
    """Root mean square from a mean square; over the cells of the second column, if
    there is one.
    """
    return np.sqrt(first(means) if means.shape[-1] == 1 else ratio(means))


def excess(means: np.ndarray) -> np.ndarray:
    """By how much the first root mean square exceeds the second, from mean squares."""
    return np.sqrt(means[..., 0]) - np.sqrt(means[..., 1])


def quantile(share: float, edges: np.ndarray) -> Statistic:
    """The statistic that reads a quantile off a histogram."""
    return lambda counts: edges[
        1 + (counts.cumsum(-1) < share * counts.sum(-1, keepdims=True)).sum(-1)
    ]


def mean_iou(confusion: np.ndarray) -> np.ndarray:
    """Intersection over union, averaged over the classes, from confusion counts [*,
    C·C].
    """
    count = round(confusion.shape[-1] ** 0.5)
    square = confusion.reshape(*confusion.shape[:-1], count, count)
    both = np.diagonal(square, axis1=-2, axis2=-1)
    return (both / (square.sum(-1) + square.sum(-2) - both)).mean(-1)


STATISTICS: dict[str, Statistic] = {
    "first": first,
    "ratio": ratio,
    "rms": rms,
    "excess": excess,
    "mean_iou": mean_iou,
    "median_slope": quantile(0.5, SLOPE_EDGES),
    "steep_slope": quantile(0.95, SLOPE_EDGES),
    "low_traversability": quantile(0.05, SHARE_EDGES),
}
