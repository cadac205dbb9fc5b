"""Several distributions as one: the average of their CDFs, as of the members of an
ensemble or of classes.

Letters in shapes: M members, H×W cells, *B any leading dimensions.
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
    """The average of distributions; `pool` makes one of distributions that are alike
    likely.

    Args:
        members: one or more, of one shape, dtype and device.
        weights: how likely each is, summing to 1 over M, shape [*B, M, H, W]; None
            where each is as likely as the others.

    Raises:
        ConfigError: there are none, they differ, or the weights are of another shape.
    """

    members: tuple[TraversabilityDistribution, ...]
    weights: Tensor | None = None

    def __post_init__(self) -> None:
        """Checks that the members fit one another."""
        expect(self.members, "one distribution or more to pool, got none.")
        kinds = {
            f"{list(own.shape)} as {own.dtype} on {own.device}": None
            for own in self.members
        }
        if len(kinds) > 1:
            raise ConfigError(
                "Expected distributions of one shape, dtype and device to pool, got "
                f"{', '.join(kinds)}."
            )
        if self.weights is not None:
            *batch, height, width = self.shape
            wanted = [*batch, len(self.members), height, width]
            expect(
                list(self.weights.shape) == wanted,
                f"`weights` of shape {wanted}, got {list(self.weights.shape)}.",
            )

    @property
    def shape(self) -> torch.Size:
        """[*B, H, W]."""
        return self.members[0].shape

    def cdf(self, value: Tensor | float) -> Tensor:
        """P(λ ≤ value), shape [*B, H, W]; see the base."""
        return self._average([own.cdf(value) for own in self.members])

    def cdf_limits(self, value: Tensor | float) -> tuple[Tensor, Tensor]:
        """P(λ < value) and P(λ ≤ value), each of shape [*B, H, W]; see the base."""
        lower, upper = zip(
            *(own.cdf_limits(value) for own in self.members), strict=True
        )
        return self._average(lower), self._average(upper)

    @property
    def searched(self) -> bool:
        """See the base."""
        return all(own.searched for own in self.members)

    def quantile(self, probability: Tensor | float) -> Tensor:
        """Least λ that is not exceeded with this probability, within 10⁻¹²; exact at 0
        and 1, shape [*B, H, W].
        """
        exact = self._exact()
        share = torch.as_tensor(
            probability, dtype=torch.float64, device=self.device
        ).expand(self.shape)
        low = torch.zeros(self.shape, dtype=torch.float64, device=self.device)
        high = torch.where(exact.cdf(low) >= share, 0.0, torch.ones_like(low))
        for _ in range(_HALVINGS):
            middle = (low + high) / 2
            reached = exact.cdf(middle) >= share
            low, high = (
                torch.where(reached, low, middle),
                torch.where(reached, middle, high),
            )
        return high.to(self.dtype)

    def mean(self) -> Tensor:
        """E[λ], shape [*B, H, W]."""
        return self._average([own.mean() for own in self.members])

    def expected_time(self, floor: float) -> Tensor:
        """E[1 / max(λ, floor)], shape [*B, H, W]; see the base."""
        return self._average([own.expected_time(floor) for own in self.members])

    def log_prob(self, value: Tensor) -> Tensor:
        """Log of the average density, shape [*B, H, W]; not a number where a member has
        none.
        """
        densities = torch.stack([own.log_prob(value).double() for own in self.members])
        if self.weights is None:
            return (densities.logsumexp(0) - math.log(len(self.members))).to(self.dtype)
        return (
            (densities + self.weights.double().movedim(-3, 0).log())
            .logsumexp(0)
            .to(self.dtype)
        )

    def _average(self, values: Sequence[Tensor]) -> Tensor:
        whole = torch.stack([value.double() for value in values])
        if self.weights is None:
            return whole.mean(0).to(self.dtype)
        return (whole * self.weights.double().movedim(-3, 0)).sum(0).to(self.dtype)


def pool(
    distributions: Sequence[TraversabilityDistribution],
) -> TraversabilityDistribution:
    """Averages the CDFs of distributions, as of the members of an ensemble.

    Args:
        distributions: M of one shape, dtype and device.

    Returns:
        Of mixtures whose components belong to the same classes a mixture of all
        components, exactly; else a `PooledDistribution`; of a single one itself.

    Raises:
        ConfigError: there are none, or they differ in shape, dtype or device.
    """
    pooled = PooledDistribution(tuple(distributions))
    if len(pooled.members) == 1:
        return pooled.members[0]
    mixtures = [own for own in distributions if isinstance(own, TraversabilityMixture)]
    if len(mixtures) < len(pooled.members) or len({own.group for own in mixtures}) > 1:
        return pooled
    shares = [
        own.weights / (own.weights.sum(-3, keepdim=True) * len(mixtures))
        for own in mixtures
    ]
    group = mixtures[0].group
    return TraversabilityMixture(
        torch.cat(shares, -3),
        torch.cat([own.means for own in mixtures], -3),
        torch.cat([own.stds for own in mixtures], -3),
        None if group is None else group * len(mixtures),
    )
