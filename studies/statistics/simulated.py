"""Coverage of intervals and error rates of tests, on simulated benchmarks whose truth is known.

Maps have a chance of success of their own (beta, with a given correlation within a map), and conditions have their
chances and their noise partly in common. Times of arrival are lognormal, half of their spread the map's, longer where
the chance is low, and a failure counts as T = 100 s. Tables have how often an interval covers the truth, and how often
a family of comparisons in which nothing differs finds a difference.
"""

from collections.abc import Iterator, Sequence
from itertools import combinations, product

import numpy as np
from scipy.stats import beta, bootstrap, norm, t

from benchnav.stats.best import best_set_p
from benchnav.stats.by_map import alike
from benchnav.stats.flips import sign_flip_p, signed_rank_p
from benchnav.stats.holm import ALPHA
from benchnav.stats.intervals import design_effect, success_interval, total_time_interval, wilson_interval

_MAPS_WITHIN = 0.2  # correlation within a map of a group, about the group's chance
RATES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
# Correlation within a map, and the share of chances and noise that two conditions have in common.
LIKENESS = ((0.1, 0.3), (0.3, 0.7), (0.6, 0.9))
TIME_BUDGET_S = 100.0
_MEDIAN_S, _SPREAD, _STEP_S = 33.0, 0.3, 0.1


def chances(
    generator: np.random.Generator, rates: np.ndarray, shape: tuple[int, int], within: float, common: float
) -> np.ndarray:
    """Chance of success of each condition on each map, shape [studies, conditions, maps]."""
    studies, maps = shape
    shared = generator.standard_normal((studies, 1, maps))
    own = generator.standard_normal((studies, len(rates), maps))
    scores = np.sqrt(common) * shared + np.sqrt(1 - common) * own
    size, grid = 1 / within - 1, np.linspace(-6, 6, 4_001)
    return np.stack(
        [
            np.interp(scores[:, i], grid, beta.ppf(norm.cdf(grid), rate * size, (1 - rate) * size))
            for i, rate in enumerate(rates)
        ],
        axis=1,
    )


def outcomes(generator: np.random.Generator, chance: np.ndarray, draws: int, common: float) -> np.ndarray:
    """Success, bool, shape [studies, conditions, maps, draws]; a share of the noise is the same for all conditions."""
    shape = (*chance.shape, draws)
    noise = np.broadcast_to(generator.random((shape[0], 1, *shape[2:])), shape)
    own = generator.random(shape)
    return np.where(generator.random(shape) < common, noise, own) < chance[..., None]


def times(generator: np.random.Generator, success: np.ndarray, hardness: np.ndarray) -> np.ndarray:
    """T_total in seconds, of the shape of `success`; hardness of maps as normal scores, of that less the last."""
    own = generator.standard_normal(success.shape)
    arrival = _MEDIAN_S * np.exp(_SPREAD * np.sqrt(0.5) * (hardness[..., None] + own))
    steps = np.rint(np.minimum(arrival, TIME_BUDGET_S - 1) / _STEP_S)
    return np.where(success, steps * _STEP_S, TIME_BUDGET_S)


def hardness(chance: np.ndarray, rates: np.ndarray, within: float) -> np.ndarray:
    """Normal scores of maps, the higher the lower their chance; of the shape of `chance`."""
    size = 1 / within - 1
    made = np.empty_like(chance)
    for i, rate in enumerate(rates):
        grid = np.linspace(-4, 4, 2_001)
        at = beta.ppf(norm.cdf(grid), rate * size, (1 - rate) * size)
        made[:, i] = -np.interp(chance[:, i], at, grid)
    return made


def drives(
    generator: np.random.Generator,
    rates: Sequence[float],
    shape: tuple[int, int],
    draws: int,
    like: tuple[float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """Success and T_total, both of shape [studies, conditions, maps, draws]."""
    given = np.array(rates)
    chance = chances(generator, given, shape, *like)
    success = outcomes(generator, chance, draws, like[1])
    return success, times(generator, success, hardness(chance, given, like[0]))


def rate_cover(success: np.ndarray, rate: float) -> float:
    """How often Wilson's interval over the design effect holds the rate; success of shape [studies, maps, draws]."""
    maps, draws = success.shape[1:]
    member = np.repeat(np.arange(maps), draws)
    held = 0
    for study in success:
        low, high = wilson_interval(study.mean(), study.size / design_effect(study.ravel(), member))
        held += low <= rate <= high
    return held / len(success)


def cover_of_success(
    generator: np.random.Generator, studies: int, maps: int, draws: int, rates: Sequence[float] = RATES
) -> Iterator[float]:
    """For each rate and likeness, how often Wilson's interval over the design effect holds the rate."""
    for rate, (within, common) in product(rates, LIKENESS):
        chance = chances(generator, np.array([rate]), (studies, maps), within, common)
        yield rate_cover(outcomes(generator, chance, draws, common)[:, 0], rate)


def cover_of_differences(
    generator: np.random.Generator, studies: int, maps: int, draws: int, rates: Sequence[float] = RATES
) -> Iterator[float]:
    """For each pair of rates and likeness, how often the interval of the difference of success holds it."""
    for (one, other), (within, common) in product(combinations(rates, 2), LIKENESS):
        chance = chances(generator, np.array([one, other]), (studies, maps), within, common)
        wins = outcomes(generator, chance, draws, common).sum(-1)
        _, low, high = success_interval(wins[:, 0] - wins[:, 1], draws)
        yield float(np.mean((low <= one - other) & (one - other <= high)))


def time_intervals(
    success: np.ndarray, taken: np.ndarray, confidence: float = 0.95
) -> dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Intervals of T_total of the first condition and of its difference from the second.

    As `summary.total_time_mean` and `comparison.time_difference` make them, of many studies at once.

    Args:
        success: bool, shape [studies, 2, maps, draws].
        taken: T_total in seconds, of the same shape.
        confidence: coverage asked for; that of T_total itself is 95 %.

    Returns:
        Mean and ends of `time` and `difference`, each of shape [studies].
    """
    maps, draws = success.shape[2:]
    member = np.repeat(np.arange(maps), draws)
    arrivals = np.where(success, taken, 0.0).sum((2, 3)), success.sum((2, 3))
    failed, by_map = 1.0 - success.mean(-1), taken.mean(-1)
    effects = [design_effect(study.ravel(), member) for study in success[:, 0]]
    rates = success[:, 0].mean((1, 2))
    ends = np.array(
        [wilson_interval(rate, maps * draws / effect) for rate, effect in zip(rates, effects, strict=True)]
    )
    penalty_s = TIME_BUDGET_S - arrivals[0][:, 0] / np.maximum(arrivals[1][:, 0], 1)
    some = success.any(-1)
    own = total_time_interval(
        by_map[:, 0], failed[:, 0], (1 - ends[:, 1], 1 - ends[:, 0]), penalty_s, some[:, 0].sum(-1)
    )
    gain = success[:, 0].sum(-1) - success[:, 1].sum(-1)
    _, low, high = success_interval(gain, draws, confidence)
    penalty_s = TIME_BUDGET_S - arrivals[0].sum(1) / np.maximum(arrivals[1].sum(1), 1)
    both = some.all(1).sum(-1)
    late, fewer = by_map[:, 0] - by_map[:, 1], failed[:, 0] - failed[:, 1]
    difference = total_time_interval(late, fewer, (-high, -low), penalty_s, both, confidence)
    return {"time": own, "difference": difference}


def cover_of_times(
    generator: np.random.Generator,
    studies: int,
    maps: int,
    draws: int,
    rates: tuple[float, float],
    resampled: int = 0,
) -> dict[str, float]:
    """Cover and mean width of the intervals of T_total and of its difference between two conditions.

    Args:
        generator: of all that is drawn.
        studies: how many of each likeness.
        maps: of a study.
        draws: episodes a map.
        rates: of success; T_total is that of the first.
        resampled: of so many studies also of a bootstrap (BCa) over maps.
    """
    found: dict[str, list[np.ndarray]] = {}
    for like in LIKENESS:
        _, far = drives(generator, rates, (1, 400_000), 1, like)
        truths = {"time": far[0, 0].mean(), "difference": (far[0, 0] - far[0, 1]).mean()}
        success, taken = drives(generator, rates, (studies, maps), draws, like)
        by_map = taken.mean(-1)
        values = {"time": by_map[:, 0], "difference": by_map[:, 0] - by_map[:, 1]}
        for name, interval in time_intervals(success, taken).items():
            ends = {"": interval[1:]}
            if resampled:
                drawn = bootstrap(
                    (values[name][:resampled],), np.mean, axis=-1, n_resamples=999, rng=generator
                )
                ends["_bootstrap"] = (drawn.confidence_interval.low, drawn.confidence_interval.high)
            for how, (low, high) in ends.items():
                held = (low <= truths[name]) & (truths[name] <= high)
                found.setdefault(f"{name}_cover{how}", []).append(held)
                found.setdefault(f"{name}_width{how}", []).append(high - low)
    return {name: float(np.concatenate(parts).mean()) for name, parts in found.items()}


def false_findings(
    generator: np.random.Generator,
    studies: int,
    maps: int,
    draws: int,
    rates: Sequence[float] = (0.05, 0.5, 0.8),
) -> Iterator[tuple[float, float]]:
    """For each rate and likeness, how often any two of six settings that are alike differ significantly.

    By success, and by time.
    """
    settings = 6
    for rate, like in product(rates, LIKENESS):
        success, total_time_s = drives(generator, [rate] * settings, (studies, maps), draws, like)
        wins, taken = success.sum(-1), total_time_s.mean(-1)
        found = np.zeros(2)
        for study in range(studies):
            pairs = list(combinations(range(settings), 2))
            by_success = [sign_flip_p(wins[study, i] - wins[study, j]) for i, j in pairs]
            late = [alike(taken[study, i] - taken[study, j], TIME_BUDGET_S) for i, j in pairs]
            by_time = [signed_rank_p(values) for values in late]
            # Holm's correction finds something where its first step does.
            found += [min(p) <= ALPHA / len(pairs) for p in (by_success, by_time)]
        yield tuple(found / studies)


def group_wins(
    generator: np.random.Generator,
    rates: Sequence[float],
    shape: tuple[int, int],
    episodes: int,
    like: tuple[float, float],
    one_map: bool,
) -> np.ndarray:
    """Successes by group, shape [studies, conditions, groups], with all episodes on one map or each on its own."""
    chance = chances(generator, np.array(rates), shape, *like)
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
    """Cover of the intervals of a difference and of each rate, and half-widths, those of a cluster t beside them."""
    wins = np.concatenate(
        [
            group_wins(generator, rates, (studies // 2, groups), episodes, like, one_map)
            for one_map in (True, False)
        ]
    )
    gain, truth = wins[:, 0] - wins[:, 1], rates[0] - rates[1]
    mean, low, high = success_interval(gain, episodes)
    error = (gain / episodes).std(-1, ddof=1) / np.sqrt(groups)
    half = t.ppf(0.975, groups - 1) * error
    found = {
        "cover": float(np.mean((low <= truth) & (truth <= high))),
        "half": float(np.mean(high - low) / 2),
        "cover_t": float(np.mean(np.abs(mean - truth) <= half)),
        "half_t": float(half.mean()),
    }
    for place, rate in enumerate(rates):
        found[f"cover_{place}"] = rate_cover(np.arange(episodes) < wins[:, place, :, None], rate)
    return found


def unlike(
    generator: np.random.Generator, studies: int, settings: int, maps: int, draws: int, same_maps: bool
) -> np.ndarray:
    """Successes of settings of one mean and unlike shape, shape [studies, settings, maps].

    The first half succeeds with a chance of 0.9 everywhere, the other always but for a tenth of the maps, where it
    always fails: the same maps for all of that half, or each its own.
    """
    half = settings // 2
    steady = generator.binomial(draws, 0.9, (studies, half, maps))
    failing = generator.random((studies, 1 if same_maps else settings - half, maps)) < 0.1
    return np.concatenate(
        [steady, np.broadcast_to(draws * ~failing, (studies, settings - half, maps))], axis=1
    )


def called_worse(wins: np.ndarray, draws: int) -> np.ndarray:
    """Which settings a report calls worse than the best, bool, of the shape [studies, settings].

    Args:
        wins: successes, shape [studies, settings, maps].
        draws: episodes a map.
    """
    return np.array([best_set_p(study.T, draws)[0] < ALPHA for study in wins])
