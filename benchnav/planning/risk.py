"""Risk measures: from the distribution of traversability to the one map a planner is
given.

A measure maps a `TraversabilityDistribution` of shape [B, H, W] to λ̂ in [0, 1] of that
shape. The shipped measures are values, such as `CVaR(0.8)`; a user's own may be any
function of a distribution, whose further keyword parameters are its options. In suites
and commands a setting is written `name` or `name:level`: `cvar:0.9`, `var:0.95`,
`expected-time:0.05`, `mean`. Risk means the lower tail of λ; a higher level of CVaR or
VaR is more cautious. The integrals are the distribution's own. Source: paper II and
III-B; `ExpectedTime`, `TimeCVaR` and `Chance` go beyond it.
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
    """The base class of the shipped risk measures."""

    @abstractmethod
    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Infer λ̂.

        Args:
            distribution: of λ in each cell, shape [B, H, W].

        Returns:
            λ̂ in [0, 1], shape [B, H, W].
        """


@dataclass(frozen=True)
class Mean(RiskMeasure):
    """E[λ], which considers no tail."""

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
    """1 / E[1 / max(λ, floor)], by which a path's length gives its expected time.

    A risk-neutral robot plans with it where the λ field stays the same during an
    episode: unlike the mean it counts the time that is lost on slow terrain, and it
    considers no tail. A lower floor makes immobilising terrain dearer.

    Args:
        floor: minimum speed, as a fraction of the commanded one, in (0, 1].
    """

    floor: float = 0.05

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Infer λ̂; see `RiskMeasure`."""
        return (1 / distribution.expected_time(self.floor)).clamp(self.floor, 1)


@dataclass(frozen=True)
class TimeCVaR(RiskMeasure):
    """1 / CVaR of the time 1 / max(λ, floor): a path's length over it is the path's
    time on the worst terrain.

    CVaR averages λ over its worst fraction; this averages the time over it.

    Args:
        level: α in [0, 1); at 0 it is `ExpectedTime`.
        floor: minimum speed, as a fraction of the commanded one, in (0, 1].
    """

    level: float = 0.9
    floor: float = 0.05

    def __call__(self, distribution: TraversabilityDistribution) -> Tensor:
        """Infer λ̂; see `RiskMeasure`."""
        return (1 / distribution.time_cvar(self.level, self.floor)).clamp(self.floor, 1)


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
        distribution: of λ in each cell, shape [B, H, W].

    Returns:
        λ̂ in [0, 1], shape [B, H, W].

    Raises:
        ConfigError: If the measure returns anything else.
    """
    risk_map = measure(distribution)
    shape = distribution.shape
    got = (
        list(risk_map.shape)
        if isinstance(risk_map, Tensor)
        else type(risk_map).__name__
    )
    expect(
        got == list(shape),
        f"a risk measure to give λ̂ of shape {list(shape)}, got {got}.",
    )
    expect(
        risk_map.is_floating_point(),
        f"a risk measure to give λ̂ as floating-point numbers, got {risk_map.dtype}.",
    )
    expect(
        ((risk_map >= 0) & (risk_map <= 1)).all(),
        "a risk measure to give λ̂ in [0, 1], got values outside or not a number.",
    )
    return risk_map.to(distribution.dtype)
