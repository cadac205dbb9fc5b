"""Coverage of intervals and error rates of tests, on simulated benchmarks.

The true values of these benchmarks are known. Each map has its own probability of
success (beta distributed, with a given correlation within a map). Conditions share a
part of these probabilities and of the noise. Times to the goal are lognormal. Half of
their variance is between maps, and times are longer on maps with a low probability of
success. A failure counts as T = 100 s.

The tables have the coverage of intervals, and the rate at which a family of comparisons
between equal conditions finds a significant difference.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, product

import numpy as np
import pandas as pd
from scipy.stats import beta, bootstrap, norm, t

from benchnav.eval.stats.summary import total_time_mean
from benchnav.stats.best import best_set_p
from benchnav.stats.by_map import alike
from benchnav.stats.episodes import time_difference
from benchnav.stats.flips import sign_flip_p, signed_rank_p
from benchnav.stats.holm import ALPHA
from benchnav.stats.intervals import design_effect, success_interval, wilson_interval

# Correlation within a map, about the probability of success of its group.
_MAPS_WITHIN = 0.2
RATES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
# Pairs of: correlation within a map; fraction of the probabilities of success and of
# the noise that two conditions share.
LIKENESS = ((0.1, 0.3), (0.3, 0.7), (0.6, 0.9))
TIME_BUDGET_S = 100.0
_MEDIAN_S, _SPREAD, _STEP_S = 33.0, 0.3, 0.1


def chance_at(score: np.ndarray, rate: float, within: float) -> np.ndarray:
    """Return the probability of success of maps, given their normal scores."""
    size = 1 / within - 1
    return beta.ppf(norm.cdf(score), rate * size, (1 - rate) * size)


def chances(
    generator: np.random.Generator,
    rates: Sequence[float],
    shape: tuple[int, int],
    like: tuple[float, float],
) -> np.ndarray:
    """Draw the probability of success, shape [studies, conditions, maps]."""
    within, common = like
    studies, maps = shape
    shared = generator.standard_normal((studies, 1, maps))
    independent = generator.standard_normal((studies, len(rates), maps))
    scores = np.sqrt(common) * shared + np.sqrt(1 - common) * independent
    grid = np.linspace(-6, 6, 4_001)
    columns = [
        np.interp(scores[:, i], grid, chance_at(grid, rate, within))
        for i, rate in enumerate(rates)
    ]
    return np.stack(columns, axis=1)


def outcomes(
    generator: np.random.Generator, chance: np.ndarray, draws: int, common: float
) -> np.ndarray:
    """Draw success, bool, shape [studies, conditions, maps, draws].

    Args:
        generator: source of all draws.
        chance: probability of success, shape [studies, conditions, maps].
        draws: episodes per map.
        common: probability that a condition uses the noise that all conditions share.
    """
    shape = (*chance.shape, draws)
    shared = generator.random((shape[0], 1, *shape[2:]))
    independent = generator.random(shape)
    is_shared = generator.random(shape) < common
    noise = np.where(is_shared, shared, independent)
    return noise < chance[..., None]


def times(
    generator: np.random.Generator, success: np.ndarray, hardness: np.ndarray
) -> np.ndarray:
    """Draw T_total in seconds, of the shape of `success`.

    Args:
        generator: source of all draws.
        success: shape [studies, conditions, maps, draws].
        hardness: normal scores of maps, shape [studies, conditions, maps].
    """
    independent = generator.standard_normal(success.shape)
    score = hardness[..., None] + independent
    arrival_s = _MEDIAN_S * np.exp(_SPREAD * np.sqrt(0.5) * score)
    steps = np.rint(np.minimum(arrival_s, TIME_BUDGET_S - 1) / _STEP_S)
    return np.where(success, steps * _STEP_S, TIME_BUDGET_S)


def hardness(chance: np.ndarray, rates: Sequence[float], within: float) -> np.ndarray:
    """Return normal scores of maps that fall with `chance`, of its shape."""
    grid = np.linspace(-4, 4, 2_001)
    columns = [
        -np.interp(chance[:, i], chance_at(grid, rate, within), grid)
        for i, rate in enumerate(rates)
    ]
    return np.stack(columns, axis=1)


def drives(
    generator: np.random.Generator,
    rates: Sequence[float],
    shape: tuple[int, int],
    draws: int,
    like: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Draw success and T_total, both of shape [studies, conditions, maps, draws]."""
    chance = chances(generator, rates, shape, like)
    within, common = like
    success = outcomes(generator, chance, draws, common)
    total_time_s = times(generator, success, hardness(chance, rates, within))
    return success, total_time_s


def true_difference_s(
    generator: np.random.Generator, rates: Sequence[float], like: tuple[float, float]
) -> tuple[float, float]:
    """Return the true T_total of the first of two conditions, and first − second."""
    _, total_time_s = drives(generator, rates, (1, 400_000), 1, like)
    first_s, second_s = total_time_s[0]
    return first_s.mean(), (first_s - second_s).mean()


def covers(ends: np.ndarray, truth: float) -> np.ndarray:
    """Return which intervals, given ends [studies, 2], contain the true value."""
    return (ends[:, 0] <= truth) & (truth <= ends[:, 1])


def rate_intervals(success: np.ndarray) -> np.ndarray:
    """Return Wilson's intervals [studies, 2] of success [studies, maps, draws].

    The number of episodes is divided by the design effect.
    """
    maps, draws = success.shape[1:]
    map_index = np.repeat(np.arange(maps), draws)
    intervals = []
    for study in success:
        n_effective = study.size / design_effect(study.ravel(), map_index)
        intervals.append(wilson_interval(study.mean(), n_effective))
    return np.array(intervals)


def difference_intervals(
    wins: np.ndarray, episodes: int, confidence: float = 0.95
) -> np.ndarray:
    """Return intervals [studies, 2] of the difference in success rate.

    Args:
        wins: successes per map, shape [studies, 2, maps].
        episodes: episodes per map.
        confidence: nominal coverage of the intervals.
    """
    differences = wins[:, 0] - wins[:, 1]
    _, low, high = success_interval(differences, episodes, confidence)
    return np.stack((low, high), axis=1)


def cover_of_success(
    generator: np.random.Generator,
    studies: int,
    maps: int,
    draws: int,
    rates: Sequence[float] = RATES,
) -> Iterator[float]:
    """Yield the coverage of the interval of success, per rate and likeness."""
    for rate, like in product(rates, LIKENESS):
        chance = chances(generator, (rate,), (studies, maps), like)
        success = outcomes(generator, chance, draws, like[1])[:, 0]
        yield covers(rate_intervals(success), rate).mean()


def cover_of_differences(
    generator: np.random.Generator,
    studies: int,
    maps: int,
    draws: int,
    rates: Sequence[float] = RATES,
) -> Iterator[float]:
    """Yield the coverage of intervals of a difference, per pair of rates and likeness."""
    for pair, like in product(combinations(rates, 2), LIKENESS):
        chance = chances(generator, pair, (studies, maps), like)
        wins = outcomes(generator, chance, draws, like[1]).sum(-1)
        yield covers(difference_intervals(wins, draws), pair[0] - pair[1]).mean()


def episodes_of(
    success: np.ndarray, total_time_s: np.ndarray
) -> Iterator[pd.DataFrame]:
    """Yield the paired episodes of each study, in the format of `benchnav.stats`."""
    maps, draws = success.shape[2:]
    for won, taken in zip(success, total_time_s, strict=True):
        yield pd.DataFrame(
            {
                "group": np.repeat(np.arange(maps), draws),
                "success": won[0].ravel(),
                "success_other": won[1].ravel(),
                "total_time_s": taken[0].ravel(),
                "total_time_s_other": taken[1].ravel(),
                "time_budget_s": TIME_BUDGET_S,
                "time_budget_s_other": TIME_BUDGET_S,
            }
        )


def cover_of_times(
    generator: np.random.Generator,
    studies: int,
    shape: tuple[int, int],
    rates: tuple[float, float],
    resampled: int = 0,
) -> pd.DataFrame:
    """Return coverage and mean width of the intervals of T_total and its difference.

    Args:
        generator: source of all draws.
        studies: number of studies per likeness.
        shape: maps per study, and episodes per map.
        rates: success rates of two conditions; T_total is that of the first.
        resampled: number of studies for which a bootstrap (BCa) over maps is computed
            too.

    Returns:
        Rows `T_total`, `ΔT_total` and, with `resampled`, those of the bootstrap;
        columns `cover` and `width`.
    """
    maps, draws = shape
    rows = []
    for like in LIKENESS:
        truths = true_difference_s(generator, rates, like)
        success, taken = drives(generator, rates, (studies, maps), draws, like)
        by_map = taken.mean(-1)
        episodes = list(episodes_of(success, taken))
        intervals = (
            [
                total_time_mean(study, {"time_budget_s": TIME_BUDGET_S})[1:]
                for study in episodes
            ],
            [time_difference(study)[1:] for study in episodes],
        )
        values = by_map[:, 0], by_map[:, 0] - by_map[:, 1]
        for name, ends, truth, value in zip(
            ("T_total", "ΔT_total"), intervals, truths, values, strict=True
        ):
            ends_by_method = {name: np.array(ends)}
            if resampled:
                drawn = bootstrap(
                    (value[:resampled],),
                    np.mean,
                    axis=-1,
                    n_resamples=999,
                    rng=generator,
                )
                ends_by_method[f"{name}, bootstrap"] = np.stack(
                    drawn.confidence_interval, axis=1
                )
            rows += [
                pd.DataFrame(
                    {
                        "name": method,
                        "cover": covers(method_ends, truth),
                        "width": method_ends[:, 1] - method_ends[:, 0],
                    }
                )
                for method, method_ends in ends_by_method.items()
            ]
    return pd.concat(rows).groupby("name", sort=False).mean()


def false_findings(
    generator: np.random.Generator,
    studies: int,
    maps: int,
    draws: int,
    rates: Sequence[float] = (0.05, 0.5, 0.8),
) -> Iterator[np.ndarray]:
    """Yield the rates of studies in which any two of six equal settings differ.

    There is one array per rate and likeness: by success, and by time.
    """
    pairs = list(combinations(range(6), 2))
    for rate, like in product(rates, LIKENESS):
        success, total_time_s = drives(
            generator, [rate] * 6, (studies, maps), draws, like
        )
        # Holm's correction rejects any hypothesis only if its first step does.
        first_level = ALPHA / len(pairs)
        n_significant = np.zeros(2)
        for wins, taken in zip(success.sum(-1), total_time_s.mean(-1), strict=True):
            p_of_success, p_of_time = [], []
            for i, j in pairs:
                p_of_success.append(sign_flip_p(wins[i] - wins[j]))
                difference_s = alike(taken[i] - taken[j], TIME_BUDGET_S)
                p_of_time.append(signed_rank_p(difference_s))
            n_significant[0] += min(p_of_success) <= first_level
            n_significant[1] += min(p_of_time) <= first_level
        yield n_significant / studies


def group_wins(
    generator: np.random.Generator,
    rates: Sequence[float],
    shape: tuple[int, int],
    episodes: int,
    like: tuple[float, float],
    one_map: bool,
) -> np.ndarray:
    """Draw successes per group, shape [studies, conditions, groups].

    With `one_map`, all episodes of a group are on one map; otherwise each has its own.
    """
    chance = chances(generator, rates, shape, like)
    if one_map:
        return outcomes(generator, chance, episodes, like[1]).sum(-1)
    size = 1 / _MAPS_WITHIN - 1
    group_chance = np.clip(chance, 1e-9, 1 - 1e-9)[..., None]
    alpha, beta_ = group_chance * size, (1 - group_chance) * size
    map_chance = generator.beta(alpha, beta_, (*chance.shape, episodes))
    return outcomes(generator, map_chance, 1, like[1])[..., 0].sum(-1)


def cover_of_groups(
    generator: np.random.Generator,
    studies: int,
    groups: int,
    episodes: int,
    rates: tuple[float, float],
    like: tuple[float, float],
) -> dict[str, float]:
    """Return the coverage of intervals of a difference and of each rate, with few groups.

    For the difference, half-widths and the values of a cluster t interval (`_t`) are
    returned too.
    """
    drawn = [
        group_wins(generator, rates, (studies // 2, groups), episodes, like, one_map)
        for one_map in (True, False)
    ]
    wins, truth = np.concatenate(drawn), rates[0] - rates[1]
    differences = (wins[:, 0] - wins[:, 1]) / episodes
    half = t.ppf(0.975, groups - 1) * differences.std(-1, ddof=1) / np.sqrt(groups)
    student = differences.mean(-1)[:, None] + np.stack((-half, half), axis=1)
    results = {}
    for name, ends in (("", difference_intervals(wins, episodes)), ("_t", student)):
        results |= {
            f"cover{name}": covers(ends, truth).mean(),
            f"half{name}": np.ptp(ends, axis=1).mean() / 2,
        }
    for index, rate in enumerate(rates):
        ends = rate_intervals(np.arange(episodes) < wins[:, index, :, None])
        results[f"cover_{index}"] = covers(ends, rate).mean()
    return results


def unlike(
    generator: np.random.Generator,
    studies: int,
    settings: int,
    maps: int,
    draws: int,
    same_maps: bool,
) -> np.ndarray:
    """Draw successes of settings of equal mean and different shape.

    The first half of the settings succeeds with probability 0.9 on every map. The other
    half always fails on a tenth of the maps and always succeeds on the others. With
    `same_maps`, the settings of that half fail on the same maps.

    Returns:
        Successes, shape [studies, settings, maps].
    """
    n_steady = settings // 2
    n_failing = settings - n_steady
    steady = generator.binomial(draws, 0.9, (studies, n_steady, maps))
    n_drawn = 1 if same_maps else n_failing
    fails = generator.random((studies, n_drawn, maps)) < 0.1
    failing = np.broadcast_to(draws * ~fails, (studies, n_failing, maps))
    return np.concatenate([steady, failing], axis=1)


def called_worse(wins: np.ndarray, draws: int) -> np.ndarray:
    """Return which settings a report calls worse than the best, [studies, settings].

    Args:
        wins: successes, shape [studies, settings, maps].
        draws: episodes per map.
    """
    return np.array([best_set_p(study.T, draws)[0] < ALPHA for study in wins])
