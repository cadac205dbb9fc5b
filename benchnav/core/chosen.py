"""A distribution that is one of two in each cell, such as a prediction where ground was
seen and a prior elsewhere.

Letters in shapes: H×W cells, K components, *B any leading dimensions.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.mixture import TraversabilityMixture

NO_CLASS = -1  # the group of components that belong to no class


@dataclass(frozen=True)
class ChosenDistribution(TraversabilityDistribution):
    """One distribution where cells are chosen, another in all other cells.

    Args:
        first: of shape [*B, H, W]; its dtype is that of both.
        second: of shape [*B, H, W].
        chosen: which cells have the first, bool, shape [*B, H, W].
    """

    first: TraversabilityDistribution
    second: TraversabilityDistribution
    chosen: Tensor

    @property
    def shape(self) -> torch.Size:
        """[*B, H, W]."""
        return self.chosen.shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """P(λ ≤ value), shape [*B, H, W]; see the base."""
        return self._pick(self.first.cdf(value), self.second.cdf(value))

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """P(λ < value) and P(λ ≤ value), each of shape [*B, H, W]; see the base."""
        (low, high), (other_low, other_high) = (
            self.first.cdf_limits(value),
            self.second.cdf_limits(value),
        )
        return self._pick(low, other_low), self._pick(high, other_high)

    @property
    def searched(self) -> bool:
        """See the base."""
        return self.first.searched and self.second.searched

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Least λ that is not exceeded with this probability, shape [*B, H, W]; see the
        base.
        """
        return self._pick(
            self.first.quantile(probability), self.second.quantile(probability)
        )

    def mean(self) -> Tensor:
        """E[λ], shape [*B, H, W]."""
        return self._pick(self.first.mean(), self.second.mean())

    def cvar(self, level: float) -> Tensor:
        """Conditional value at risk, shape [*B, H, W]; see the base."""
        return self._pick(self.first.cvar(level), self.second.cvar(level))

    def expected_time(self, floor: float) -> Tensor:
        """E[1 / max(λ, floor)], shape [*B, H, W]; see the base."""
        return self._pick(
            self.first.expected_time(floor), self.second.expected_time(floor)
        )

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """CVaR of the time 1 / max(λ, floor), shape [*B, H, W]; see the base."""
        return self._pick(
            self.first.time_cvar(level, floor), self.second.time_cvar(level, floor)
        )

    def log_prob(self, value: Tensor) -> Tensor:
        """Log density on (0, 1), log mass at 0 and at 1, shape [*B, H, W]; see the
        base.
        """
        return self._pick(self.first.log_prob(value), self.second.log_prob(value))

    def from_normal(self, normal: Tensor) -> Tensor:
        """λ of standard normal numbers, shape [*B, H, W]; see the base."""
        return self._pick(
            self.first.from_normal(normal), self.second.from_normal(normal)
        )

    def to_normal(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """The interval of standard normal numbers, each of shape [*B, H, W]; see the
        base.
        """
        (low, high), (other_low, other_high) = (
            self.first.to_normal(value),
            self.second.to_normal(value),
        )
        return self._pick(low, other_low), self._pick(high, other_high)

    def _pick(self, first: Tensor, second: Tensor) -> Tensor:
        return torch.where(self.chosen, first, second.to(first.dtype))


def choose(
    chosen: Tensor,
    first: TraversabilityDistribution,
    second: TraversabilityDistribution,
) -> TraversabilityDistribution:
    """The first distribution where cells are chosen, the second in all other cells.

    Args:
        chosen: bool, shape [*B, H, W].
        first: of shape [*B, H, W].
        second: of shape [*B, H, W].

    Returns:
        A mixture again where both are; the components of the second then belong to no
        class.
    """
    if not isinstance(first, TraversabilityMixture) or not isinstance(
        second, TraversabilityMixture
    ):
        return ChosenDistribution(first, second, chosen)
    own = chosen.unsqueeze(-3)
    parts = [first, second]
    weights = torch.cat(
        [
            torch.where(own == (part is first), part.weights, 0.0).to(first.weights)
            for part in parts
        ],
        -3,
    )
    means, stds = (
        torch.cat([getattr(part, name).to(first.weights) for part in parts], -3)
        for name in ("means", "stds")
    )
    group = (
        None
        if first.group is None
        else (*first.group, *[NO_CLASS] * second.weights.shape[-3])
    )
    return TraversabilityMixture(weights, means, stds, group)
