"""Statistics of means over maps, with standard errors by a bootstrap over maps."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from benchnav.core import rng

RESAMPLES = 1000
SLOPE_EDGES, SHARE_EDGES = np.linspace(0, 60, 6001), np.linspace(0, 1, 2001)

Maps = Mapping[str, np.ndarray]
Statistic = Callable[[np.ndarray], np.ndarray]


def histogram(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Count the cells of each map in bins, shape [B, bins]."""
    return np.stack([np.histogram(entry, edges)[0] for entry in values])


def estimate(
    columns: Sequence[np.ndarray], statistic: Statistic
) -> tuple[float, float]:
    """Return a statistic of means over maps, and its standard error by the bootstrap.

    Args:
        columns: arrays to concatenate along K: [B], [B, K], or [B, H, W], which is
            averaged over cells.
        statistic: function from means [*, K] to values [*].
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
    """Format `value ± standard error`, or only the value if the error is 0."""
    value, error = (
        scale * number for number in estimate(columns, STATISTICS[statistic])
    )
    return f"{value:.{digits}f}".replace("-", "−") + (
        f" ± {error:.{digits}f}" if error > 0 else ""
    )


def first(means: np.ndarray) -> np.ndarray:
    """Return the first mean."""
    return means[..., 0]


def ratio(means: np.ndarray) -> np.ndarray:
    """Return the ratio of the first mean to the second."""
    return means[..., 0] / means[..., 1]


def rms(means: np.ndarray) -> np.ndarray:
    """Return the root mean square, given a mean square.

    With two columns, the mean is over the cells of the mask in the second.
    """
    return np.sqrt(first(means) if means.shape[-1] == 1 else ratio(means))


def excess(means: np.ndarray) -> np.ndarray:
    """Return the difference of the first two root mean squares, given mean squares."""
    return np.sqrt(means[..., 0]) - np.sqrt(means[..., 1])


def quantile(fraction: float, edges: np.ndarray) -> Statistic:
    """Return the statistic that reads a quantile from a histogram."""
    return lambda counts: edges[
        1 + (counts.cumsum(-1) < fraction * counts.sum(-1, keepdims=True)).sum(-1)
    ]


def mean_iou(confusion: np.ndarray) -> np.ndarray:
    """Return the mean intersection over union, given confusion counts [*, C·C]."""
    count = round(confusion.shape[-1] ** 0.5)
    square = confusion.reshape(*confusion.shape[:-1], count, count)
    intersection = np.diagonal(square, axis1=-2, axis2=-1)
    return (intersection / (square.sum(-1) + square.sum(-2) - intersection)).mean(-1)


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
