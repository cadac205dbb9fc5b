"""Risk measures: from the distribution of traversability to a map for planners.

A measure maps a `TraversabilityDistribution` of shape [B, H, W] to λ̂ in [0, 1] of that
shape. The shipped measures are values, such as `CVaR(0.8)`. A custom measure may be any
function of a distribution; its other keyword parameters are its options. In suites and
commands a setting is written `name` or `name:level`: `cvar:0.9`, `var:0.95`,
`expected-time:0.05`, `mean`. Risk means the lower tail of λ; a higher level of CVaR or
VaR is more cautious. The distribution computes the integrals. Source: paper II and
III-B; `ExpectedTime`, `TimeCVaR` and `Chance` go beyond the paper.
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
        """Infer λ̂.

        Args:
            distribution: distribution of λ in each cell, shape [B, H, W].

        Returns:
            λ̂ in [0, 1], shape [B, H, W].
        """


@dataclass(frozen=True)
class Mean(RiskMeasure):
    """Mean E[λ], which does not consider a tail."""

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Infer λ̂; see `RiskMeasure`."""
        return distribution.mean()


@dataclass(frozen=True)
class VaR(RiskMeasure):
    """Value at risk: λ is below it with probability 1 − level.

    Args:
        level: α in [0, 1).
    """

    level: float = 0.9

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Infer λ̂; see `RiskMeasure`."""
        return distribution.var(self.level)


@dataclass(frozen=True)
class CVaR(RiskMeasure):
    """Conditional value at risk: the mean of λ over its worst fraction 1 − level.

    Args:
        level: α in [0, 1).
    """

    level: float = 0.9

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Infer λ̂; see `RiskMeasure`."""
        return distribution.cvar(self.level)


@dataclass(frozen=True)
class ExpectedTime(RiskMeasure):
    """1 / E[1 / max(λ, floor)]: a path's length over it is the expected time.

    It suits a risk-neutral robot if the λ field is constant during an episode. In
    contrast to the mean, it includes the time that is lost on slow terrain; it does not
    consider a tail. A lower floor makes immobilising terrain more expensive.

    Args:
        floor: minimum speed, as a fraction of the commanded one, in (0, 1].
    """

    floor: float = 0.05

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Infer λ̂; see `RiskMeasure`."""
        time = distribution.expected_time(self.floor)
        return (1 / time).clamp(self.floor, 1)


@dataclass(frozen=True)
class TimeCVaR(RiskMeasure):
    """1 / CVaR of the time 1 / max(λ, floor).

    A path's length over it is the path's time on the worst fraction of terrain. `CVaR`
    averages λ over this fraction, and `TimeCVaR` averages the time.

    Args:
        level: α in [0, 1); 0 for `ExpectedTime`.
        floor: minimum speed, as a fraction of the commanded one, in (0, 1].
    """

    level: float = 0.9
    floor: float = 0.05

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Infer λ̂; see `RiskMeasure`."""
        time = distribution.time_cvar(self.level, self.floor)
        return (1 / time).clamp(self.floor, 1)


@dataclass(frozen=True)
class Chance(RiskMeasure):
    """P(λ ≥ bound), the exceedance probability.

    Args:
        bound: traversability in [0, 1].
    """

    bound: float = 0.1

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Infer λ̂; see `RiskMeasure`."""
        expect(0 <= self.bound <= 1, f"`bound` in [0, 1], got {self.bound}.")
        return distribution.chance(self.bound)


@dataclass(frozen=True)
class SingleClass(RiskMeasure):
    """The CVaR of the most likely class only, including its soft spots.

    Args:
        level: α in [0, 1).
    """

    level: float = 0.9

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Infer λ̂; see `RiskMeasure`."""
        return distribution.most_likely().cvar(self.level)


def apply(measure: RiskFunction, distribution: TraversabilityDistribution) -> Tensor:
    """Infer λ̂ and check it.

    Args:
        measure: any risk measure.
        distribution: distribution of λ in each cell, shape [B, H, W].

    Returns:
        λ̂ in [0, 1], shape [B, H, W].

    Raises:
        ConfigError: If the measure returns anything else.
    """
    risk_map = measure(distribution)
    shape = list(distribution.shape)
    got: object = type(risk_map).__name__
    if isinstance(risk_map, Tensor):
        got = list(risk_map.shape)
    expect(got == shape, f"a risk measure to return λ̂ of shape {shape}, got {got}.")
    expect(
        risk_map.is_floating_point(),
        f"a risk measure to return λ̂ as floating-point numbers, got {risk_map.dtype}.",
    )
    in_range = (risk_map >= 0) & (risk_map <= 1)
    expect(
        in_range.all(),
        "a risk measure to return λ̂ in [0, 1], got values outside or NaN.",
    )
    return risk_map.to(distribution.dtype)
