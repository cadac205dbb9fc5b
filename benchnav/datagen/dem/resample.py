"""Resampling along one axis, as sparse weights: those of two axes, one from either side, do a raster.

Ours rather than GDAL's, which flattens the ground at the raster's border and blends what lies beside
missing cells: here planes keep their slope everywhere, and who has a share in what can be asked.

Source: Keys (1981), "Cubic convolution interpolation for digital image processing".
Letters in shapes: M intervals, K cells that an interval's weights may reach.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import sparse

Rule = Callable[[np.ndarray, np.ndarray, int], sparse.csr_matrix]

_NEAR = 1e-6  # of a raster's cell: rounding, no distance


def shares(low: np.ndarray, high: np.ndarray, cells: int) -> sparse.csr_matrix:
    """Share of each cell of a raster in intervals along an axis.

    Args:
        low: where each interval begins, in cells, shape [M].
        high: where it ends.
        cells: number of cells.

    Returns:
        Rows that sum to 1, shape [M, cells].
    """
    index, share, _ = _overlaps(low, high)
    return _matrix(index, share, cells)


def heights(low: np.ndarray, high: np.ndarray, cells: int) -> sparse.csr_matrix:
    """Weights that give the ground's elevation in intervals; as `shares`, exact on planes everywhere.

    Intervals up to a cell: Keys' cubic at their middle. Longer ones: the mean over ground that has the
    elevation of each cell on its average and the slope between its neighbours.
    """
    if (high - low).max() > 1 + _NEAR:
        index, share, off = _overlaps(low, high)
        lean = share * off / 2
        return _matrix(np.hstack([index, index + 1, index - 1]), np.hstack([share, lean, -lean]), cells)
    middle = snapped((low + high) / 2 - 0.5)
    base = np.floor(middle)
    t = middle - base
    weights = [
        ((2 - t) * t - 1) * t / 2,
        ((3 * t - 5) * t * t + 2) / 2,
        ((4 - 3 * t) * t + 1) * t / 2,
        (t - 1) * t * t / 2,
    ]
    return _matrix(base.astype(int)[:, None] + np.arange(-1, 3), np.stack(weights, axis=1), cells)


def _overlaps(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cells that intervals meet, their shares, and how far the parts' middles lie off the cells' own."""
    first = np.floor(low).astype(int)
    index = first[:, None] + np.arange(int((np.ceil(high) - first).max()))
    begin, end = np.maximum(low[:, None], index), np.minimum(high[:, None], index + 1)
    return index, np.maximum(end - begin, 0) / (high - low)[:, None], (begin + end - 1) / 2 - index


def _matrix(index: np.ndarray, weight: np.ndarray, cells: int) -> sparse.csr_matrix:
    """Sparse rows from weights [M, K]; beyond the border the raster goes on linearly."""
    inside = index.clip(0, cells - 1)
    beyond = abs(index - inside)
    inner = (inside + np.where(index < 0, 1, -1)).clip(0, cells - 1)
    rows = np.broadcast_to(np.arange(len(index))[:, None], (len(index), 2 * index.shape[1]))
    entries = np.hstack([weight * (1 + beyond), -weight * beyond])
    columns = np.hstack([inside, inner])
    matrix = sparse.coo_matrix((entries.ravel(), (rows.ravel(), columns.ravel())), (len(index), cells))
    return matrix.tocsr()


def snapped(cells: Any) -> Any:
    """Takes places that are off a cell's edge by rounding alone to be on it."""
    return np.where(abs(cells - np.rint(cells)) < _NEAR, np.rint(cells), cells)
