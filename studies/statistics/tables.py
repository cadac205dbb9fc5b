"""The tables of the study, a script each."""

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

# Of the studies of few, large groups: rates of two conditions, correlation within a
# group, and what they share.
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
    """Make a script of a function that yields rows from the number of studies of each
    condition and a seed.
    """

    def script(
        work: Work, folder: Path, studies: int = 2000, seed: int = 0
    ) -> dict[str, pd.DataFrame]:
        return {"rows": pd.DataFrame(track(rows(studies, seed), rows.__name__))}

    return script


@_as_table
def intervals(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """Yield cover of the intervals of success and of its difference, and how often
    `compare` errs.
    """
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
    """Yield cover and width of the intervals of T_total and of its difference, and
    those of a bootstrap.
    """
    for maps, draws, rate in product((8, 20, 30), DRAWS, (0.8, 0.95, 0.99)):
        generator = np.random.default_rng([seed, maps, draws, round(100 * rate)])
        rates = rate, rate - 0.1
        found = cover_of_times(
            generator, studies // 3, (maps, draws), rates, studies // 20
        )
        cells = {
            name: f"{100 * row['cover']:.1f} ({row['width']:.1f} s)"
            for name, row in found.iterrows()
        }
        yield {"maps": maps, "episodes a map": draws, "success": rate, **cells}


@_as_table
def groups(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """Cover and width of the intervals of success and of its difference on few, large
    groups.
    """
    for groups, episodes, like in product(GROUPS, IN_A_GROUP, GROUP_LIKENESS):
        generator = np.random.default_rng(
            [seed, groups, episodes, *(round(100 * value) for value in like)]
        )
        row: dict[str, object] = {"groups": groups, "episodes": episodes}
        row |= {"correlation": like[0], "shared": like[1]}
        covers: dict[str, object] = {}
        for one, other in GROUP_RATES:
            found = cover_of_groups(
                generator, studies, groups, episodes, (one, other), like
            )
            row[f"{one:g} − {other:g}"] = (
                f"{100 * found['cover']:.1f} ({found['half']:.2f})"
            )
            row[f"{one:g} − {other:g}, t"] = (
                f"{100 * found['cover_t']:.1f} ({found['half_t']:.2f})"
            )
            covers |= {
                f"{one:g}": f"{100 * found['cover_0']:.1f}",
                f"{other:g}": f"{100 * found['cover_1']:.1f}",
            }
        yield row | covers


@_as_table
def best(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """How often a condition that is as good as the best is called worse, and one that
    is 10 or 20 points worse.
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
        for words, own in rates.items():
            called = _called_worse(generator, own, (studies, maps), draws)
            row[words] = _share(called[:, np.array(own) == max(own)].any(1))
        for words, same_maps in (("unlike", False), ("unlike, same maps", True)):
            wins = unlike(generator, studies, settings, maps, draws, same_maps)
            row[words] = _share(called_worse(wins, draws).any(1))
        for points in (10, 20):
            own = [0.8] * (settings - 1) + [0.8 - points / 100]
            called = _called_worse(generator, own, (studies, maps), draws)
            row[f"power, {points} points"] = f"{100 * called[:, -1].mean():.0f}"
        yield row


def _called_worse(
    generator: np.random.Generator,
    rates: list[float],
    shape: tuple[int, int],
    draws: int,
) -> np.ndarray:
    """Draw studies of settings with these rates; return which are called worse,
    [studies, settings].
    """
    success, _ = drives(generator, rates, shape, draws, LIKENESS[1])
    return called_worse(success.sum(-1), draws)


@_as_table
def hypotheses(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """How often a single hypothesis is shown where it is false: no difference, or one
    as large as the margin.
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
            [time_difference(own, 1 - 2 * ALPHA)[1:] for own in pairs]
        ).T
        yield {
            "maps": maps,
            "episodes a map": draws,
            "success": rate,
            "difference, success": _share(
                np.array([sign_flip_p(wins[0] - wins[1]) < ALPHA for wins in equal])
            ),
            "non-inferiority, success": _share(low > -0.1),
            "non-inferiority, T_total": _share(high_s < margin_s),
            "equivalence, T_total": _share((high_s < margin_s) & (low_s > -margin_s)),
        }


def _share(found: np.ndarray) -> str:
    """A share in per cent with its 95 % interval of Clopper and Pearson."""
    ends = binomtest(int(found.sum()), len(found)).proportion_ci()
    return f"{100 * found.mean():.1f} ({100 * ends.low:.1f}–{100 * ends.high:.1f})"
