"""Conditioning of the maps of one episode on its observations, and the estimate of ℓ.

Only cells within `_REACH` ℓ of changed observations are updated, from all observations
up to `_BEYOND` ℓ farther away. A cell changes only if the mean or the standard
deviation of its score moves by `_MIN_CHANGE` or more.
Letters in shapes: N observations, H×W map.
"""

import math
from functools import lru_cache

import numpy as np
import torch
from numpy import ndarray

from benchnav.planning.sensing.belief import CovarianceModel
from benchnav.planning.sensing.gaussian import (
    Field,
    Observed,
    condition,
    evidence,
    predict,
)
from benchnav.planning.sensing.lattice import (
    Cells,
    Lattice,
    condition_and_predict,
    spacing_of,
)

_REACH = 4.0  # in ℓ; the correlation is 3e-4 at this distance
# In ℓ. Observations farther away change no cell within `_REACH` by `_MIN_CHANGE`.
_BEYOND = 2.0
# Maximum number of observations without a lattice, so that an update takes at most half
# a second. Those nearest to changed ones are used, and other observed cells are not
# updated.
_MAX_EXACT = 2048
_MIN_CHANGE = 0.005  # of a score
_MEDIAN_PER_SKEW = 1 / 6  # change of the median of a score per change of its skewness
_MOMENTS = ("mean", "std", "skew")
MEDIAN_M = 1.5
"""Median of the prior of ℓ, in metres."""
_LOG_STD = math.log(2)  # of the prior of ℓ
_LENGTHS_M = tuple(MEDIAN_M * 2 ** (step / 4) for step in range(-8, 9))
MIN_OBSERVATIONS = 8
"""Minimum number of observations for an estimate of ℓ."""


def condition_maps(
    field: Field, member: int, maps: dict[str, ndarray], new: ndarray, window: int
) -> None:
    """Condition terms and scores near changed observations of one episode, in place.

    Cells within `_REACH` ℓ of changed observations are computed from all observations
    up to `_BEYOND` ℓ farther away. Hence no observation that affects them is omitted.

    Args:
        field: correlations of the scores.
        member: index of the episode in the field.
        maps: maps of `CopulaState` by name, float64, shape [H, W].
        new: mask of changed observations, bool, shape [H, W].
        window: number of observations above which a lattice is used.
    """
    length = float(field.length[member])
    reach = math.ceil(_REACH * length)
    rows, columns = _around(new, reach)
    nearby = _around(new, reach + math.ceil(_BEYOND * length))
    remaining = np.zeros_like(new)
    remaining[nearby] = ~np.isnan(maps["value"][nearby])
    by_lattice = remaining.sum() > window and spacing_of(length) > 1
    limit = remaining.size if by_lattice else _MAX_EXACT
    cells = nearest(remaining, new, limit)
    remaining[cells] = False
    observed = _observed(maps, *cells)
    if by_lattice:
        block = np.mgrid[rows.start : rows.stop, columns.start : columns.stop]
        targets = block[0].ravel(), block[1].ravel()
        basis = Lattice.around(field, member, cells)
        precision, shift, moments = condition_and_predict(
            basis, observed, cells, targets
        )
    else:
        precision, shift, moments = _condition_exactly(
            field, member, observed, cells, (rows, columns)
        )
    mean, variance, skew = moments
    shape = rows.stop - rows.start, columns.stop - columns.start
    new_moments = np.stack((mean, np.sqrt(variance.clip(0)), skew)).reshape(3, *shape)
    old_moments = np.stack([maps[name][rows, columns] for name in _MOMENTS])
    # Observed cells beyond the limit keep their posterior, which includes more
    # observations than this update.
    unchanged = remaining[rows, columns]
    if not observed.interval.any():
        # Conditioning on numbers never increases a standard deviation.
        old_std = old_moments[1]
        unchanged |= new_moments[1] > old_std + _MIN_CHANGE
        new_moments[1] = np.minimum(new_moments[1], old_std)
    scales = np.array((1, 1, _MEDIAN_PER_SKEW))[:, None, None]
    has_moved = abs(new_moments - old_moments) >= _MIN_CHANGE / scales
    moved = has_moved.any(0) & ~unchanged
    for name, values in zip(_MOMENTS, new_moments, strict=True):
        np.copyto(maps[name][rows, columns], values, where=moved)
    maps["precision"][cells] = precision
    maps["shift"][cells] = shift


def _condition_exactly(
    field: Field,
    member: int,
    observed: Observed,
    cells: Cells,
    block: tuple[slice, slice],
) -> tuple[ndarray, ndarray, tuple[ndarray, ndarray, ndarray]]:
    """Return what `condition_and_predict` does, without a lattice, for a block of cells."""
    row = torch.from_numpy(cells[0])[:, None]
    column = torch.from_numpy(cells[1])[:, None]
    inner = field.covariance(member, row - row.T, column - column.T).numpy()
    solved = condition(inner, observed)
    block_rows, block_columns = (torch.arange(ends.start, ends.stop) for ends in block)
    row_offsets = (row - block_rows)[..., None]
    column_offsets = (column - block_columns)[:, None]
    across = field.covariance(member, row_offsets, column_offsets)
    moments = predict(solved, inner, observed, across.flatten(1).numpy())
    return solved.precision, solved.shift, moments


def _around(new: ndarray, reach: int) -> tuple[slice, slice]:
    """Return the rows and columns of a map within some cells of changed ones."""
    slices = []
    for (first, last), size in zip(bounds(new), new.shape, strict=True):
        start = max(first - reach, 0)
        stop = min(last + reach + 1, size)
        slices.append(slice(start, stop))
    rows, columns = slices
    return rows, columns


def _observed(maps: dict[str, ndarray], row: ndarray, column: ndarray) -> Observed:
    """Return the observations of some cells of one episode."""
    names = ("lower", "upper", "noise_std", "precision", "shift")
    return Observed(*(maps[name][row, column] for name in names))


def estimate_length(
    covariance_model: CovarianceModel,
    maps: dict[str, ndarray],
    row: ndarray,
    column: ndarray,
) -> float:
    """Return ℓ of one episode in cells: the mode of its posterior among `_LENGTHS_M`.

    Args:
        covariance_model: covariance model, whose ℓ is ignored.
        maps: maps of `CopulaState` by name, float64, shape [H, W].
        row: rows of the observed cells, shape [N].
        column: columns of the observed cells, shape [N].
    """
    grid = covariance_model.grid
    observed = _observed(maps, row, column)
    field = _candidates(grid.shape, grid.resolution_m, covariance_model.nugget)
    rows = torch.from_numpy(row[:, None] - row)
    columns = torch.from_numpy(column[:, None] - column)
    log_posterior = []
    for index, length_m in enumerate(_LENGTHS_M):
        covariance = field.covariance(index, rows, columns).numpy()
        solved = condition(covariance, observed)
        log_likelihood = evidence(covariance, observed, solved)
        z = math.log(length_m / MEDIAN_M) / _LOG_STD
        log_posterior.append(log_likelihood - 0.5 * z**2)
    best = int(np.argmax(log_posterior))
    return float(field.length[best])


@lru_cache(maxsize=8)
def _candidates(shape: tuple[int, int], resolution_m: float, nugget: float) -> Field:
    lengths = [length / resolution_m for length in _LENGTHS_M]
    return Field.of(shape, lengths, "cpu", nugget)


def bounds(new: ndarray) -> list[tuple[int, int]]:
    """Return first and last row, and first and last column, of the cells of a mask."""
    return [(int(indices.min()), int(indices.max())) for indices in new.nonzero()]


def nearest(observed: ndarray, new: ndarray, window: int) -> tuple[ndarray, ndarray]:
    """Return rows and columns of new cells and of the observed cells nearest to them.

    Args:
        observed: mask of observed cells, new ones included, bool, shape [H, W].
        new: mask of new cells, bool, shape [H, W].
        window: maximum number of cells; more if more are new.
    """
    row, column = observed.nonzero()
    (top, bottom), (first_column, last_column) = bounds(new)
    down = np.maximum(top - row, row - bottom).clip(0)
    across = np.maximum(first_column - column, column - last_column).clip(0)
    is_new = new[row, column]
    distance = np.where(is_new, -1, down**2 + across**2)
    # A stable sort breaks ties in the same order on every machine.
    order = distance.argsort(kind="stable")
    count = max(window, int(new.sum()))
    chosen = order[:count]
    return row[chosen], column[chosen]
