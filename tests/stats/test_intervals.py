import numpy as np
import pytest
from scipy.stats import binomtest, norm, t, ttest_1samp

from benchnav.stats.by_map import by_map
from benchnav.stats.intervals import (
    design_effect,
    mean_interval,
    standard_deviation,
    success_interval,
    total_time_interval,
    wilson_interval,
)


def test_difference_with_one_episode_a_map_is_that_of_bonett_and_price() -> None:
    # Their formula, on 30 maps of which 8 were won and 3 lost.
    won, lost, maps = (8 + 1) / 32, (3 + 1) / 32, 32
    half = t.ppf(0.975, 29) * ((won + lost - (won - lost) ** 2) / maps) ** 0.5
    gain = np.array([1] * 8 + [-1] * 3 + [0] * 19)
    mean, low, high = success_interval(gain, 1)
    assert mean == pytest.approx(5 / 30)
    assert (low, high) == pytest.approx((won - lost - half, won - lost + half))
    assert standard_deviation(gain, 1) == pytest.approx(
        (won + lost - (won - lost) ** 2) ** 0.5
    )


def test_difference_takes_episodes_a_map_into_account() -> None:
    gain = np.array([[3, 0, -1, 2, 0, 0, 1, 1], [1, 1, 1, 1, 1, 1, 1, 1]])
    mean, low, high = success_interval(gain, 3)
    assert mean == pytest.approx(gain.mean(1) / 3)
    squares, sizes = 3**2 + 1 + 2**2 + 1 + 1, 3 + 1 + 2 + 1 + 1  # in thirds
    c = (squares / 9 / 8 + 0.01) / (sizes / 3 / 8 + 0.01)
    shares = np.append(gain[0] / 3, [c, -c])
    half = t.ppf(0.975, 7) * shares.std() / 10**0.5
    assert (low[0], high[0]) == pytest.approx(
        (shares.mean() - half, shares.mean() + half)
    )
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
    size, share = (
        np.append(size, [added, added]),
        np.append(share, [added * c, -added * c]),
    )
    centre = share.sum() / size.sum()
    half = t.ppf(0.975, 2) * (((share - centre * size) ** 2).sum()) ** 0.5 / size.sum()
    assert (mean, low, high) == pytest.approx(
        (4 / 9, max(centre - half, -1), min(centre + half, 1))
    )


@pytest.mark.parametrize("sizes", [[20] * 5, [10, 10, 20, 20, 40]])
def test_the_difference_of_few_large_groups_is_covered(sizes: list[int]) -> None:
    """Rates 0.99 and 0.90 with a correlation of 0.3 within a group; pseudo-maps of ±1/m
    cover 72 %.
    """
    generator = np.random.default_rng(0)
    wins = [
        generator.binomial(
            sizes, generator.beta(rate * 7 / 3, (1 - rate) * 7 / 3, (600, 5))
        )
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
    narrow = total_time_interval(
        times, 1.0 * failed, (0.05, 0.5), 65.0, 8, confidence=0.5
    )
    assert low < narrow[1] < narrow[2] < high


@pytest.mark.parametrize(("successes", "n"), [(0, 20), (18, 20), (20, 20), (7, 13)])
def test_wilson_interval_is_scipys(successes: int, n: int) -> None:
    expected = binomtest(successes, n).proportion_ci(0.95, method="wilson")
    assert wilson_interval(successes / n, n) == pytest.approx(
        (expected.low, expected.high), abs=1e-12
    )


def drawn(
    generator: np.random.Generator,
    maps: int,
    each: int,
    correlation: float,
    rate: float,
) -> np.ndarray:
    """Successes, shape [maps, each], from the beta-binomial of a given intra-class
    correlation.
    """
    size = 1 / correlation - 1
    chance = generator.beta(rate * size, (1 - rate) * size, size=maps)
    return generator.random((maps, each)) < chance[:, None]


def effect_of(success: np.ndarray) -> float:
    return design_effect(
        success.ravel(), np.repeat(np.arange(len(success)), success.shape[1])
    )


@pytest.mark.parametrize(("correlation", "each"), [(0.05, 5), (0.3, 5), (0.6, 3)])
def test_design_effect_is_that_of_a_simulation(correlation: float, each: int) -> None:
    generator = np.random.default_rng(1)
    found = [
        effect_of(drawn(generator, 300, each, correlation, 0.8)) for _ in range(60)
    ]
    expected = (1 + (each - 1) * correlation) * 0.16 / each  # variance of a map's rate
    assert np.mean(found) == pytest.approx(each * (expected + 0.01) / 0.17, rel=0.04)


def test_many_maps_have_the_error_of_a_clustered_regression() -> None:
    """Maps with 1, 2 and 9 episodes; statsmodels' variance by cluster is that of the
    ratio estimator.
    """
    generator = np.random.default_rng(2)
    size = np.tile([1, 2, 9], 100)
    success = drawn(generator, len(size), 9, 0.3, 0.7)[np.arange(9) < size[:, None]]
    maps = np.repeat(np.arange(len(size)), size)
    import statsmodels.api as sm  # heavy, as all that tests import where they need it

    fit = sm.OLS(success.astype(float), np.ones(len(success))).fit(
        cov_type="cluster", cov_kwds={"groups": maps, "use_correction": False}
    )
    assert by_map(success.astype(float), maps).var() / len(size) == pytest.approx(
        fit.cov_params()[0, 0]
    )
    rate, unequal = success.mean(), (size**2).mean() / size.mean() ** 2
    gain = (rate * (1 - rate) + 0.01) / (
        len(size) * fit.cov_params()[0, 0] + 0.01 * unequal
    )
    student = (t.ppf(0.975, len(size) - 1) / norm.ppf(0.975)) ** 2
    assert design_effect(success, maps) == pytest.approx(size.mean() / gain * student)


def test_design_effect_by_hand() -> None:
    # Three maps of two episodes with the rates 1, 1/2, 1/2: p(1 − p) = 2/9, variance of
    # maps 1/18.
    success = np.array([1, 1, 0, 1, 1, 0], dtype=bool)
    gain = (2 / 9 + 0.01) / (1 / 18 + 0.01) * (norm.ppf(0.975) / t.ppf(0.975, 2)) ** 2
    assert gain < 1  # few maps do not tell that they are alike
    assert design_effect(success, np.array([0, 0, 1, 1, 2, 2])) == 2
    many = np.tile(success, 20), np.repeat(np.arange(60), 2)
    gain = (2 / 9 + 0.01) / (1 / 18 + 0.01) * (norm.ppf(0.975) / t.ppf(0.975, 59)) ** 2
    assert design_effect(*many) == pytest.approx(2 / gain)


def test_design_effect_at_its_ends() -> None:
    both = np.array([True, False, True, True])
    # each episode on a map of its own
    assert design_effect(both, np.arange(4)) == pytest.approx(1)
    assert design_effect(
        np.repeat(both, 3), np.repeat(np.arange(4), 3)
    ) == pytest.approx(3)  # all alike
    # What cannot be seen is taken to be as bad as it can be: one map, or nothing but
    # successes.
    assert design_effect(both, np.zeros(4)) == 4
    assert design_effect(
        np.ones(12, dtype=bool), np.repeat(np.arange(4), 3)
    ) == pytest.approx(3)
    # 8, 1, 1, 1 and 1 episodes are worth 144/68 maps.
    assert design_effect(
        np.ones(12, dtype=bool), [*[0] * 8, 1, 2, 3, 4]
    ) == pytest.approx(12 / (144 / 68))
