import numpy as np
import pytest
from scipy.stats import bootstrap

from benchnav.stats.bootstrap import bootstrap_counts, percentile_interval


def test_each_sample_has_as_many_maps_drawn_with_replacement() -> None:
    counts = bootstrap_counts(20)
    assert counts.shape == (2000, 20)
    assert (counts.sum(1) == 20).all()
    # How often a map is in a sample is binomial, of variance 1 − 1/20.
    assert abs(counts.mean(0) - 1).max() < 0.1
    assert abs(counts.var() - 0.95) < 0.05


def test_pseudo_maps_are_drawn_as_often_as_maps() -> None:
    counts = bootstrap_counts(20, 4)
    assert counts.shape == (2000, 24)
    assert (counts.sum(1) == 20).all()
    assert abs(counts[:, 20:].mean() - 20 / 24) < 0.03
    assert not counts.flags.writeable  # the same for all callers


def test_the_interval_is_scipys() -> None:
    values = np.random.default_rng(2).random(25)
    exact = bootstrap(
        (values,),
        np.mean,
        method="percentile",
        n_resamples=9_999,
        rng=np.random.default_rng(0),
    ).confidence_interval
    found = percentile_interval(bootstrap_counts(25) @ values / 25)
    assert found == pytest.approx((exact.low, exact.high), abs=0.01)
    assert np.isnan(percentile_interval(np.array([1.0, np.nan]))).all()
