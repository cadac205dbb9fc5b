"""The average of the CDFs of several distributions, such as those of an ensemble.

Letters in shapes: M members; H×W cells; *B any leading dimensions.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import ConfigError, expect
from benchnav.core.mixture import TraversabilityMixture

_BISECTIONS = 40  # of [0, 1]; the last interval is 10⁻¹² wide


@dataclass(frozen=True)
class PooledDistribution(TraversabilityDistribution):
    """The weighted average of distributions; `pool` returns one with equal weights.

    Args:
        members: at least one distribution, all of the same shape, dtype and device.
        weights: weights of the members, summing to 1 over M, shape [*B, M, H, W]; if
            None, equal weights.

    Raises:
        ConfigError: If there are no members, their shapes, dtypes or devices differ, or
            the weights have another shape.
    """

    members: tuple[TraversabilityDistribution, ...]
    weights: Tensor | None = None

    def __post_init__(self) -> None:
        """Validate that the members have the same shape, dtype and device."""
        expect(self.members, "at least one distribution to pool, got none.")
        kinds = {
            f"{list(member.shape)} as {member.dtype} on {member.device}": None
            for member in self.members
        }
        if len(kinds) > 1:
            raise ConfigError(
                "Expected distributions of the same shape, dtype and device to pool, "
                f"got {', '.join(kinds)}."
            )
        if self.weights is not None:
            *batch, height, width = self.shape
            expected_shape = [*batch, len(self.members), height, width]
            expect(
                list(self.weights.shape) == expected_shape,
                f"`weights` of shape {expected_shape}, got {list(self.weights.shape)}.",
            )

    @property
    def shape(self) -> torch.Size:
        """Shape of the maps, [*B, H, W]."""
        return self.members[0].shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """Return P(λ ≤ value), shape [*B, H, W]."""
        return self._average([member.cdf(value) for member in self.members])

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return P(λ < value) and P(λ ≤ value), each of shape [*B, H, W]."""
        limits = [member.cdf_limits(value) for member in self.members]
        lower, upper = zip(*limits, strict=True)
        return self._average(lower), self._average(upper)

    @property
    def searched(self) -> bool:
        """Whether all members find their quantiles by a slow search."""
        return all(member.searched for member in self.members)

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Return the quantiles of λ by bisection, shape [*B, H, W].

        Their error is at most 10⁻¹². Quantiles that equal 0 or 1 are exact.
        """
        in_float64 = self._in_float64()
        u = torch.as_tensor(probability, dtype=torch.float64, device=self.device)
        u = u.expand(self.shape)
        low = torch.zeros(self.shape, dtype=torch.float64, device=self.device)
        high = torch.where(in_float64.cdf(low) >= u, 0.0, torch.ones_like(low))
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            reaches_u = in_float64.cdf(middle) >= u
            low = torch.where(reaches_u, low, middle)
            high = torch.where(reaches_u, middle, high)
        return high.to(self.dtype)

    def mean(self) -> Tensor:
        """Return E[λ], shape [*B, H, W]."""
        return self._average([member.mean() for member in self.members])

    def expected_time(self, floor: float) -> Tensor:
        """Return E[1 / max(λ, floor)], shape [*B, H, W]."""
        return self._average([member.expected_time(floor) for member in self.members])

    def log_prob(self, value: Tensor) -> Tensor:
        """Return the log of the average density, shape [*B, H, W].

        It is NaN where a member has no density.
        """
        log_probs = [member.log_prob(value).double() for member in self.members]
        stacked = torch.stack(log_probs)
        if self.weights is None:
            total = stacked.logsumexp(0) - math.log(len(self.members))
        else:
            log_weights = self.weights.double().movedim(-3, 0).log()
            total = (stacked + log_weights).logsumexp(0)
        return total.to(self.dtype)

    def _average(self, values: Sequence[Tensor]) -> Tensor:
        stacked = torch.stack([value.double() for value in values])
        if self.weights is None:
            return stacked.mean(0).to(self.dtype)
        weights = self.weights.double().movedim(-3, 0)
        return (stacked * weights).sum(0).to(self.dtype)


def pool(
    distributions: Sequence[TraversabilityDistribution],
) -> TraversabilityDistribution:
    """Average the CDFs of distributions, such as those of an ensemble.

    Args:
        distributions: M distributions of the same shape, dtype and device.

    Returns:
        If M is 1, the distribution itself. If all distributions are mixtures with the
        same classes of components, the exact mixture of all their components. Otherwise
        a `PooledDistribution`.

    Raises:
        ConfigError: If there are no distributions, or their shapes, dtypes or devices
            differ.
    """
    pooled = PooledDistribution(tuple(distributions))
    n_members = len(pooled.members)
    if n_members == 1:
        return pooled.members[0]
    mixtures = [
        member for member in distributions if isinstance(member, TraversabilityMixture)
    ]
    component_classes = {mixture.group for mixture in mixtures}
    if len(mixtures) < n_members or len(component_classes) > 1:
        return pooled
    weights = [
        mixture.weights / (mixture.weights.sum(-3, keepdim=True) * n_members)
        for mixture in mixtures
    ]
    means = [mixture.means for mixture in mixtures]
    stds = [mixture.stds for mixture in mixtures]
    group = mixtures[0].group
    return TraversabilityMixture(
        torch.cat(weights, -3),
        torch.cat(means, -3),
        torch.cat(stds, -3),
        None if group is None else group * n_members,
    )
