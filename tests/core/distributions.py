"""Distributions for the tests: some hidden from all but their CDF, and quantiles with
atoms and gaps.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.mixture import TraversabilityMixture
from benchnav.core.quantiles import LEVELS, QuantileDistribution


@dataclass(frozen=True)
class Hidden(TraversabilityDistribution):
    """Another distribution of which no more than CDF and quantiles are known."""

    own: TraversabilityDistribution

    @property
    def shape(self) -> torch.Size:
        return self.own.shape

    def cdf(self, value: Tensor | float) -> Tensor:
        return self.own.cdf(value)

    def quantile(self, probability: Tensor | float) -> Tensor:
        return self.own.quantile(probability)


def mixture(
    components: int,
    least: float,
    most: float,
    seed: int = 0,
    maps: int = 2,
    dtype: torch.dtype = torch.float64,
) -> TraversabilityMixture:
    """Components of weights from few to many and deviations from least to most, means
    from −0.2 to 1.2.
    """
    generator = torch.Generator().manual_seed(seed)
    weights, means, stds = torch.rand(
        3, maps, components, 5, 7, generator=generator, dtype=torch.float64
    )
    weights, stds = weights**2, least * math.exp(1) ** (math.log(most / least) * stds)
    parameters = (weights / weights.sum(1, keepdim=True), 1.4 * means - 0.2, stds)
    return TraversabilityMixture(
        *(values.to(dtype) for values in parameters), tuple(range(components))
    )


def quantiles(
    seed: int = 0, maps: int = 2, dtype: torch.dtype = torch.float64
) -> QuantileDistribution:
    """Quantiles with an atom at 0, one or two inside and two gaps in most cells, shape
    [B, 5, 7].
    """
    generator = torch.Generator().manual_seed(seed)

    def drawn() -> Tensor:
        return torch.rand(maps, 1, 5, 7, generator=generator, dtype=torch.float64)

    levels = torch.tensor(LEVELS, dtype=torch.float64).view(-1, 1, 1)
    values = 1.1 * drawn() * levels ** (0.5 + 2 * drawn()) - 0.1
    values = (
        values + 0.2 * drawn() * (levels > drawn()) + 0.3 * drawn() * (levels > drawn())
    )
    for _ in range(2):
        low = drawn() * values.amax(1, keepdim=True)
        values = torch.where(
            (values > low) & (values < low + 0.05 * (1 + drawn())), low, values
        )
    return QuantileDistribution(values.clamp(0, 1).cummax(1).values.to(dtype))
