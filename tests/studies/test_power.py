"""Power of a study's hypotheses."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.stats import norm

from studies import power
from studies.power import power_of
from studies.study import Study, Work


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
    assert power_of(row, error, alpha, true) == pytest.approx(supported.mean(), abs=0.005)


def test_power_is_of_the_maps_that_the_study_confirms_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    row = {
        "claim": "it pays",
        "kind": "difference",
        "direction": "higher",
        "margin": 0.0,
        "difference": 3.0,
        "n_maps": 100,
    }
    tests = pd.DataFrame([{**row, "low": 3 - 1.96 * 3, "high": 3 + 1.96 * 3}] * 4)

    class Read:
        def __init__(self, folder: Path) -> None:
            assert folder == tmp_path / "knowledge-developed"
            self.tests = tests

    monkeypatch.setattr(power, "read_report", Read)
    # A standard error of 3 over 100 maps is one of 1.5 over 400.
    first, last = (norm.cdf(3 / 1.5 - norm.ppf(1 - alpha)) for alpha in (0.05 / 4, 0.05))
    told = power.power(Study.load("knowledge"), Work(out=tmp_path, maps_in=tmp_path, maps=60))
    assert f"| 1 | it pays | +3.00 (-2.9 to +8.9) | {first:.2f} to {last:.2f} | – |" in told
