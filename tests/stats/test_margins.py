import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ttest_1samp

from benchnav.stats.intervals import mean_interval
from benchnav.stats.margins import margin_p


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 2))
def test_margins_are_tested_as_two_one_sided_t_tests(seed: int, margin: float) -> None:
    values = np.random.default_rng(seed).normal(0.1, 1, 12)

    def interval(confidence: float) -> tuple[float, float, float]:
        mean, low, high = map(float, mean_interval(values, confidence))
        return mean, low, high

    above, below = (
        float(ttest_1samp(values, bound, alternative=side).pvalue)
        for bound, side in ((-margin, "greater"), (margin, "less"))
    )
    assert margin_p(interval, "equivalence", "", margin) == pytest.approx(
        max(above, below), rel=1e-4
    )
    assert margin_p(interval, "non-inferiority", "higher", margin) == pytest.approx(
        above, rel=1e-4
    )
    assert margin_p(interval, "non-inferiority", "lower", margin) == pytest.approx(
        below, rel=1e-4
    )
    superior = float(ttest_1samp(values, margin, alternative="greater").pvalue)
    assert margin_p(interval, "superiority", "higher", margin) == pytest.approx(
        superior, rel=1e-4
    )


def test_without_an_interval_nothing_is_supported() -> None:
    assert margin_p(lambda _: (0.0, np.nan, np.nan), "equivalence", "", 1.0) == 1
