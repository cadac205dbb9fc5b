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
    numbers = np.hstack([_per_map(column) for column in columns]).astype(np.float64)
    n_maps = len(numbers)
    key = rng.stream_key(0, "docs", "bootstrap")
    uniform = rng.uniform(key, np.arange(RESAMPLES), (n_maps,))
    indices = (uniform * n_maps).astype(np.int64)
    # Each row counts how often a resample has each map.
    counts = np.stack([np.bincount(row, minlength=n_maps) for row in indices])
    value = statistic(numbers.mean(0))
    resampled = statistic(counts @ numbers / n_maps)
    return float(value), float(resampled.std(ddof=1))


def _per_map(column: np.ndarray) -> np.ndarray:
    if column.ndim < 3:
        return column.reshape(len(column), -1)
    return column.mean(axis=(1, 2))[:, None]


def show(
    columns: Sequence[np.ndarray],
    statistic: str = "first",
    scale: float = 1,
    digits: int = 1,
) -> str:
    """Format `value ± standard error`, or only the value if the error is 0."""
    value, error = estimate(columns, STATISTICS[statistic])
    text = f"{scale * value:.{digits}f}".replace("-", "−")
    if scale * error > 0:
        text += f" ± {scale * error:.{digits}f}"
    return text


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
    has_mask = means.shape[-1] > 1
    mean_square = ratio(means) if has_mask else first(means)
    return np.sqrt(mean_square)


def excess(means: np.ndarray) -> np.ndarray:
    """Return the difference of the first two root mean squares, given mean squares."""
    return np.sqrt(means[..., 0]) - np.sqrt(means[..., 1])


def quantile(fraction: float, edges: np.ndarray) -> Statistic:
    """Return the statistic that reads a quantile from a histogram."""

    def read(counts: np.ndarray) -> np.ndarray:
        is_below = counts.cumsum(-1) < fraction * counts.sum(-1, keepdims=True)
        upper_edges: np.ndarray = edges[1 + is_below.sum(-1)]
        return upper_edges

    return read


def mean_iou(confusion: np.ndarray) -> np.ndarray:
    """Return the mean intersection over union, given confusion counts [*, C·C]."""
    n_classes = round(confusion.shape[-1] ** 0.5)
    square = confusion.reshape(*confusion.shape[:-1], n_classes, n_classes)
    intersection = np.diagonal(square, axis1=-2, axis2=-1)
    union = square.sum(-1) + square.sum(-2) - intersection
    return (intersection / union).mean(-1)


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
