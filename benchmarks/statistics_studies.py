"""Do intervals hold what they promise, and do tests err as rarely as they say? Studies on simulated benchmarks.

    python benchmarks/statistics_studies.py --studies 2000
    python benchmarks/statistics_studies.py --studies 2000 --parts best --json best.json

Maps have a chance of success of their own (beta, with a given correlation within a map), and conditions have their
chances and their noise partly in common. Times of arrival are lognormal, half of their spread the map's, longer where
the chance is low, and a failure counts as T = 100 s. Printed is how often an interval covers the truth, and how often a
family of comparisons in which nothing differs finds a difference.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Sequence
from itertools import combinations, product
from pathlib import Path

import numpy as np
from scipy.stats import beta, binomtest, bootstrap, norm

from benchnav.core.resampling import sign_flips
from benchnav.eval.stats.best import best_set_p
from benchnav.eval.stats.comparison import ALPHA
from benchnav.eval.stats.paired_difference import (
    sign_flip_p,
    signed_rank_p,
    success_interval,
    total_time_interval,
)
from benchnav.eval.stats.summary import cautious_design_effect, wilson_interval

RATES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
MAPS = (50, 100, 200)
DRAWS = (1, 3)
# Correlation within a map, and the share of chances and noise that two conditions have in common.
LIKENESS = ((0.1, 0.3), (0.3, 0.7), (0.6, 0.9))
TIME_BUDGET_S = 100.0
_MEDIAN_S, _SPREAD = 33.0, 0.3

# Flips of signs in a study of the best: of as many as a report draws, the first.
_FLIPS = 2_000


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
    return np.where(success, np.minimum(arrival, TIME_BUDGET_S - 1), TIME_BUDGET_S)


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


def cover_of_success(
    generator: np.random.Generator, studies: int, maps: int, draws: int, rates: Sequence[float] = RATES
) -> Iterator[float]:
    """For each rate and likeness, how often Wilson's interval over the design effect holds the rate."""
    member = np.repeat(np.arange(maps), draws)
    for rate, (within, common) in product(rates, LIKENESS):
        chance = chances(generator, np.array([rate]), (studies, maps), within, common)
        held = 0
        for study in outcomes(generator, chance, draws, common)[:, 0]:
            effect = cautious_design_effect(study.ravel(), member)
            low, high = wilson_interval(study.mean(), study.size / effect)
            held += low <= rate <= high
        yield held / studies


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
    effects = [cautious_design_effect(study.ravel(), member) for study in success[:, 0]]
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
            by_time = [signed_rank_p(taken[study, i] - taken[study, j]) for i, j in pairs]
            # Holm's correction finds something where its first step does.
            found += [min(p) <= ALPHA / len(pairs) for p in (by_success, by_time)]
        yield tuple(found / studies)


def called_worse(
    generator: np.random.Generator,
    studies: int,
    rates: Sequence[float],
    maps: int,
    draws: int,
    like: tuple[float, float],
) -> dict[str, np.ndarray]:
    """Which conditions are called worse than the best by success and by T_total, bool, shape [studies, conditions].

    Conditions of one rate have one distribution of times, so that those of the highest rate are the best by both.
    """
    success, total_time_s = drives(generator, rates, (studies, maps), draws, like)
    flips = sign_flips(maps)[:_FLIPS] if 2**maps > _FLIPS else sign_flips(maps)
    measures = {"success": success.sum(-1), "time": -total_time_s.mean(-1)}
    return {
        name: np.array([best_set_p(study.T.astype(float), flips)[0] < ALPHA for study in values])
        for name, values in measures.items()
    }


def study_intervals(studies: int, seed: int) -> list[dict[str, object]]:
    """Cover of the intervals of success and of its difference, and how often `compare` errs."""
    rows = []
    for maps, draws in product(MAPS, DRAWS):
        generator = np.random.default_rng([seed, maps, draws])
        row: dict[str, object] = {"maps": maps, "episodes a map": draws}
        for name, cover in (("success", cover_of_success), ("difference", cover_of_differences)):
            found = list(cover(generator, studies, maps, draws))
            row[name] = f"{100 * np.mean(found):.1f}, {100 * np.min(found):.1f}"
        false = 100 * np.array(list(false_findings(generator, studies // 5, maps, draws)))
        for place, name in enumerate(("false: success", "false: T_total")):
            row[name] = f"{false[:, place].mean():.1f}, {false[:, place].max():.1f}"
        rows.append(row)
    return rows


def study_times(studies: int, seed: int) -> list[dict[str, object]]:
    """Cover and width of the intervals of T_total and of its difference, beside those of a bootstrap."""
    rows = []
    for maps, draws, rate in product((8, 20, 30), DRAWS, (0.8, 0.95, 0.99)):
        generator = np.random.default_rng([seed, maps, draws, round(100 * rate)])
        row: dict[str, object] = {"maps": maps, "episodes a map": draws, "success": rate}
        found = cover_of_times(generator, studies // 3, maps, draws, (rate, rate - 0.1), studies // 20)
        for name, words in (("time", "T_total"), ("difference", "ΔT_total")):
            for how, by in (("", ""), ("_bootstrap", ", bootstrap")):
                cover, width = found[f"{name}_cover{how}"], found[f"{name}_width{how}"]
                row[words + by] = f"{100 * cover:.1f} ({width:.1f} s)"
        rows.append(row)
    return rows


def study_best(studies: int, seed: int) -> list[dict[str, object]]:
    """How often a condition that is as good as the best is called worse, and one that is 10 points worse."""
    rows = []
    for settings, (maps, draws), rate in product((6, 12, 24), ((20, 1), (50, 3), (200, 3)), (0.8, 0.95)):
        generator = np.random.default_rng([seed, settings, maps, draws, round(100 * rate)])
        row: dict[str, object] = {
            "settings": settings,
            "maps": maps,
            "episodes a map": draws,
            "success": rate,
        }
        half = settings // 2
        cases = {"all tied": (settings, 0), "half tied": (half, half), "power": (settings - 1, 1)}
        for case, (tied, worse) in cases.items():
            rates = [rate] * tied + [rate - 0.1] * worse
            found = called_worse(generator, studies, rates, maps, draws, LIKENESS[1])
            for name, called in found.items():
                words = "T_total" if name == "time" else name
                if case == "power":
                    row[f"power, {words}"] = f"{100 * called[:, -1].mean():.0f}"
                else:
                    row[f"{case}, {words}"] = _share(called[:, :tied].any(1))
        rows.append(row)
    return rows


def study_hypotheses(studies: int, seed: int) -> list[dict[str, object]]:
    """How often a single hypothesis is shown where it is false: no difference, or one as large as the margin."""
    rows = []
    for maps, draws, rate in product((20, 50, 200), DRAWS, (0.8, 0.95)):
        generator = np.random.default_rng([seed, maps, draws, round(100 * rate), 1])
        row: dict[str, object] = {"maps": maps, "episodes a map": draws, "success": rate}
        one, other, like = rate - 0.1, rate, LIKENESS[1]
        success, taken = drives(generator, (other, other), (studies, maps), draws, like)
        wins = success[:, 0].sum(-1) - success[:, 1].sum(-1)
        row["difference, success"] = _share(np.array([sign_flip_p(gain) < ALPHA for gain in wins]))
        _, far = drives(generator, (one, other), (1, 400_000), 1, like)
        success, taken = drives(generator, (one, other), (studies, maps), draws, like)
        wins = success[:, 0].sum(-1) - success[:, 1].sum(-1)
        _, low, _ = success_interval(wins, draws, 1 - 2 * ALPHA)
        row["non-inferiority, success"] = _share(low > -0.1)
        _, low, high = time_intervals(success, taken, 1 - 2 * ALPHA)["difference"]
        margin = (far[0, 0] - far[0, 1]).mean()
        row["non-inferiority, T_total"] = _share(high < margin)
        row["equivalence, T_total"] = _share((high < margin) & (low > -margin))
        rows.append(row)
    return rows


def _share(found: np.ndarray) -> str:
    """A share in per cent with its 95 % interval of Clopper and Pearson."""
    ends = binomtest(int(found.sum()), len(found)).proportion_ci()
    return f"{100 * found.mean():.1f} ({100 * ends.low:.1f}–{100 * ends.high:.1f})"


STUDIES: dict[str, tuple[Callable[[int, int], list[dict[str, object]]], str]] = {
    "intervals": (
        study_intervals,
        "Cover of 95 % intervals [%], mean and least over conditions; false findings of a family, mean and most.",
    ),
    "times": (
        study_times,
        "Cover of 95 % intervals [%] and mean width, the other condition 10 points worse.",
    ),
    "hypotheses": (
        study_hypotheses,
        "How often a hypothesis is shown that is false, the truth being no difference or on the margin [%].",
    ),
    "best": (
        study_best,
        "How often a condition as good as the best is called worse [%], with its 95 % interval; power at 10 points.",
    ),
}


def main() -> None:
    """Prints the tables of the studies as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=2000, help="simulated benchmarks for each condition")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--parts", nargs="+", choices=STUDIES, default=list(STUDIES), help="which studies")
    parser.add_argument("--json", type=Path, help="where the numbers are written")
    given = parser.parse_args()
    tables = {}
    for part in given.parts:
        make, title = STUDIES[part]
        tables[part] = make(given.studies, given.seed)
        columns = list(tables[part][0])
        print(f"\n{title}\n\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}")
        for row in tables[part]:
            print(f"| {' | '.join(str(row[name]) for name in columns)} |", flush=True)
    if given.json:
        given.json.write_text(json.dumps(tables, indent=1))


if __name__ == "__main__":
    main()
