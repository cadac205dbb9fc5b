"""Sparse conditioning of a correlated field on many observations, by a lattice of cells.

If ℓ is several cells long, the field is smooth from cell to cell. Its values in a
coarse lattice of cells, the basis, then almost determine the field. The remaining
variance of a cell is assumed to be independent of all other cells. For N observations
and m basis cells, the computation takes N m² operations instead of N³.

Sources: Snelson and Ghahramani (2006), "Sparse Gaussian processes using pseudo-inputs"
(FITC), for point observations; Naish-Guzman and Holden (2008), "The generalized FITC
approximation", for intervals, by expectation propagation as in `gaussian`.

Fields are conditioned one at a time, in NumPy and float64, as in `gaussian`.
Letters in shapes: N observations, M cells, m cells of the basis, H×W map.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from benchnav.planning.sensing.gaussian import (
    DAMPED_ROUNDS,
    MIN_VARIANCE,
    Field,
    Observed,
    Terms,
    product,
    skewness,
    third_cumulants,
)

# Added to each basis cell's variance, so that their covariance has a Cholesky factor.
_JITTER = 1e-8
# Number of basis cells by which the basis extends beyond the observed cells. With a
# margin of 1, some variances have an error of 0.02.
_MARGIN = 2

Cells = tuple[ndarray, ndarray]
"""Rows and columns of cells."""


def spacing_of(length: float) -> int:
    """Return the spacing of the basis in cells, ℓ/2 rounded down.

    With this spacing, errors of standard deviations are below 0.003.

    Args:
        length: ℓ in cells.
    """
    return int(length // 2)


@dataclass(frozen=True)
class Lattice:
    """Cells whose scores determine those of all cells nearby: the basis.

    Args:
        field: correlations of the scores.
        member: index of the field.
        basis: rows and columns of the basis cells.
        root: Cholesky factor of the covariance of the basis cells, shape [m, m].
    """

    field: Field
    member: int
    basis: Cells
    root: Tensor

    @classmethod
    def around(cls, field: Field, member: int, cells: Cells) -> "Lattice":
        """Return the lattice around observed cells."""
        spacing = spacing_of(float(field.length[member]))
        height = field.down.shape[1]
        width = field.across.shape[1]
        basis_rows = np.arange(spacing // 2, height, spacing)
        basis_columns = np.arange(spacing // 2, width, spacing)
        nearest_row = (cells[0] // spacing).clip(0, len(basis_rows) - 1)
        nearest_column = (cells[1] // spacing).clip(0, len(basis_columns) - 1)
        # The mask of used basis cells is padded by the margin on all sides.
        n_rows = len(basis_rows) + 2 * _MARGIN
        n_columns = len(basis_columns) + 2 * _MARGIN
        is_used = np.zeros((n_rows, n_columns), bool)
        for down in range(2 * _MARGIN + 1):
            for across in range(2 * _MARGIN + 1):
                is_used[nearest_row + down, nearest_column + across] = True
        rows, columns = is_used[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN].nonzero()
        basis = basis_rows[rows], basis_columns[columns]
        covariance = _covariance_without_nugget(field, member, basis, basis)
        covariance.diagonal().add_(_JITTER)
        root = torch.linalg.cholesky(covariance)
        return cls(field, member, basis, root)

    def coefficients(self, cells: Cells) -> tuple[ndarray, ndarray]:
        """Return cells as linear functions of m independent standard normals.

        Args:
            cells: rows and columns of M cells.

        Returns:
            Coefficients of the cells, shape [m, M], and the residual variance of each
            cell, which the normals do not explain, shape [M].
        """
        covariance = _covariance_without_nugget(
            self.field, self.member, self.basis, cells
        )
        weights = torch.linalg.solve_triangular(
            self.root, covariance, upper=False
        ).numpy()
        residual = 1 - np.square(weights).sum(0)
        return weights, residual.clip(0)


def _covariance_without_nugget(
    field: Field, member: int, first: Cells, second: Cells
) -> Tensor:
    """Return the covariances of two sets of cells without the nugget, [N, M]."""
    rows = torch.from_numpy(first[0][:, None] - second[0])
    columns = torch.from_numpy(first[1][:, None] - second[1])
    return field.covariance_without_nugget(member, rows, columns)


@dataclass(frozen=True)
class Normals:
    """Posterior of a lattice's m normals, given Gaussian terms of some cells.

    Args:
        factor: L, the Cholesky factor of the normals' posterior precision, shape
            [m, m].
        whitened_shift: L⁻¹ times the posterior shift (precision times mean), shape [m].
    """

    factor: Tensor
    whitened_shift: ndarray

    @classmethod
    def of(cls, precision: Tensor, shift: ndarray) -> "Normals":
        """Return the posterior of precision [m, m] and shift [m]."""
        factor = torch.linalg.cholesky(precision)
        column = torch.from_numpy(shift)[:, None]
        whitened = torch.linalg.solve_triangular(factor, column, upper=False)
        return cls(factor, whitened[:, 0].numpy())

    def whiten(self, weights: ndarray) -> ndarray:
        """Return L⁻¹ times coefficients of cells, shape [m, M].

        The squares in a column add up to the variance that the normals give to a cell.
        """
        columns = torch.from_numpy(weights)
        return torch.linalg.solve_triangular(self.factor, columns, upper=False).numpy()


def _moments(
    normals: Normals,
    weights: ndarray,
    residual: ndarray,
    precision: ndarray,
    shift: ndarray,
) -> tuple[ndarray, ndarray, ndarray]:
    """Return mean [M], variance [M] and whitened coefficients [m, M] of cells with terms.

    Args:
        normals: posterior of the lattice's normals.
        weights: coefficients of the cells, shape [m, M].
        residual: residual variance of the cells, shape [M].
        precision: precision of the cells' own terms, 0 without a term, shape [M].
        shift: precision times mean of these terms, shape [M].
    """
    whitened = normals.whiten(weights)
    shrink = 1 / (1 + residual * precision)
    explained = product(whitened.T, normals.whitened_shift)
    mean = (explained + residual * shift) * shrink
    explained_variance = np.square(whitened).sum(0)
    variance = (residual + explained_variance * shrink) * shrink
    return mean, variance, whitened


def _added_by_terms(
    weights: ndarray, residual: ndarray, precision: ndarray, shift: ndarray
) -> tuple[Tensor, ndarray]:
    """Return the precision [m, m] and the shift [m] that terms add to the normals."""
    shrink = 1 / (1 + residual * precision)
    scaled = torch.from_numpy(weights * (precision * shrink))
    added_precision = scaled @ torch.from_numpy(weights).T
    return added_precision, product(weights, shift * shrink)


def condition_and_predict(
    lattice: Lattice, observed: Observed, cells: Cells, targets: Cells
) -> tuple[ndarray, ndarray, tuple[ndarray, ndarray, ndarray]]:
    """Condition a field on observations, and predict target cells.

    Args:
        lattice: the lattice around the observed cells.
        observed: observations; the terms of intervals are start values.
        cells: rows and columns of the N observed cells.
        targets: rows and columns of the M cells to predict, which may include observed
            cells.

    Returns:
        Precision and shift of the terms that represent the observations, each of shape
        [N]; and mean, variance and skewness of the targets, each of shape [M].
    """
    censored = observed.interval
    exact = ~censored
    precision = np.where(censored, 0.0, 1 / np.square(observed.std))
    shift = precision * np.where(censored, 0.0, observed.lower)
    weights, residual = lattice.coefficients(cells)
    exact_inputs = weights[:, exact], residual[exact]
    added, prior_shift = _added_by_terms(*exact_inputs, precision[exact], shift[exact])
    prior_precision = added + torch.eye(len(prior_shift), dtype=added.dtype)
    normals = Normals.of(prior_precision, prior_shift)
    censored_weights = weights[:, censored]
    censored_residual = residual[censored]
    if censored.any():
        # Expectation propagation, as in `gaussian.condition`.
        terms = Terms(observed.precision[censored], observed.shift[censored])
        lower = observed.lower[censored]
        upper = observed.upper[censored]
        std = observed.std[censored]
        censored_inputs = censored_weights, censored_residual
        for _ in range(DAMPED_ROUNDS):
            added, added_shift = _added_by_terms(*censored_inputs, *terms)
            normals = Normals.of(prior_precision + added, prior_shift + added_shift)
            mean, variance, _ = _moments(normals, *censored_inputs, *terms)
            variance = variance.clip(MIN_VARIANCE)
            terms, converged = terms.updated(mean, variance, lower, upper, std)
            if converged:
                break
        precision[censored], shift[censored] = terms
        added, added_shift = _added_by_terms(*censored_inputs, *terms)
        normals = Normals.of(prior_precision + added, prior_shift + added_shift)
    # Targets that are observed have terms of their own.
    field = lattice.field
    map_shape = field.down.shape[1], field.across.shape[1]
    precision_map = np.zeros(map_shape)
    shift_map = np.zeros(map_shape)
    precision_map[cells] = precision
    shift_map[cells] = shift
    target_precision = precision_map[targets]
    target_weights, target_residual = lattice.coefficients(targets)
    mean, variance, whitened = _moments(
        normals, target_weights, target_residual, target_precision, shift_map[targets]
    )
    if not censored.any():
        return precision, shift, (mean, variance, np.zeros_like(mean))
    censored_precision = precision[censored]
    censored_mean, censored_variance, censored_whitened = _moments(
        normals,
        censored_weights,
        censored_residual,
        censored_precision,
        shift[censored],
    )
    censored_variance = censored_variance.clip(MIN_VARIANCE)
    shrink = 1 / (1 + censored_residual * censored_precision)
    gain = censored_whitened * shrink / censored_variance
    inverse_shrink = 1 + target_residual * target_precision
    regression = product(gain.T, whitened) / inverse_shrink
    target_index = np.full(map_shape, -1)
    target_index[targets] = np.arange(len(mean))
    censored_cells = cells[0][censored], cells[1][censored]
    indices = target_index[censored_cells]
    is_target = indices >= 0
    target_rows = is_target.nonzero()[0]
    regression[target_rows, indices[is_target]] = 1
    third = third_cumulants(
        observed, precision, shift, censored_mean, censored_variance
    )
    skew = skewness(third, regression, variance)
    return precision, shift, (mean, variance, skew)
