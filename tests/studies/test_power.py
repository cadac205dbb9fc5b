"""Power of a study's hypotheses."""

import numpy as np
import pytest
from scipy.stats import norm

from studies import power
from studies.power import power_of


@pytest.mark.parametrize(
    ("kind", "direction", "margin", "true"),
    [
        ("difference", "higher", 0.0, 2.0),
        ("difference", "lower", 0.0, -2.0),
        ("superiority", "higher", 5.0, 8.0),
        ("non-inferiority", "higher", 3.0, 0.0),
        ("non-inferiority", "lower", 3.0, 1.0),
        ("equivalence", "", 3.0, 0.0),
        ("equivalence", "", 3.0, 1.0),
    ],
)
def test_power_is_the_share_of_studies_that_support_it(
    kind: str, direction: str, margin: float, true: float
) -> None:
    error, alpha = 1.2, 0.05
    z = norm.ppf(1 - alpha)
    found = np.random.default_rng(0).normal(true, error, 200_000)
    low, high = found - z * error, found + z * error
    if direction == "lower":
        low, high = -high, -low
    supported = {
        "difference": low > 0,
        "superiority": low > margin,
        "non-inferiority": low > -margin,
        "equivalence": (low > -margin) & (high < margin),
    }[kind]
    row = {"kind": kind, "direction": direction, "margin": margin}
    assert power_of(row, error, alpha, true) == pytest.approx(
        supported.mean(), abs=0.005
    )


def test_power_is_of_the_maps_that_the_study_confirms_on() -> None:
    row = {
        "claim": "it pays",
        "kind": "difference",
        "direction": "higher",
        "margin": 0.0,
        "difference": 3.0,
    }
    row |= {"n_maps": 100, "low": 3 - 1.96 * 3, "high": 3 + 1.96 * 3}
    # A standard error of 3 over 100 maps is one of 1.5 over 400.
    first, last = (
        norm.cdf(3 / 1.5 - norm.ppf(1 - alpha)) for alpha in (0.05 / 4, 0.05)
    )
    cells = list(power._row(row, 4, 400).values())
    assert cells[:4] == [
        "it pays",
        "+3.00 (-2.9 to +8.9)",
        f"{first:.2f} to {last:.2f}",
        "–",
    ]
