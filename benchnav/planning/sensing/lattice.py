"""A field of correlated standard normals, given many observations, by a lattice of some
of its cells.

Where ℓ is several cells long, the field is smooth from cell to cell. Its values on a
lattice of every few cells, the basis, then determine it, and what the basis leaves of a
cell's variance counts as that cell's own, independent of all others. All observations
count; the cost is of N m² for N of them and m cells of the basis, not of N³.

Sources: Snelson and Ghahramani (2006), "Sparse Gaussian processes using pseudo-inputs"
(FITC), for numbers; Naish-Guzman and Holden (2008), "The generalized FITC
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
    LEAST_VARIANCE,
    Field,
    Observed,
    Terms,
    skewness,
    third_cumulants,
    times,
)

_JITTER = (
    1e-8  # of a variance of 1, so that the lattice's covariance has a Cholesky factor
)
# steps of the lattice that the basis reaches beyond the observed cells; with 1 some
# variances err by 0.02
_BEYOND = 2

Cells = tuple[ndarray, ndarray]  # rows and columns


def spacing_of(length: float) -> int:
    """Return how many cells the basis goes on by: half of ℓ, for which standard
    deviations err by under 0.003.
    """
    return int(length // 2)


@dataclass(frozen=True)
class Lattice:
    """A basis of some cells of a field.

    Args:
        field: correlations of the scores.
        own: which field of it.
        basis: the cells.
        root: Cholesky factor of their covariance, shape [m, m].
    """

    field: Field
    own: int
    basis: Cells
    root: Tensor

    @classmethod
    def around(cls, field: Field, own: int, cells: Cells) -> "Lattice":
        """Return the basis for some observed cells."""
        spacing = spacing_of(float(field.length[own]))
        lines = [
            np.arange(spacing // 2, correlations.shape[1], spacing)
            for correlations in (field.down, field.across)
        ]
        blocks = [
            (places // spacing).clip(0, len(line) - 1)
            for places, line in zip(cells, lines, strict=True)
        ]
        used = np.zeros([len(line) + 2 * _BEYOND for line in lines], bool)
        for down in range(2 * _BEYOND + 1):
            for across in range(2 * _BEYOND + 1):
                used[blocks[0] + down, blocks[1] + across] = True
        chosen = used[_BEYOND:-_BEYOND, _BEYOND:-_BEYOND].nonzero()
        basis = lines[0][chosen[0]], lines[1][chosen[1]]
        covariance = _shared(field, own, basis, basis)
        covariance.diagonal().add_(_JITTER)
        return cls(field, own, basis, torch.linalg.cholesky(covariance))

    def coefficients(self, cells: Cells) -> tuple[ndarray, ndarray]:
        """Return cells as sums of independent normals, [m, M], and the variance that is
        each cell's own, [M].
        """
        shared = _shared(self.field, self.own, self.basis, cells)
        combined = torch.linalg.solve_triangular(self.root, shared, upper=False).numpy()
        return combined, (1 - np.square(combined).sum(0)).clip(0)


def _shared(field: Field, own: int, one: Cells, other: Cells) -> Tensor:
    """Return the covariances of what cells share with their neighbours, [N, M]; a
    nugget is a cell's own.
    """
    rows, columns = (
        torch.from_numpy(a[:, None] - b) for a, b in zip(one, other, strict=True)
    )
    return field.shared(own, rows, columns)


@dataclass(frozen=True)
class Known:
    """The normals behind a lattice, given Gaussian terms of some cells.

    Args:
        factor: Cholesky factor of their precision, shape [m, m].
        pulled: what the factor makes of the terms' shift, shape [m].
    """

    factor: Tensor
    pulled: ndarray

    @classmethod
    def of(cls, precision: Tensor, shift: ndarray) -> "Known":
        """Return what is known by precision [m, m] and shift [m]."""
        factor = torch.linalg.cholesky(precision)
        pulled = torch.linalg.solve_triangular(
            factor, torch.from_numpy(shift)[:, None], upper=False
        )
        return cls(factor, pulled[:, 0].numpy())

    def taken(self, combined: ndarray) -> ndarray:
        """Return the part of cells [m, M] that is left of the normals, [m, M]; its
        squares add up to a variance.
        """
        return torch.linalg.solve_triangular(
            self.factor, torch.from_numpy(combined), upper=False
        ).numpy()


def _moments(
    known: Known, combined: ndarray, own: ndarray, precision: ndarray, shift: ndarray
) -> tuple[ndarray, ndarray, ndarray]:
    """Return mean and variance of cells that have terms, [M], and what is left of the
    normals in them, [m, M].
    """
    left = known.taken(combined)
    share = 1 / (1 + own * precision)
    mean = (times(left.T, known.pulled) + own * shift) * share
    return mean, (own + np.square(left).sum(0) * share) * share, left


def _weighted(
    combined: ndarray, own: ndarray, precision: ndarray, shift: ndarray
) -> tuple[Tensor, ndarray]:
    """Return what terms add to the precision of the normals, [m, m], and to their
    shift, [m].
    """
    share = 1 / (1 + own * precision)
    return torch.from_numpy(combined * (precision * share)) @ torch.from_numpy(
        combined
    ).T, times(combined, shift * share)


def condition_and_predict(
    lattice: Lattice, observed: Observed, cells: Cells, wanted: Cells
) -> tuple[ndarray, ndarray, tuple[ndarray, ndarray, ndarray]]:
    """Condition a field on what is observed of some cells, and predict others.

    Args:
        lattice: around the observed cells.
        observed: what is known of them; the terms that it has are where intervals
            begin.
        cells: the observed ones, N.
        wanted: those to predict, M; observed ones may be among them.

    Returns:
        Precision and shift of the terms that stand for what is observed, each of shape
        [N]; and mean, variance and skewness of the wanted cells, each of shape [M].
    """
    held = observed.interval
    precision = np.where(held, 0.0, 1 / np.square(observed.std))
    shift = precision * np.where(held, 0.0, observed.lower)
    combined, own = lattice.coefficients(cells)
    more, pulled = _weighted(
        combined[:, ~held], own[~held], precision[~held], shift[~held]
    )
    before = more + torch.eye(len(pulled), dtype=more.dtype), pulled
    known = Known.of(*before)
    if held.any():
        # The intervals, one term a cell, all at once and damped.
        terms = Terms(observed.precision[held], observed.shift[held])
        ends = observed.lower[held], observed.upper[held], observed.std[held]
        for _ in range(DAMPED_ROUNDS):
            more, pulled = _weighted(combined[:, held], own[held], *terms)
            known = Known.of(before[0] + more, before[1] + pulled)
            mean, variance, _ = _moments(known, combined[:, held], own[held], *terms)
            variance = variance.clip(LEAST_VARIANCE)
            terms, settled = terms.step(mean, variance, *ends)
            if settled:
                break
        precision[held], shift[held] = terms
        more, pulled = _weighted(combined[:, held], own[held], *terms)
        known = Known.of(before[0] + more, before[1] + pulled)
    # Terms of the wanted cells that are observed.
    maps = np.zeros((2, lattice.field.down.shape[1], lattice.field.across.shape[1]))
    maps[0][cells], maps[1][cells] = precision, shift
    basis, wanted_own = lattice.coefficients(wanted)
    terms_there = maps[0][wanted], maps[1][wanted]
    mean, variance, left = _moments(known, basis, wanted_own, *terms_there)
    skew = np.zeros_like(mean)
    if held.any():
        own_mean, own_variance, own_left = _moments(
            known, combined[:, held], own[held], precision[held], shift[held]
        )
        own_variance = own_variance.clip(LEAST_VARIANCE)
        share = 1 / (1 + own[held] * precision[held])
        regression = times((own_left * share / own_variance).T, left) / (
            1 + wanted_own * terms_there[0]
        )
        there = np.full(maps.shape[1:], -1)
        there[wanted] = np.arange(len(mean))
        places = there[cells[0][held], cells[1][held]]
        seen = places >= 0
        regression[seen.nonzero()[0], places[seen]] = 1
        third = third_cumulants(observed, precision, shift, own_mean, own_variance)
        skew = skewness(third, regression, variance)
    return precision, shift, (mean, variance, skew)
