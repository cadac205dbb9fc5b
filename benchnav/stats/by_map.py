"""One number a map, the statistical unit: all episodes on a map, under other seeds or
realisations, make one.

Where a dataset has groups of maps, all episodes of a group make one, and "map" means
group in all of `stats`.
Letters in shapes: N episodes; M maps.
"""

import numpy as np

# Of the scale of what is summed: far more than rounding, far less than a time step.
_ROUNDING = 1e-9


def alike(values: np.ndarray, scale: float) -> np.ndarray:
    """Return values in which sizes that differ by rounding are one size, and 0 where
    they are as small.

    Tests by ranks and by signs ask which values are 0 and which are equal. Sums of
    times on a grid of steps answer that but for rounding, which the order of episodes
    decides.

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


def sums_by_map(
    values: np.ndarray, maps: np.ndarray, scale: float | None = None
) -> np.ndarray:
    """Return the sum of each map over the mean number of episodes a map, without
    rounding (see `alike`).

    Args:
        values: one an episode, shape [N].
        maps: which map each was on, any labels, shape [N].
        scale: largest number that the values were computed from; their own where not
            given.

    Returns:
        Shape [M], in the order of sorted labels.
    """
    if not len(values):
        return np.empty(0)
    _, member, size = np.unique(maps, return_inverse=True, return_counts=True)
    sums = np.bincount(member, weights=values) / size.mean()
    return alike(sums, float(np.abs(values).max()) if scale is None else scale)


def by_map(
    values: np.ndarray, maps: np.ndarray, scale: float | None = None
) -> np.ndarray:
    """Return one number a map, whose mean over maps is that over episodes.

    Of maps with equally many episodes it is the mean of each. Else it is the
    contribution of each map to the mean of all, Σ(v − v̄)·M/N + v̄, whose standard
    deviation is that of a ratio estimator.
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
