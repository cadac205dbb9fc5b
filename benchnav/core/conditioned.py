"""A distribution whose normal score is known better than before: what observations
nearby tell of a cell.

A field of λ goes through correlated standard normals, λ = Q(Φ(z)). Where observations
give z a posterior N(μ, σ²), λ has the quantile function Q(Φ(μ + σ Φ⁻¹(u))) and the CDF
Φ((Φ⁻¹(F(x)) − μ) / σ). Where the posterior is skew, as beside ground whose score is
known to lie in an interval, σ multiplies a shifted log-normal number of that skewness
in place of the normal one.
Letters in shapes: H×W cells, *B any leading dimensions.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.distribution import MOST_SCORE, TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture

_SMALLEST_STD = 1e-9
LEAST_SKEW = 1e-3  # under which a number counts as normal


@dataclass(frozen=True)
class ConditionedDistribution(TraversabilityDistribution):
    """A distribution given a posterior of its normal score in each cell.

    Args:
        base: what is known without the observations, of shape [*B, H, W].
        score_mean: μ, shape [*B, H, W].
        score_std: σ ≥ 0, shape [*B, H, W]; where it is 0, all of λ is Q(Φ(μ)).
        score_skew: skewness of the score, shape [*B, H, W]; None for none.

    Raises:
        ConfigError: the shapes differ.
    """

    base: TraversabilityDistribution
    score_mean: Tensor
    score_std: Tensor
    score_skew: Tensor | None = None

    def __post_init__(self) -> None:
        """Checks the shapes."""
        skew = self.score_std if self.score_skew is None else self.score_skew
        if (
            not self.score_mean.shape
            == self.score_std.shape
            == skew.shape
            == self.base.shape
        ):
            raise ConfigError(
                "Expected `score_mean` and `score_std` of the base's shape "
                f"{list(self.base.shape)}, got "
                f"{list(self.score_mean.shape)} and {list(self.score_std.shape)}."
            )

    @property
    def shape(self) -> torch.Size:
        """[*B, H, W]."""
        return self.base.shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """P(λ ≤ value), shape [*B, H, W]; see the base."""
        return torch.special.ndtr(self._scores(value)[1]).to(self.dtype)

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """P(λ < value) and P(λ ≤ value), each of shape [*B, H, W]; see the base."""
        lower, upper = self._scores(value)
        return torch.special.ndtr(lower).to(self.dtype), torch.special.ndtr(upper).to(
            self.dtype
        )

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Least λ that is not exceeded with this probability, shape [*B, H, W]; see the
        base.
        """
        share = torch.as_tensor(probability, dtype=torch.float64, device=self.device)
        score = torch.special.ndtri(share).clamp(-MOST_SCORE, MOST_SCORE)
        value = self.from_normal(score.expand(self.shape))
        if not isinstance(probability, Tensor) and 0 < probability < 1:
            return value
        # The ends of the range, which no finite score reaches.
        ends = self.base.quantile((share >= 1).double().expand(self.shape)).to(
            self.dtype
        )
        return torch.where(
            ((share <= 0) | (share >= 1)) & (self.score_std > 0), ends, value
        )

    def from_normal(self, normal: Tensor) -> Tensor:
        """λ of the rank that a standard normal number has, shape [*B, H, W]; see the
        base.
        """
        if self.score_skew is not None:
            normal = skewed(normal, self.score_skew).to(self.score_std.dtype)
        return self.base.from_normal(self.score_mean + self.score_std * normal).to(
            self.dtype
        )

    def to_normal(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """The interval of standard normal numbers that `from_normal` takes to λ, each
        of shape [*B, H, W].
        """
        lower, upper = self._scores(value)
        return lower.to(self.dtype), upper.to(self.dtype)

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density on (0, 1), log mass at 0 and at 1, shape [*B, H, W]; not a number
        where the base has none.
        """
        value, std = value.double(), self.score_std.double().clamp(min=_SMALLEST_STD)
        lower, upper = self._scores(value)
        prior = self.base._exact().to_normal(value)[1]  # whose density is known
        inside = (
            self.base._exact().log_prob(value).double()
            + (prior.square() - upper.square()) / 2
            - std.log()
        )
        if self.score_skew is not None:
            inside = torch.where(
                upper.isinf(), -math.inf, inside - _slope(upper, self.score_skew).log()
            )
        mass = torch.where(value <= 0, upper, -lower)
        total = torch.where(
            (value <= 0) | (value >= 1), torch.special.log_ndtr(mass), inside
        )
        return torch.where((value < 0) | (value > 1), -math.inf, total).to(self.dtype)

    def _scores(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Standard normal numbers in float64, whose Φ are P(λ < value) and P(λ ≤
        value).
        """
        lower, upper = self.base._exact().to_normal(value)
        mean, std = (
            self.score_mean.double(),
            self.score_std.double().clamp(min=_SMALLEST_STD),
        )
        ends = (lower - mean) / std, (upper - mean) / std
        if self.score_skew is None:
            return ends
        return unskewed(ends[0], self.score_skew), unskewed(ends[1], self.score_skew)


def skewed(normal: Tensor, skew: Tensor) -> Tensor:
    """Makes of a standard normal number one of mean 0 and variance 1 that is skew, a
    shifted log-normal one, float64.

    Args:
        normal: any shape.
        skew: its skewness, of a shape that broadcasts.
    """
    sign, root, scale, width = _log_normal(skew)
    found = sign * ((sign * width * normal).exp() - root) / scale
    return torch.where(skew.abs() < LEAST_SKEW, normal.double(), found)


def unskewed(value: Tensor, skew: Tensor) -> Tensor:
    """The number that `skewed` makes a value of; infinite beyond its range."""
    sign, root, scale, width = _log_normal(skew)
    found = sign * (root + sign * value * scale).clamp(min=0).log() / width
    return torch.where(skew.abs() < LEAST_SKEW, value, found)


def _slope(normal: Tensor, skew: Tensor) -> Tensor:
    """Derivative of `skewed`."""
    sign, _, scale, width = _log_normal(skew)
    return torch.where(
        skew.abs() < LEAST_SKEW, 1.0, width * (sign * width * normal).exp() / scale
    )


def _log_normal(skew: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of exp(σ z) for the σ that gives it a skewness: the sign, the mean, the standard
    deviation, and σ.
    """
    size = skew.double().abs().clamp(min=LEAST_SKEW)
    half = 1 + size.square() / 2
    third = (half + (half.square() - 1).sqrt()).pow(1 / 3)
    power = third + 1 / third - 1  # exp(σ²)
    return (
        torch.where(skew < 0, -1.0, 1.0).double(),
        power.sqrt(),
        (power * (power - 1)).sqrt(),
        power.log().sqrt(),
    )


def conditioned(
    base: TraversabilityDistribution, mean: Tensor, std: Tensor
) -> TraversabilityDistribution:
    """The distribution of λ where its normal score has a posterior.

    Args:
        base: what is known without the observations, of shape [*B, H, W].
        mean: μ of the score, shape [*B, H, W].
        std: σ ≥ 0 of the score, shape [*B, H, W].

    Returns:
        A mixture again, exactly, where the base is one of a single component: clip(m +
        s (μ + σ z)); else a `ConditionedDistribution`.
    """
    if not isinstance(base, TraversabilityMixture) or base.weights.shape[-3] > 1:
        return ConditionedDistribution(base, mean, std)
    means = base.means + base.stds * mean.unsqueeze(-3)
    return TraversabilityMixture(
        base.weights, means, base.stds * std.unsqueeze(-3), base.group
    )
