"""Tables of our episodes compared with published ones, as Markdown.

Intervals are Wilson's 95 % intervals over episodes. Two settings, or two runs, on the
same episodes are compared by the exact McNemar test. Ours are compared with theirs by
Fisher's exact test and Newcombe's interval (1998, "Interval estimation for the
difference between independent proportions: comparison of eleven methods", method 10).

The results of Cai et al. are counted in the log that they publish with their code,
`mppi_benchmark/envs_40_trials_5_densities_4_date_20220907-2234.pickle` in
https://github.com/mit-acl/mppi_numba, method `risk_dyn`. Their λ̂ is the mean of the
lowest fraction α of the distribution, which is our `cvar:1 − α`; α = 1 is our `mean`.
`published.csv` has the number of successes within 15 s in 200 episodes, and their mean
time. `published_pairs.csv` has, per density, the numbers of episodes in which only
`cvar:0.8` or only `mean` reached the goal.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import fisher_exact
from statsmodels.stats.proportion import confint_proportions_2indep

from benchnav.core.tables import NOTHING
from benchnav.stats.flips import sign_flip_p
from benchnav.stats.holm import holm
from benchnav.stats.intervals import wilson_interval

TRIALS = 200
LINE = ["density", "setting"]
PUBLISHED = pd.read_csv(Path(__file__).with_name("published.csv")).set_index(LINE)
PUBLISHED_PAIRS = pd.read_csv(
    Path(__file__).with_name("published_pairs.csv")
).set_index("density")
# Pairs of settings on the same episodes. The first pair is counted in their log too.
PAIRS = (("cvar:0.8", "mean"), ("cost-cvar:0.6", "cost"), ("cost-cvar:0.6", "cvar:0.6"))


def tabulate(rows: pd.DataFrame) -> str:
    """Return the table of success, and those of the pairs of settings that were run.

    Args:
        rows: one row per episode, from `run_trials`.
    """
    settings = set(rows["setting"])
    pairs = [tabulate_pairs(rows, *pair) for pair in PAIRS if {*pair} <= settings]
    return "\n\n".join([tabulate_success(rows), *pairs])


def tabulate_success(rows: pd.DataFrame) -> str:
    """Return success and mean time of successes, ours and theirs.

    p has Holm's correction over all lines.

    Args:
        rows: one row per episode, from `run_trials`.
    """
    ours = rows.groupby(LINE, sort=False).agg(
        arrived=("success", "sum"),
        trials=("success", "size"),
        mean_s=("time_s", "mean"),
    )
    lines, p = [], []
    for row in ours.join(PUBLISHED).itertuples():
        line = [
            *show_line(row.Index),
            show_share(row.arrived, row.trials),
            show_time(row.mean_s),
        ]
        if not np.isnan(row.successes):
            theirs = int(row.successes)
            table = [[row.arrived, row.trials - row.arrived], [theirs, TRIALS - theirs]]
            p.append(fisher_exact(table).pvalue)
            line += [show_share(theirs, TRIALS), show_time(row.time_s)]
            line += [show_difference(row.arrived, row.trials, theirs, TRIALS)]
        lines.append(line)
    corrected = map(show_p, holm(np.array(p)))
    lines = [
        [*line, next(corrected)] if len(line) == 7 else [*line, *4 * [NOTHING]]
        for line in lines
    ]
    header = ["vegetation", "setting", "success, %", "time, s"]
    return markdown(
        [*header, "theirs, %", "theirs, s", "ours − theirs", "p of ours = theirs"],
        lines,
    )


def tabulate_pairs(rows: pd.DataFrame, a: str, b: str) -> str:
    """Return the gain of setting `a` over setting `b` on the same episodes.

    For the first of `PAIRS` the gain in their log is added.

    Args:
        rows: one row per episode of both settings, from `run_trials`.
        a: setting whose gain is computed.
        b: setting to compare with.
    """
    won = wins(rows)
    won_a, won_b = won.xs(a, level="setting"), won.xs(b, level="setting")
    header = ["points", f"only `{a}`, only `{b}`", "p"]
    has_theirs = (a, b) == PAIRS[0]
    lines = []
    for density, changed in changes(won_a, won_b, ["density"]).items():
        line = [f"{100 * density:.0f} %", *show_changes(changed, sign_flip_p(changed))]
        if has_theirs and density in PUBLISHED_PAIRS.index:
            gained, lost = PUBLISHED_PAIRS.loc[density]
            theirs = np.repeat([1, -1, 0], [gained, lost, TRIALS - gained - lost])
            line += show_changes(theirs, sign_flip_p(theirs))
        lines.append(line + [NOTHING] * (3 * has_theirs + 4 - len(line)))
    columns = ["vegetation", *header]
    if has_theirs:
        columns += [f"theirs: {name}" for name in header]
    return markdown(columns, lines)


def tabulate_runs(runs: Mapping[str, pd.DataFrame]) -> str:
    """Return success and mean time of runs of the same episodes, and their differences.

    Differences are to the first run; p has Holm's correction over the lines of a run.

    Args:
        runs: rows of episodes by name of the run, from `run_trials`.
    """
    first, *others = runs
    means = {
        name: rows.groupby(LINE, sort=False)[["success", "time_s"]].mean()
        for name, rows in runs.items()
    }
    means["theirs"] = PUBLISHED.assign(success=PUBLISHED["successes"] / TRIALS)
    cells = {
        name: {
            row.Index: f"{100 * row.success:.1f}, {show_time(row.time_s)} s"
            for row in means_of_run.itertuples()
        }
        for name, means_of_run in means.items()
    }
    lines = [
        [
            *show_line(line),
            *(cells_of_run.get(line, NOTHING) for cells_of_run in cells.values()),
        ]
        for line in means[first].index
    ]
    tables = [markdown(["vegetation", "setting", *cells], lines)]
    for name in others:
        changed = changes(wins(runs[name]), wins(runs[first]), LINE)
        p_values = [sign_flip_p(differences) for differences in changed.values()]
        corrected = holm(np.array(p_values))
        lines = [
            [*show_line(line), *show_changes(differences, p)]
            for (line, differences), p in zip(changed.items(), corrected, strict=True)
        ]
        won = f"won only with {name}, only with {first}"
        tables.append(markdown(["vegetation", "setting", "points", won, "p"], lines))
    return "\n\n".join(tables)


def wins(rows: pd.DataFrame) -> pd.Series:
    """Return success as 0 or 1, by density, setting, map and realisation."""
    return rows.set_index([*LINE, "map", "realisation"])["success"].astype(int)


def changes(
    a: pd.Series, b: pd.Series, by: list[str]
) -> dict[tuple[float, str], np.ndarray]:
    """Return the differences a − b in success of each episode, by line.

    A difference is 1, 0 or −1. Lines are in the order of `b`.
    """
    paired = b.to_frame("b").join(a.rename("a"), how="inner")
    keys = by[0] if len(by) == 1 else by
    lines = (paired["a"] - paired["b"]).groupby(keys, sort=False)
    return {line: changed.to_numpy() for line, changed in lines}


def show_changes(changed: np.ndarray, p: float) -> list[str]:
    """Format a difference in points, the numbers of gains and losses, and p."""
    return [
        f"{100 * changed.mean():+.1f}",
        f"{(changed > 0).sum()}, {(changed < 0).sum()}",
        show_p(p),
    ]


def show_line(line: tuple[float, str]) -> list[str]:
    """Format density and setting."""
    return [f"{100 * line[0]:.0f} %", f"`{line[1]}`"]


def show_share(successes: int, trials: int) -> str:
    """Format a fraction in per cent with its interval."""
    low, high = wilson_interval(successes / trials, trials)
    return f"{100 * successes / trials:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def show_difference(a: int, n_a: int, b: int, n_b: int) -> str:
    """Format the difference a/n_a − b/n_b of independent rates with its interval."""
    low, high = confint_proportions_2indep(a, n_a, b, n_b, method="newcomb")
    return f"{100 * (a / n_a - b / n_b):+.1f} [{100 * low:.1f}, {100 * high:.1f}]"


def show_time(seconds: float) -> str:
    """Format seconds, or a dash if there is no success."""
    return NOTHING if np.isnan(seconds) else f"{seconds:.1f}"


def show_p(p: float) -> str:
    """Format a p-value."""
    return f"{p:.2f}" if p >= 0.1 else f"{p:.1g}"


def markdown(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Format a Markdown table; cells may contain Markdown."""
    return "\n".join(
        f"| {' | '.join(line)} |" for line in [header, ["---"] * len(header), *lines]
    )
