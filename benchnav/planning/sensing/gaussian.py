"""A field of correlated standard normals, given what is known of some of its cells.

A cell's normal score is known as a number with noise, or to lie in an interval with noise, as where λ is 0 or 1.
Numbers are conditioned on exactly. Intervals have no closed form: expectation propagation finds for each a Gaussian
term whose product with the field has, cell by cell, the mean and variance that the interval gives (Minka 2001;
equations as in Rasmussen and Williams 2006, section 3.6, with all terms updated at once and damped).

All in float64. Letters in shapes: B fields, N observations (empty places have no weight), M cells, H×W map.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.copula import correlations

_DAMPING = 0.8
_ROUNDS = 40
_ENOUGH = 1e-3  # change of a mean and of a standard deviation, in normal scores
_LEAST_SHARE = 1e-9  # of the variance that an interval leaves


@dataclass(frozen=True, kw_only=True)
class Cells:
    """Cells of several maps, as many of each.

    Args:
        row: int64, shape [B, N].
        column: int64, shape [B, N].
    """

    row: Tensor
    column: Tensor


@dataclass(frozen=True)
class Field:
    """Correlations of the cells of a map, by their distances along both axes.

    Args:
        down: by rows, float64, shape [H].
        across: by columns, float64, shape [W].
    """

    down: Tensor
    across: Tensor

    @classmethod
    def of(cls, shape: tuple[int, int], correlation_cells: float, device: torch.device | str) -> "Field":
        """The field that `benchnav.core.copula.correlated_normal` draws."""
        down, across = (
            torch.from_numpy(correlations(size, correlation_cells)).to(device=device) for size in shape
        )
        return cls(down, across)

    def covariance(self, one: Cells, other: Cells) -> Tensor:
        """Correlations of N cells with M others, shape [B, N, M]."""
        down = self.down[(one.row[:, :, None] - other.row[:, None]).abs()]
        return down.mul_(self.across[(one.column[:, :, None] - other.column[:, None]).abs()])


@dataclass(frozen=True, kw_only=True)
class Observed:
    """What is known of some scores, and the Gaussian terms that stand for it.

    Args:
        lower: least score, −∞ where there is none, shape [B, N].
        upper: greatest score; where it is the least, the score itself.
        std: of the noise that was added to the score, shape [B, N].
        precision: of the Gaussian terms; 0 where none was found yet, and in empty places, shape [B, N].
        shift: precision times mean of the terms, shape [B, N].
        there: which places are not empty, bool, shape [B, N].
    """

    lower: Tensor
    upper: Tensor
    std: Tensor
    precision: Tensor
    shift: Tensor
    there: Tensor


@dataclass(frozen=True, kw_only=True)
class Posterior:
    """A field given Gaussian terms.

    Args:
        root: √precision of the terms, shape [B, N].
        factor: Cholesky factor of I + √T K √T, shape [B, N, N].
        weights: what multiplies covariances with the observed cells to give a mean, shape [B, N].
        precision: of the terms, shape [B, N].
        shift: of the terms, shape [B, N].
    """

    root: Tensor
    factor: Tensor
    weights: Tensor
    precision: Tensor
    shift: Tensor

    def moments(self, covariance: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of M cells of unit variance, from their covariances with the observed, [B, N, M]."""
        mean = torch.einsum("bn,bnm->bm", self.weights, covariance)
        reduced = torch.linalg.solve_triangular(self.factor, self.root[..., None] * covariance, upper=False)
        return mean, (1 - reduced.square().sum(1)).clamp(min=0)


def posterior(covariance: Tensor, precision: Tensor, shift: Tensor) -> Posterior:
    """Conditions a field on Gaussian terms.

    Args:
        covariance: K of the observed cells, shape [B, N, N].
        precision: of the terms, ≥ 0, shape [B, N].
        shift: precision times mean, shape [B, N].
    """
    root = precision.sqrt()
    inner = root[:, :, None] * covariance * root[:, None]
    inner.diagonal(dim1=1, dim2=2).add_(1)
    factor = torch.linalg.cholesky(inner)
    # (K⁻¹ + T)⁻¹ ν = K (ν − √T (I + √T K √T)⁻¹ √T K ν)
    pulled = root * (covariance @ shift[..., None])[..., 0]
    solved = torch.cholesky_solve(pulled[..., None], factor)[..., 0]
    return Posterior(
        root=root, factor=factor, weights=shift - root * solved, precision=precision, shift=shift
    )


def condition(covariance: Tensor, observed: Observed) -> Posterior:
    """Conditions a field on numbers exactly, and on intervals by expectation propagation.

    A field's terms do not depend on the others of the batch: each goes on until its own stand still.

    Args:
        covariance: K of the observed cells, shape [B, N, N].
        observed: what is known of them; the terms that it has are where intervals begin.
    """
    lower, upper, there = observed.lower, observed.upper, observed.there
    interval = there & (upper > lower)
    known = 1 / observed.std.square()
    number = there & ~interval
    precision = torch.where(number, known, torch.where(interval, observed.precision, 0.0))
    shift = torch.where(number, known * lower, torch.where(interval, observed.shift, 0.0))
    going = interval.any(1).nonzero()[:, 0]
    for _ in range(_ROUNDS):
        if len(going) == 0:
            break
        own = posterior(covariance[going], precision[going], shift[going])
        mean, variance = own.moments(covariance[going])
        new_precision, new_shift = _terms(
            mean, variance, precision[going], shift[going],
            lower[going], upper[going], observed.std[going],
        )  # fmt: skip
        held = interval[going]
        new_precision = torch.where(held, torch.lerp(own.precision, new_precision, _DAMPING), own.precision)
        new_shift = torch.where(held, torch.lerp(own.shift, new_shift, _DAMPING), own.shift)
        # By how much each term moves its own cell, were it alone to change.
        scale = 1 / (1 / variance.clamp(min=1e-12) + (new_precision - own.precision).clamp(min=0))
        moved = (
            scale * ((new_shift - own.shift).abs() + (new_precision - own.precision).abs() * mean.abs())
        ).amax(1)
        precision[going], shift[going] = new_precision, new_shift
        going = going[moved > _ENOUGH]
    return posterior(covariance, precision, shift)


def _terms(
    mean: Tensor,
    variance: Tensor,
    precision: Tensor,
    shift: Tensor,
    lower: Tensor,
    upper: Tensor,
    std: Tensor,
) -> tuple[Tensor, Tensor]:
    """Precision and shift of the terms that give each cell the moments of its interval, all else as it is."""
    variance = variance.clamp(min=1e-12)
    without = 1 / (1 / variance - precision).clamp(min=1e-12)
    centre = without * (mean / variance - shift)
    total = without + std.square()
    noisy_mean, noisy_variance = interval_moments(centre, total, lower, upper)
    pull = (noisy_mean - centre) / total
    shrink = (1 - noisy_variance / total) / total
    left = (1 - without * shrink).clamp(min=_LEAST_SHARE)
    new_precision = shrink / left
    return new_precision, centre * new_precision + pull / left


def interval_moments(mean: Tensor, variance: Tensor, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance of a normal number that lies in an interval, also far out in a tail.

    Args:
        mean: of the number, float64.
        variance: of the number, > 0.
        lower: −∞ for none.
        upper: above `lower`; ∞ for none.
    """
    std = variance.sqrt()
    low, high = (lower - mean) / std, (upper - mean) / std
    # On the side where Φ is small, so that nothing is lost to rounding.
    flipped = low + high > 0
    low, high = torch.where(flipped, -high, low), torch.where(flipped, -low, high)
    log_high = torch.special.log_ndtr(high)
    apart = (torch.special.log_ndtr(low) - log_high).clamp(max=-1e-300)
    log_mass = log_high + torch.log(-torch.expm1(apart))
    at_low, at_high = (torch.where(end.isinf(), 0.0, _density(end, log_mass)) for end in (low, high))
    shift = at_low - at_high
    slope = torch.where(low.isinf(), 0.0, low) * at_low - torch.where(high.isinf(), 0.0, high) * at_high
    share = (1 + slope - shift.square()).clamp(_LEAST_SHARE, 1)
    shift = torch.maximum(torch.minimum(shift, high), low)
    return mean + std * torch.where(flipped, -shift, shift), variance * share


def _density(at: Tensor, log_mass: Tensor) -> Tensor:
    return torch.exp(-0.5 * at.square() - 0.5 * math.log(2 * math.pi) - log_mass)
