import numpy as np

from benchnav.core.resampling import bootstrap_counts, sign_flips


def test_signs_are_flipped_in_all_ways_or_in_as_many_as_are_drawn() -> None:
    assert len(np.unique(sign_flips(5), axis=0)) == 2**5
    many = sign_flips(40)
    assert many.shape == (10_000, 40)
    assert set(np.unique(many)) == {-1, 1}
    assert (many[0] == 1).all()  # as they were seen is one of the ways
    assert abs(many[1:].mean()) < 0.01
    np.testing.assert_array_equal(many, sign_flips(40))


def test_each_sample_of_the_bootstrap_has_as_many_maps_drawn_with_replacement() -> None:
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
    assert not counts.flags.writeable  # the same for all who ask
