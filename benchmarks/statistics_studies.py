"""Do intervals hold what they promise, and do tests err as rarely as they say? Studies on simulated benchmarks.

    python benchmarks/statistics_studies.py --studies 2000
    python benchmarks/statistics_studies.py --studies 2000 --json statistics.json

Maps have a chance of success of their own (beta, with a given correlation within a map), two trials have their chances
and their luck partly in common, and times are gamma-distributed, a failure counting as T. Printed is how often an
interval holds the truth, and how often a family of comparisons in which nothing differs finds a difference.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from itertools import combinations, product
from pathlib import Path

import numpy as np
from scipy.stats import beta, norm

from benchnav.eval.stats.difference import mean_interval, sign_flip_p, signed_rank_p, success_interval
from benchnav.eval.stats.summary import cautious_design_effect, wilson_interval

RATES = (0.05, 0.2, 0.35, 0.5, 0.65, 0.8, 0.95)
MAPS = (50, 100, 200)
DRAWS = (1, 3)
# Correlation within a map, and the share of chances and luck that two trials have in common.
LIKENESS = ((0.1, 0.3), (0.3, 0.7), (0.6, 0.9))
TIME_BUDGET_S = 100.0


def chances(
    generator: np.random.Generator, rates: np.ndarray, shape: tuple[int, int], within: float, common: float
) -> np.ndarray:
    """Chance of success of each trial on each map, shape [studies, trials, maps]."""
    studies, maps = shape
    shared = generator.standard_normal((studies, 1, maps))
    own = generator.standard_normal((studies, len(rates), maps))
    likeness = norm.cdf(np.sqrt(common) * shared + np.sqrt(1 - common) * own)
    size = 1 / within - 1
    return beta.ppf(likeness, rates[:, None] * size, (1 - rates[:, None]) * size)


def outcomes(generator: np.random.Generator, chance: np.ndarray, draws: int, common: float) -> np.ndarray:
    """Success, bool, shape [studies, trials, maps, draws]; a share of the luck is the same for all trials."""
    shape = (*chance.shape, draws)
    luck = np.broadcast_to(generator.random((shape[0], 1, *shape[2:])), shape)
    own = generator.random(shape)
    return np.where(generator.random(shape) < common, luck, own) < chance[..., None]


def times(generator: np.random.Generator, success: np.ndarray) -> np.ndarray:
    """T_total in seconds, of the same shape: of successes around 35 s, skewed."""
    arrived = 20 + generator.gamma(2.0, 7.5, success.shape)
    return np.where(success, arrived, TIME_BUDGET_S)


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


def cover_of_times(
    generator: np.random.Generator, studies: int, maps: int, draws: int, rates: Sequence[float] = RATES
) -> Iterator[float]:
    """For each rate, how often the bootstrap's interval holds the mean of T_total, and of its difference."""
    for rate, (within, common) in product(rates, LIKENESS):
        both = np.array([rate, min(rate + 0.1, 0.95)])
        chance = chances(generator, both, (studies, maps), within, common)
        taken = times(generator, outcomes(generator, chance, draws, common)).mean(-1)
        expected = both * 35 + (1 - both) * TIME_BUDGET_S
        for values, truth in (
            (taken[:, 0], expected[0]),
            (taken[:, 0] - taken[:, 1], expected[0] - expected[1]),
        ):
            _, low, high = mean_interval(values)
            yield float(np.mean((low <= truth) & (truth <= high)))


def false_findings(
    generator: np.random.Generator,
    studies: int,
    maps: int,
    draws: int,
    rates: Sequence[float] = (0.05, 0.5, 0.8),
) -> Iterator[tuple[float, float]]:
    """For each rate and likeness, how often any two of six settings that are alike are told apart.

    By success, and by time.
    """
    settings = 6
    for rate, (within, common) in product(rates, LIKENESS):
        chance = chances(generator, np.full(settings, rate), (studies, maps), within, common)
        success = outcomes(generator, chance, draws, common)
        wins, taken = success.sum(-1), times(generator, success).mean(-1)
        found = np.zeros(2)
        for study in range(studies):
            pairs = list(combinations(range(settings), 2))
            by_success = [sign_flip_p(wins[study, i] - wins[study, j]) for i, j in pairs]
            by_time = [signed_rank_p(taken[study, i] - taken[study, j]) for i, j in pairs]
            # Holm's correction finds something where its first step does.
            found += [min(p) <= 0.05 / len(pairs) for p in (by_success, by_time)]
        yield tuple(found / studies)


def study(studies: int, seed: int = 0) -> list[dict[str, object]]:
    """All studies, a row for each number of maps and of episodes a map."""
    rows = []
    for maps, draws in product(MAPS, DRAWS):
        generator = np.random.default_rng([seed, maps, draws])
        row: dict[str, object] = {"maps": maps, "draws": draws}
        for name, cover in (
            ("success", cover_of_success),
            ("difference", cover_of_differences),
            ("time", cover_of_times),
        ):
            # The bootstrap is the slow one.
            found = list(cover(generator, studies if name != "time" else studies // 5, maps, draws))
            row |= {f"{name}_mean": float(np.mean(found)), f"{name}_least": float(np.min(found))}
        false = np.array(list(false_findings(generator, studies // 5, maps, draws)))
        row |= {"false_success": float(false[:, 0].mean()), "false_success_most": float(false[:, 0].max())}
        row |= {"false_time": float(false[:, 1].mean()), "false_time_most": float(false[:, 1].max())}
        rows.append(row)
    return rows


def main() -> None:
    """Prints the table of all studies as Markdown."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=2000, help="simulated benchmarks for each condition")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="where the numbers are written")
    given = parser.parse_args()
    rows = study(given.studies, given.seed)
    print(
        "Cover of 95 % intervals [%], mean and least over conditions; false findings of a family, mean and most."
    )
    print("\n| maps | episodes a map | success | difference | T_total | false: success | false: T_total |")
    print("|---|---|---|---|---|---|---|")
    columns = (
        ("success_mean", "success_least"),
        ("difference_mean", "difference_least"),
        ("time_mean", "time_least"),
    )
    columns += ("false_success", "false_success_most"), ("false_time", "false_time_most")
    for row in rows:
        cells = " | ".join(", ".join(f"{100 * row[name]:.1f}" for name in names) for names in columns)
        print(f"| {row['maps']} | {row['draws']} | {cells} |")
    if given.json:
        given.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
