"""Risk measures, which reduce the distribution of traversability to a map for planners.

A measure maps a `TraversabilityDistribution` of shape [B, H, W] to λ̂ in [0, 1] of the
same shape. The shipped measures are objects, such as `CVaR(0.8)`. A custom measure may
be any function of a distribution; its other keyword parameters are its options. In
suites and commands, a risk setting is written as a name, or as a name and the value of
the first option: `mean`, `cvar:0.9`, `var:0.95`, `expected-time:0.05`.

Low λ is bad, so risk concerns the lower tail of λ. A higher level of CVaR or VaR is
more cautious. Source: paper II and III-B; `ExpectedTime`, `TimeCVaR` and `Chance` go
beyond the paper.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect
from benchnav.core.specified import Specified

RiskFunction = Callable[[TraversabilityDistribution], Tensor]


class RiskMeasure(Specified, ABC):
    """Base class of the shipped risk measures."""

    @abstractmethod
    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Return λ̂ of each cell.

        Args:
            distribution: distribution of λ in each cell, shape [B, H, W].

        Returns:
            λ̂ in [0, 1], shape [B, H, W].
        """


@dataclass(frozen=True)
class Mean(RiskMeasure):
    """Mean E[λ], which is neutral to risk."""

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Return λ̂; see `RiskMeasure`."""
        return distribution.mean()


@dataclass(frozen=True)
class VaR(RiskMeasure):
    """Value at risk: λ is below it with probability 1 − level.

    Args:
        level: α in [0, 1).
    """

    level: float = 0.9

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Return λ̂; see `RiskMeasure`."""
        return distribution.var(self.level)


@dataclass(frozen=True)
class CVaR(RiskMeasure):
    """Conditional value at risk: the mean of λ over its worst fraction 1 − level.

    Args:
        level: α in [0, 1).
    """

    level: float = 0.9

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Return λ̂; see `RiskMeasure`."""
        return distribution.cvar(self.level)


@dataclass(frozen=True)
class ExpectedTime(RiskMeasure):
    """λ̂ = 1 / E[1 / max(λ, floor)]: a path's length over it is the expected time.

    The time of a path is its length over λ̂, at a commanded speed of 1. The measure
    suits a risk-neutral robot if the λ field is constant during an episode. In contrast
    to the mean, it includes the time that is lost on slow terrain. A lower floor makes
    immobilising terrain more expensive.

    Args:
        floor: minimum speed as a fraction of the commanded speed, in (0, 1].
    """

    floor: float = 0.05

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Return λ̂; see `RiskMeasure`."""
        time = distribution.expected_time(self.floor)
        return (1 / time).clamp(self.floor, 1)


@dataclass(frozen=True)
class TimeCVaR(RiskMeasure):
    """λ̂ = 1 / CVaR of the time 1 / max(λ, floor).

    Over the worst 1 − level fraction of each cell's distribution, `CVaR` averages λ,
    and `TimeCVaR` averages the time per metre.

    Args:
        level: α in [0, 1); 0 is equivalent to `ExpectedTime`.
        floor: minimum speed as a fraction of the commanded speed, in (0, 1].
    """

    level: float = 0.9
    floor: float = 0.05

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Return λ̂; see `RiskMeasure`."""
        time = distribution.time_cvar(self.level, self.floor)
        return (1 / time).clamp(self.floor, 1)


@dataclass(frozen=True)
class Chance(RiskMeasure):
    """Exceedance probability P(λ ≥ bound).

    Args:
        bound: bound of λ, in [0, 1].
    """

    bound: float = 0.1

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Return λ̂; see `RiskMeasure`."""
        expect(0 <= self.bound <= 1, f"`bound` in [0, 1], got {self.bound}.")
        return distribution.chance(self.bound)


@dataclass(frozen=True)
class SingleClass(RiskMeasure):
    """CVaR under the most likely class of each cell, including its soft spots.

    Args:
        level: α in [0, 1).
    """

    level: float = 0.9

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Return λ̂; see `RiskMeasure`."""
        return distribution.most_likely().cvar(self.level)


def apply(measure: RiskFunction, distribution: TraversabilityDistribution) -> Tensor:
    """Return the λ̂ that a risk measure computes, after checks.

    Args:
        measure: any risk measure.
        distribution: distribution of λ in each cell, shape [B, H, W].

    Returns:
        λ̂ in [0, 1], shape [B, H, W].

    Raises:
        ConfigError: If the measure does not return floating-point values in [0, 1] of
            this shape.
    """
    risk_map = measure(distribution)
    shape = list(distribution.shape)
    got: object = type(risk_map).__name__
    if isinstance(risk_map, Tensor):
        got = list(risk_map.shape)
    expect(
        got == shape, f"a risk measure to return a tensor of shape {shape}, got {got}."
    )
    expect(
        risk_map.is_floating_point(),
        "a risk measure to return a floating-point tensor, got dtype "
        f"{risk_map.dtype}.",
    )
    in_range = (risk_map >= 0) & (risk_map <= 1)
    expect(
        in_range.all(),
        "a risk measure to return values in [0, 1], got values outside this range or "
        "NaN.",
    )
    return risk_map.to(distribution.dtype)
