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

# Largest confidence in the search for p.
_MAX = 1 - 1e-12


def margin_p(
    interval: Callable[[float], tuple[float, float, float]],
    kind: str,
    direction: str,
    margin: float,
) -> float:
    """Return the p-value of a hypothesis with a margin; 1 if there is no interval.

    Args:
        interval: function that takes the confidence, and returns the difference and the
            ends of its interval.
        kind: `non-inferiority`, `superiority` or `equivalence`.
        direction: the better direction, `higher` or `lower`; empty for equivalence.
        margin: above 0, in the unit of the difference.
    """
    sides = {"higher": [-1.0], "lower": [1.0]}.get(direction, [-1.0, 1.0])
    bound = -margin if kind == "superiority" else margin
    return max(_side_p(interval, bound, side) for side in sides)


def _side_p(
    interval: Callable[[float], tuple[float, float, float]], margin: float, side: float
) -> float:
    """Return the p-value of H₀: the difference is beyond the margin on one side.

    Beyond means below −margin (side −1) or above margin (side 1). p is the level at
    which the end of the one-sided interval equals the margin.
    """

    def end(signed: float) -> float:
        """Return the end on the margin's side, or the opposite end if `signed` < 0."""
        _, low, high = interval(abs(signed))
        is_upper = (side > 0) == (signed >= 0)
        value = high if is_upper else low
        return side * value

    def excess(signed: float) -> float:
        return end(signed) - margin

    if np.isnan(end(0.5)):
        return 1.0
    if end(_MAX) < margin:
        return (1 - _MAX) / 2
    if end(-_MAX) > margin:
        return 1.0
    signed = float(brentq(excess, -_MAX, _MAX))
    return (1 - signed) / 2
