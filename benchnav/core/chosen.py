"""A choice between two distributions in each cell of a map.

For example, observed cells have the predicted distribution, all other cells a prior.
Letters in shapes: H×W cells; K components; *B any leading dimensions.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.mixture import TraversabilityMixture

NO_CLASS = -1  # class index of components without a class


@dataclass(frozen=True)
class ChosenDistribution(TraversabilityDistribution):
    """The first distribution in chosen cells, the second in all other cells.

    Args:
        first: distribution of shape [*B, H, W]; results have its dtype.
        second: distribution of shape [*B, H, W].
        chosen: mask of the cells with the first distribution, bool, shape [*B, H, W].
    """

    first: TraversabilityDistribution
    second: TraversabilityDistribution
    chosen: Tensor

    @property
    def shape(self) -> torch.Size:
        """Shape of the maps, [*B, H, W]."""
        return self.chosen.shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """Return P(λ ≤ value), shape [*B, H, W]."""
        first = self.first.cdf(value)
        return self._pick(first, self.second.cdf(value))

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return P(λ < value) and P(λ ≤ value), each of shape [*B, H, W]."""
        first = self.first.cdf_limits(value)
        second = self.second.cdf_limits(value)
        lower = self._pick(first[0], second[0])
        upper = self._pick(first[1], second[1])
        return lower, upper

    @property
    def searched(self) -> bool:
        """Whether both distributions find their quantiles by a slow search."""
        return self.first.searched and self.second.searched

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Return the quantiles of λ, shape [*B, H, W]."""
        first = self.first.quantile(probability)
        return self._pick(first, self.second.quantile(probability))

    def mean(self) -> Tensor:
        """Return E[λ], shape [*B, H, W]."""
        return self._pick(self.first.mean(), self.second.mean())

    def cvar(self, level: float) -> Tensor:
        """Return the conditional value at risk, shape [*B, H, W]."""
        first = self.first.cvar(level)
        return self._pick(first, self.second.cvar(level))

    def expected_time(self, floor: float) -> Tensor:
        """Return E[1 / max(λ, floor)], shape [*B, H, W]."""
        first = self.first.expected_time(floor)
        return self._pick(first, self.second.expected_time(floor))

    def time_cvar(self, level: float, floor: float) -> Tensor:
        """Return the CVaR of the time 1 / max(λ, floor), shape [*B, H, W]."""
        first = self.first.time_cvar(level, floor)
        return self._pick(first, self.second.time_cvar(level, floor))

    def log_prob(self, value: Tensor) -> Tensor:
        """Return log density on (0, 1) and log mass at 0 and 1, shape [*B, H, W]."""
        first = self.first.log_prob(value)
        return self._pick(first, self.second.log_prob(value))

    def from_normal(self, normal: Tensor) -> Tensor:
        """Return λ of standard normal scores, shape [*B, H, W]."""
        first = self.first.from_normal(normal)
        return self._pick(first, self.second.from_normal(normal))

    def to_normal(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """Return the interval of standard normal scores, each of shape [*B, H, W]."""
        first = self.first.to_normal(value)
        second = self.second.to_normal(value)
        lower = self._pick(first[0], second[0])
        upper = self._pick(first[1], second[1])
        return lower, upper

    def _pick(self, first: Tensor, second: Tensor) -> Tensor:
        return torch.where(self.chosen, first, second.to(first.dtype))


def choose(
    chosen: Tensor,
    first: TraversabilityDistribution,
    second: TraversabilityDistribution,
) -> TraversabilityDistribution:
    """Return the first distribution in chosen cells, the second in all other cells.

    Args:
        chosen: mask of the cells with the first distribution, bool, shape [*B, H, W].
        first: distribution of shape [*B, H, W].
        second: distribution of shape [*B, H, W].

    Returns:
        If both are mixtures, a mixture in which components of the second have no class.
        Otherwise a `ChosenDistribution`.
    """
    if not isinstance(first, TraversabilityMixture):
        return ChosenDistribution(first, second, chosen)
    if not isinstance(second, TraversabilityMixture):
        return ChosenDistribution(first, second, chosen)
    is_first = chosen.unsqueeze(-3)
    dtype_source = first.weights
    first_weights = torch.where(is_first, first.weights, 0.0).to(dtype_source)
    second_weights = torch.where(~is_first, second.weights, 0.0).to(dtype_source)
    weights = torch.cat([first_weights, second_weights], -3)
    means = _concatenated(first.means, second.means, dtype_source)
    stds = _concatenated(first.stds, second.stds, dtype_source)
    group = None
    if first.group is not None:
        n_second = second.weights.shape[-3]
        group = (*first.group, *[NO_CLASS] * n_second)
    return TraversabilityMixture(weights, means, stds, group)


def _concatenated(first: Tensor, second: Tensor, like: Tensor) -> Tensor:
    """Return a parameter of both mixtures, with the dtype and device of `like`."""
    return torch.cat([first.to(like), second.to(like)], -3)
