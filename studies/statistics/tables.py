"""The tables of the study, a script each."""

from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
from rich.progress import track
from scipy.stats import binomtest

from benchnav.stats.flips import sign_flip_p
from benchnav.stats.holm import ALPHA
from benchnav.stats.intervals import success_interval
from studies.statistics.simulated import (
    LIKENESS,
    called_worse,
    cover_of_differences,
    cover_of_groups,
    cover_of_success,
    cover_of_times,
    drives,
    false_findings,
    time_intervals,
    unlike,
)
from studies.study import Work

# Of the studies of few, large groups: rates of two conditions, correlation within a group, and what they share.
GROUPS, IN_A_GROUP = (5, 8, 12), (20, 60)
GROUP_RATES, GROUP_LIKENESS = ((0.99, 0.9), (0.8, 0.6)), tuple(product((0.1, 0.3, 0.5), (0.0, 0.5)))
MAPS = (50, 100, 200)
DRAWS = (1, 3)


def _as_table(
    rows: Callable[[int, int], Iterator[dict[str, object]]],
) -> Callable[..., dict[str, pd.DataFrame]]:
    """Make a script of a function that yields rows from the number of studies of each condition and a seed."""

    def script(work: Work, folder: Path, studies: int = 2000, seed: int = 0) -> dict[str, pd.DataFrame]:
        return {"rows": pd.DataFrame(track(rows(studies, seed), rows.__name__))}

    return script


@_as_table
def intervals(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """Cover of the intervals of success and of its difference, and how often `compare` errs."""
    for maps, draws in product(MAPS, DRAWS):
        generator = np.random.default_rng([seed, maps, draws])
        row: dict[str, object] = {"maps": maps, "episodes a map": draws}
        for name, cover in (("success", cover_of_success), ("difference", cover_of_differences)):
            found = list(cover(generator, studies, maps, draws))
            row[name] = f"{100 * np.mean(found):.1f}, {100 * np.min(found):.1f}"
        false = 100 * np.array(list(false_findings(generator, studies // 5, maps, draws)))
        for place, name in enumerate(("false: success", "false: T_total")):
            row[name] = f"{false[:, place].mean():.1f}, {false[:, place].max():.1f}"
        yield row


@_as_table
def times(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """Cover and width of the intervals of T_total and of its difference, beside those of a bootstrap."""
    for maps, draws, rate in product((8, 20, 30), DRAWS, (0.8, 0.95, 0.99)):
        generator = np.random.default_rng([seed, maps, draws, round(100 * rate)])
        row: dict[str, object] = {"maps": maps, "episodes a map": draws, "success": rate}
        found = cover_of_times(generator, studies // 3, maps, draws, (rate, rate - 0.1), studies // 20)
        for name, words in (("time", "T_total"), ("difference", "ΔT_total")):
            for how, by in (("", ""), ("_bootstrap", ", bootstrap")):
                cover, width = found[f"{name}_cover{how}"], found[f"{name}_width{how}"]
                row[words + by] = f"{100 * cover:.1f} ({width:.1f} s)"
        yield row


@_as_table
def groups(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """Cover and width of the intervals of success and of its difference on few, large groups."""
    for groups, episodes, like in product(GROUPS, IN_A_GROUP, GROUP_LIKENESS):
        generator = np.random.default_rng([seed, groups, episodes, *(round(100 * value) for value in like)])
        row: dict[str, object] = {
            "groups": groups,
            "episodes": episodes,
            "correlation": like[0],
            "shared": like[1],
        }
        covers: dict[str, object] = {}
        for rates in GROUP_RATES:
            found = cover_of_groups(generator, studies, groups, episodes, rates, like)
            one, other = (f"{rate:g}" for rate in rates)
            row[f"{one} − {other}"] = f"{100 * found['cover']:.1f} ({found['half']:.2f})"
            row[f"{one} − {other}, t"] = f"{100 * found['cover_t']:.1f} ({found['half_t']:.2f})"
            covers |= {name: f"{100 * found[f'cover_{i}']:.1f}" for i, name in enumerate((one, other))}
        yield row | covers


@_as_table
def best(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """How often a condition that is as good as the best is called worse, and one that is 10 or 20 points worse."""
    for settings, maps, draws in product((6, 12), (20, *MAPS), DRAWS):
        generator = np.random.default_rng([seed, settings, maps, draws])
        row: dict[str, object] = {"settings": settings, "maps": maps, "episodes a map": draws}

        half = settings // 2
        cases = {f"all tied, {rate:g}": [rate] * settings for rate in (0.8, 0.95)}
        for words, rates in (cases | {"half tied": [0.8] * half + [0.7] * half}).items():
            success, _ = drives(generator, rates, (studies, maps), draws, LIKENESS[1])
            tied = np.array(rates) == max(rates)
            row[words] = _share(called_worse(success.sum(-1), draws)[:, tied].any(1))
        for words, same_maps in (("unlike", False), ("unlike, same maps", True)):
            wins = unlike(generator, studies, settings, maps, draws, same_maps)
            row[words] = _share(called_worse(wins, draws).any(1))
        for points in (10, 20):
            rates = [0.8] * (settings - 1) + [0.8 - points / 100]
            success, _ = drives(generator, rates, (studies, maps), draws, LIKENESS[1])
            called = called_worse(success.sum(-1), draws)
            row[f"power, {points} points"] = f"{100 * called[:, -1].mean():.0f}"
        yield row


@_as_table
def hypotheses(studies: int, seed: int) -> Iterator[dict[str, object]]:
    """How often a single hypothesis is shown where it is false: no difference, or one as large as the margin."""
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
        yield row


def _share(found: np.ndarray) -> str:
    """A share in per cent with its 95 % interval of Clopper and Pearson."""
    ends = binomtest(int(found.sum()), len(found)).proportion_ci()
    return f"{100 * found.mean():.1f} ({100 * ends.low:.1f}–{100 * ends.high:.1f})"
