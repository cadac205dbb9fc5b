"""Agreement between worlds on the success of the same settings on the same maps.

Wins are numbers of successful episodes. All settings have the same episodes in all
worlds. Intervals are 95 % percentile intervals of the bootstrap over maps, in which a
sample contains the same maps in all worlds; their ends are NaN with fewer than
`LEAST_MAPS` maps. Sampling variation lowers correlations, and raises rank violations
and regret, in the observed values and again in the samples. Intervals therefore extend
too far towards disagreement: the upper end of a correlation near 1 can be below the
correlation of the expected rates.

Letters in shapes: W worlds; C settings; M maps; R bootstrap samples; J pairs of
settings; a leading `...` is any number of comparisons.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.stats import rankdata

from benchnav.stats.best import best_set_p
from benchnav.stats.bootstrap import LEAST_MAPS, bootstrap_counts, percentile_interval
from benchnav.stats.episodes import Interval
from benchnav.stats.flips import sign_flip_p
from benchnav.stats.holm import ALPHA, holm

# Minimum number of settings for a correlation: two points are always on a line.
MIN_SETTINGS = 3
# Number of values in a chunk of samples for rank violations, which fits in memory.
_CHUNK_SIZE = 2_000_000

Statistic = Callable[[np.ndarray, np.ndarray], np.ndarray]


def pearson(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return Pearson's correlation of rates in two worlds.

    Args:
        first: rate of each setting in the first world, shape [..., C].
        second: rate of each setting in the second world, shape [..., C].

    Returns:
        Correlations in [−1, 1], shape [...]; NaN with fewer than `MIN_SETTINGS`
        settings, or if all rates of a world are equal.
    """
    first_deviation = first - first.mean(-1, keepdims=True)
    second_deviation = second - second.mean(-1, keepdims=True)
    products = (first_deviation * second_deviation).sum(-1)
    first_square = (first_deviation**2).sum(-1)
    second_square = (second_deviation**2).sum(-1)
    is_defined = (np.ptp(first, -1) > 0) & (np.ptp(second, -1) > 0)
    is_defined &= first.shape[-1] >= MIN_SETTINGS
    scale = np.sqrt(first_square * second_square)
    correlations = products / np.where(is_defined, scale, np.nan)
    return np.clip(correlations, -1, 1)


def spearman(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return Spearman's rank correlation; equal rates have their mean rank.

    Arguments and result are those of `pearson`.
    """
    return pearson(rankdata(first, axis=-1), rankdata(second, axis=-1))


def rank_violation(predicted: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the mean maximum rank violation (MMRV) of predicted rates.

    A pair of settings violates the ranks if only one of the worlds has the first below
    the second. It costs the difference of the pair in the reference world. The MMRV is
    the mean over settings of the largest cost of a setting's pairs: 0 if the worlds
    agree on all ranks.

    Source: Li et al. (2024), "Evaluating Real-World Robot Manipulation Policies in
    Simulation" (SIMPLER), where the reference is the real world.

    Args:
        predicted: rate of each setting in the predicting world, shape [..., C].
        reference: rate of each setting in the reference world, shape [..., C].

    Returns:
        Violations in the unit of the rates, ≥ 0, shape [...]; NaN without settings.
    """
    n_settings = reference.shape[-1]
    if not n_settings:
        return np.full(reference.shape[:-1], np.nan)
    flat_predicted = predicted.reshape(-1, n_settings)
    flat_reference = reference.reshape(-1, n_settings)
    n_chunks = -(-flat_reference.size * n_settings // _CHUNK_SIZE)
    violations = []
    for rows in np.array_split(np.arange(len(flat_reference)), n_chunks):
        difference = _differences(flat_reference[rows])
        is_below = difference < 0
        is_violated = is_below != (_differences(flat_predicted[rows]) < 0)
        costs = np.abs(difference) * is_violated
        violations.append(costs.max(-1).mean(-1))
    return np.concatenate(violations).reshape(reference.shape[:-1])


def _differences(rates: np.ndarray) -> np.ndarray:
    """Return the rate of the row's setting minus that of the column's, [..., C, C]."""
    return rates[..., :, None] - rates[..., None, :]


def estimate(statistic: Statistic, wins: np.ndarray, episodes: np.ndarray) -> Interval:
    """Return a statistic of the rates in two worlds, with its interval.

    Args:
        statistic: function of the rates in both worlds, each of shape [..., C], with a
            result of shape [...].
        wins: numbers of successes, shape [2, C, M].
        episodes: number of episodes of each setting on each map, shape [M].
    """
    first, second = wins.sum(-1) / episodes.sum()
    value = float(statistic(first, second))
    if len(episodes) < LEAST_MAPS:
        return value, np.nan, np.nan
    sampled = _sampled_rates(wins, episodes)
    values = statistic(sampled[:, 0], sampled[:, 1])
    low, high = percentile_interval(values)
    return value, low, high


def _sampled_rates(wins: np.ndarray, episodes: np.ndarray) -> np.ndarray:
    """Return the rates in each bootstrap sample of maps, shape [R, W, C]."""
    counts = bootstrap_counts(len(episodes))
    sums = np.moveaxis(wins @ counts.T, -1, 0)
    return sums / (counts @ episodes)[:, None, None]


def kappa(tables: np.ndarray) -> np.ndarray:
    """Return Cohen's κ of two classifications.

    Source: Cohen (1960), "A coefficient of agreement for nominal scales".

    Args:
        tables: numbers of cases by class in the first and in the second classification,
            shape [..., N, N] for N classes.

    Returns:
        κ ≤ 1, shape [...]: 1 for full agreement, 0 for agreement by chance; NaN if both
        classifications have only the same class.
    """
    total = tables.sum((-2, -1))
    observed = np.trace(tables, axis1=-2, axis2=-1)
    by_chance = (tables.sum(-1) * tables.sum(-2)).sum(-1)
    square = total**2
    possible = square - by_chance
    return (observed * total - by_chance) / np.where(possible > 0, possible, np.nan)


def kappa_interval(tables: np.ndarray) -> Interval:
    """Return Cohen's κ of the success of episodes in two worlds, with its interval.

    Args:
        tables: numbers of episodes on each map by success in the first and in the
            second world, shape [M, 2, 2].
    """
    n_maps = len(tables)
    value = float(kappa(tables.sum(0)))
    if n_maps < LEAST_MAPS:
        return value, np.nan, np.nan
    sampled = bootstrap_counts(n_maps) @ tables.reshape(n_maps, -1)
    low, high = percentile_interval(kappa(sampled.reshape(-1, 2, 2)))
    return value, low, high


@dataclass(frozen=True, kw_only=True)
class SameSign:
    """Fraction of significant differences that have the same sign in another world.

    Args:
        pairs: number of significant pairs of settings, J.
        fraction: fraction of these pairs, in [0, 1]; NaN without pairs.
        low: lower end of its one-sided 95 % interval; NaN without pairs or with fewer
            than `LEAST_MAPS` maps.
        p: p-value of H₀: the fraction is at most one half; 1 if `low` is NaN.
    """

    pairs: int
    fraction: float = np.nan
    low: float = np.nan
    p: float = 1.0


def same_sign(wins: np.ndarray, episodes: np.ndarray) -> SameSign:
    """Compare the signs of significant differences with those in another world.

    The pairs are those that are significant in the reference world (sign-flip tests per
    map, Holm's correction). Bootstrap samples keep these pairs. A pair without a
    difference in the other world has another sign. Pairs that share settings are
    dependent; the samples contain this dependence.

    Args:
        wins: numbers of successes in the reference world and in the other world, shape
            [2, C, M].
        episodes: number of episodes of each setting on each map, shape [M].
    """
    pairs = significant_pairs(wins[0])
    if not len(pairs):
        return SameSign(pairs=0)
    first, second = pairs.T
    gains = wins[:, first] - wins[:, second]
    observed = np.sign(gains.sum(-1))
    fraction = float((observed[0] == observed[1]).mean())
    if len(episodes) < LEAST_MAPS:
        return SameSign(pairs=len(pairs), fraction=fraction)
    signs = np.sign(gains @ bootstrap_counts(len(episodes)).T)
    fractions = (signs[0] == signs[1]).mean(0)
    n_low = int((fractions <= 0.5).sum())
    return SameSign(
        pairs=len(pairs),
        fraction=fraction,
        low=float(np.quantile(fractions, ALPHA)),
        p=(1 + n_low) / (1 + len(fractions)),
    )


def significant_pairs(wins: np.ndarray) -> np.ndarray:
    """Return the pairs of settings that differ significantly in one world.

    Args:
        wins: numbers of successes, shape [C, M].

    Returns:
        Indices of both settings of each pair, int64, shape [J, 2].
    """
    pairs = np.array(list(combinations(range(len(wins)), 2)), dtype=np.int64)
    pairs = pairs.reshape(-1, 2)
    gains = wins[pairs[:, 0]] - wins[pairs[:, 1]]
    p = np.array([sign_flip_p(gain) for gain in gains])
    return pairs[holm(p) < ALPHA]


def best_sets(wins: np.ndarray, episodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Test each setting against the best setting of each world, at level 0.05/W.

    The robust set contains the settings that are in the best set of all worlds. A
    setting that is best in all worlds is left out with a probability of at most about
    5 %, by Bonferroni's inequality.

    Args:
        wins: numbers of successes, shape [W, C, M].
        episodes: number of episodes of each setting on each map, shape [M].

    Returns:
        Two arrays of shape [W, C]. The first is p from `best.best_set_p`, corrected for
        the number of settings, but not for the number of worlds. The second is whether
        the setting is in the best set of the world.
    """
    p = np.stack([best_set_p(world_wins.T, episodes)[0] for world_wins in wins])
    return p, p >= ALPHA / len(wins)


def worst_regret(rates: np.ndarray) -> np.ndarray:
    """Return the largest regret of each setting over worlds.

    The regret in a world is the best rate of any setting minus the setting's own rate.

    Args:
        rates: success rates, shape [..., W, C].

    Returns:
        Regrets ≥ 0, shape [..., C].
    """
    regret = rates.max(-1, keepdims=True) - rates
    return regret.max(-2)


def regret_intervals(
    wins: np.ndarray, episodes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the largest regret of each setting over worlds, with its interval.

    Args:
        wins: numbers of successes, shape [W, C, M].
        episodes: number of episodes of each setting on each map, shape [M].

    Returns:
        Regret, lower end and upper end, each of shape [C].
    """
    regret = worst_regret(wins.sum(-1) / episodes.sum())
    ends = np.full((2, len(regret)), np.nan)
    if len(episodes) >= LEAST_MAPS:
        sampled = worst_regret(_sampled_rates(wins, episodes))
        intervals = [percentile_interval(values) for values in sampled.T]
        ends = np.array(intervals).T
    low, high = ends
    return regret, low, high
