"""The contract of distributions of traversability, tried on what a model predicts.

Letters in shapes: B maps, H×W cells.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from benchnav.core.distribution import TraversabilityDistribution
from benchnav.testing.breaches import NOTHING, Breaches

_VALUES = (
    0.0,
    0.01,
    0.05,
    0.1,
    0.2,
    0.3,
    0.4,
    0.5,
    0.6,
    0.7,
    0.8,
    0.9,
    0.95,
    0.99,
    1.0,
)
_PROBABILITIES = (0.0, 0.01, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.99, 1.0)
_LEVEL, _FLOOR = 0.9, 0.05  # of the CVaR and the expected time that are compared
# times the tolerance, within which the exact forms and those of the base are to be
_QUADRATURE = 10


def check_functions(
    distribution: TraversabilityDistribution, tolerance: float, breaches: Breaches
) -> None:
    """Tells where a distribution's functions are not those of a distribution on [0, 1],
    or not of each other.

    Args:
        distribution: of shape [B, H, W].
        tolerance: by how much λ and probabilities may be off.
        breaches: where what is wrong is noted.
    """
    expect, own = (
        breaches.expect,
        distribution.select(torch.tensor([0], device=distribution.device)),
    )
    like = torch.zeros(1, dtype=own.dtype, device=own.device)

    def ask(name: str, *arguments: Any) -> Any:
        """What a method gives, or `NOTHING` where that is of no use."""
        answer = breaches.watch(name, lambda: getattr(own, name)(*arguments))
        is_map = breaches.is_tensor(
            f"what `{name}` of the distribution gives", like, own.shape
        )
        return answer if answer is not NOTHING and is_map(answer) else NOTHING

    shares = [ask("cdf", value) for value in (-tolerance, *_VALUES)]
    values = [ask("quantile", probability) for probability in _PROBABILITIES]
    if any(answer is NOTHING for answer in (*shares, *values)):
        return
    expect(
        _ascend(shares, tolerance)
        and bool((shares[0] == 0).all())
        and bool((shares[-1] == 1).all()),
        "Expected `cdf` to ascend from 0 under λ = 0 to 1 at λ = 1, got another.",
    )
    expect(
        _ascend(values, 0)
        and bool((values[0] >= 0).all())
        and bool((values[-1] <= 1).all()),
        "Expected `quantile` to ascend within [0, 1], got another.",
    )
    for value, probability in zip(values, _PROBABILITIES, strict=True):
        under, over = (
            own.cdf(value - tolerance).double(),
            own.cdf(value + tolerance).double(),
        )
        expect(
            bool(
                (
                    (under <= probability + tolerance)
                    & (over >= probability - tolerance)
                ).all()
            ),
            "Expected `quantile` to be the inverse of `cdf`, got another.",
        )
    if type(own).cdf_limits is not TraversabilityDistribution.cdf_limits:
        for value, share in zip(_VALUES, shares[1:], strict=True):
            lower, upper = own.cdf_limits(value)
            least = own.cdf(value - tolerance) - tolerance
            expect(
                bool(
                    (
                        (least <= lower)
                        & (lower <= upper)
                        & ((upper - share).abs() <= tolerance)
                    ).all()
                ),
                "Expected `cdf_limits` to be P(λ < value) and `cdf`, got others.",
            )
    _check_integrals(own, ask, _QUADRATURE * tolerance, breaches)


def _check_integrals(
    own: TraversabilityDistribution,
    ask: Callable[..., Any],
    tolerance: float,
    breaches: Breaches,
) -> None:
    """Tells where what a class gives in place of the base's integrals is something
    else.
    """
    base = TraversabilityDistribution
    for name, arguments in (
        ("mean", ()),
        ("cvar", (_LEVEL,)),
        ("expected_time", (_FLOOR,)),
        ("time_cvar", (_LEVEL, _FLOOR)),
    ):
        found = ask(name, *arguments)
        if found is NOTHING or getattr(type(own), name) is getattr(base, name):
            continue
        wanted = getattr(base, name)(own, *arguments)
        off = ((found - wanted).abs() / wanted.clamp(min=1)).max()
        breaches.expect(
            bool(off <= tolerance),
            f"Expected `{name}` to be what `cdf` and `quantile` make of it, got "
            "another.",
        )


def _ascend(maps: list[Tensor], slack: float) -> bool:
    return all(
        bool((second >= first - slack).all()) for first, second in pairwise(maps)
    )
