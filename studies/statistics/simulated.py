"""Coverage of intervals and error rates of tests, on simulated benchmarks whose truth
is known.

Maps have a chance of success of their own (beta, with a given correlation within a
map), and conditions have their chances and their noise partly in common. Times of
arrival are lognormal, half of their spread the map's, longer where the chance is low,
and a failure counts as T = 100 s. Tables have how often an interval covers the truth,
and how often a family of comparisons in which nothing differs finds a difference.
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

_MAPS_WITHIN = 0.2  # correlation within a map of a group, about the group's chance
RATES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
# Correlation within a map, and the share of chances and noise that two conditions have
# in common.
LIKENESS = ((0.1, 0.3), (0.3, 0.7), (0.6, 0.9))
TIME_BUDGET_S = 100.0
_MEDIAN_S, _SPREAD, _STEP_S = 33.0, 0.3, 0.1


def chance_at(score: np.ndarray, rate: float, within: float) -> np.ndarray:
    """Return the chance of success of maps by their normal scores."""
    size = 1 / within - 1
    return beta.ppf(norm.cdf(score), rate * size, (1 - rate) * size)


def chances(
    generator: np.random.Generator,
    rates: Sequence[float],
    shape: tuple[int, int],
    like: tuple[float, float],
) -> np.ndarray:
    """Draw the chance of success of each condition on each map, shape [studies,
    conditions, maps].
    """
    within, common = like
    studies, maps = shape
    shared = generator.standard_normal((studies, 1, maps))
    own = generator.standard_normal((studies, len(rates), maps))
    scores = np.sqrt(common) * shared + np.sqrt(1 - common) * own
    grid = np.linspace(-6, 6, 4_001)
    columns = [
        np.interp(scores[:, i], grid, chance_at(grid, rate, within))
        for i, rate in enumerate(rates)
    ]
    return np.stack(columns, axis=1)


def outcomes(
    generator: np.random.Generator, chance: np.ndarray, draws: int, common: float
) -> np.ndarray:
    """Success, bool, shape [studies, conditions, maps, draws]; a share of the noise is
    the same for all conditions.
    """
    shape = (*chance.shape, draws)
    noise = np.broadcast_to(generator.random((shape[0], 1, *shape[2:])), shape)
    own = generator.random(shape)
    return np.where(generator.random(shape) < common, noise, own) < chance[..., None]


def times(
    generator: np.random.Generator, success: np.ndarray, hardness: np.ndarray
) -> np.ndarray:
    """T_total in seconds, of the shape of `success`; hardness of maps as normal scores,
    of that less the last.
    """
    own = generator.standard_normal(success.shape)
    arrival = _MEDIAN_S * np.exp(_SPREAD * np.sqrt(0.5) * (hardness[..., None] + own))
    steps = np.rint(np.minimum(arrival, TIME_BUDGET_S - 1) / _STEP_S)
    return np.where(success, steps * _STEP_S, TIME_BUDGET_S)


def hardness(chance: np.ndarray, rates: Sequence[float], within: float) -> np.ndarray:
    """Return normal scores of maps, the higher the lower their chance; of the shape of
    `chance`.
    """
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
    success = outcomes(generator, chance, draws, like[1])
    return success, times(generator, success, hardness(chance, rates, like[0]))


def true_difference_s(
    generator: np.random.Generator, rates: Sequence[float], like: tuple[float, float]
) -> tuple[float, float]:
    """Return T_total of the first of two conditions, and how much it is over the
    other's.
    """
    _, far = drives(generator, rates, (1, 400_000), 1, like)
    return far[0, 0].mean(), (far[0, 0] - far[0, 1]).mean()


def covers(ends: np.ndarray, truth: float) -> np.ndarray:
    """Return which intervals, ends of shape [studies, 2], hold the truth."""
    return (ends[:, 0] <= truth) & (truth <= ends[:, 1])


def rate_intervals(success: np.ndarray) -> np.ndarray:
    """Return Wilson's intervals over the design effect, [studies, 2], of success
    [studies, maps, draws].
    """
    maps, draws = success.shape[1:]
    member = np.repeat(np.arange(maps), draws)
    return np.array(
        [
            wilson_interval(
                study.mean(), study.size / design_effect(study.ravel(), member)
            )
            for study in success
        ]
    )


def difference_intervals(
    wins: np.ndarray, episodes: int, confidence: float = 0.95
) -> np.ndarray:
    """Return intervals of the difference of success, [studies, 2], of successes by map
    [studies, 2, maps].
    """
    return np.stack(
        success_interval(wins[:, 0] - wins[:, 1], episodes, confidence)[1:], axis=1
    )


def cover_of_success(
    generator: np.random.Generator,
    studies: int,
    maps: int,
    draws: int,
    rates: Sequence[float] = RATES,
) -> Iterator[float]:
    """For each rate and likeness, yield how often the interval of success holds the
    rate.
    """
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
    """For each pair of rates and likeness, yield how often the interval of the
    difference of success holds it.
    """
    for pair, like in product(combinations(rates, 2), LIKENESS):
        chance = chances(generator, pair, (studies, maps), like)
        wins = outcomes(generator, chance, draws, like[1]).sum(-1)
        yield covers(difference_intervals(wins, draws), pair[0] - pair[1]).mean()


def episodes_of(
    success: np.ndarray, total_time_s: np.ndarray
) -> Iterator[pd.DataFrame]:
    """Yield the paired episodes of each study, as the package's statistics read them."""
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
    """Return cover and mean width of the intervals of T_total and of its difference
    between two conditions.

    Args:
        generator: of all that is drawn.
        studies: how many of each likeness.
        shape: maps of a study, and episodes a map.
        rates: of success; T_total is that of the first.
        resampled: number of the studies for which a bootstrap (BCa) over maps is
            computed too.

    Returns:
        A row each for `T_total` and `ΔT_total`, and for the bootstrap's; columns
        `cover` and `width`.
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
                total_time_mean(own, {"time_budget_s": TIME_BUDGET_S})[1:]
                for own in episodes
            ],
            [time_difference(own)[1:] for own in episodes],
        )
        values = by_map[:, 0], by_map[:, 0] - by_map[:, 1]
        for name, ends, truth, value in zip(
            ("T_total", "ΔT_total"), intervals, truths, values, strict=True
        ):
            found = {name: np.array(ends)}
            if resampled:
                drawn = bootstrap(
                    (value[:resampled],),
                    np.mean,
                    axis=-1,
                    n_resamples=999,
                    rng=generator,
                )
                found[f"{name}, bootstrap"] = np.stack(
                    drawn.confidence_interval, axis=1
                )
            rows += [
                pd.DataFrame(
                    {
                        "name": key,
                        "cover": covers(own, truth),
                        "width": own[:, 1] - own[:, 0],
                    }
                )
                for key, own in found.items()
            ]
    return pd.concat(rows).groupby("name", sort=False).mean()


def false_findings(
    generator: np.random.Generator,
    studies: int,
    maps: int,
    draws: int,
    rates: Sequence[float] = (0.05, 0.5, 0.8),
) -> Iterator[np.ndarray]:
    """For each rate and likeness, yield how often any two of six equal settings differ
    significantly.

    By success, and by time.
    """
    pairs = list(combinations(range(6), 2))
    for rate, like in product(rates, LIKENESS):
        success, total_time_s = drives(
            generator, [rate] * 6, (studies, maps), draws, like
        )
        found = np.zeros(2)
        for wins, taken in zip(success.sum(-1), total_time_s.mean(-1), strict=True):
            by_success = [sign_flip_p(wins[i] - wins[j]) for i, j in pairs]
            by_time = [
                signed_rank_p(alike(taken[i] - taken[j], TIME_BUDGET_S))
                for i, j in pairs
            ]
            # Holm's correction finds something where its first step does.
            found += [min(p) <= ALPHA / len(pairs) for p in (by_success, by_time)]
        yield found / studies


def group_wins(
    generator: np.random.Generator,
    rates: Sequence[float],
    shape: tuple[int, int],
    episodes: int,
    like: tuple[float, float],
    one_map: bool,
) -> np.ndarray:
    """Draw successes by group, shape [studies, conditions, groups], all episodes on one
    map or each on its own.
    """
    chance = chances(generator, rates, shape, like)
    if one_map:
        return outcomes(generator, chance, episodes, like[1]).sum(-1)
    size, inside = 1 / _MAPS_WITHIN - 1, np.clip(chance, 1e-9, 1 - 1e-9)[..., None]
    maps = generator.beta(inside * size, (1 - inside) * size, (*chance.shape, episodes))
    return outcomes(generator, maps, 1, like[1])[..., 0].sum(-1)


def cover_of_groups(
    generator: np.random.Generator,
    studies: int,
    groups: int,
    episodes: int,
    rates: tuple[float, float],
    like: tuple[float, float],
) -> dict[str, float]:
    """Return cover of the intervals of a difference and of each rate, and half-widths;
    also those of a cluster t.
    """
    drawn = [
        group_wins(generator, rates, (studies // 2, groups), episodes, like, one_map)
        for one_map in (True, False)
    ]
    wins, truth = np.concatenate(drawn), rates[0] - rates[1]
    shares = (wins[:, 0] - wins[:, 1]) / episodes
    half = t.ppf(0.975, groups - 1) * shares.std(-1, ddof=1) / np.sqrt(groups)
    student = shares.mean(-1)[:, None] + np.stack((-half, half), axis=1)
    found = {}
    for name, ends in (("", difference_intervals(wins, episodes)), ("_t", student)):
        found |= {
            f"cover{name}": covers(ends, truth).mean(),
            f"half{name}": np.ptp(ends, axis=1).mean() / 2,
        }
    for place, rate in enumerate(rates):
        ends = rate_intervals(np.arange(episodes) < wins[:, place, :, None])
        found[f"cover_{place}"] = covers(ends, rate).mean()
    return found


def unlike(
    generator: np.random.Generator,
    studies: int,
    settings: int,
    maps: int,
    draws: int,
    same_maps: bool,
) -> np.ndarray:
    """Successes of settings of one mean and unlike shape, shape [studies, settings,
    maps].

    The first half succeeds with a chance of 0.9 everywhere, the other always but for a
    tenth of the maps, where it
    always fails: the same maps for all of that half, or each its own.
    """
    half = settings // 2
    steady = generator.binomial(draws, 0.9, (studies, half, maps))
    failing = (
        generator.random((studies, 1 if same_maps else settings - half, maps)) < 0.1
    )
    return np.concatenate(
        [steady, np.broadcast_to(draws * ~failing, (studies, settings - half, maps))],
        axis=1,
    )


def called_worse(wins: np.ndarray, draws: int) -> np.ndarray:
    """Which settings a report calls worse than the best, bool, of the shape [studies,
    settings].

    Args:
        wins: successes, shape [studies, settings, maps].
        draws: episodes a map.
    """
    return np.array([best_set_p(study.T, draws)[0] < ALPHA for study in wins])
