"""A distribution that is conditioned on a posterior of its normal score.

A λ field is a transform of correlated standard normals z, λ = Q(Φ(z)). If the posterior
of z is N(μ, σ²), λ has the quantile function Q(Φ(μ + σ Φ⁻¹(u))) and the CDF
Φ((Φ⁻¹(F(x)) − μ) / σ). The posterior may be skewed, as it is near interval-censored
observations. Then σ multiplies a shifted log-normal variable of the same skewness
instead of a normal variable.
Letters in shapes: H×W cells; *B any leading dimensions.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.distribution import MAX_SCORE, TraversabilityDistribution
from benchnav.core.errors import ConfigError
from benchnav.core.mixture import TraversabilityMixture

_MIN_STD = 1e-9
MIN_SKEW = 1e-3  # a variable of smaller absolute skewness counts as normal


@dataclass(frozen=True)
class ConditionedDistribution(TraversabilityDistribution):
    """A distribution given a posterior of its normal score in each cell.

    Args:
        base: prior distribution of shape [*B, H, W].
        score_mean: posterior mean μ, shape [*B, H, W].
        score_std: posterior standard deviation σ ≥ 0, shape [*B, H, W]; if it is 0, λ
            is Q(Φ(μ)).
        score_skew: posterior skewness, shape [*B, H, W]; if None, the skewness is 0.

    Raises:
        ConfigError: If the shapes differ.
    """

    base: TraversabilityDistribution
    score_mean: Tensor
    score_std: Tensor
    score_skew: Tensor | None = None

    def __post_init__(self) -> None:
        """Validate the shapes."""
        skew = self.score_std if self.score_skew is None else self.score_skew
        shapes = (self.score_std.shape, skew.shape, self.base.shape)
        if any(shape != self.score_mean.shape for shape in shapes):
            raise ConfigError(
                "Expected `score_mean` and `score_std` of the shape of `base` "
                f"({list(self.base.shape)}), got "
                f"{list(self.score_mean.shape)} and {list(self.score_std.shape)}."
            )

    @property
    def shape(self) -> torch.Size:
        """Shape of the maps, [*B, H, W]."""
        return self.base.shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """Return P(λ ≤ value), shape [*B, H, W]."""
        _, upper = self._scores(value)
        return torch.special.ndtr(upper).to(self.dtype)

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return P(λ < value) and P(λ ≤ value), each of shape [*B, H, W]."""
        lower, upper = self._scores(value)
        below = torch.special.ndtr(lower)
        at_most = torch.special.ndtr(upper)
        return below.to(self.dtype), at_most.to(self.dtype)

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Return the quantiles of λ, shape [*B, H, W]."""
        u = torch.as_tensor(probability, dtype=torch.float64, device=self.device)
        score = torch.special.ndtri(u).clamp(-MAX_SCORE, MAX_SCORE)
        value = self.from_normal(score.expand(self.shape))
        if not isinstance(probability, Tensor) and 0 < probability < 1:
            return value
        # At probability 0 or 1, λ is at an end of its range, for which no score is
        # finite.
        end_level = (u >= 1).double().expand(self.shape)
        ends = self.base.quantile(end_level).to(self.dtype)
        is_extreme = (u <= 0) | (u >= 1)
        is_end = is_extreme & (self.score_std > 0)
        return torch.where(is_end, ends, value)

    def from_normal(self, normal: Tensor) -> Tensor:
        """Return λ of standard normal scores, shape [*B, H, W]."""
        if self.score_skew is not None:
            normal = skewed(normal, self.score_skew).to(self.score_std.dtype)
        prior_score = self.score_mean + self.score_std * normal
        return self.base.from_normal(prior_score).to(self.dtype)

    def to_normal(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return the interval of standard normal scores, each of shape [*B, H, W]."""
        lower, upper = self._scores(value)
        return lower.to(self.dtype), upper.to(self.dtype)

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log density on (0, 1) and log mass at 0 and 1, shape [*B, H, W].

        It is NaN where `base` has no density.
        """
        value = value.double()
        std = self.score_std.double().clamp(min=_MIN_STD)
        lower, upper = self._scores(value)
        base = self.base._in_float64()
        prior = base.to_normal(value)[1]
        # The density of λ follows from the density under `base`, if the prior's score
        # is replaced by the posterior's score.
        log_ratio = (prior.square() - upper.square()) / 2
        inside = base.log_prob(value).double() + log_ratio - std.log()
        if self.score_skew is not None:
            log_slope = _slope(upper, self.score_skew).log()
            inside = torch.where(upper.isinf(), -math.inf, inside - log_slope)
        tail = torch.where(value <= 0, upper, -lower)
        is_end = (value <= 0) | (value >= 1)
        log_mass = torch.special.log_ndtr(tail)
        total = torch.where(is_end, log_mass, inside)
        is_outside = (value < 0) | (value > 1)
        return torch.where(is_outside, -math.inf, total).to(self.dtype)

    def _scores(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return Φ⁻¹ of P(λ < value) and of P(λ ≤ value), float64."""
        lower, upper = self.base._in_float64().to_normal(value)
        mean = self.score_mean.double()
        std = self.score_std.double().clamp(min=_MIN_STD)
        lower = (lower - mean) / std
        upper = (upper - mean) / std
        if self.score_skew is None:
            return lower, upper
        return unskewed(lower, self.score_skew), unskewed(upper, self.score_skew)


def skewed(normal: Tensor, skew: Tensor) -> Tensor:
    """Transform a standard normal variable to a shifted log-normal one.

    Args:
        normal: values of any shape.
        skew: skewness of the result; its shape broadcasts to the shape of `normal`.

    Returns:
        Values of mean 0 and variance 1, float64.
    """
    sign, mean, std, sigma = _log_normal(skew)
    log_normal = (sign * sigma * normal).exp()
    transformed = sign * (log_normal - mean) / std
    return torch.where(skew.abs() < MIN_SKEW, normal.double(), transformed)


def unskewed(value: Tensor, skew: Tensor) -> Tensor:
    """Return the inverse of `skewed`; infinite for values outside its range."""
    sign, mean, std, sigma = _log_normal(skew)
    log_normal = (mean + sign * value * std).clamp(min=0)
    normal = sign * log_normal.log() / sigma
    return torch.where(skew.abs() < MIN_SKEW, value, normal)


def _slope(normal: Tensor, skew: Tensor) -> Tensor:
    """Return the derivative of `skewed` with respect to `normal`."""
    sign, _, std, sigma = _log_normal(skew)
    log_normal = (sign * sigma * normal).exp()
    slope = sigma * log_normal / std
    return torch.where(skew.abs() < MIN_SKEW, 1.0, slope)


def _log_normal(skew: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the sign of a skewness, and mean, standard deviation and σ of exp(σ z).

    The skewness of exp(σ z) is the absolute value of `skew`.
    """
    abs_skew = skew.double().abs().clamp(min=MIN_SKEW)
    # Solve skew² = (w + 2)² (w − 1) for w = exp(σ²).
    a = 1 + abs_skew.square() / 2
    root = (a + (a.square() - 1).sqrt()).pow(1 / 3)
    w = root + 1 / root - 1
    sign = torch.where(skew < 0, -1.0, 1.0).double()
    mean = w.sqrt()
    std = (w * (w - 1)).sqrt()
    sigma = w.log().sqrt()
    return sign, mean, std, sigma


def conditioned(
    base: TraversabilityDistribution, mean: Tensor, std: Tensor
) -> TraversabilityDistribution:
    """Condition a distribution of λ on a posterior of its normal score.

    Args:
        base: prior distribution of shape [*B, H, W].
        mean: posterior mean μ of the score, shape [*B, H, W].
        std: posterior standard deviation σ ≥ 0 of the score, shape [*B, H, W].

    Returns:
        The exact mixture clip(m + s (μ + σ z)) if `base` is a mixture of a single
        component N(m, s²), else a `ConditionedDistribution`.
    """
    if not isinstance(base, TraversabilityMixture) or base.weights.shape[-3] > 1:
        return ConditionedDistribution(base, mean, std)
    means = base.means + base.stds * mean.unsqueeze(-3)
    stds = base.stds * std.unsqueeze(-3)
    return TraversabilityMixture(base.weights, means, stds, base.group)
