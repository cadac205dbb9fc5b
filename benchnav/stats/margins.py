"""Tests of a difference against a margin: non-inferiority, superiority and equivalence.

Each test compares the ends of the difference's interval with the margin (two one-sided
tests).
Sources: Schuirmann (1987), "A comparison of the two one-sided tests procedure and the
power approach for assessing the equivalence of average bioavailability"; Wellek (2010),
"Testing Statistical Hypotheses of Equivalence and Noninferiority", 1.
"""

from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq

# Maximum confidence in the search for p.
_MAX_CONFIDENCE = 1 - 1e-12


def margin_p(
    interval: Callable[[float], tuple[float, float, float]],
    kind: str,
    direction: str,
    margin: float,
) -> float:
    """Return the p-value of a hypothesis with a margin; 1 if there is no interval.

    Args:
        interval: function of the confidence that returns the difference and the lower
            and upper end of its interval.
        kind: `non-inferiority`, `superiority` or `equivalence`.
        direction: better direction, `higher` or `lower`; empty for equivalence.
        margin: margin > 0, in the unit of the difference.
    """
    sides = {"higher": [-1.0], "lower": [1.0]}.get(direction, [-1.0, 1.0])
    bound = -margin if kind == "superiority" else margin
    return max(_side_p(interval, bound, side) for side in sides)


def _side_p(
    interval: Callable[[float], tuple[float, float, float]], margin: float, side: float
) -> float:
    """Return the p-value of H₀: the difference exceeds the margin on one side.

    The difference is below −margin for side −1, or above margin for side 1. p is the
    level at which the end of the one-sided interval equals the margin.
    """

    def end(signed_confidence: float) -> float:
        """Return the interval's end on the margin's side, times the side.

        A negative confidence means the opposite end.
        """
        _, low, high = interval(abs(signed_confidence))
        is_upper = (side > 0) == (signed_confidence >= 0)
        value = high if is_upper else low
        return side * value

    def excess(signed_confidence: float) -> float:
        return end(signed_confidence) - margin

    if np.isnan(end(0.5)):
        return 1.0
    if end(_MAX_CONFIDENCE) < margin:
        return (1 - _MAX_CONFIDENCE) / 2
    if end(-_MAX_CONFIDENCE) > margin:
        return 1.0
    signed_confidence = float(brentq(excess, -_MAX_CONFIDENCE, _MAX_CONFIDENCE))
    return (1 - signed_confidence) / 2
