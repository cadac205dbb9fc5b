"""The check of the functions of a traversability distribution.

Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.testing.breaches import NOTHING, Breaches

_TENTHS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
_VALUES = (0.0, 0.01, 0.05, *_TENTHS, 0.95, 0.99, 1.0)
_PROBABILITIES = (0.0, 0.01, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.99, 1.0)
_LEVEL = 0.9  # level of the compared CVaR
_FLOOR = 0.05  # floor of λ in the compared times
# The tolerance between closed forms and the base class's quadrature is larger.
_QUADRATURE_FACTOR = 10


def check_functions(
    distribution: TraversabilityDistribution, tolerance: float, breaches: Breaches
) -> None:
    """Note where a distribution's functions are invalid or contradict one another.

    Args:
        distribution: distribution of shape [B, H, W].
        tolerance: tolerance of λ and of probabilities.
        breaches: collection of breaches.
    """
    expect = breaches.expect
    first_map = torch.tensor([0], device=distribution.device)
    distribution = distribution.select(first_map)
    like = torch.zeros(1, dtype=distribution.dtype, device=distribution.device)

    def evaluate(name: str, *arguments: Any) -> Any:
        """Return a method's result, or `NOTHING` if it is not a map of numbers."""
        method = getattr(distribution, name)
        answer = breaches.watch(name, lambda: method(*arguments))
        if answer is NOTHING:
            return NOTHING
        description = f"results of `{name}` of the distribution"
        is_map = breaches.is_tensor(description, like, distribution.shape)
        return answer if is_map(answer) else NOTHING

    probabilities = [evaluate("cdf", value) for value in (-tolerance, *_VALUES)]
    values = [evaluate("quantile", probability) for probability in _PROBABILITIES]
    if any(answer is NOTHING for answer in (*probabilities, *values)):
        return
    starts_at_0 = bool((probabilities[0] == 0).all())
    ends_at_1 = bool((probabilities[-1] == 1).all())
    ascends = _ascend(probabilities, tolerance)
    expect(
        ascends and starts_at_0 and ends_at_1,
        "Expected `cdf` to ascend from 0 below λ = 0 to 1 at λ = 1, got one that does "
        "not.",
    )
    starts_inside = bool((values[0] >= 0).all())
    ends_inside = bool((values[-1] <= 1).all())
    expect(
        _ascend(values, 0) and starts_inside and ends_inside,
        "Expected `quantile` to ascend with the probability and to stay in [0, 1], got "
        "one that does not.",
    )
    for value, probability in zip(values, _PROBABILITIES, strict=True):
        below = distribution.cdf(value - tolerance).double()
        above = distribution.cdf(value + tolerance).double()
        is_inverse = below <= probability + tolerance
        is_inverse &= above >= probability - tolerance
        expect(
            bool(is_inverse.all()),
            "Expected `quantile` to be the inverse of `cdf`, got different values.",
        )
    base = TraversabilityDistribution
    if type(distribution).cdf_limits is not base.cdf_limits:
        for value, probability in zip(_VALUES, probabilities[1:], strict=True):
            lower, upper = distribution.cdf_limits(value)
            minimum = distribution.cdf(value - tolerance) - tolerance
            is_limit = (minimum <= lower) & (lower <= upper)
            is_limit &= (upper - probability).abs() <= tolerance
            expect(
                bool(is_limit.all()),
                "Expected `cdf_limits` to return P(λ < value) and P(λ ≤ value), the "
                "second equal to `cdf`, got other values.",
            )
    _check_integrals(distribution, evaluate, _QUADRATURE_FACTOR * tolerance, breaches)


def _check_integrals(
    distribution: TraversabilityDistribution,
    evaluate: Callable[..., Any],
    tolerance: float,
    breaches: Breaches,
) -> None:
    """Note where an overridden integral differs from the base class's quadrature."""
    base = TraversabilityDistribution
    integrals: dict[str, tuple[float, ...]] = {
        "mean": (),
        "cvar": (_LEVEL,),
        "expected_time": (_FLOOR,),
        "time_cvar": (_LEVEL, _FLOOR),
    }
    for name, arguments in integrals.items():
        integral = evaluate(name, *arguments)
        by_quadrature = getattr(base, name)
        is_inherited = getattr(type(distribution), name) is by_quadrature
        if integral is NOTHING or is_inherited:
            continue
        expected = by_quadrature(distribution, *arguments)
        scale = expected.clamp(min=1)
        error = (integral - expected).abs() / scale
        breaches.expect(
            bool(error.max() <= tolerance),
            f"Expected `{name}` to agree with `cdf` and `quantile`, got different "
            "values.",
        )


def _ascend(maps: list[Tensor], tolerance: float) -> bool:
    for first, second in pairwise(maps):
        ascends = second >= first - tolerance
        if not bool(ascends.all()):
            return False
    return True
