"""Conditioning of the maps of one episode on its observations, and the estimate of ℓ.

Only cells within `_REACH` ℓ of changed observations are updated, from all observations
within `_BEYOND` ℓ more. They change only if mean or standard deviation of the score
move by `_MIN_CHANGE` or more.
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
from benchnav.planning.sensing.lattice import Lattice, condition_and_predict, spacing_of

_REACH = 4.0  # ℓ; the correlation is 3e-4 at this distance
# ℓ; observations farther off change no cell within `_REACH` by `_MIN_CHANGE`.
_BEYOND = 2.0
# Maximum number of observations that are conditioned on without a lattice, those
# nearest to changed ones: an update takes half a second at most. Other observed cells
# are not updated.
_MAX_EXACT = 2048
_MIN_CHANGE = 0.005  # of a score
_OF_SKEW = 1 / 6  # change of the median's score per change of the skewness
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
    within `_BEYOND` ℓ more. Hence nothing that affects them is left out or forgotten.
    """
    length = float(field.length[member])
    reach = math.ceil(_REACH * length)
    rows, columns = _around(new, reach)
    near = _around(new, reach + math.ceil(_BEYOND * length))
    remaining = np.zeros_like(new)
    remaining[near] = ~np.isnan(maps["value"][near])
    by_lattice = remaining.sum() > window and spacing_of(length) > 1
    limit = remaining.size if by_lattice else _MAX_EXACT
    row, column = nearest(remaining, new, limit)
    cells = row, column
    remaining[cells] = False
    observed = _observed(maps, *cells)
    shape = rows.stop - rows.start, columns.stop - columns.start
    if by_lattice:
        block = np.mgrid[rows.start : rows.stop, columns.start : columns.stop]
        targets = block[0].ravel(), block[1].ravel()
        basis = Lattice.around(field, member, cells)
        precision, shift, (mean, variance, skew) = condition_and_predict(
            basis, observed, cells, targets
        )
    else:
        at_row = torch.from_numpy(row)[:, None]
        at_column = torch.from_numpy(column)[:, None]
        covariance = field.covariance(
            member, at_row - at_row.T, at_column - at_column.T
        ).numpy()
        solved = condition(covariance, observed)
        precision = solved.precision
        shift = solved.shift
        block_rows = torch.arange(rows.start, rows.stop)
        block_columns = torch.arange(columns.start, columns.stop)
        across = field.covariance(
            member,
            (at_row - block_rows)[..., None],
            (at_column - block_columns)[:, None],
        )
        mean, variance, skew = predict(
            solved, covariance, observed, across.flatten(1).numpy()
        )
    moments = np.stack((mean, np.sqrt(variance.clip(0)), skew)).reshape(3, *shape)
    old = np.stack([maps[name][rows, columns] for name in ("mean", "std", "skew")])
    # Observed cells beyond the limit keep their posterior, which has used more than
    # this update. Conditioning on numbers never increases a standard deviation.
    unchanged = remaining[rows, columns]
    if not observed.interval.any():
        unchanged |= moments[1] > old[1] + _MIN_CHANGE
        moments[1] = np.minimum(moments[1], old[1])
    min_change = _MIN_CHANGE / np.array((1, 1, _OF_SKEW))[:, None, None]
    moved = (abs(moments - old) >= min_change).any(0) & ~unchanged
    for name, values in zip(("mean", "std", "skew"), moments, strict=True):
        np.copyto(maps[name][rows, columns], values, where=moved)
    maps["precision"][cells], maps["shift"][cells] = precision, shift


def _around(new: ndarray, reach: int) -> tuple[slice, slice]:
    """Return the rows and columns of a map within some cells of changed ones."""
    rows, columns = (
        slice(max(low - reach, 0), min(high + reach + 1, size))
        for (low, high), size in zip(bounds(new), new.shape, strict=True)
    )
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
    """Return ℓ of one episode in cells: the mode of its posterior among `_LENGTHS_M`."""
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
    return float(field.length[int(np.argmax(log_posterior))])


@lru_cache(maxsize=8)
def _candidates(shape: tuple[int, int], resolution_m: float, nugget: float) -> Field:
    return Field.of(
        shape, [length / resolution_m for length in _LENGTHS_M], "cpu", nugget
    )


def bounds(new: ndarray) -> list[tuple[int, int]]:
    """Return first and last row, and first and last column, of the cells of a mask."""
    return [(int(places.min()), int(places.max())) for places in new.nonzero()]


def nearest(observed: ndarray, new: ndarray, window: int) -> tuple[ndarray, ndarray]:
    """Return rows and columns of new cells and of the observed cells nearest to them.

    Args:
        observed: mask of observed cells, new ones included, bool, shape [H, W].
        new: mask of new cells, bool, shape [H, W].
        window: maximum number of cells; more if more are new.
    """
    row, column = observed.nonzero()
    (top, bottom), (left, right) = bounds(new)
    down = np.maximum(top - row, row - bottom).clip(0)
    across = np.maximum(left - column, column - right).clip(0)
    # Of equal distances the first cell goes first, on every machine.
    distance = np.where(new[row, column], -1, down**2 + across**2)
    order = distance.argsort(kind="stable")
    chosen = order[: max(window, int(new.sum()))]
    return row[chosen], column[chosen]
