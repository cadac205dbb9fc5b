import numpy as np
import pytest
from scipy import stats

from benchnav.core import rng
from benchnav.core.copula import correlated_normal, correlations

KEY = rng.stream_key(0, "noise")
DRAWS = 3000


@pytest.mark.parametrize("length", [0.0, 0.5, 2.0, 6.0])
def test_every_cell_is_standard_normal(length: float) -> None:
    field = correlated_normal(KEY, np.arange(DRAWS), (24, 26), length)
    assert field.shape == (DRAWS, 24, 26)
    for row, column in ((0, 0), (23, 25), (12, 7), (0, 25)):
        assert stats.kstest(field[:, row, column], "norm").pvalue > 1e-3
    assert abs(field.std(axis=0) - 1).max() < 5 / np.sqrt(2 * DRAWS)


@pytest.mark.parametrize("length", [1.0, 2.0, 3.5, 6.0])
def test_the_correlation_is_the_bell_of_the_distance(length: float) -> None:
    field = correlated_normal(KEY, np.arange(DRAWS), (24, 30), length)
    for down, across in (
        (0, 1),
        (1, 0),
        (2, 0),
        (0, 3),
        (3, 4),
        (0, 12),
        (12, 0),
        (23, 0),
        (0, 29),
        (23, 29),
    ):
        here, there = field[:, : 24 - down, : 30 - across], field[:, down:, across:]
        found = (here * there).mean()
        # The last lags are those of opposite edges: no torus.
        assert found == pytest.approx(
            np.exp(-(down**2 + across**2) / (2 * length**2)), abs=0.03
        )


@pytest.mark.parametrize("length", [1.0, 2.0, 4.0, 6.0])
def test_a_matern_field_has_its_correlation_and_that_of_the_bell_at_the_length(
    length: float,
) -> None:
    field = correlated_normal(KEY, np.arange(DRAWS), (24, 30), length, "matern32")
    for row, column in ((0, 0), (23, 29), (12, 7)):
        assert stats.kstest(field[:, row, column], "norm").pvalue > 1e-3
    for down, across in (
        (0, 1),
        (1, 0),
        (2, 0),
        (0, 3),
        (3, 4),
        (0, 6),
        (6, 0),
        (0, 12),
        (23, 0),
        (23, 29),
    ):
        found = (field[:, : 24 - down, : 30 - across] * field[:, down:, across:]).mean()
        away = np.hypot(down, across) / length
        expected = (1 + 1.357677 * away) * np.exp(-1.357677 * away)
        assert found == pytest.approx(expected, abs=0.035)
        if away == 1:
            assert found == pytest.approx(np.exp(-0.5), abs=0.035)


def test_the_kernel_is_the_bell_when_none_is_named_and_filters_the_same_white_noise() -> (
    None
):
    given = KEY, np.arange(3), (12, 14)
    one, named, other = (
        correlated_normal(*given, 2.0, *kernel)
        for kernel in ((), ("gaussian",), ("matern32",))
    )
    np.testing.assert_array_equal(one, named)
    assert 0.8 < np.corrcoef(one.ravel(), other.ravel())[0, 1] < 0.99
    # It is rougher: it bends more from cell to cell.
    assert np.diff(other, 2).std() > 1.4 * np.diff(one, 2).std()
    np.testing.assert_array_equal(
        correlated_normal(*given, 0.0, "matern32"), correlated_normal(*given, 0.0)
    )


def test_at_length_zero_every_cell_is_for_itself() -> None:
    field = correlated_normal(KEY, np.arange(400), (12, 14), 0.0)
    for down, across in ((0, 1), (1, 0), (1, 1)):
        assert (
            abs(
                (field[:, : 12 - down, : 14 - across] * field[:, down:, across:]).mean()
            )
            < 0.02
        )


def test_another_length_filters_the_same_white_noise() -> None:
    shape, indices = (16, 20), np.arange(5)
    white = rng.normal(KEY, indices, (32, 40))
    np.testing.assert_array_equal(
        correlated_normal(KEY, indices, shape, 0.0), white[:, :16, :20]
    )
    for length in (1.0, 3.0):
        # By sums over all cells of the torus, rather than by Fourier transforms.
        down, across = (
            np.minimum(np.arange(n), n - np.arange(n)) for n in white.shape[1:]
        )
        kernel = np.exp(-(down[:, None] ** 2 + across[None] ** 2) / length**2)
        kernel /= np.linalg.norm(kernel)
        expected = sum(
            kernel[i, j] * np.roll(white, (i, j), axis=(1, 2))
            for i in range(32)
            for j in range(40)
        )
        found = correlated_normal(KEY, indices, shape, length)
        np.testing.assert_allclose(found, expected[:, :16, :20], atol=1e-9)


def test_an_element_is_the_same_in_any_batch() -> None:
    whole = correlated_normal(KEY, np.arange(9), (12, 12), 2.0)
    np.testing.assert_array_equal(
        correlated_normal(KEY, np.array([1, 4, 8]), (12, 12), 2.0), whole[[1, 4, 8]]
    )
    assert not np.allclose(whole[0], whole[1])
    other = correlated_normal(rng.stream_key(1, "noise"), np.arange(9), (12, 12), 2.0)
    assert not np.allclose(whole, other)


def test_the_largest_word_gives_no_infinite_noise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ends = np.array([[0, 2**64 - 1]], dtype=np.uint64)
    monkeypatch.setattr(rng, "random_bits", lambda *_: ends)
    assert rng.uniform(KEY, np.arange(1), (2,)).tolist() == [[2.0**-54, 1 - 2.0**-53]]
    assert np.isfinite(rng.normal(KEY, np.arange(1), (2,))).all()


@pytest.mark.parametrize("length", [0.0, 0.4, 1.0, 2.0, 3.0])
def test_the_correlations_told_are_those_of_the_fields_that_are_drawn(
    length: float,
) -> None:
    along = correlations(12, length)
    field = correlated_normal(KEY, np.arange(20_000), (12, 12), length)
    for down, across in ((0, 0), (0, 1), (1, 1), (2, 0), (0, 5), (4, 3)):
        found = (field[:, 0, 0] * field[:, down, across]).mean()
        assert found == pytest.approx(along[down] * along[across], abs=0.03)
    if length >= 2:
        np.testing.assert_allclose(
            along, np.exp(-(np.arange(12) ** 2) / (2 * length**2)), atol=1e-3
        )
    # Of a kernel of few cells it is not the bell.
    if length == 0.4:
        assert along[1] == pytest.approx(
            2 * np.exp(-1 / 0.16) / (1 + 2 * np.exp(-2 / 0.16)), rel=1e-3
        )
