"""A field of correlated standard normals, given what is known of some of its cells.

A cell's normal score is known as a number with noise, or to lie in an interval with
noise, as where λ is 0 or 1. Numbers are conditioned on exactly. Intervals have no
closed form: expectation propagation finds for each a Gaussian term whose product with
the field has, cell by cell, the mean and variance that the interval gives (Minka 2001;
equations as in Rasmussen and Williams 2006, section 3.6, with all terms updated at once
and damped).

One field at a time, in NumPy, whose calls cost least where there is little to do; all
in float64. PyTorch multiplies and solves, since what NumPy makes of that depends by
rounding on how many threads it has. Letters in shapes: B fields, N observations, M
cells, H×W map.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy import ndarray
from scipy.special import log_ndtr
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.copula import correlations

_DAMPING = 0.8
DAMPED_ROUNDS = 40
_ENOUGH = 1e-3  # change of a mean and of a standard deviation, in normal scores
_LEAST_SHARE = 1e-9  # of the variance that an interval leaves
LEAST_VARIANCE = 1e-12
_MOST_SKEW = 2.0  # that of an exponential, which a number far out in a tail is


@dataclass(frozen=True)
class Field(Batch):
    """Correlations of the cells of maps, by their distances along both axes.

    Args:
        length: ℓ in cells, float64, shape [B].
        down: correlations by rows, float64, shape [B, H].
        across: correlations by columns, float64, shape [B, W].
        nugget: share of a cell's variance that is its own and no neighbour's.
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
        """The fields that `benchnav.core.copula.correlated_normal` draws, with a nugget
        where there is one.

        Args:
            shape: (H, W).
            lengths: ℓ in cells of each field, B of them.
            device: where the correlations are.
            nugget: of all of them.
        """
        known = {
            length: [correlations(size, length) for size in shape] for length in lengths
        }
        down, across = (
            torch.from_numpy(np.stack([known[length][axis] for length in lengths])).to(
                device
            )
            for axis in (0, 1)
        )
        return cls(
            torch.tensor(lengths, dtype=torch.float64, device=device),
            down,
            across,
            nugget,
        )

    def write(self, own: int, field: "Field") -> None:
        """Writes the one field of another into this."""
        for name in ("length", "down", "across"):
            getattr(self, name)[own] = getattr(field, name)[0]

    def covariance(self, member: int | Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Correlations of cells so many rows and columns apart, of the shape to which
        all broadcast.

        Args:
            member: the field, or which one each is of, int64.
            rows: between both cells, of either sign, int64.
            columns: as many.
        """
        found = self.shared(member, rows, columns)
        if self.nugget:
            found = torch.where(
                (rows == 0) & (columns == 0), found + self.nugget, found
            )
        return found

    def shared(self, member: int | Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Return what of `covariance` is shared with neighbours: all but the nugget,
        also of a cell with itself.
        """
        return (
            (1 - self.nugget)
            * self.down[member, rows.abs()]
            * self.across[member, columns.abs()]
        )


@dataclass(frozen=True)
class Observed:
    """What is known of some scores, and the Gaussian terms that stand for it.

    Args:
        lower: least score, −∞ where there is none, shape [N].
        upper: greatest score; where it is the least, the score itself.
        std: of the noise that was added to the score, shape [N].
        precision: of the Gaussian terms; 0 where none was found yet, shape [N].
        shift: precision times mean of the terms, shape [N].
    """

    lower: ndarray
    upper: ndarray
    std: ndarray
    precision: ndarray
    shift: ndarray

    @property
    def interval(self) -> ndarray:
        """Which cells are known to lie in an interval, bool, shape [N]."""
        return self.upper > self.lower


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """A field given Gaussian terms.

    Args:
        root: √precision of the terms, shape [N].
        factor: Cholesky factor of I + √T K √T, shape [N, N].
        weights: what multiplies covariances with the observed cells to give a mean,
            shape [N].
        precision: of the terms, shape [N].
        shift: of the terms, shape [N].
    """

    root: ndarray
    factor: Tensor
    weights: ndarray
    precision: ndarray
    shift: ndarray

    def moments(self, covariance: ndarray) -> tuple[ndarray, ndarray, ndarray]:
        """Moments of M cells of unit variance, from their covariances with the
        observed, [N, M].

        Returns:
            Mean [M], variance [M], and what the terms take from the covariances of
            these cells, as a matrix [N, M] times its own transpose.
        """
        taken = _taken(self.factor, self.root, covariance)
        return (
            times(self.weights, covariance),
            (1 - np.square(taken).sum(0)).clip(0),
            taken,
        )


def posterior(covariance: ndarray, precision: ndarray, shift: ndarray) -> Posterior:
    """Conditions a field on Gaussian terms.

    Args:
        covariance: K of the observed cells, shape [N, N].
        precision: of the terms, ≥ 0, shape [N].
        shift: precision times mean, shape [N].
    """
    root = np.sqrt(precision)
    factor = _factor(covariance, root)
    # (K⁻¹ + T)⁻¹ ν = K (ν − √T (I + √T K √T)⁻¹ √T K ν)
    pulled = torch.from_numpy(root * times(covariance, shift))
    weights = shift - root * torch.cholesky_solve(pulled[:, None], factor)[:, 0].numpy()
    return Posterior(
        root=root, factor=factor, weights=weights, precision=precision, shift=shift
    )


def condition(covariance: ndarray, observed: Observed) -> Posterior:
    """Conditions a field on numbers exactly, and then on intervals by expectation
    propagation.

    Args:
        covariance: K of the observed cells, shape [N, N].
        observed: what is known of them; the terms that it has are where intervals
            begin.
    """
    held = observed.interval
    precision = np.where(held, 0.0, 1 / np.square(observed.std))
    shift = precision * np.where(held, 0.0, observed.lower)
    numbers = posterior(covariance, precision, shift)
    if not held.any():
        return numbers
    # The intervals alone, as a field of few cells that the numbers have given a mean.
    columns = covariance[:, held]
    centre, _, taken = numbers.moments(columns)
    left = columns[held] - times(taken.T, taken)
    terms = Terms(observed.precision[held], observed.shift[held])
    ends = observed.lower[held], observed.upper[held], observed.std[held]
    for _ in range(DAMPED_ROUNDS):
        mean, variance = terms.moments(left, centre)
        terms, settled = terms.step(mean, variance, *ends)
        if settled:
            break
    precision, shift = precision.copy(), shift.copy()
    precision[held], shift[held] = terms
    return posterior(covariance, precision, shift)


def evidence(covariance: ndarray, observed: Observed, found: Posterior) -> float:
    """Log likelihood of what is observed, up to what does not depend on the field.

    Numbers are exact. Intervals are by expectation propagation (Rasmussen and Williams
    2006, equation 3.65).

    Args:
        covariance: K of the observed cells, shape [N, N].
        observed: what is known of them.
        found: the field given that, from `condition`.
    """
    mean, variance, _ = found.moments(covariance)
    whole = (
        0.5 * (found.shift * mean).sum() - np.log(found.factor.diagonal().numpy()).sum()
    )
    held = observed.interval
    terms = Terms(found.precision[held], found.shift[held])
    centre, without = terms.left_out(mean[held], variance[held].clip(LEAST_VARIANCE))
    total = without + np.square(observed.std[held])
    mass = _standard(centre, total, observed.lower[held], observed.upper[held])[2]
    # What the Gaussian term has in the place of the interval.
    scaled = 1 + without * terms.precision
    joint = np.square(centre + without * terms.shift) / scaled
    term = (joint - np.square(centre)) / (2 * without) - 0.5 * np.log(scaled)
    return float(whole + (mass - term).sum())


def predict(
    found: Posterior, covariance: ndarray, observed: Observed, block: ndarray
) -> tuple[ndarray, ndarray, ndarray]:
    """Mean, variance and skewness of M cells, each of shape [M].

    An interval leaves its cell skew, and by the correlation that is left its
    neighbours: a cell's third cumulant is the sum of those of the intervals' cells
    times the cube of the cell's regression on each, which is right for a single
    interval and of first order for several (Opper, Paquet and Winther 2013,
    "Perturbative corrections for approximate inference in Gaussian latent variable
    models").

    Args:
        found: the field given what is observed, from `condition`.
        covariance: K of the observed cells, shape [N, N].
        observed: what is known of them.
        block: covariances of the observed cells with the M, shape [N, M].
    """
    mean, variance, taken = found.moments(block)
    held = observed.interval
    if not held.any():
        return mean, variance, np.zeros_like(mean)
    own_mean, own_variance, own = found.moments(covariance[:, held])
    own_variance = own_variance.clip(LEAST_VARIANCE)
    third = third_cumulants(
        observed, found.precision, found.shift, own_mean, own_variance
    )
    regression = (block[held] - times(own.T, taken)) / own_variance[:, None]
    return mean, variance, skewness(third, regression, variance)


def third_cumulants(
    observed: Observed,
    precision: ndarray,
    shift: ndarray,
    mean: ndarray,
    variance: ndarray,
) -> ndarray:
    """Return the third cumulants of the cells of intervals.

    Args:
        observed: what is known, of N cells.
        precision: of all terms, shape [N].
        shift: of all terms, shape [N].
        mean: of the cells of intervals.
        variance: of the cells of intervals, > 0.
    """
    held = observed.interval
    centre, without = Terms(precision[held], shift[held]).left_out(mean, variance)
    total = without + np.square(observed.std[held])
    third = _third_cumulant(centre, total, observed.lower[held], observed.upper[held])
    return third * (without / total) ** 3


def skewness(third: ndarray, regression: ndarray, variance: ndarray) -> ndarray:
    """Return the skewness of M cells, by third cumulants of intervals and the
    regression on these, [intervals, M].
    """
    # Products and roots, which are far quicker than powers.
    found = times(third, regression * regression * regression)
    spread = variance.clip(LEAST_VARIANCE)
    skew: ndarray = found / (spread * np.sqrt(spread))
    return skew.clip(-_MOST_SKEW, _MOST_SKEW)


def _factor(covariance: ndarray, root: ndarray) -> Tensor:
    """Cholesky factor of I + √T K √T."""
    inner = torch.from_numpy(root[:, None] * covariance * root)
    inner.diagonal().add_(1)
    return torch.linalg.cholesky(inner)


def _taken(factor: Tensor, root: ndarray, covariance: ndarray) -> ndarray:
    """Return A = L⁻¹√T K for M cells, shape [N, M]; AᵀA is the reduction in covariance."""
    scaled = torch.from_numpy(root[:, None] * covariance)
    return torch.linalg.solve_triangular(factor, scaled, upper=False).numpy()


def times(one: ndarray, other: ndarray) -> ndarray:
    """A product of matrices or vectors."""
    return (torch.from_numpy(one) @ torch.from_numpy(other)).numpy()


class Terms(NamedTuple):
    """Gaussian terms, one a cell: exp(shift · z − precision · z² / 2), each of shape
    [N].
    """

    precision: ndarray
    shift: ndarray

    def moments(self, covariance: ndarray, centre: ndarray) -> tuple[ndarray, ndarray]:
        """Mean and variance of the cells of a field of covariance [N, N] and mean [N],
        given the terms.
        """
        root = np.sqrt(self.precision)
        taken = _taken(_factor(covariance, root), root, covariance)
        left = covariance - times(taken.T, taken)
        mean = centre + times(left, self.shift - self.precision * centre)
        return mean, left.diagonal().clip(LEAST_VARIANCE)

    def left_out(self, mean: ndarray, variance: ndarray) -> tuple[ndarray, ndarray]:
        """Return cavity means and variances."""
        without = 1 / (1 / variance - self.precision).clip(LEAST_VARIANCE)
        return without * (mean / variance - self.shift), without

    def step(
        self,
        mean: ndarray,
        variance: ndarray,
        lower: ndarray,
        upper: ndarray,
        std: ndarray,
    ) -> "tuple[Terms, bool]":
        """Return the terms of `towards`, and whether none moves its own cell by more
        than `_ENOUGH`.
        """
        new = self.towards(mean, variance, lower, upper, std)
        more = new.precision - self.precision
        moved = abs(new.shift - self.shift) + abs(more * mean)
        return new, bool((moved / (1 / variance + more.clip(0))).max() <= _ENOUGH)

    def towards(
        self,
        mean: ndarray,
        variance: ndarray,
        lower: ndarray,
        upper: ndarray,
        std: ndarray,
    ) -> "Terms":
        """Terms that give each cell more nearly the moments of its interval, all else
        as it is.
        """
        centre, without = self.left_out(mean, variance)
        total = without + np.square(std)
        noisy_mean, noisy_variance = interval_moments(centre, total, lower, upper)
        shrink = (1 - noisy_variance / total) / total
        left = (1 - without * shrink).clip(_LEAST_SHARE)
        precision = shrink / left
        shift = centre * precision + (noisy_mean - centre) / total / left
        return Terms(
            self.precision + _DAMPING * (precision - self.precision),
            self.shift + _DAMPING * (shift - self.shift),
        )


@np.errstate(over="ignore")
def interval_moments(
    mean: ndarray, variance: ndarray, lower: ndarray, upper: ndarray
) -> tuple[ndarray, ndarray]:
    """Mean and variance of normal numbers that lie in intervals, also far out in a
    tail.

    Args:
        mean: of the number, float64.
        variance: of the number, > 0.
        lower: −∞ for none.
        upper: above `lower`; ∞ for none.
    """
    low, high, log_mass, flipped = _standard(mean, variance, lower, upper)
    at_low, at_high = _density(low, log_mass), _density(high, log_mass)
    shift = at_low - at_high
    share = (
        1 + _finite(low) * at_low - _finite(high) * at_high - np.square(shift)
    ).clip(_LEAST_SHARE, 1)
    shift = shift.clip(low, high)
    return mean + np.sqrt(variance) * np.where(flipped, -shift, shift), variance * share


@np.errstate(over="ignore", invalid="ignore")
def _third_cumulant(
    mean: ndarray, variance: ndarray, lower: ndarray, upper: ndarray
) -> ndarray:
    """Third cumulant of normal numbers that lie in intervals."""
    low, high, log_mass, flipped = _standard(mean, variance, lower, upper)
    at_low, at_high = _density(low, log_mass), _density(high, log_mass)
    low, high = _finite(low), _finite(high)
    first = at_low - at_high
    second = 1 + low * at_low - high * at_high
    third = (low**2 + 2) * at_low - (high**2 + 2) * at_high
    # Far out in a tail, where rounding leaves nothing of it, the number is exponential.
    most = 2 * (second - first**2).clip(0) ** 1.5
    found = (third - 3 * first * second + 2 * first**3).clip(-most, most)
    return variance**1.5 * np.where(flipped, -found, found)


def _standard(
    mean: ndarray, variance: ndarray, lower: ndarray, upper: ndarray
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """An interval in standard deviations, the log of its probability, and whether it
    was flipped to low numbers.
    """
    std = np.sqrt(variance)
    low, high = (lower - mean) / std, (upper - mean) / std
    # On the side where Φ is small, so that nothing is lost to rounding.
    flipped = low > -high
    low, high = np.where(flipped, -high, low), np.where(flipped, -low, high)
    log_high = log_ndtr(high)
    apart = (log_ndtr(low) - log_high).clip(max=-1e-300)
    return low, high, log_high + np.log(-np.expm1(apart)), flipped


def _finite(ends: ndarray) -> ndarray:
    """Ends of intervals, 0 where there is none."""
    return np.where(np.isinf(ends), 0.0, ends)


def _density(at: ndarray, log_mass: ndarray) -> ndarray:
    return np.exp(-0.5 * np.square(at) - 0.5 * math.log(2 * math.pi) - log_mass)
