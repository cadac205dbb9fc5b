"""Scripts of the study; each computes one table."""

from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from rich.progress import track
from scipy.stats import binomtest

from benchnav.stats.episodes import time_difference
from benchnav.stats.flips import sign_flip_p
from benchnav.stats.holm import ALPHA
from studies.statistics.simulated import (
    LIKENESS,
    called_worse,
    cover_of_differences,
    cover_of_groups,
    cover_of_success,
    cover_of_times,
    difference_intervals,
    drives,
    episodes_of,
    false_findings,
    true_difference_s,
    unlike,
)
from studies.study import Work

# Studies with few, large groups: success rates of two conditions; correlation within a
# group, and the fraction that two conditions share.
GROUPS, IN_A_GROUP = (5, 8, 12), (20, 60)
GROUP_RATES, GROUP_LIKENESS = (
    ((0.99, 0.9), (0.8, 0.6)),
    tuple(product((0.1, 0.3, 0.5), (0.0, 0.5))),
)
MAPS = (50, 100, 200)
DRAWS = (1, 3)


def _as_table(
    rows: Callable[[int, int], Iterator[dict[str, object]]],
) -> Callable[..., dict[str, pd.DataFrame]]:
    """Turn a function that yields rows into a script.

    The function takes the number of studies per condition and a seed.
    """

    def script(
        work: Work, folder: Path, studies: int = 2000, seed: int = 0
    ) -> dict[str, pd.DataFrame]:
        return {"rows": pd.DataFrame(track(rows(studies, seed), rows.__name__))}

    return script


@_as_table
def intervals(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """Yield coverage of intervals of success, and type I error rates of `compare`."""
    for maps, draws in product(MAPS, DRAWS):
        generator = np.random.default_rng([seed, maps, draws])
        success, difference = (
            100 * np.array(list(cover(generator, studies, maps, draws)))
            for cover in (cover_of_success, cover_of_differences)
        )
        false = (
            100 * np.array(list(false_findings(generator, studies // 5, maps, draws))).T
        )
        yield {
            "maps": maps,
            "episodes a map": draws,
            "success": f"{success.mean():.1f}, {success.min():.1f}",
            "difference": f"{difference.mean():.1f}, {difference.min():.1f}",
            "false: success": f"{false[0].mean():.1f}, {false[0].max():.1f}",
            "false: T_total": f"{false[1].mean():.1f}, {false[1].max():.1f}",
        }


@_as_table
def times(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """Yield coverage and width of intervals of T_total, also those of a bootstrap."""
    for maps, draws, rate in product((8, 20, 30), DRAWS, (0.8, 0.95, 0.99)):
        generator = np.random.default_rng([seed, maps, draws, round(100 * rate)])
        rates = rate, rate - 0.1
        coverage = cover_of_times(
            generator, studies // 3, (maps, draws), rates, studies // 20
        )
        cells = {
            name: f"{100 * row['cover']:.1f} ({row['width']:.1f} s)"
            for name, row in coverage.iterrows()
        }
        yield {"maps": maps, "episodes a map": draws, "success": rate, **cells}


@_as_table
def groups(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """Yield coverage and width of intervals of success with few, large groups."""
    for groups, episodes, like in product(GROUPS, IN_A_GROUP, GROUP_LIKENESS):
        generator = np.random.default_rng(
            [seed, groups, episodes, *(round(100 * value) for value in like)]
        )
        row: dict[str, object] = {"groups": groups, "episodes": episodes}
        row |= {"correlation": like[0], "shared": like[1]}
        covers: dict[str, object] = {}
        for rate_a, rate_b in GROUP_RATES:
            coverage = cover_of_groups(
                generator, studies, groups, episodes, (rate_a, rate_b), like
            )
            row[f"{rate_a:g} − {rate_b:g}"] = (
                f"{100 * coverage['cover']:.1f} ({coverage['half']:.2f})"
            )
            row[f"{rate_a:g} − {rate_b:g}, t"] = (
                f"{100 * coverage['cover_t']:.1f} ({coverage['half_t']:.2f})"
            )
            covers |= {
                f"{rate_a:g}": f"{100 * coverage['cover_0']:.1f}",
                f"{rate_b:g}": f"{100 * coverage['cover_1']:.1f}",
            }
        yield row | covers


@_as_table
def best(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """Yield how often a condition as good as the best is called worse, and the power.

    The power is for a condition that is 10 or 20 points worse.
    """
    for settings, maps, draws in product((6, 12), (20, *MAPS), DRAWS):
        generator = np.random.default_rng([seed, settings, maps, draws])
        row: dict[str, object] = {
            "settings": settings,
            "maps": maps,
            "episodes a map": draws,
        }

        half = settings // 2
        rates = {f"all tied, {rate:g}": [rate] * settings for rate in (0.8, 0.95)}
        rates["half tied"] = [0.8] * half + [0.7] * half
        for heading, case in rates.items():
            called = _called_worse(generator, case, (studies, maps), draws)
            is_best = np.array(case) == max(case)
            row[heading] = _percentage(called[:, is_best].any(1))
        for heading, same_maps in (("unlike", False), ("unlike, same maps", True)):
            wins = unlike(generator, studies, settings, maps, draws, same_maps)
            row[heading] = _percentage(called_worse(wins, draws).any(1))
        for points in (10, 20):
            case = [0.8] * (settings - 1) + [0.8 - points / 100]
            called = _called_worse(generator, case, (studies, maps), draws)
            row[f"power, {points} points"] = f"{100 * called[:, -1].mean():.0f}"
        yield row


def _called_worse(
    generator: np.random.Generator,
    rates: list[float],
    shape: tuple[int, int],
    draws: int,
) -> np.ndarray:
    """Draw studies with these rates; return which settings are called worse."""
    success, _ = drives(generator, rates, shape, draws, LIKENESS[1])
    return called_worse(success.sum(-1), draws)


@_as_table
def hypotheses(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """Yield how often a false hypothesis is supported.

    It is false because the conditions do not differ, or differ by the margin.
    """
    for maps, draws, rate in product((20, 50, 200), DRAWS, (0.8, 0.95)):
        generator = np.random.default_rng([seed, maps, draws, round(100 * rate), 1])
        worse, like = rate - 0.1, LIKENESS[1]
        success, _ = drives(generator, (rate, rate), (studies, maps), draws, like)
        equal = success.sum(-1)
        _, margin_s = true_difference_s(generator, (worse, rate), like)
        success, taken = drives(generator, (worse, rate), (studies, maps), draws, like)
        low = difference_intervals(success.sum(-1), draws, 1 - 2 * ALPHA)[:, 0]
        pairs = episodes_of(success, taken)
        low_s, high_s = np.array(
            [time_difference(episodes, 1 - 2 * ALPHA)[1:] for episodes in pairs]
        ).T
        yield {
            "maps": maps,
            "episodes a map": draws,
            "success": rate,
            "difference, success": _percentage(
                np.array([sign_flip_p(wins[0] - wins[1]) < ALPHA for wins in equal])
            ),
            "non-inferiority, success": _percentage(low > -0.1),
            "non-inferiority, T_total": _percentage(high_s < margin_s),
            "equivalence, T_total": _percentage(
                (high_s < margin_s) & (low_s > -margin_s)
            ),
        }


def _percentage(is_true: np.ndarray) -> str:
    """Format a rate in per cent with its 95 % interval of Clopper and Pearson."""
    ends = binomtest(int(is_true.sum()), len(is_true)).proportion_ci()
    return f"{100 * is_true.mean():.1f} ({100 * ends.low:.1f}–{100 * ends.high:.1f})"
