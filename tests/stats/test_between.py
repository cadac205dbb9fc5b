from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from benchnav.stats.best import best_set_p
from benchnav.stats.between import (
    MIN_SETTINGS,
    best_sets,
    estimate,
    kappa,
    kappa_interval,
    pearson,
    rank_violation,
    regret_intervals,
    same_sign,
    significant_pairs,
    spearman,
    worst_regret,
)
from benchnav.stats.bootstrap import LEAST_MAPS, bootstrap_counts

DRAWS = 2


def studies(
    rates: list[list[float]], maps: int, count: int, seed: int = 0
) -> np.ndarray:
    """Wins of simulated studies, shape [count, W, C, M].

    Maps differ in difficulty, and all conditions share half of an episode's variance.
    """
    rng = np.random.default_rng(seed)
    worlds, settings = np.shape(rates)
    difficulty = rng.standard_normal((count, 1, 1, maps, 1))
    shared = rng.standard_normal((count, 1, 1, maps, DRAWS))
    own = rng.standard_normal((count, worlds, settings, maps, DRAWS))
    threshold = stats.norm.ppf(rates)[:, :, None, None] * np.sqrt(3)
    return np.asarray((difficulty + shared + own < threshold).sum(-1))


def wins_of(rates: list[list[float]], maps: int = 60, seed: int = 0) -> np.ndarray:
    (wins,) = studies(rates, maps, 1, seed)
    return np.asarray(wins)


@pytest.fixture(scope="module")
def tied() -> np.ndarray:
    """Rates of pairs of worlds with many ties, shape [50, 2, 7]."""
    return np.random.default_rng(2).integers(0, 5, (50, 2, 7)) / 4


def test_correlations_are_those_of_scipy(tied: np.ndarray) -> None:
    for (first, second), r, rho in zip(
        tied,
        pearson(tied[:, 0], tied[:, 1]),
        spearman(tied[:, 0], tied[:, 1]),
        strict=True,
    ):
        assert r == pytest.approx(stats.pearsonr(first, second).statistic)
        assert rho == pytest.approx(stats.spearmanr(first, second).statistic)


def test_correlations_need_three_settings_and_rates_that_vary() -> None:
    varying = np.array([0.1, 0.4, 0.7, 0.2])
    for statistic in (pearson, spearman):
        assert np.isnan(statistic(varying, np.full(4, 0.9)))
        assert np.isnan(statistic(varying[: MIN_SETTINGS - 1], varying[1:MIN_SETTINGS]))
        assert statistic(varying, 2 * varying) == pytest.approx(1)


def test_rank_violation_is_its_definition(tied: np.ndarray) -> None:
    for predicted, reference in tied:
        largest = []
        for i in range(7):
            costs = [0.0]
            for j in range(7):
                if (predicted[i] < predicted[j]) != (reference[i] < reference[j]):
                    costs.append(abs(reference[i] - reference[j]))
            largest.append(max(costs))
        assert rank_violation(predicted, reference) == pytest.approx(np.mean(largest))
    # Chunks of samples give the same values as single samples.
    many = np.tile(tied, (1_000, 1, 1))
    values = rank_violation(many[:, 0], many[:, 1]).reshape(1_000, 50)
    assert (values == rank_violation(tied[:, 0], tied[:, 1])).all()


def test_rank_violation_is_in_the_unit_of_the_reference() -> None:
    reference = np.array([0.2, 0.5, 0.9])
    assert rank_violation(np.array([1.0, 2.0, 3.0]), reference) == 0
    # The last two are exchanged: each of them has a pair that costs 0.4.
    exchanged = rank_violation(np.array([1.0, 3.0, 2.0]), reference)
    assert exchanged == pytest.approx((0.4 + 0.4) / 3)


def test_intervals_are_percentiles_over_the_same_maps_in_both_worlds() -> None:
    wins = wins_of([[0.5, 0.6, 0.8, 0.9], [0.5, 0.7, 0.7, 0.8]])
    episodes = np.full(60, DRAWS)
    value, low, high = estimate(pearson, wins, episodes)
    first, second = wins.mean(-1) / DRAWS
    assert value == pytest.approx(stats.pearsonr(first, second).statistic)
    sampled = []
    for counts in bootstrap_counts(60):
        maps = np.repeat(np.arange(60), counts.astype(int))
        rates = wins[:, :, maps].mean(-1) / DRAWS
        sampled.append(np.corrcoef(*rates)[0, 1])
    assert (low, high) == pytest.approx(np.quantile(sampled, [0.025, 0.975]))


def test_maps_count_by_their_episodes() -> None:
    """Four episodes on a map weigh as much as one on each of four maps."""
    wins = wins_of([[0.5, 0.6, 0.8], [0.5, 0.7, 0.6]], 40)
    grouped = wins.reshape(2, 3, 10, 4).sum(-1)
    value, low, high = estimate(pearson, grouped, np.full(10, 4 * DRAWS))
    assert value == estimate(pearson, wins, np.full(40, DRAWS))[0]
    assert low < value < high
    uneven = np.concatenate([grouped[..., :5], wins[..., 20:]], axis=-1)
    sizes = np.repeat([4 * DRAWS, DRAWS], [5, 20])
    assert estimate(pearson, uneven, sizes)[0] == pytest.approx(value)
    regret, low, high = regret_intervals(uneven, sizes)
    sampled = []
    for counts in bootstrap_counts(25):
        rates = (uneven * counts).sum(-1) / (sizes * counts).sum()
        sampled.append((rates.max(1, keepdims=True) - rates).max(0))
    assert regret == pytest.approx(regret_intervals(wins, np.full(40, DRAWS))[0])
    assert [low, high] == pytest.approx(np.quantile(sampled, [0.025, 0.975], axis=0))


def test_few_maps_have_no_interval() -> None:
    few = LEAST_MAPS - 1
    wins = wins_of([[0.3, 0.6, 0.8], [0.2, 0.7, 0.6]], few)
    episodes = np.full(few, DRAWS)
    value, low, high = estimate(rank_violation, wins, episodes)
    assert np.isfinite(value)
    assert np.isnan([low, high]).all()
    assert np.isnan(regret_intervals(wins, episodes)[1:]).all()
    assert np.isnan(kappa_interval(np.ones((few, 2, 2)))[1:]).all()
    assert same_sign(wins, episodes).p == 1


def test_kappa_by_hand() -> None:
    # 35 of 50 agree; by chance 0.5 · 0.6 + 0.5 · 0.4 = 0.5 do: (0.7 − 0.5) / 0.5.
    assert kappa(np.array([[20, 5], [10, 15]])) == pytest.approx(0.4)
    assert kappa(np.diag([3, 4])) == 1
    assert kappa(np.array([[9, 3], [3, 1]])) == pytest.approx(0)
    assert np.isnan(kappa(np.array([[0, 0], [0, 8]])))
    tables = np.array([[[20, 5], [10, 15]]] * LEAST_MAPS)
    assert kappa_interval(tables) == pytest.approx((0.4, 0.4, 0.4))
    tables[0] = np.diag([25, 25])
    value, low, high = kappa_interval(tables)
    assert low < value < high


def test_significant_pairs_are_holms_of_exact_tests() -> None:
    wins = wins_of([[0.5, 0.6, 0.75, 0.68]])[0]
    pairs = list(combinations(range(4), 2))
    p = []
    for i, j in pairs:
        gain = wins[i] - wins[j]
        signs = np.random.default_rng(0).choice([-1, 1], (20_000, 60))
        p.append((np.abs(signs @ gain) >= abs(gain.sum())).mean())
    order = np.argsort(p)
    expected = set()
    for step, index in enumerate(order):
        if p[index] * (len(p) - step) >= 0.05:
            break
        expected.add(pairs[index])
    assert 0 < len(expected) < sum(value < 0.05 for value in p)
    assert set(map(tuple, significant_pairs(wins).tolist())) == expected
    assert significant_pairs(wins[:1]).shape == (0, 2)


def test_same_sign_counts_significant_pairs_of_the_first_world() -> None:
    rates = [[0.4, 0.6, 0.8], [0.4, 0.7, 0.55]]
    wins = wins_of(rates, 300)
    episodes = np.full(300, DRAWS)
    agreement = same_sign(wins, episodes)
    assert agreement.pairs == 3
    assert agreement.fraction == pytest.approx(2 / 3)
    assert agreement.low == pytest.approx(2 / 3)
    assert agreement.p == pytest.approx(1 / 2001)
    assert same_sign(wins[[0, 0]], episodes).fraction == 1
    reversed_world = DRAWS - wins[0]
    opposite = same_sign(np.stack([wins[0], reversed_world]), episodes)
    assert (opposite.fraction, opposite.low, opposite.p) == (0, 0, 1)
    # Equal rates have no sign.
    equal = np.repeat(wins[:1, :1], 3, axis=1)
    assert same_sign(np.concatenate([wins[:1], equal]), episodes).fraction == 0
    assert same_sign(np.concatenate([equal, wins[:1]]), episodes).pairs == 0
    assert np.isnan(same_sign(np.concatenate([equal, wins[:1]]), episodes).fraction)


def test_same_sign_of_one_pair_is_a_one_sided_test() -> None:
    """If the pair is certain in the first world, p is that of the second world."""
    episodes = np.full(200, DRAWS)
    first = wins_of([[0.3, 0.9]], 200)
    p_values = []
    for seed in range(6):
        second = wins_of([[0.60, 0.64]], 200, seed)
        agreement = same_sign(np.concatenate([first, second]), episodes)
        gains = second[0, 1] - second[0, 0]
        error = gains.std() / np.sqrt(200)
        assert agreement.p == pytest.approx(
            stats.norm.sf(gains.mean() / error), abs=0.04
        )
        assert agreement.low == float(agreement.p < 0.05)
        p_values.append(agreement.p)
    assert min(p_values) < 0.05 < max(p_values) < 0.5


def test_same_sign_of_half_of_the_pairs_is_not_significant() -> None:
    first = np.repeat([[DRAWS], [DRAWS], [0]], 40, axis=1)
    second = np.repeat([[2], [0], [1]], 40, axis=1)
    agreement = same_sign(np.stack([first, second]), np.full(40, DRAWS))
    assert agreement.pairs == 2
    assert (agreement.fraction, agreement.low, agreement.p) == (0.5, 0.5, 1)


def test_regret_is_the_largest_over_worlds() -> None:
    rates = np.array([[0.9, 0.8, 0.85], [0.5, 0.7, 0.68]])
    assert worst_regret(rates) == pytest.approx([0.2, 0.1, 0.05])
    wins = wins_of(rates.tolist(), 300)
    regret, low, high = regret_intervals(wins, np.full(300, DRAWS))
    assert regret == pytest.approx(worst_regret(wins.mean(-1) / DRAWS))
    assert (low <= regret).all()
    assert (regret <= high).all()
    assert (low <= [0.2, 0.1, 0.05]).all()
    assert (high >= [0.2, 0.1, 0.05]).all()


def test_best_sets_have_level_divided_by_worlds() -> None:
    rates = [[0.7, 0.78], [0.78, 0.78], [0.78, 0.78], [0.78, 0.78]]
    all_p = []
    for seed in range(40):
        wins = wins_of(rates, 100, seed)
        p, is_best = best_sets(wins, np.full(100, DRAWS))
        assert (p[1] == best_set_p(wins[1].T, DRAWS)[0]).all()
        assert (is_best == (p >= 0.05 / 4)).all()
        all_p.append(p)
    between_levels = (np.array(all_p) < 0.05) & (np.array(all_p) >= 0.05 / 4)
    assert between_levels.any()


# Rates of settings in two worlds. The first setting is best in both, with others close
# to it, so that a set that is too strict would exclude it.
BEST = [[0.86, 0.86, 0.855, 0.80, 0.7], [0.78, 0.775, 0.77, 0.78, 0.7]]
# The second setting is 10 points worse in the second world.
WORSE = [[0.86, 0.86, 0.855, 0.80, 0.7], [0.78, 0.68, 0.77, 0.78, 0.7]]


def fraction_in_robust_set(rates: list[list[float]], index: int, count: int) -> float:
    episodes = np.full(300, DRAWS)
    n_kept = 0
    for seed in range(count // 100):
        for wins in studies(rates, 300, 100, seed):
            _, is_best = best_sets(wins, episodes)
            n_kept += is_best.all(0)[index]
    return n_kept / count


@pytest.mark.parametrize(
    "count", [100, pytest.param(2_000, marks=pytest.mark.slow)], ids=str
)
def test_the_robust_set_keeps_the_best_and_excludes_a_worse_one(count: int) -> None:
    equal = [[0.8] * 5] * 3  # each setting is as good as the best
    assert fraction_in_robust_set(equal, 0, count) >= 0.95
    assert fraction_in_robust_set(BEST, 0, count) >= 0.95
    assert fraction_in_robust_set(WORSE, 1, count) <= 0.2
