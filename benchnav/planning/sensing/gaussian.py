"""Conditioning of a field of correlated standard normals on observations.

An observation of a cell's normal score is either a number with noise, or an interval
with noise, for example if λ is 0 or 1. Conditioning on numbers is exact. Conditioning
on intervals has no closed form. Expectation propagation represents each interval by a
Gaussian term. The field times these terms has, in each cell, the mean and variance that
it has under the cell's interval (Minka 2001). Equations are as in Rasmussen and Williams
(2006), section 3.6, except that all terms are updated at once, with damping.

Fields are conditioned one at a time, in float64. NumPy has the least overhead for small
systems. PyTorch computes products and solutions, since NumPy's rounding in these
depends on the number of threads.
Letters in shapes: B fields, N observations, M cells, H×W map; T is the diagonal matrix
of the terms' precisions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy import ndarray
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.copula import correlations
from benchnav.planning.sensing.truncated_normal import (
    MIN_FRACTION,
    interval_moments,
    standardise,
    third_cumulant,
)

_DAMPING = 0.8
DAMPED_ROUNDS = 40
"""Maximum number of updates of the terms."""
_TOLERANCE = 1e-3  # maximum change of a mean at convergence, in normal scores
MIN_VARIANCE = 1e-12
_MAX_SKEW = 2.0  # skewness of an exponential distribution, as far out in a tail


@dataclass(frozen=True)
class Field(Batch):
    """Correlations between cells of maps, by their offsets along both axes.

    Args:
        length: ℓ in cells, float64, shape [B].
        down: correlation of cells by their offset in rows, float64, shape [B, H].
        across: correlation of cells by their offset in columns, float64, shape [B, W].
        nugget: fraction of a cell's variance that is independent of all other cells.
    """

    length: Tensor
    down: Tensor
    across: Tensor
    nugget: float = 0.0

    @classmethod
    def of(
        cls,
        shape: tuple[int, int],
        lengths: Sequence[float],
        device: torch.device | str,
        nugget: float = 0.0,
    ) -> "Field":
        """Return the correlations of `benchnav.core.copula.correlated_normal`.

        Args:
            shape: (H, W).
            lengths: ℓ of each field in cells, length B.
            device: device of the correlations.
            nugget: nugget of all fields, in [0, 1).
        """
        height, width = shape
        # Most fields have the same ℓ, so correlations are computed once per ℓ.
        down_by_length = {ell: correlations(height, ell) for ell in set(lengths)}
        across_by_length = {ell: correlations(width, ell) for ell in set(lengths)}
        down = np.stack([down_by_length[ell] for ell in lengths])
        across = np.stack([across_by_length[ell] for ell in lengths])
        return cls(
            length=torch.tensor(lengths, dtype=torch.float64, device=device),
            down=torch.from_numpy(down).to(device),
            across=torch.from_numpy(across).to(device),
            nugget=nugget,
        )

    def write(self, member: int, field: "Field") -> None:
        """Replace the field at an index by a single field (B = 1), in place."""
        for name in ("length", "down", "across"):
            getattr(self, name)[member] = getattr(field, name)[0]

    def covariance(self, member: int | Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Return correlations of pairs of cells.

        Args:
            member: index of the field; a tensor (int64) contains an index per pair.
            rows: offset in rows between the cells of each pair, of either sign, int64.
            columns: offset in columns, int64.

        Returns:
            Correlations, float64, of the arguments' broadcast shape.
        """
        correlation = self.covariance_without_nugget(member, rows, columns)
        if self.nugget:
            same_cell = (rows == 0) & (columns == 0)
            correlation = torch.where(same_cell, correlation + self.nugget, correlation)
        return correlation

    def covariance_without_nugget(
        self, member: int | Tensor, rows: Tensor, columns: Tensor
    ) -> Tensor:
        """Return `covariance` without the nugget, which affects only equal cells."""
        down = self.down[member, rows.abs()]
        across = self.across[member, columns.abs()]
        return (1 - self.nugget) * down * across


@dataclass(frozen=True)
class Observed:
    """Observed scores, and the Gaussian terms that represent them.

    Args:
        lower: minimum score; −∞ if unbounded, shape [N].
        upper: maximum score, ∞ if unbounded; for a number, equal to the minimum, shape
            [N].
        std: standard deviation of the noise of the score, shape [N].
        precision: precision of the Gaussian terms; 0 if not yet computed, shape [N].
        shift: precision times mean of the terms, shape [N].
    """

    lower: ndarray
    upper: ndarray
    std: ndarray
    precision: ndarray
    shift: ndarray

    @property
    def interval(self) -> ndarray:
        """Mask of interval-censored scores, bool, shape [N]."""
        return self.upper > self.lower


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """A field conditioned on Gaussian terms.

    Args:
        root: √precision of the terms, shape [N].
        factor: Cholesky factor of I + √T K √T, shape [N, N].
        weights: weights of covariances with the observed cells in a mean, shape [N].
        precision: precision of the terms, shape [N].
        shift: precision times mean of the terms, shape [N].
    """

    root: ndarray
    factor: Tensor
    weights: ndarray
    precision: ndarray
    shift: ndarray

    def moments(self, covariance: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """Return posterior moments of M cells, whose prior variance is 1.

        Args:
            covariance: covariances of the observed cells with the M cells, shape
                [N, M].

        Returns:
            Mean [M], variance [M], and A of shape [N, M]; AᵀA is the reduction of the
            covariance of the M cells.
        """
        reduction = _reduction(self.factor, self.root, covariance)
        mean = product(self.weights, covariance)
        explained = np.square(reduction).sum(0)
        variance = (1 - explained).clip(0)
        return mean, variance, reduction


def posterior(covariance: ndarray, precision: ndarray, shift: ndarray) -> Posterior:
    """Condition a field on Gaussian terms.

    Args:
        covariance: K of the observed cells, shape [N, N].
        precision: precision of the terms, ≥ 0, shape [N].
        shift: precision times mean of the terms, shape [N].
    """
    root = np.sqrt(precision)
    factor = _factor(covariance, root)
    # (K⁻¹ + T)⁻¹ ν = K (ν − √T (I + √T K √T)⁻¹ √T K ν)
    scaled = torch.from_numpy(root * product(covariance, shift))
    solved = torch.cholesky_solve(scaled[:, None], factor)[:, 0].numpy()
    weights = shift - root * solved
    return Posterior(
        root=root, factor=factor, weights=weights, precision=precision, shift=shift
    )


def condition(covariance: ndarray, observed: Observed) -> Posterior:
    """Condition a field on numbers exactly, and on intervals by expectation propagation.

    Args:
        covariance: K of the observed cells, shape [N, N].
        observed: observations; the terms of intervals are start values.
    """
    censored = observed.interval
    precision = np.where(censored, 0.0, 1 / np.square(observed.std))
    shift = precision * np.where(censored, 0.0, observed.lower)
    numbers = posterior(covariance, precision, shift)
    if not censored.any():
        return numbers
    # Expectation propagation runs on the interval-censored cells only, whose mean and
    # covariance are first conditioned on the numbers.
    columns = covariance[:, censored]
    centre, _, reduction = numbers.moments(columns)
    residual_cov = columns[censored] - product(reduction.T, reduction)
    terms = Terms(observed.precision[censored], observed.shift[censored])
    lower = observed.lower[censored]
    upper = observed.upper[censored]
    std = observed.std[censored]
    for _ in range(DAMPED_ROUNDS):
        mean, variance = terms.moments(residual_cov, centre)
        terms, converged = terms.updated(mean, variance, lower, upper, std)
        if converged:
            break
    precision = precision.copy()
    shift = shift.copy()
    precision[censored], shift[censored] = terms
    return posterior(covariance, precision, shift)


def log_evidence(covariance: ndarray, observed: Observed, solved: Posterior) -> float:
    """Return the log-likelihood of observations, up to a constant.

    The result is exact for numbers. For intervals it is the estimate of expectation
    propagation (Rasmussen and Williams 2006, equation 3.65).

    Args:
        covariance: K of the observed cells, shape [N, N].
        observed: observations.
        solved: the conditioned field, from `condition`.
    """
    mean, variance, _ = solved.moments(covariance)
    diagonal = solved.factor.diagonal().numpy()
    log_determinant = np.log(diagonal).sum()
    exact_part = 0.5 * (solved.shift * mean).sum() - log_determinant
    censored = observed.interval
    terms = Terms(solved.precision[censored], solved.shift[censored])
    variance = variance[censored].clip(MIN_VARIANCE)
    centre, cavity = terms.cavity(mean[censored], variance)
    total = cavity + np.square(observed.std[censored])
    lower = observed.lower[censored]
    upper = observed.upper[censored]
    log_mass = standardise(centre, total, lower, upper)[2]
    # The probability of the interval replaces the integral of its Gaussian term.
    scaled = 1 + cavity * terms.precision
    joint = np.square(centre + cavity * terms.shift) / scaled
    exponent = (joint - np.square(centre)) / (2 * cavity)
    log_integral = exponent - 0.5 * np.log(scaled)
    return float(exact_part + (log_mass - log_integral).sum())


def predict(
    solved: Posterior, covariance: ndarray, observed: Observed, block: ndarray
) -> tuple[ndarray, ndarray, ndarray]:
    """Return mean, variance and skewness of M cells, each of shape [M].

    An interval skews the posterior of its cell and, by correlation, of cells nearby. A
    cell's third cumulant is a sum over the interval-censored cells: the third cumulant
    of each such cell, times the cube of the cell's regression coefficient on it. The
    sum is exact for one interval and of first order for several (Opper, Paquet and
    Winther 2013, "Perturbative corrections for approximate inference in Gaussian latent
    variable models").

    Args:
        solved: the conditioned field, from `condition`.
        covariance: K of the observed cells, shape [N, N].
        observed: the N observations.
        block: covariances of the observed cells with the M cells, shape [N, M].
    """
    mean, variance, reduction = solved.moments(block)
    censored = observed.interval
    if not censored.any():
        return mean, variance, np.zeros_like(mean)
    censored_mean, censored_variance, censored_reduction = solved.moments(
        covariance[:, censored]
    )
    censored_variance = censored_variance.clip(MIN_VARIANCE)
    third = third_cumulants(
        observed, solved.precision, solved.shift, censored_mean, censored_variance
    )
    residual = block[censored] - product(censored_reduction.T, reduction)
    regression = residual / censored_variance[:, None]
    return mean, variance, skewness(third, regression, variance)


def third_cumulants(
    observed: Observed,
    precision: ndarray,
    shift: ndarray,
    mean: ndarray,
    variance: ndarray,
) -> ndarray:
    """Return the third cumulants of interval-censored cells.

    Args:
        observed: observations of N cells.
        precision: precision of all terms, shape [N].
        shift: precision times mean of all terms, shape [N].
        mean: posterior mean of the interval-censored cells.
        variance: posterior variance of the interval-censored cells, > 0.
    """
    censored = observed.interval
    terms = Terms(precision[censored], shift[censored])
    centre, cavity = terms.cavity(mean, variance)
    total = cavity + np.square(observed.std[censored])
    lower = observed.lower[censored]
    third = third_cumulant(centre, total, lower, observed.upper[censored])
    return third * (cavity / total) ** 3


def skewness(third: ndarray, regression: ndarray, variance: ndarray) -> ndarray:
    """Return the skewness of M cells.

    Args:
        third: third cumulants of the interval-censored cells.
        regression: regression coefficients of the M cells on the interval-censored
            cells, one row per interval-censored cell and M columns.
        variance: variance of the M cells, shape [M].
    """
    # Products and roots are far faster than powers.
    cumulant = product(third, regression * regression * regression)
    spread = variance.clip(MIN_VARIANCE)
    skew: ndarray = cumulant / (spread * np.sqrt(spread))
    return skew.clip(-_MAX_SKEW, _MAX_SKEW)


def _factor(covariance: ndarray, root: ndarray) -> Tensor:
    """Return the Cholesky factor of I + √T K √T."""
    inner = torch.from_numpy(root[:, None] * covariance * root)
    inner.diagonal().add_(1)
    return torch.linalg.cholesky(inner)


def _reduction(factor: Tensor, root: ndarray, covariance: ndarray) -> ndarray:
    """Return A = L⁻¹√T K, shape [N, M]; AᵀA is the reduction of the M cells' covariance."""
    scaled = torch.from_numpy(root[:, None] * covariance)
    return torch.linalg.solve_triangular(factor, scaled, upper=False).numpy()


def product(first: ndarray, second: ndarray) -> ndarray:
    """Return the product of two matrices or vectors."""
    return (torch.from_numpy(first) @ torch.from_numpy(second)).numpy()


class Terms(NamedTuple):
    """Gaussian terms of N cells: exp(shift · z − precision · z² / 2).

    `precision` and `shift` have the shape [N].
    """

    precision: ndarray
    shift: ndarray

    def moments(self, covariance: ndarray, centre: ndarray) -> tuple[ndarray, ndarray]:
        """Return posterior mean and variance of the cells, given their terms.

        Args:
            covariance: prior covariance of the cells, shape [N, N].
            centre: prior mean of the cells, shape [N].
        """
        root = np.sqrt(self.precision)
        factor = _factor(covariance, root)
        reduction = _reduction(factor, root, covariance)
        residual_cov = covariance - product(reduction.T, reduction)
        residual_shift = self.shift - self.precision * centre
        mean = centre + product(residual_cov, residual_shift)
        variance = residual_cov.diagonal().clip(MIN_VARIANCE)
        return mean, variance

    def cavity(self, mean: ndarray, variance: ndarray) -> tuple[ndarray, ndarray]:
        """Return cavity means and variances, from posterior means and variances.

        The cavity of a cell is its posterior without its own term.
        """
        precision = (1 / variance - self.precision).clip(MIN_VARIANCE)
        cavity = 1 / precision
        centre = cavity * (mean / variance - self.shift)
        return centre, cavity

    def updated(
        self,
        mean: ndarray,
        variance: ndarray,
        lower: ndarray,
        upper: ndarray,
        std: ndarray,
    ) -> "tuple[Terms, bool]":
        """Return the terms of `matched`, and whether they converged.

        Terms have converged if no new term changes the mean of its cell by more than
        `_TOLERANCE`.
        """
        new = self.matched(mean, variance, lower, upper, std)
        added = new.precision - self.precision
        moved = abs(new.shift - self.shift) + abs(added * mean)
        change = moved / (1 / variance + added.clip(0))
        return new, bool(change.max() <= _TOLERANCE)

    def matched(
        self,
        mean: ndarray,
        variance: ndarray,
        lower: ndarray,
        upper: ndarray,
        std: ndarray,
    ) -> "Terms":
        """Return damped terms that match the moments of each interval.

        The term of each cell is computed with the terms of all other cells fixed.

        Args:
            mean: posterior mean of the cells, shape [N].
            variance: posterior variance of the cells, > 0, shape [N].
            lower: lower bound of each interval, shape [N].
            upper: upper bound of each interval, shape [N].
            std: standard deviation of the noise of the scores, shape [N].
        """
        centre, cavity = self.cavity(mean, variance)
        total = cavity + np.square(std)
        noisy_mean, noisy_variance = interval_moments(centre, total, lower, upper)
        shrink = (1 - noisy_variance / total) / total
        remaining = (1 - cavity * shrink).clip(MIN_FRACTION)
        precision = shrink / remaining
        shift = centre * precision + (noisy_mean - centre) / total / remaining
        damped_precision = self.precision + _DAMPING * (precision - self.precision)
        damped_shift = self.shift + _DAMPING * (shift - self.shift)
        return Terms(damped_precision, damped_shift)
