"""Sparse conditioning of a correlated field on many observations, by a lattice of cells.

Where ℓ is several cells long, the field is smooth from cell to cell. Its values on a
lattice of every few cells, the basis, then determine it. The rest of a cell's variance
counts as independent of all other cells. All observations are used; the cost is N m²
for N of them and m basis cells, instead of N³.

Sources: Snelson and Ghahramani (2006), "Sparse Gaussian processes using pseudo-inputs"
(FITC), for point observations; Naish-Guzman and Holden (2008), "The generalized FITC
approximation", for intervals, by expectation propagation as in `gaussian`.

One field at a time, in NumPy and float64, as in `gaussian`. Letters in shapes: N
observations, M cells, m cells of the basis, H×W map.
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
    skewness,
    third_cumulants,
    times,
)

# Added to a variance of 1, so that the lattice's covariance has a Cholesky factor.
_JITTER = 1e-8
# Steps of the lattice that the basis extends beyond the observed cells; with 1 some
# variances are off by 0.02.
_MARGIN = 2

Cells = tuple[ndarray, ndarray]  # rows and columns


def spacing_of(length: float) -> int:
    """Return the spacing of the basis in cells: ℓ/2.

    Standard deviations are then off by less than 0.003.
    """
    return int(length // 2)


@dataclass(frozen=True)
class Lattice:
    """A basis of some cells of a field.

    Args:
        field: correlations of the scores.
        member: index of the field.
        basis: the basis cells.
        root: Cholesky factor of their covariance, shape [m, m].
    """

    field: Field
    member: int
    basis: Cells
    root: Tensor

    @classmethod
    def around(cls, field: Field, member: int, cells: Cells) -> "Lattice":
        """Return the basis for some observed cells."""
        spacing = spacing_of(float(field.length[member]))
        lines = [
            np.arange(spacing // 2, correlations.shape[1], spacing)
            for correlations in (field.down, field.across)
        ]
        blocks = [
            (indices // spacing).clip(0, len(line) - 1)
            for indices, line in zip(cells, lines, strict=True)
        ]
        is_used = np.zeros([len(line) + 2 * _MARGIN for line in lines], bool)
        for down in range(2 * _MARGIN + 1):
            for across in range(2 * _MARGIN + 1):
                is_used[blocks[0] + down, blocks[1] + across] = True
        rows, columns = is_used[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN].nonzero()
        basis = lines[0][rows], lines[1][columns]
        covariance = _shared(field, member, basis, basis)
        covariance.diagonal().add_(_JITTER)
        return cls(field, member, basis, torch.linalg.cholesky(covariance))

    def coefficients(self, cells: Cells) -> tuple[ndarray, ndarray]:
        """Return coefficients of cells in independent normals, [m, M], and their
        residual variance, [M].
        """
        shared = _shared(self.field, self.member, self.basis, cells)
        weights = torch.linalg.solve_triangular(self.root, shared, upper=False).numpy()
        return weights, (1 - np.square(weights).sum(0)).clip(0)


def _shared(field: Field, member: int, first: Cells, second: Cells) -> Tensor:
    """Return the covariances of two sets of cells without the nugget, [N, M]."""
    rows = torch.from_numpy(first[0][:, None] - second[0])
    columns = torch.from_numpy(first[1][:, None] - second[1])
    return field.shared(member, rows, columns)


@dataclass(frozen=True)
class Normals:
    """The independent normals of a lattice, given Gaussian terms of some cells.

    Args:
        factor: Cholesky factor of their precision, shape [m, m].
        whitened_shift: shift of the terms, solved by the factor, shape [m].
    """

    factor: Tensor
    whitened_shift: ndarray

    @classmethod
    def of(cls, precision: Tensor, shift: ndarray) -> "Normals":
        """Return the normals of precision [m, m] and shift [m]."""
        factor = torch.linalg.cholesky(precision)
        column = torch.from_numpy(shift)[:, None]
        whitened = torch.linalg.solve_triangular(factor, column, upper=False)
        return cls(factor, whitened[:, 0].numpy())

    def whiten(self, weights: ndarray) -> ndarray:
        """Solve coefficients of cells by the factor, [m, M].

        The squares of a column add up to the variance of a cell.
        """
        return torch.linalg.solve_triangular(
            self.factor, torch.from_numpy(weights), upper=False
        ).numpy()


def _moments(
    normals: Normals,
    weights: ndarray,
    residual: ndarray,
    precision: ndarray,
    shift: ndarray,
) -> tuple[ndarray, ndarray, ndarray]:
    """Return mean [M] and variance [M] of cells with terms, and their whitened
    coefficients, [m, M].
    """
    whitened = normals.whiten(weights)
    shrink = 1 / (1 + residual * precision)
    mean = (times(whitened.T, normals.whitened_shift) + residual * shift) * shrink
    variance = (residual + np.square(whitened).sum(0) * shrink) * shrink
    return mean, variance, whitened


def _weighted(
    weights: ndarray, residual: ndarray, precision: ndarray, shift: ndarray
) -> tuple[Tensor, ndarray]:
    """Return the precision [m, m] and the shift [m] that terms add to the normals."""
    shrink = 1 / (1 + residual * precision)
    scaled = torch.from_numpy(weights * (precision * shrink))
    return scaled @ torch.from_numpy(weights).T, times(weights, shift * shrink)


def condition_and_predict(
    lattice: Lattice, observed: Observed, cells: Cells, targets: Cells
) -> tuple[ndarray, ndarray, tuple[ndarray, ndarray, ndarray]]:
    """Condition a field on observations of some cells, and predict others.

    Args:
        lattice: the basis around the observed cells.
        observed: observations; their terms are the start values of those of intervals.
        cells: the observed cells, N.
        targets: the cells to predict, M; observed ones may be among them.

    Returns:
        Precision and shift of the terms that stand for the observations, each of shape
        [N]; and mean, variance and skewness of the targets, each of shape [M].
    """
    censored = observed.interval
    exact = ~censored
    precision = np.where(censored, 0.0, 1 / np.square(observed.std))
    shift = precision * np.where(censored, 0.0, observed.lower)
    weights, residual = lattice.coefficients(cells)
    added, pulled = _weighted(
        weights[:, exact], residual[exact], precision[exact], shift[exact]
    )
    prior_precision = added + torch.eye(len(pulled), dtype=added.dtype)
    prior_shift = pulled
    normals = Normals.of(prior_precision, prior_shift)
    if censored.any():
        # One term for each interval, all updated at once and damped.
        terms = Terms(observed.precision[censored], observed.shift[censored])
        lower = observed.lower[censored]
        upper = observed.upper[censored]
        std = observed.std[censored]
        of_censored = weights[:, censored], residual[censored]
        for _ in range(DAMPED_ROUNDS):
            added, pulled = _weighted(*of_censored, *terms)
            normals = Normals.of(prior_precision + added, prior_shift + pulled)
            mean, variance, _ = _moments(normals, *of_censored, *terms)
            variance = variance.clip(MIN_VARIANCE)
            terms, converged = terms.step(mean, variance, lower, upper, std)
            if converged:
                break
        precision[censored], shift[censored] = terms
        added, pulled = _weighted(*of_censored, *terms)
        normals = Normals.of(prior_precision + added, prior_shift + pulled)
    # Terms of the targets that are observed.
    map_shape = lattice.field.down.shape[1], lattice.field.across.shape[1]
    maps = np.zeros((2, *map_shape))
    maps[0][cells], maps[1][cells] = precision, shift
    basis, target_residual = lattice.coefficients(targets)
    target_precision = maps[0][targets]
    target_shift = maps[1][targets]
    mean, variance, whitened = _moments(
        normals, basis, target_residual, target_precision, target_shift
    )
    skew = np.zeros_like(mean)
    if censored.any():
        own_mean, own_variance, own_whitened = _moments(
            normals, *of_censored, precision[censored], shift[censored]
        )
        own_variance = own_variance.clip(MIN_VARIANCE)
        shrink = 1 / (1 + residual[censored] * precision[censored])
        gain = own_whitened * shrink / own_variance
        unshrink = 1 + target_residual * target_precision
        regression = times(gain.T, whitened) / unshrink
        target_index = np.full(map_shape, -1)
        target_index[targets] = np.arange(len(mean))
        indices = target_index[cells[0][censored], cells[1][censored]]
        is_target = indices >= 0
        regression[is_target.nonzero()[0], indices[is_target]] = 1
        third = third_cumulants(observed, precision, shift, own_mean, own_variance)
        skew = skewness(third, regression, variance)
    return precision, shift, (mean, variance, skew)
