"""Conditioning of the maps of one episode on its observations, and the estimate of ℓ.

Only cells within `_UPDATE_RADIUS` of changed observations are updated, from all
observations up to `_EXTRA_RADIUS` farther away. A cell changes only if the mean, the
standard deviation or the median of its score changes by `_MIN_CHANGE` or more.
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
    log_evidence,
    predict,
)
from benchnav.planning.sensing.lattice import (
    Cells,
    Lattice,
    condition_and_predict,
    spacing_of,
)

_UPDATE_RADIUS = 4.0  # in ℓ; the correlation is 3e-4 at this distance
# In ℓ. Observations beyond it change no cell within `_UPDATE_RADIUS` by `_MIN_CHANGE`.
_EXTRA_RADIUS = 2.0
# Maximum number of observations without a lattice, so that an update takes at most half
# a second. The observations nearest to changed observations are used. Observed cells
# beyond the limit are not updated.
_MAX_EXACT = 2048
_MIN_CHANGE = 0.005  # in normal scores
_MEDIAN_PER_SKEW = 1 / 6  # change of the median of a score per change of its skewness
_MOMENTS = ("mean", "std", "skew")
MEDIAN_M = 1.5
"""Median of the prior of ℓ, in metres."""
_LOG_STD = math.log(2)  # standard deviation of the prior of log ℓ
_OCTAVES = [step / 4 for step in range(-8, 9)]
_LENGTHS_M = tuple(MEDIAN_M * 2**octaves for octaves in _OCTAVES)
MIN_OBSERVATIONS = 8
"""Minimum number of observations for an estimate of ℓ."""


def condition_maps(
    field: Field, member: int, maps: dict[str, ndarray], changed: ndarray, window: int
) -> None:
    """Condition scores near changed observations of one episode, in place.

    Cells within `_UPDATE_RADIUS` of changed observations are computed from all
    observations up to `_EXTRA_RADIUS` farther away, so that no observation that affects
    them is omitted.

    Args:
        field: correlations of the scores.
        member: index of the episode in `field`.
        maps: maps of `CopulaState` by name, float64, shape [H, W]; they are changed.
        changed: mask of changed observations, bool, shape [H, W].
        window: number of observations above which a lattice is used.
    """
    length = float(field.length[member])
    reach = math.ceil(_UPDATE_RADIUS * length)
    rows, columns = _slices_around(changed, reach)
    observed_block = _slices_around(changed, reach + math.ceil(_EXTRA_RADIUS * length))
    is_unused = np.zeros_like(changed)
    values = maps["value"][observed_block]
    is_unused[observed_block] = ~np.isnan(values)
    uses_lattice = is_unused.sum() > window and spacing_of(length) > 1
    limit = is_unused.size if uses_lattice else _MAX_EXACT
    cells = nearest(is_unused, changed, limit)
    is_unused[cells] = False
    observed = _observed(maps, *cells)
    block = rows, columns
    if uses_lattice:
        target_rows, target_columns = np.mgrid[block]
        targets = target_rows.ravel(), target_columns.ravel()
        basis = Lattice.around(field, member, cells)
        precision, shift, moments = condition_and_predict(
            basis, observed, cells, targets
        )
    else:
        precision, shift, moments = _condition_exactly(
            field, member, observed, cells, block
        )
    mean, variance, skew = moments
    std = np.sqrt(variance.clip(0))
    old_moments = np.stack([maps[name][block] for name in _MOMENTS])
    new_moments = np.stack((mean, std, skew)).reshape(old_moments.shape)
    # Observed cells beyond the limit keep their posterior: it includes observations
    # that this update omits.
    unchanged = is_unused[block]
    if not observed.interval.any():
        # Conditioning on numbers never increases a standard deviation.
        old_std = old_moments[1]
        new_std = new_moments[1]
        unchanged |= new_std > old_std + _MIN_CHANGE
        new_moments[1] = np.minimum(new_std, old_std)
    scales = np.array((1, 1, _MEDIAN_PER_SKEW))[:, None, None]
    min_change = _MIN_CHANGE / scales
    has_changed = abs(new_moments - old_moments) >= min_change
    is_updated = has_changed.any(0) & ~unchanged
    for name, new_values in zip(_MOMENTS, new_moments, strict=True):
        np.copyto(maps[name][block], new_values, where=is_updated)
    maps["precision"][cells] = precision
    maps["shift"][cells] = shift


def _condition_exactly(
    field: Field,
    member: int,
    observed: Observed,
    cells: Cells,
    block: tuple[slice, slice],
) -> tuple[ndarray, ndarray, tuple[ndarray, ndarray, ndarray]]:
    """Condition on observations and predict a block of cells, without a lattice.

    Args:
        field: correlations of the scores.
        member: index of the episode in `field`.
        observed: observations of N cells.
        cells: rows and columns of the N observed cells.
        block: rows and columns of the block.

    Returns:
        As in `condition_and_predict`, with the cells of the block as targets.
    """
    row = torch.from_numpy(cells[0])[:, None]
    column = torch.from_numpy(cells[1])[:, None]
    row_offsets = row - row.T
    column_offsets = column - column.T
    covariance = field.covariance(member, row_offsets, column_offsets).numpy()
    solved = condition(covariance, observed)
    rows, columns = block
    block_rows = torch.arange(rows.start, rows.stop)
    block_columns = torch.arange(columns.start, columns.stop)
    row_offsets = (row - block_rows)[..., None]
    column_offsets = (column - block_columns)[:, None]
    block_covariance = field.covariance(member, row_offsets, column_offsets)
    flat_covariance = block_covariance.flatten(1).numpy()
    moments = predict(solved, covariance, observed, flat_covariance)
    return solved.precision, solved.shift, moments


def _slices_around(changed: ndarray, margin: int) -> tuple[slice, slice]:
    """Return the smallest rectangle around the changed cells, widened by a margin.

    Args:
        changed: mask of changed cells, bool, shape [H, W].
        margin: margin in cells; the rectangle ends at the map's borders.

    Returns:
        Slices of rows and of columns.
    """
    slices = []
    for ends, size in zip(bounds(changed), changed.shape, strict=True):
        first, last = ends
        start = max(first - margin, 0)
        stop = min(last + margin + 1, size)
        slices.append(slice(start, stop))
    rows, columns = slices
    return rows, columns


def _observed(maps: dict[str, ndarray], row: ndarray, column: ndarray) -> Observed:
    """Return the observations of the cells at these rows and columns."""
    names = ("lower", "upper", "noise_std", "precision", "shift")
    return Observed(*(maps[name][row, column] for name in names))


def estimate_length(
    covariance_model: CovarianceModel,
    maps: dict[str, ndarray],
    row: ndarray,
    column: ndarray,
) -> float:
    """Return an episode's ℓ in cells: the mode of its posterior among `_LENGTHS_M`.

    Args:
        covariance_model: covariance model; its ℓ is ignored.
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
        log_likelihood = log_evidence(covariance, observed, solved)
        z = math.log(length_m / MEDIAN_M) / _LOG_STD
        log_posterior.append(log_likelihood - 0.5 * z**2)
    best = int(np.argmax(log_posterior))
    return float(field.length[best])


@lru_cache(maxsize=8)
def _candidates(shape: tuple[int, int], resolution_m: float, nugget: float) -> Field:
    lengths = [length / resolution_m for length in _LENGTHS_M]
    return Field.of(shape, lengths, "cpu", nugget)


def bounds(mask: ndarray) -> list[tuple[int, int]]:
    """Return first and last row, and first and last column, of the cells of a mask."""
    ends = []
    for indices in mask.nonzero():
        first = int(indices.min())
        last = int(indices.max())
        ends.append((first, last))
    return ends


def nearest(
    observed: ndarray, changed: ndarray, max_cells: int
) -> tuple[ndarray, ndarray]:
    """Return rows and columns of the changed cells and of the observed cells nearby.

    Observed cells are ordered by their distance to the rectangle around the changed
    cells.

    Args:
        observed: mask of observed cells, which include the changed cells, bool, shape
            [H, W].
        changed: mask of changed cells, bool, shape [H, W].
        max_cells: maximum number of returned cells; all changed cells are returned even
            if there are more.
    """
    row, column = observed.nonzero()
    (top, bottom), (first_column, last_column) = bounds(changed)
    row_distance = np.maximum(top - row, row - bottom).clip(0)
    column_distance = np.maximum(first_column - column, column - last_column).clip(0)
    squared_distance = row_distance**2 + column_distance**2
    is_changed = changed[row, column]
    distance = np.where(is_changed, -1, squared_distance)
    # A stable sort breaks ties in the same order on every machine.
    order = distance.argsort(kind="stable")
    n_cells = max(max_cells, int(changed.sum()))
    selected = order[:n_cells]
    return row[selected], column[selected]
