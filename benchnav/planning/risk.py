"""Risk measures: from the distribution of traversability to the one map a planner is given.

A measure is a function of a `TraversabilityDistribution` of shape [B, H, W] that gives λ̂ in [0, 1] of that shape; its
further keyword parameters are its options. A setting is written `name` or `name:level`: `cvar:0.9`, `var:0.95`,
`expected-time:0.05`, `mean`. Risk means the lower tail of λ; a higher level of CVaR or VaR is more cautious. The
integrals are the distribution's own, the names are given in `pyproject.toml`, and the registry reads what is written.
Source: paper II and III-B; `expected_time`, `time_cvar` and `chance` go beyond it.
"""

from collections.abc import Callable

from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.core.errors import expect

RiskMeasure = Callable[[TraversabilityDistribution], Tensor]


def mean(distribution: TraversabilityDistribution) -> Tensor:
    """E[λ], which looks at no tail."""
    return distribution.mean()


def var(distribution: TraversabilityDistribution, level: float = 0.9) -> Tensor:
    """Value at risk: λ falls below it with probability 1 − level.

    Args:
        distribution: of λ in each cell.
        level: α in [0, 1).
    """
    return distribution.var(level)


def cvar(distribution: TraversabilityDistribution, level: float = 0.9) -> Tensor:
    """Conditional value at risk: the mean of λ over its worst share 1 − level.

    Args:
        distribution: of λ in each cell.
        level: α in [0, 1).
    """
    return distribution.cvar(level)


def expected_time(distribution: TraversabilityDistribution, floor: float = 0.05) -> Tensor:
    """1 / E[1 / max(λ, floor)], by which a path's length gives its expected time.

    What a risk-neutral robot plans with where λ stays what it is at a place: it holds against the mean that
    time is lost on slow ground, and looks at no tail. A lower floor makes ground that immobilises a robot dearer.

    Args:
        distribution: of λ in each cell.
        floor: least speed, as a share of the commanded one, in (0, 1].
    """
    return (1 / distribution.expected_time(floor)).clamp(floor, 1)


def time_cvar(distribution: TraversabilityDistribution, level: float = 0.9, floor: float = 0.05) -> Tensor:
    """1 / CVaR of the time 1 / max(λ, floor), by which a path's length gives the time it takes on the worst ground.

    As CVaR looks at the mean of λ over its worst share, this looks at the mean of the time over it.

    Args:
        distribution: of λ in each cell.
        level: α in [0, 1); at 0 it is `expected_time`.
        floor: least speed, as a share of the commanded one, in (0, 1].
    """
    return (1 / distribution.time_cvar(level, floor)).clamp(floor, 1)


def chance(distribution: TraversabilityDistribution, bound: float = 0.1) -> Tensor:
    """P(λ ≥ bound), the chance that the ground carries the robot.

    Args:
        distribution: of λ in each cell.
        bound: traversability in [0, 1].
    """
    expect(0 <= bound <= 1, f"`bound` in [0, 1], got {bound}.")
    return distribution.chance(bound)


def single_class(distribution: TraversabilityDistribution, level: float = 0.9) -> Tensor:
    """The CVaR of the most likely class alone, its soft spots with it.

    Args:
        distribution: one that knows of classes.
        level: α in [0, 1).
    """
    return distribution.most_likely().cvar(level)


def apply(measure: RiskMeasure, distribution: TraversabilityDistribution) -> Tensor:
    """Infers λ̂ and checks it.

    Args:
        measure: any risk measure.
        distribution: of λ in each cell, shape [B, H, W].

    Returns:
        λ̂ in [0, 1], shape [B, H, W].

    Raises:
        ConfigError: the measure gave something else.
    """
    risk_map = measure(distribution)
    shape = distribution.shape
    got = list(risk_map.shape) if isinstance(risk_map, Tensor) else type(risk_map).__name__
    expect(got == list(shape), f"a risk measure to give λ̂ of shape {list(shape)}, got {got}.")
    expect(
        risk_map.is_floating_point(),
        f"a risk measure to give λ̂ as floating-point numbers, got {risk_map.dtype}.",
    )
    expect(
        ((risk_map >= 0) & (risk_map <= 1)).all(),
        "a risk measure to give λ̂ in [0, 1], got values outside or not a number.",
    )
    return risk_map.to(distribution.dtype)
