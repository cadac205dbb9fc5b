import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from benchnav.core import rng


@given(st.lists(st.integers(0, 500), min_size=1, max_size=20), st.integers(1, 9))
@settings(deadline=None)
def test_an_element_is_the_same_in_any_batch_and_order(
    indices: list[int], count: int
) -> None:
    key = rng.stream_key(3, "a")
    batch = rng.random_bits(key, np.array(indices), count)
    for row, index in zip(batch, indices, strict=True):
        np.testing.assert_array_equal(
            row, rng.random_bits(key, np.array([index]), count)[0]
        )


def test_elements_and_streams_share_no_words() -> None:
    one = rng.random_bits(rng.stream_key(0, "a"), np.arange(50), 6)
    other = rng.random_bits(rng.stream_key(0, "b"), np.arange(50), 6)
    assert len(np.unique(np.concatenate((one, other)))) == 2 * 50 * 6


def test_names_are_not_confused_by_joining() -> None:
    keys = {
        rng.stream_key(0, *names)
        for names in (("ab", "c"), ("a", "bc"), ("abc",), ("a", "b", "c"), ("1",), (1,))
    }
    assert len(keys) == 6
    assert rng.stream_key(0, "a") != rng.stream_key(1, "a")


def test_transforms_have_their_distributions() -> None:
    key = rng.stream_key(1, "x")
    assert (
        stats.kstest(rng.normal(key, np.arange(200), (100,)).ravel(), "norm").pvalue
        > 1e-3
    )
    assert (
        stats.kstest(rng.uniform(key, np.arange(200), (100,)).ravel(), "uniform").pvalue
        > 1e-3
    )
    orders = rng.permutation(key, np.arange(6000), 3)
    _, counts = np.unique(orders, axis=0, return_counts=True)
    assert len(counts) == 6
    assert stats.chisquare(counts).pvalue > 1e-3


def test_numpys_bit_generator_has_not_changed() -> None:
    assert rng.random_bits(7, np.array([2]), 2)[0].tolist() == [
        260241063655440860,
        14515071666965347364,
    ]


@given(seed=st.integers(0, 2**63), count=st.integers(1, 9))
def test_many_streams_at_once_are_the_same_streams(seed: int, count: int) -> None:
    draw = np.random.default_rng(seed)
    keys = [rng.stream_key(seed, place) for place in range(4)]
    stream, indices = draw.integers(0, 4, 12), draw.integers(0, 2**40, 12)
    found = rng.normal_of_each(keys, stream, indices, count)
    one_by_one = [
        rng.normal(keys[own], np.array([i]), (count,))
        for own, i in zip(stream, indices, strict=True)
    ]
    assert np.array_equal(found, np.concatenate(one_by_one))
    assert rng.normal_of_each(keys, stream[:0], indices[:0], count).shape == (0, count)
