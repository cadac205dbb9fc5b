import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest, norm, permutation_test, t

from benchnav.eval.stats.difference import (
    mean_interval,
    sign_flip_p,
    signed_rank_p,
    standard_deviation,
    success_interval,
)


@given(st.integers(0, 40), st.integers(0, 40), st.integers(0, 200))
def test_one_episode_a_map_is_the_exact_test_of_mcnemar(won: int, lost: int, alike: int) -> None:
    gain = np.array([1] * won + [-1] * lost + [0] * alike, dtype=int)
    expected = binomtest(won, won + lost).pvalue if won + lost else 1.0
    assert sign_flip_p(gain) == pytest.approx(expected, rel=1e-9)


@given(st.lists(st.integers(-3, 3), min_size=2, max_size=12))
def test_several_episodes_a_map_are_flipped_in_all_ways(gain: list[int]) -> None:
    signs = np.array(np.meshgrid(*[[-1, 1]] * len(gain))).reshape(len(gain), -1)
    sums = np.abs(gain) @ signs
    assert sign_flip_p(np.array(gain)) == pytest.approx(np.mean(np.abs(sums) >= abs(sum(gain))), rel=1e-9)


def test_sign_flips_agree_with_scipy_on_many_maps() -> None:
    gain = np.random.default_rng(0).binomial(3, 0.6, 80) - np.random.default_rng(1).binomial(3, 0.5, 80)
    drawn = permutation_test((gain,), np.sum, permutation_type="samples", n_resamples=20_000, rng=2)
    assert sign_flip_p(gain) == pytest.approx(drawn.pvalue, abs=4 * (drawn.pvalue / 20_000) ** 0.5)


def test_difference_with_one_episode_a_map_is_that_of_bonett_and_price() -> None:
    # Their formula, on 30 maps of which 8 were won and 3 lost.
    won, lost, maps = (8 + 1) / 32, (3 + 1) / 32, 32
    half = t.ppf(0.975, 29) * ((won + lost - (won - lost) ** 2) / maps) ** 0.5
    gain = np.array([1] * 8 + [-1] * 3 + [0] * 19)
    mean, low, high = success_interval(gain, 1)
    assert mean == pytest.approx(5 / 30)
    assert (low, high) == pytest.approx((won - lost - half, won - lost + half))
    assert standard_deviation(gain, 1) == pytest.approx((won + lost - (won - lost) ** 2) ** 0.5)


def test_difference_takes_episodes_a_map_into_account() -> None:
    gain = np.array([[3, 0, -1, 2, 0, 0, 1, 1], [1, 1, 1, 1, 1, 1, 1, 1]])
    mean, low, high = success_interval(gain, 3)
    assert mean == pytest.approx(gain.mean(1) / 3)
    shares = np.append(gain[0] / 3, [1 / 3, -1 / 3])
    half = t.ppf(0.975, 7) * shares.std() / 10**0.5
    assert (low[0], high[0]) == pytest.approx((shares.mean() - half, shares.mean() + half))
    wide = success_interval(gain, 3, confidence=0.99)
    assert np.all(wide[1] < low)
    assert np.all(wide[2] > high)


def test_two_trials_that_ended_alike_everywhere_may_still_differ() -> None:
    mean, low, high = success_interval(np.zeros(50, dtype=int), 1)
    assert (mean, low) == (0, pytest.approx(-high))
    assert 0.04 < high < 0.1


def test_an_interval_ends_at_one() -> None:
    mean, _, high = success_interval(np.ones(4, dtype=int), 1)
    assert (mean, high) == (1, 1)


def test_mean_interval_is_near_that_of_normal_theory() -> None:
    values = np.random.default_rng(0).normal(5.0, 2.0, (3, 400))
    mean, low, high = mean_interval(values)
    half = norm.ppf(0.975) * values.std(1) / 20
    np.testing.assert_allclose(mean, values.mean(1))
    np.testing.assert_allclose(low, mean - half, atol=0.03)
    np.testing.assert_allclose(high, mean + half, atol=0.03)
    assert mean_interval(values, confidence=0.5)[1][0] > low[0]


def test_mean_interval_of_skewed_times_leans_the_right_way() -> None:
    values = np.random.default_rng(1).lognormal(0, 1.2, 60)
    mean, low, high = mean_interval(values)
    assert high - mean > 1.2 * (mean - low)


def test_mean_interval_where_nothing_can_be_resampled() -> None:
    _, low, high = mean_interval(np.array([[4.0], [5.0]]))
    assert np.isnan([low, high]).all()
    mean, low, high = mean_interval(np.array([[2.0, 2.0, 2.0], [1.0, 2.0, 6.0]]))
    assert (mean[0], low[0], high[0]) == (2, 2, 2)
    assert low[1] < mean[1] < high[1]


def test_a_row_has_its_interval_whatever_stands_beside_it() -> None:
    values = np.random.default_rng(3).exponential(1.0, (4, 50))
    assert mean_interval(values)[1][2] == pytest.approx(float(mean_interval(values[2])[1]))


def test_time_is_tested_by_ranks() -> None:
    assert signed_rank_p(np.zeros(9)) == 1
    # All eight differences have one sign: 2 of 2^8 ways are as far out.
    assert signed_rank_p(np.arange(1.0, 9.0)) == pytest.approx(2 / 2**8)
