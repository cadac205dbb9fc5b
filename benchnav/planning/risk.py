"""Risk measures: from the distribution of traversability to the one map a planner is given.

A measure is a function of a `TraversabilityMixture` with parameters of shape [B, K, H, W] that gives λ̂ in
[0, 1] of shape [B, H, W]; its further keyword parameters are its options. A setting is written
`name` or `name:level`: `cvar:0.9`, `var:0.95`, `mean`. Risk means the lower tail of λ; a higher level is
more cautious. Source: paper II and III-B.
"""

from collections.abc import Callable

from torch import Tensor

from benchnav.errors import ConfigError
from benchnav.mixture import TraversabilityMixture

RiskMeasure = Callable[[TraversabilityMixture], Tensor]


def mean(mixture: TraversabilityMixture) -> Tensor:
    """E[λ], which looks at no tail."""
    return mixture.mean()


def var(mixture: TraversabilityMixture, level: float = 0.9) -> Tensor:
    """Value at risk: λ falls below it with probability 1 − level.

    Args:
        mixture: distribution a cell.
        level: α in [0, 1).
    """
    return mixture.var(level)


def cvar(mixture: TraversabilityMixture, level: float = 0.9) -> Tensor:
    """Conditional value at risk: the mean of λ over its worst share 1 − level.

    Args:
        mixture: distribution a cell.
        level: α in [0, 1).
    """
    return mixture.cvar(level)


def single_class(mixture: TraversabilityMixture, level: float = 0.9) -> Tensor:
    """The CVaR of the most likely class alone.

    Args:
        mixture: distribution a cell.
        level: α in [0, 1).
    """
    return mixture.most_likely().cvar(level)


def apply(measure: RiskMeasure, mixture: TraversabilityMixture) -> Tensor:
    """Infers λ̂ and checks it.

    Args:
        measure: any risk measure.
        mixture: distribution a cell, parameters of shape [B, K, H, W].

    Returns:
        λ̂ in [0, 1], shape [B, H, W].

    Raises:
        ConfigError: the measure gave something else.
    """
    risk_map = measure(mixture)
    shape = mixture.weights.select(-3, 0).shape
    if not isinstance(risk_map, Tensor) or risk_map.shape != shape:
        got = list(risk_map.shape) if isinstance(risk_map, Tensor) else type(risk_map).__name__
        raise ConfigError(f"Expected a risk measure to give λ̂ of shape {list(shape)}, got {got}.")
    if not risk_map.is_floating_point():
        raise ConfigError(
            f"Expected a risk measure to give λ̂ as floating-point numbers, got {risk_map.dtype}."
        )
    if not bool(((risk_map >= 0) & (risk_map <= 1)).all()):
        raise ConfigError("Expected a risk measure to give λ̂ in [0, 1], got values outside or not a number.")
    return risk_map.to(mixture.weights.dtype)
