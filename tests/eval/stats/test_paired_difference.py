import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import PermutationMethod, binomtest, permutation_test, t, ttest_1samp, wilcoxon

from benchnav.eval.stats.paired_difference import (
    by_map,
    maps_needed,
    mean_interval,
    sign_flip_p,
    signed_rank_p,
    smallest_difference,
    standard_deviation,
    success_interval,
    total_time_interval,
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
    squares, sizes = 3**2 + 1 + 2**2 + 1 + 1, 3 + 1 + 2 + 1 + 1  # in thirds
    c = (squares / 9 / 8 + 0.01) / (sizes / 3 / 8 + 0.01)
    shares = np.append(gain[0] / 3, [c, -c])
    half = t.ppf(0.975, 7) * shares.std() / 10**0.5
    assert (low[0], high[0]) == pytest.approx((shares.mean() - half, shares.mean() + half))
    wide = success_interval(gain, 3, confidence=0.99)
    assert np.all(wide[1] < low)
    assert np.all(wide[2] > high)


def test_a_difference_of_unequal_maps_is_a_ratio_of_sums() -> None:
    """By hand: 1, 2 and 6 episodes on three maps, of which 1, 0 and 3 more succeeded."""
    gain, episodes = np.array([1, 0, 3]), np.array([1, 2, 6])
    mean, low, high = success_interval(gain, episodes)
    size, share = episodes / 3, gain / 3
    c = ((1 / 1 + 9 / 6) / 9 + 0.01) / (4 / 9 + 0.01)
    added = ((size**2).mean()) ** 0.5
    size, share = np.append(size, [added, added]), np.append(share, [added * c, -added * c])
    centre = share.sum() / size.sum()
    half = t.ppf(0.975, 2) * (((share - centre * size) ** 2).sum()) ** 0.5 / size.sum()
    assert (mean, low, high) == pytest.approx((4 / 9, max(centre - half, -1), min(centre + half, 1)))


@pytest.mark.parametrize("sizes", [[20] * 5, [10, 10, 20, 20, 40]])
def test_the_difference_of_few_large_groups_is_covered(sizes: list[int]) -> None:
    """Rates 0.99 and 0.90 with a correlation of 0.3 within a group; pseudo-maps of ±1/m cover 72 %."""
    generator = np.random.default_rng(0)
    wins = [
        generator.binomial(sizes, generator.beta(rate * 7 / 3, (1 - rate) * 7 / 3, (600, 5)))
        for rate in (0.99, 0.9)
    ]
    _, low, high = success_interval(wins[0] - wins[1], np.array(sizes))
    assert np.isfinite([low, high]).all()
    assert np.mean((low <= 0.09) & (high >= 0.09)) > 0.93
    if len(set(sizes)) > 1:
        return
    error = ((wins[0] - wins[1]) / 20).std(1, ddof=1) / 5**0.5
    assert (high - low).mean() / 2 < 1.7 * t.ppf(0.975, 4) * error.mean()


def test_two_conditions_that_ended_alike_everywhere_may_still_differ() -> None:
    mean, low, high = success_interval(np.zeros(50, dtype=int), 1)
    assert (mean, low) == (0, pytest.approx(-high))
    assert 0.04 < high < 0.1


def test_an_interval_ends_at_one() -> None:
    mean, _, high = success_interval(np.ones(4, dtype=int), 1)
    assert (mean, high) == (1, 1)


def test_mean_interval_is_students() -> None:
    values = np.random.default_rng(0).normal(5.0, 2.0, (3, 12))
    for confidence in (0.95, 0.9):
        expected = ttest_1samp(values, 0, axis=1).confidence_interval(confidence)
        mean, low, high = mean_interval(values, confidence)
        np.testing.assert_allclose(mean, values.mean(1))
        np.testing.assert_allclose((low, high), (expected.low, expected.high))


def test_seven_maps_and_none_have_no_interval_of_a_mean() -> None:
    mean, low, high = mean_interval(np.arange(7.0))
    assert mean == 3
    assert np.isnan([low, high]).all()
    assert np.isfinite(mean_interval(np.arange(8.0))).all()
    assert np.isnan(mean_interval(np.empty(0))).all()


def test_total_time_is_put_together_of_failures_and_of_time_without_them() -> None:
    """By hand: ten maps, two of which fail at 100 s; those that arrive take 30 or 40 s."""
    times = np.array([30.0, 40, 30, 40, 30, 40, 30, 40, 100, 100])
    failed = times == 100
    mean, low, high = total_time_interval(times, 1.0 * failed, (0.05, 0.5), 65.0, 8)
    without = np.array([30.0, 40, 30, 40, 30, 40, 30, 40, 35, 35])
    half = t.ppf(0.975, 7) * without.std(ddof=1) / 10**0.5
    assert mean == 48
    assert low == pytest.approx(48 - (half**2 + (65 * 0.15) ** 2) ** 0.5)
    assert high == pytest.approx(48 + (half**2 + (65 * 0.3) ** 2) ** 0.5)
    narrow = total_time_interval(times, 1.0 * failed, (0.05, 0.5), 65.0, 8, confidence=0.5)
    assert low < narrow[1] < narrow[2] < high


def test_by_map_has_the_mean_of_all_and_that_of_each_map_where_they_are_alike() -> None:
    values = np.array([1.0, 3, 5, 7, 9, 20])
    np.testing.assert_allclose(by_map(values, np.array([4, 2, 2, 4, 7, 7])), [4, 4, 14.5])
    found = by_map(values, np.array([0, 0, 0, 0, 1, 2]))
    assert found.mean() == pytest.approx(values.mean())
    # Contribution of the first map: 4 values, 14 under 4 times the mean of 7.5, where a map has 2 on average.
    assert found[0] == pytest.approx(7.5 + (16 - 4 * 7.5) / 2)


def test_one_sided_sign_flips_are_counted_to_their_own_side() -> None:
    gain = np.array([2, 1, -1, 3, 0, 1])
    signs = np.array(np.meshgrid(*[[-1, 1]] * 6)).reshape(6, -1)
    sums = np.abs(gain) @ signs
    assert sign_flip_p(gain, "higher") == pytest.approx(np.mean(sums >= 6))
    assert sign_flip_p(gain, "lower") == pytest.approx(np.mean(sums <= 6))


def test_time_is_tested_by_ranks() -> None:
    assert signed_rank_p(np.zeros(9)) == 1
    # Those that are 0 count for nothing, be the rest few or many.
    many = np.random.default_rng(0).permutation(np.arange(-9.0, 25.0))
    many = many[many != 0]
    assert signed_rank_p(np.append(many, np.zeros(5))) == signed_rank_p(many) == wilcoxon(many).pvalue
    # All eight differences have one sign: 2 of 2^8 ways are as far out.
    assert signed_rank_p(np.arange(1.0, 9.0)) == pytest.approx(2 / 2**8)


@pytest.mark.parametrize("maps", [2, 5, 9, 13, 14, 40, 60])
def test_ranks_are_tested_as_scipy_does(maps: int) -> None:
    chance = np.random.default_rng(maps)
    for values in (chance.normal(0.3, 1, maps), chance.integers(-2, 4, maps), chance.integers(0, 3, maps)):
        if np.count_nonzero(values) < 2:
            continue
        expected = wilcoxon(
            values[values != 0], method=PermutationMethod(n_resamples=np.inf) if maps < 10 else "auto"
        ).pvalue
        assert signed_rank_p(values.astype(float)) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("alpha", [0.05, 0.05 / 15])
def test_the_smallest_difference_is_shown_in_four_of_five_studies(alpha: float) -> None:
    # A quarter of 200 maps end differently; the test used is the one of the tables.
    difference = smallest_difference(0.5, 200, alpha)
    generator = np.random.default_rng(0)
    chances = [(0.25 + difference) / 2, 0.75, (0.25 - difference) / 2]
    studies = generator.choice([1, 0, -1], size=(1500, 200), p=chances)
    shown = np.mean([sign_flip_p(gain) < alpha for gain in studies])
    # McNemar's test is discrete, and shows a little less than its level allows.
    assert 0.72 < shown < 0.83


def test_maps_needed_are_those_that_show_the_difference() -> None:
    for difference in (0.02, 0.05, 0.2):
        maps = maps_needed(0.5, difference, 0.01)
        assert smallest_difference(0.5, maps, 0.01) <= difference < smallest_difference(0.5, maps - 1, 0.01)


def test_more_maps_are_needed_for_more_power_and_less_chance() -> None:
    usual = maps_needed(0.4, 0.1, 0.05)
    assert usual == 126  # (1.95996 + 0.84162)² · 16
    assert maps_needed(0.4, 0.1, 0.005) > usual


def test_spread_is_never_nothing() -> None:
    assert standard_deviation(np.zeros(30, dtype=int), 3) > 0


def test_where_no_result_would_be_significant_nothing_is_detected() -> None:
    """Of M maps the least p of a sign-flip test is 2 of 2^M."""
    assert smallest_difference(0.1, 5, 0.05) == math.inf
    assert smallest_difference(0.1, 6, 0.05) < 1
    assert smallest_difference(0.1, 6, 0.05 / 3) == math.inf
