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

_HALVINGS = 40  # of [0, 1], to 10⁻¹²


@dataclass(frozen=True)
class PooledDistribution(TraversabilityDistribution):
    """The weighted average of distributions; `pool` creates one of equal weights.

    Args:
        members: at least one distribution, of one shape, dtype and device.
        weights: weights of the members, summing to 1 over M, shape [*B, M, H, W]; if
            None, equal weights.

    Raises:
        ConfigError: If there are no members, if their shape, dtype or device differ, or
            if the weights have another shape.
    """

    members: tuple[TraversabilityDistribution, ...]
    weights: Tensor | None = None

    def __post_init__(self) -> None:
        """Validate that the members have one shape, dtype and device."""
        expect(self.members, "at least one distribution to pool, got none.")
        kinds = {
            f"{list(member.shape)} as {member.dtype} on {member.device}": None
            for member in self.members
        }
        if len(kinds) > 1:
            raise ConfigError(
                "Expected distributions of one shape, dtype and device to pool, got "
                f"{', '.join(kinds)}."
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
        """[*B, H, W]."""
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
        """Whether all members search for quantiles."""
        return all(member.searched for member in self.members)

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Return the quantiles of λ by bisection, shape [*B, H, W].

        They are within 10⁻¹², and exact at 0 and 1.
        """
        exact = self._exact()
        u = torch.as_tensor(probability, dtype=torch.float64, device=self.device)
        u = u.expand(self.shape)
        low = torch.zeros(self.shape, dtype=torch.float64, device=self.device)
        high = torch.where(exact.cdf(low) >= u, 0.0, torch.ones_like(low))
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            is_upper = exact.cdf(middle) >= u
            low = torch.where(is_upper, low, middle)
            high = torch.where(is_upper, middle, high)
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
        distributions: M distributions of one shape, dtype and device.

    Returns:
        The distribution itself if M is 1. An exact mixture of all components if all are
        mixtures whose components have the same classes. Otherwise a
        `PooledDistribution`.

    Raises:
        ConfigError: If there are no distributions, or shape, dtype or device differ.
    """
    pooled = PooledDistribution(tuple(distributions))
    n_members = len(pooled.members)
    if n_members == 1:
        return pooled.members[0]
    mixtures = [
        member for member in distributions if isinstance(member, TraversabilityMixture)
    ]
    groups = {mixture.group for mixture in mixtures}
    if len(mixtures) < n_members or len(groups) > 1:
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
