"""One value per map, the statistical unit, from all episodes on the map.

If a dataset has groups of maps, the group is the unit. Throughout `benchnav.stats`,
"map" then means group.
Letters in shapes: N episodes; M maps.
"""

import numpy as np

# Tolerance relative to the largest summed value: well above rounding errors, and well
# below a time step.
_ROUNDING = 1e-9


def alike(values: np.ndarray, scale: float) -> np.ndarray:
    """Return values whose magnitudes are equal if they differed only by rounding.

    Rank and sign tests depend on which values are 0 and which are tied. Sums of times
    have rounding errors, which break ties and depend on the order of episodes.

    Args:
        values: shape [M].
        scale: largest magnitude that the values were computed from.

    Returns:
        Shape [M], float64, within a few `_ROUNDING` times `scale` of `values`.
    """
    sizes = np.abs(values)
    order = np.argsort(sizes)
    magnitudes = np.concatenate([[0.0], sizes[order]])
    steps = np.diff(magnitudes)
    is_new = ~(steps <= _ROUNDING * scale)
    positions = np.arange(1, len(magnitudes))
    first = np.maximum.accumulate(np.where(is_new, positions, 0))
    snapped = np.empty(len(values))
    snapped[order] = magnitudes[first]
    return np.copysign(snapped, values) + 0.0


def sums_by_map(
    values: np.ndarray, maps: np.ndarray, scale: float | None = None
) -> np.ndarray:
    """Return each map's sum of values, divided by the mean number of episodes per map.

    Values that differ only by rounding are equal in the result; see `alike`.

    Args:
        values: value of each episode, shape [N].
        maps: label of each episode's map, shape [N].
        scale: largest magnitude that the values were computed from; if None, the
            largest magnitude of the values themselves.

    Returns:
        Shape [M], float64, in the order of sorted labels.
    """
    if not len(values):
        return np.empty(0)
    _, index, size = np.unique(maps, return_inverse=True, return_counts=True)
    sums = np.bincount(index, weights=values) / size.mean()
    if scale is None:
        scale = float(np.abs(values).max())
    return alike(sums, scale)


def by_map(
    values: np.ndarray, maps: np.ndarray, scale: float | None = None
) -> np.ndarray:
    """Return one value per map; their mean over maps is the mean over episodes.

    If all maps have the same number of episodes, the value is the mean of each map.
    Otherwise it is the contribution of each map to the overall mean, Σ(v − v̄)·M/N + v̄,
    whose standard deviation is that of a ratio estimator.
    Source: Cochran (1977), "Sampling Techniques", 6.3.

    Args:
        values: value of each episode, shape [N].
        maps: label of each episode's map, shape [N].
        scale: largest magnitude that the values were computed from; if None, the
            largest magnitude of the values themselves.

    Returns:
        Shape [M], float64, in the order of sorted labels.
    """
    sums = sums_by_map(values, maps, scale)
    _, size = np.unique(maps, return_counts=True)
    if np.all(size == size[:1]):
        return sums
    missing_weight = 1 - size / size.mean()
    return sums + values.mean() * missing_weight
