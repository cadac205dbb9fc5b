"""Means of costly values, made more precise by cheap ones."""

import numpy as np
import pytest

from benchnav.core.errors import ConfigError
from benchnav.stats.control_variate import ControlledMean, controlled_mean

COSTLY, OTHER = 30, 270
CORRELATION = 0.8
COVARIANCE = [[1.0, CORRELATION], [CORRELATION, 1.0]]


def drawn(rng: np.random.Generator, n_other: int = OTHER) -> ControlledMean:
    values = rng.multivariate_normal([2.0, -1.0], COVARIANCE, COSTLY + n_other)
    return controlled_mean(values[:COSTLY, 0], values[:COSTLY, 1], values[COSTLY:, 1])


def test_the_estimate_has_its_interval_and_its_variance() -> None:
    rng = np.random.default_rng(0)
    estimates = [drawn(rng) for _ in range(4000)]
    means = np.array([estimate.mean for estimate in estimates])
    covered = [estimate.low <= 2.0 <= estimate.high for estimate in estimates]
    assert np.mean(covered) == pytest.approx(0.95, abs=0.015)
    assert means.mean() == pytest.approx(2.0, abs=0.01)
    # The plain mean of 30 values has variance 1/30.
    expected = 1 - CORRELATION**2 * OTHER / (COSTLY + OTHER)
    assert means.var() * COSTLY == pytest.approx(expected, rel=0.1)
    ratios = [estimate.variance_ratio for estimate in estimates]
    assert np.median(ratios) == pytest.approx(expected, rel=0.1)
    correlations = [estimate.correlation for estimate in estimates]
    assert np.median(correlations) == pytest.approx(CORRELATION, abs=0.02)


def test_without_other_maps_it_is_the_plain_mean() -> None:
    rng = np.random.default_rng(1)
    costly = rng.normal(size=12)
    estimate = controlled_mean(costly, rng.normal(size=12), np.empty(0))
    assert estimate.mean == pytest.approx(costly.mean())
    assert estimate.variance_ratio == pytest.approx(1)


def test_equal_values_give_the_mean_over_all_maps() -> None:
    rng = np.random.default_rng(2)
    values = rng.normal(size=50)
    estimate = controlled_mean(values[:10], values[:10], values[10:])
    assert estimate.mean == pytest.approx(values.mean())
    assert estimate.slope == pytest.approx(1)


@pytest.mark.parametrize("costly", [np.full(6, 3.0), np.arange(6.0)])
def test_cheap_values_that_do_not_vary_change_nothing(costly: np.ndarray) -> None:
    estimate = controlled_mean(costly, np.ones(6), np.ones(9))
    assert estimate.mean == costly.mean()
    assert np.isnan(estimate.correlation)


def test_values_of_different_maps_are_refused() -> None:
    with pytest.raises(ConfigError, match="the same maps, at least 4, got 5 and 6"):
        controlled_mean(np.ones(5), np.ones(6), np.ones(9))
    with pytest.raises(ConfigError, match="at least 4, got 3 and 3"):
        controlled_mean(np.ones(3), np.ones(3), np.ones(9))
