"""A field of correlated standard normals, given what is known of some of its cells.

A cell's normal score is known as a number with noise, or to lie in an interval with noise, as where λ is 0 or 1.
Numbers are conditioned on exactly. Intervals have no closed form: expectation propagation finds for each a Gaussian
term whose product with the field has, cell by cell, the mean and variance that the interval gives (Minka 2001;
equations as in Rasmussen and Williams 2006, section 3.6, with all terms updated at once and damped).

All in float64. Letters in shapes: B fields, N observations (empty places have no weight), M cells, H×W map.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from benchnav.core.batch import Batch
from benchnav.core.copula import correlations

_DAMPING = 0.8
_ROUNDS = 40
_ENOUGH = 1e-3  # change of a mean and of a standard deviation, in normal scores
_LEAST_SHARE = 1e-9  # of the variance that an interval leaves
_LEAST_VARIANCE = 1e-12
_MOST_SKEW = 2.0  # that of an exponential, which a number far out in a tail is


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
        """The fields that `benchnav.core.copula.correlated_normal` draws, with a nugget where there is one.

        Args:
            shape: (H, W).
            lengths: ℓ in cells of each field, B of them.
            device: where the correlations are.
            nugget: of all of them.
        """
        known = {length: [correlations(size, length) for size in shape] for length in lengths}
        down, across = (
            torch.from_numpy(np.stack([known[length][axis] for length in lengths])).to(device)
            for axis in (0, 1)
        )
        return cls(torch.tensor(lengths, dtype=torch.float64, device=device), down, across, nugget)

    def write(self, own: int, field: "Field") -> None:
        """Writes the one field of another into this."""
        for name in ("length", "down", "across"):
            getattr(self, name)[own] = getattr(field, name)[0]

    def covariance(self, one: Cells, other: Cells) -> Tensor:
        """Correlations of N cells with M others, shape [B, N, M]."""
        found = _at(self.down, one.row, other.row) * _at(self.across, one.column, other.column)
        if not self.nugget:
            return found
        alike = one.row[:, :, None] == other.row[:, None]
        return self._shared(found, alike & (one.column[:, :, None] == other.column[:, None]))

    def with_block(self, cells: Cells, rows: Tensor, columns: Tensor) -> Tensor:
        """Correlations of N cells with those of a block, shape [B, N, R·C].

        Args:
            cells: N of each map.
            rows: of the block, int64, shape [B, R].
            columns: of the block, int64, shape [B, C].
        """
        down, across = _at(self.down, cells.row, rows), _at(self.across, cells.column, columns)
        found = down[..., None] * across[:, :, None]
        if self.nugget:
            alike = cells.row[:, :, None] == rows[:, None]
            alike = alike[..., None] & (cells.column[:, :, None] == columns[:, None])[:, :, None]
            found = self._shared(found, alike)
        return found.flatten(2)

    def _shared(self, found: Tensor, same_cell: Tensor) -> Tensor:
        """Correlations of which a share is of the cell alone."""
        return torch.where(same_cell, found, (1 - self.nugget) * found)


def _at(correlations: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """Correlations [B, S] at the distances of N lines from M others, shape [B, N, M]."""
    away = (one[:, :, None] - other[:, None]).abs()
    return correlations.expand(len(away), -1).gather(1, away.flatten(1)).view_as(away)


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

    @property
    def interval(self) -> Tensor:
        """Which cells are known to lie in an interval, bool, shape [B, N]."""
        return self.there & (self.upper > self.lower)

    @property
    def most(self) -> int:
        """The greatest number of intervals of a field."""
        return int(self.interval.sum(1).max())


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
        return mean, (1 - self.reduced(covariance).square().sum(1)).clamp(min=0)

    def reduced(self, covariance: Tensor) -> Tensor:
        """What the terms take from the covariances of M cells, as a matrix [B, N, M] times its own transpose."""
        return torch.linalg.solve_triangular(self.factor, self.root[..., None] * covariance, upper=False)


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
    """Conditions a field on numbers exactly, and then on intervals by expectation propagation.

    A field's terms do not depend on the others of the batch: each goes on until its own stand still.

    Args:
        covariance: K of the observed cells, shape [B, N, N].
        observed: what is known of them; the terms that it has are where intervals begin.
    """
    interval, most = observed.interval, observed.most
    known = torch.where(observed.there & ~interval, 1 / observed.std.square(), 0.0)
    numbers = posterior(covariance, known, known * torch.where(interval, 0.0, observed.lower))
    if most == 0:
        return numbers
    # The intervals alone, as a field of few cells that the numbers have given a mean.
    place = _first(interval, most)
    held, lower, upper, std, precision, shift = (
        values.gather(1, place)
        for values in (
            interval, observed.lower, observed.upper, observed.std, observed.precision, observed.shift,
        )
    )  # fmt: skip
    precision, shift = torch.where(held, precision, 0.0), torch.where(held, shift, 0.0)
    columns = covariance.gather(2, place[:, None].expand(-1, covariance.shape[1], -1))
    reduced = numbers.reduced(columns)
    centre = torch.einsum("bn,bnm->bm", numbers.weights, columns)
    left = columns.gather(1, place[..., None].expand(-1, -1, most)) - reduced.mT @ reduced
    going = held.any(1).nonzero()[:, 0]
    for _ in range(_ROUNDS):
        if len(going) == 0:
            break
        own = _Terms(precision[going], shift[going])
        mean, variance = own.moments(left[going], centre[going])
        new = own.towards(mean, variance, lower[going], upper[going], std[going])
        new = _Terms(*(torch.where(held[going], *both) for both in zip(new, own, strict=True)))
        # By how much each term moves its own cell, were it alone to change.
        scale = 1 / (1 / variance + (new.precision - own.precision).clamp(min=0))
        moved = (new.shift - own.shift).abs() + (new.precision - own.precision).abs() * mean.abs()
        precision[going], shift[going] = new
        going = going[(scale * moved).amax(1) > _ENOUGH]
    found = [
        values.scatter(1, place, torch.where(held, own, values.gather(1, place)))
        for values, own in ((numbers.precision, precision), (numbers.shift, shift))
    ]
    return posterior(covariance, *found)


def evidence(covariance: Tensor, observed: Observed, found: Posterior) -> Tensor:
    """Log likelihood of what is observed, up to what does not depend on the field, shape [B].

    Numbers are exact. Intervals are by expectation propagation (Rasmussen and Williams 2006, equation 3.65).

    Args:
        covariance: K of the observed cells, shape [B, N, N].
        observed: what is known of them.
        found: the field given that, from `condition`.
    """
    mean, variance = found.moments(covariance)
    terms = _Terms(found.precision, found.shift)
    whole = 0.5 * (found.shift * mean).sum(1) - found.factor.diagonal(dim1=1, dim2=2).log().sum(1)
    centre, without = terms.left_out(mean, variance.clamp(min=_LEAST_VARIANCE))
    ends = (
        torch.where(observed.interval, end, side)
        for end, side in ((observed.lower, -1.0), (observed.upper, 1.0))
    )
    mass = _standard(centre, without + observed.std.square(), *ends)[2]
    # What the Gaussian term has in the place of the interval.
    joint = (centre + without * terms.shift).square() / (1 + without * terms.precision)
    term = (joint - centre.square()) / (2 * without) - 0.5 * torch.log1p(without * terms.precision)
    return whole + torch.where(observed.interval, mass - term, 0.0).sum(1)


def predict(
    found: Posterior, covariance: Tensor, observed: Observed, block: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean, variance and skewness of M cells, each of shape [B, M].

    An interval leaves its cell skew, and by the correlation that is left its neighbours: a cell's third cumulant is the
    sum of those of the intervals' cells times the cube of the cell's regression on each, which is right for a single
    interval and of first order for several (Opper, Paquet and Winther 2013, "Perturbative corrections for approximate
    inference in Gaussian latent variable models").

    Args:
        found: the field given what is observed, from `condition`.
        covariance: K of the observed cells, shape [B, N, N].
        observed: what is known of them.
        block: covariances of the observed cells with the M, shape [B, N, M].
    """
    taken = found.reduced(block)
    mean = torch.einsum("bn,bnm->bm", found.weights, block)
    variance = (1 - taken.square().sum(1)).clamp(min=0)
    most = observed.most
    if most == 0:
        return mean, variance, torch.zeros_like(mean)
    place = _first(observed.interval, most)
    held, lower, upper, std, precision, shift = (
        values.gather(1, place)
        for values in (
            observed.interval, observed.lower, observed.upper, observed.std, found.precision, found.shift,
        )
    )  # fmt: skip
    columns = covariance.gather(2, place[:, None].expand(-1, covariance.shape[1], -1))
    own = found.reduced(columns)
    own_mean = torch.einsum("bn,bnm->bm", found.weights, columns)
    own_variance = (1 - own.square().sum(1)).clamp(min=_LEAST_VARIANCE)
    centre, without = _Terms(precision, shift).left_out(own_mean, own_variance)
    ends = torch.where(held, lower, -1.0), torch.where(held, upper, 1.0)
    total = without + std.square()
    third = _third_cumulant(centre, total, *ends) * (without / total).pow(3)
    shared = block.gather(1, place[..., None].expand(-1, -1, block.shape[2])) - own.mT @ taken
    regression = shared / own_variance[..., None]
    found_third = torch.einsum("bn,bnm->bm", torch.where(held, third, 0.0), regression.pow(3))
    skew = found_third / variance.clamp(min=_LEAST_VARIANCE).pow(1.5)
    return mean, variance, skew.clamp(-_MOST_SKEW, _MOST_SKEW)


def _first(which: Tensor, most: int) -> Tensor:
    """Places of those of each row that are meant, then of others, shape [B, most]."""
    return (~which).int().argsort(dim=1, stable=True)[:, :most]


class _Terms(NamedTuple):
    """Gaussian terms, one a cell: exp(shift · z − precision · z² / 2), each of shape [B, N]."""

    precision: Tensor
    shift: Tensor

    def moments(self, covariance: Tensor, centre: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the cells of a field of covariance [B, N, N] and mean [B, N], given the terms."""
        found = posterior(covariance, self.precision, self.shift - self.precision * centre)
        mean = torch.einsum("bn,bnm->bm", found.weights, covariance)
        taken = found.reduced(covariance).square().sum(1)
        return centre + mean, (covariance.diagonal(dim1=1, dim2=2) - taken).clamp(min=_LEAST_VARIANCE)

    def left_out(self, mean: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of each cell without its own term."""
        without = 1 / (1 / variance - self.precision).clamp(min=_LEAST_VARIANCE)
        return without * (mean / variance - self.shift), without

    def towards(self, mean: Tensor, variance: Tensor, lower: Tensor, upper: Tensor, std: Tensor) -> "_Terms":
        """Terms that give each cell more nearly the moments of its interval, all else as it is."""
        centre, without = self.left_out(mean, variance)
        total = without + std.square()
        noisy_mean, noisy_variance = interval_moments(centre, total, lower, upper)
        pull = (noisy_mean - centre) / total
        shrink = (1 - noisy_variance / total) / total
        left = (1 - without * shrink).clamp(min=_LEAST_SHARE)
        precision = shrink / left
        found = precision, centre * precision + pull / left
        return _Terms(*(torch.lerp(*both, _DAMPING) for both in zip(self, found, strict=True)))


def interval_moments(mean: Tensor, variance: Tensor, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance of a normal number that lies in an interval, also far out in a tail.

    Args:
        mean: of the number, float64.
        variance: of the number, > 0.
        lower: −∞ for none.
        upper: above `lower`; ∞ for none.
    """
    low, high, log_mass, flipped = _standard(mean, variance, lower, upper)
    at_low, at_high = (torch.where(end.isinf(), 0.0, _density(end, log_mass)) for end in (low, high))
    shift = at_low - at_high
    slope = torch.where(low.isinf(), 0.0, low) * at_low - torch.where(high.isinf(), 0.0, high) * at_high
    share = (1 + slope - shift.square()).clamp(_LEAST_SHARE, 1)
    shift = torch.maximum(torch.minimum(shift, high), low)
    return mean + variance.sqrt() * torch.where(flipped, -shift, shift), variance * share


def _third_cumulant(mean: Tensor, variance: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Third cumulant of a normal number that lies in an interval."""
    low, high, log_mass, flipped = _standard(mean, variance, lower, upper)
    at_low, at_high = (torch.where(end.isinf(), 0.0, _density(end, log_mass)) for end in (low, high))
    low, high = (torch.where(end.isinf(), 0.0, end) for end in (low, high))
    first = at_low - at_high
    second = 1 + low * at_low - high * at_high
    third = (low.square() + 2) * at_low - (high.square() + 2) * at_high
    # Far out in a tail, where rounding leaves nothing of it, the number is exponential.
    most = 2 * (second - first.square()).clamp(min=0).pow(1.5)
    found = torch.clamp(third - 3 * first * second + 2 * first.pow(3), -most, most)
    return variance.pow(1.5) * torch.where(flipped, -found, found)


def _standard(
    mean: Tensor, variance: Tensor, lower: Tensor, upper: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """An interval in standard deviations, the log of its probability, and whether it was flipped to low numbers."""
    std = variance.sqrt()
    low, high = (lower - mean) / std, (upper - mean) / std
    # On the side where Φ is small, so that nothing is lost to rounding.
    flipped = low + high > 0
    low, high = torch.where(flipped, -high, low), torch.where(flipped, -low, high)
    log_high = torch.special.log_ndtr(high)
    apart = (torch.special.log_ndtr(low) - log_high).clamp(max=-1e-300)
    return low, high, log_high + torch.log(-torch.expm1(apart)), flipped


def _density(at: Tensor, log_mass: Tensor) -> Tensor:
    return torch.exp(-0.5 * at.square() - 0.5 * math.log(2 * math.pi) - log_mass)
