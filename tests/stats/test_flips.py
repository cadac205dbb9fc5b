from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import PermutationMethod, binomtest, permutation_test, wilcoxon

from benchnav.stats.flips import exchange_p, mean_flip_p, sign_flip_p, signed_rank_p


@given(st.integers(0, 40), st.integers(0, 40), st.integers(0, 200))
def test_one_episode_a_map_is_the_exact_test_of_mcnemar(
    won: int, lost: int, alike: int
) -> None:
    gain = np.array([1] * won + [-1] * lost + [0] * alike, dtype=int)
    expected = binomtest(won, won + lost).pvalue if won + lost else 1.0
    assert sign_flip_p(gain) == pytest.approx(expected, rel=1e-9)


def test_sign_flips_agree_with_scipy_on_many_maps() -> None:
    gain = np.random.default_rng(0).binomial(3, 0.6, 80) - np.random.default_rng(
        1
    ).binomial(3, 0.5, 80)
    drawn = permutation_test(
        (gain,), np.sum, permutation_type="samples", n_resamples=20_000, rng=2
    )
    assert sign_flip_p(gain) == pytest.approx(
        drawn.pvalue, abs=4 * (drawn.pvalue / 20_000) ** 0.5
    )


def test_time_is_tested_by_ranks() -> None:
    assert signed_rank_p(np.zeros(9)) == 1
    # Those that are 0 count for nothing, be the rest few or many.
    many = np.random.default_rng(0).permutation(np.arange(-9.0, 25.0))
    many = many[many != 0]
    assert (
        signed_rank_p(np.append(many, np.zeros(5)))
        == signed_rank_p(many)
        == wilcoxon(many).pvalue
    )
    # All eight differences have one sign: 2 of 2^8 ways are as far out.
    assert signed_rank_p(np.arange(1.0, 9.0)) == pytest.approx(2 / 2**8)


@pytest.mark.parametrize("maps", [2, 5, 9, 13, 14, 40, 60])
def test_ranks_are_tested_as_scipy_does(maps: int) -> None:
    chance = np.random.default_rng(maps)
    for values in (
        chance.normal(0.3, 1, maps),
        chance.integers(-2, 4, maps),
        chance.integers(0, 3, maps),
    ):
        if np.count_nonzero(values) < 2:
            continue
        expected = wilcoxon(
            values[values != 0],
            method=PermutationMethod(n_resamples=np.inf) if maps < 10 else "auto",
        ).pvalue
        assert signed_rank_p(values.astype(float)) == pytest.approx(expected, rel=1e-9)


@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.sampled_from([1, 3]))
def test_p_does_not_depend_on_the_order_of_maps_on_maps_that_agree_or_on_which_is_first(
    seed: int, maps: int, parts: int
) -> None:
    generator = np.random.default_rng(seed)
    one, other = generator.integers(0, 5, (2, maps, parts)).astype(float)

    def difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return abs(a.prod(-1) - 9) - abs(b.prod(-1) - 9)

    p = exchange_p(one, other, difference)
    order = generator.permutation(maps)
    assert exchange_p(one[order], other[order], difference) == p
    assert exchange_p(other, one, difference) == p
    gains = (one - other)[:, 0]
    for direction, opposite in (("", ""), ("higher", "lower")):
        p = mean_flip_p(gains, direction)
        assert mean_flip_p(gains[order], direction) == p
        assert mean_flip_p(np.append(gains, [0, 0]), direction) == p
        assert mean_flip_p(3 * gains, direction) == p
        assert mean_flip_p(-gains, opposite) == p


def test_a_mean_over_many_maps_agrees_with_scipy_and_is_never_0() -> None:
    gains = np.random.default_rng(3).normal(0.3, 1, 40)
    drawn = permutation_test(
        (gains,), np.sum, permutation_type="samples", n_resamples=20_000, rng=4
    )
    assert mean_flip_p(gains) == pytest.approx(
        drawn.pvalue, abs=6 * (drawn.pvalue / 10_000) ** 0.5
    )
    assert mean_flip_p(gains + 9) == 1 / 10_000
    assert mean_flip_p(np.zeros(20)) == mean_flip_p(np.empty(0)) == 1


@given(
    st.lists(st.integers(-3, 3), min_size=1, max_size=10),
    st.sampled_from(["", "higher", "lower"]),
)
def test_signs_are_flipped_in_all_ways(gain: list[int], direction: str) -> None:
    sums = np.array(list(product((-1, 1), repeat=len(gain)))) @ gain
    observed = sum(gain)
    far = {"higher": sums >= observed, "lower": sums <= observed}.get(
        direction, abs(sums) >= abs(observed)
    )
    assert sign_flip_p(np.array(gain), direction) == pytest.approx(far.mean(), rel=1e-9)
    assert mean_flip_p(np.array(gain) / 8, direction) == far.mean()
